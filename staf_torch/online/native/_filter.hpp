// The Kalman filter of kalman_filter.py with a Gaussian kernel, a stream in every lane.
//
// All arithmetic is double, whatever the table holds. No number passes from one lane to another, and a stream
// alone takes the same path as a thousand: the bits of a stream do not depend on what stands beside it.
// DIM, COUNT (centers) and OUTPUTS are given on the command line of the compiler.

#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#if defined(__AVX512F__) && defined(__clang__)
#include <immintrin.h>
#elif defined(__AVX512F__)  // by the builtins alone: g++ reads that header for a tenth of all its time
#define _mm512_sqrt_pd(a) __builtin_ia32_sqrtpd512_mask(a, a, -1, 4)
#define _mm512_scalef_pd(a, b) __builtin_ia32_scalefpd512_mask(a, b, a, -1, 4)
#define _mm512_cvtps_pd(a) __builtin_ia32_cvtps2pd512_mask(a, __m512d{}, -1, 4)
#define _mm512_cvtpd_ps(a) __builtin_ia32_cvtpd2ps512_mask(a, __m256{}, -1, 4)
typedef double __m512d __attribute__((vector_size(64)));
typedef float __m256 __attribute__((vector_size(32)));
#endif

#ifndef REAL
#define REAL double
#endif
#define INLINE static inline __attribute__((always_inline))
typedef double V __attribute__((vector_size(64)));
typedef int64_t Mask __attribute__((vector_size(64)));  // lanes of 0 or -1
constexpr int lanes = 8, n = DIM, M = COUNT, K = OUTPUTS;
constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr double surprise = 25, streak_limit = 8, error_rate = .05;

INLINE V all(double x) { return V{} + x; }
INLINE V maximum(V a, V b) { return a > b ? a : b; }
INLINE V minimum(V a, V b) { return a < b ? a : b; }
INLINE V absolute(V a) { return a < 0 ? -a : a; }
INLINE V root(V a) {
#ifdef __AVX512F__  // the loop is scalar, as std::sqrt may set errno
    return (V)_mm512_sqrt_pd((__m512d)a);
#else
    for (int l = 0; l < lanes; ++l) a[l] = std::sqrt(a[l]);
    return a;
#endif
}
INLINE Mask finite(V a) { return a - a == V{}; }
INLINE bool any(Mask m) {
    int64_t found = 0;
    for (int l = 0; l < lanes; ++l) found |= m[l];
    return found != 0;
}

// e^x to an ulp or two, where streams are of floats to 3e-10; 0 below -708, e^709 above it.
INLINE V exponential(V x) {
    const V at = minimum(maximum(x, all(-708)), all(709)), shifted = at * 1.4426950408889634 + 0x1.8p52;
    const V whole = shifted - 0x1.8p52, r = (at - whole * 0x1.62e42feep-1) - whole * 0x1.a39ef35793c76p-33;
    constexpr double over[] = {1. / 6227020800, 1. / 479001600, 1. / 39916800, 1. / 3628800, 1. / 362880,
                               1. / 40320, 1. / 5040, 1. / 720, 1. / 120, 1. / 24, 1. / 6, 1. / 2, 1, 1};
    constexpr int first = sizeof(REAL) == sizeof(float) ? 5 : 0;
    V sum = all(over[first]);
    for (int j = first + 1; j < 14; ++j) sum = sum * r + over[j];
#ifdef __AVX512F__
    const V found = (V)_mm512_scalef_pd((__m512d)sum, (__m512d)whole);
#else
    const Mask power = ((Mask)shifted - (Mask)all(0x1.8p52) + 1022) << 52;  // 2^709 e^.3 fits in two steps
    const V found = sum * (V)power * 2.;
#endif
    return x < -708. ? V{} : x != x ? x : found;
}

struct Functions {  // of local_functions.py, in float64
    const double *offsets, *squares, *newton, *gram;  // d (M, n), |d|^2 (M), C (M, M) upper triangular, K0 (M, M)
    double rate, reach;                               // q; the largest |d|
};

struct Filter {  // of lanes streams
    V anchor[n], last[n], mean[K][M], learned[M * (M + 1) / 2], errors[K], largest, since;  // D's lower triangle
};

struct Law {
    V ratio, forgetting, slack2, robust, base;  // base: variance of the process in the units of y, at first
    double tiny, most, limit;  // the square root of the precision of the streams, their largest number, its 3/4th power
};

INLINE void functions_at(const Functions &f, const V *z, V *psi) {
    V e[M];
    for (int j = 0; j < M; ++j) {
        V apart{};
        for (int i = 0; i < n; ++i) {
            const V d = z[i] - f.offsets[j * n + i];
            apart += d * d;
        }
        e[j] = exponential(f.rate / 2 * (f.squares[j] - apart));
    }
    for (int i = 0; i < M; ++i) {
        psi[i] = V{};
        for (int j = 0; j <= i; ++j) psi[i] += f.newton[j * M + i] * e[j];
    }
}

// c(k, l) <- sum_j a(j, k) b(j, l) in blocks that stay in registers; for l <= k alone where that is enough.
// A factor that is upper triangular has no part in the sum beyond j = k, or l.
enum Triangular { neither, first, second };
template <bool lower, Triangular upper, typename A, typename B, typename Put> INLINE void product(A a, B b, Put put) {
    constexpr int side = M % 4 == 0 ? 4 : M % 3 == 0 ? 3 : M % 2 == 0 ? 2 : 1;
    for (int k = 0; k < M; k += side)
        for (int l = 0; l < (lower ? k + side : M); l += side) {
            V sum[side][side]{};
            for (int j = 0; j < (upper == first ? k + side : upper == second ? l + side : M); ++j)
                for (int p = 0; p < side; ++p)
                    for (int q = 0; q < side; ++q) sum[p][q] += a(j, k + p) * b(j, l + q);
            for (int p = 0; p < side; ++p)
                for (int q = 0; q < side; ++q)
                    if (!lower || l + q <= k + p) put(k + p, l + q, sum[p][q]);
        }
}

// u <- T u and D <- T D T' for a step h, and nothing where the step is too far for the kernel.
static void transfer(const Functions &f, const V *h, V mean[K][M], V *learned) {
    V square{}, before[M], after[M], T[M][M], half[M][M], whole[M][M];
    for (int i = 0; i < n; ++i) square += (h[i] / f.reach) * (h[i] / f.reach);
    const Mask near = square <= 1e16;
    V step[n];
    square = V{};
    for (int i = 0; i < n; ++i) step[i] = near ? h[i] : V{}, square += step[i] * step[i];
    const V shift = f.rate * root(square) * f.reach, lost = f.rate * square / 2;
    for (int j = 0; j < M; ++j) {
        V along{};
        for (int i = 0; i < n; ++i) along += f.offsets[j * n + i] * step[i];
        before[j] = exponential(f.rate * along - shift);
        after[j] = exponential(minimum(shift - f.rate * along - lost, all(700)));
    }
    for (int j = 0; j < M; ++j)
        for (int l = 0; l < M; ++l) whole[j][l] = before[j] * f.newton[j * M + l];
    product<false, second>([&](int j, int i) { return f.gram[j * M + i]; }, [&](int j, int l) { return whole[j][l]; },
                   [&](int i, int l, V sum) { half[i][l] = sum * after[i]; });
    product<false, first>([&](int i, int k) { return f.newton[i * M + k]; }, [&](int i, int l) { return half[i][l]; },
                   [&](int k, int l, V sum) { T[l][k] = near ? sum : V{}; });  // the transpose, to be read along rows
    for (int o = 0; o < K; ++o) {
        V moved[M]{};
        for (int l = 0; l < M; ++l)
            for (int k = 0; k < M; ++k) moved[k] += T[l][k] * mean[o][l];
        for (int k = 0; k < M; ++k) mean[o][k] = moved[k];
    }
    for (int i = 0; i < M; ++i)
        for (int j = 0; j <= i; ++j) whole[i][j] = whole[j][i] = learned[i * (i + 1) / 2 + j];
    product<false, neither>([&](int j, int k) { return T[j][k]; }, [&](int j, int l) { return whole[j][l]; },
                   [&](int k, int l, V sum) { half[l][k] = sum; });
    product<true, neither>([&](int j, int k) { return half[j][k]; }, [&](int j, int l) { return T[j][l]; },
                  [&](int k, int l, V sum) { learned[k * (k + 1) / 2 + l] = sum; });
}

INLINE V running_scale(const Law &law, V errors, V since) {
    const V trust = minimum(since, all(20)) / 20.;
    return maximum(errors * trust + law.base * (1. - trust), 1e-6 * law.base);
}

INLINE Mask is_fresh(const Filter &s) {
    V sum{};
    for (int i = 0; i < n; ++i) sum += s.anchor[i];
    return sum != sum;
}

// V's mean; psi'D psi, by which samples have made its variance less than 1, is returned. D's lower triangle is asked
// for by numbers.
template <typename Get>
INLINE V moments(const Functions &f, const V *z, const V known[K][M], Get learned, V mean[K]) {
    V psi[M], total{};
    functions_at(f, z, psi);
    for (int i = 0, at = 0; i < M; ++i) {
        V sum{};
        for (int j = 0; j < i; ++j) sum += learned(at++) * psi[j];
        total += psi[i] * (sum + sum + learned(at++) * psi[i]);
    }
    for (int o = 0; o < K; ++o) {
        mean[o] = V{};
        for (int i = 0; i < M; ++i) mean[o] += psi[i] * known[o][i];
    }
    return total;
}

// Mean and variance of the next y at x, a unit of time after the latest.
template <typename Get>
INLINE void predict(const Functions &f, const Law &law, const Filter &s, Get learned, const V *x, V mean[K],
                    V variance[K]) {
    V z[n];
    for (int i = 0; i < n; ++i) z[i] = (x[i] != x[i] ? s.last[i] : x[i]) - s.anchor[i];
    const V spread = 1. + law.ratio - law.forgetting * moments(f, z, s.mean, learned, mean);
    const Mask fresh = is_fresh(s);
    for (int o = 0; o < K; ++o) {
        mean[o] = fresh ? V{} : mean[o];
        variance[o] = fresh ? law.base * (1. + law.ratio) : spread * running_scale(law, s.errors[o], s.since);
    }
}

struct Verdict {  // on a sample
    Mask fine, afresh, moves;
    V streak, z[n];
};

// What is to be done with the sample: nothing is changed yet, but for the coordinates that were measured.
INLINE Verdict judge(const Law &law, Filter &s, V *x, V *y, Mask *seen, V streak) {
    Verdict v;
    V size{}, sum{};
    Mask some{}, sound{};
    for (int i = 0; i < n; ++i) sound |= x[i] == x[i];
    for (int i = 0; i < n; ++i) x[i] = x[i] != x[i] ? s.last[i] : x[i], sound &= finite(x[i]);
    for (int o = 0; o < K; ++o) {
        seen[o] = y[o] == y[o];
        some |= seen[o];
        y[o] = seen[o] ? y[o] : V{};
        sound &= finite(y[o]);
        size = maximum(size, absolute(y[o]));
    }
    sound &= some;
    const Mask huge = (s.since > 0.) & (s.largest > 0.) & (size * law.tiny > s.largest);
    const Mask small = (size > 0.) & (size < s.largest * law.tiny);
    v.streak = sound ? (huge | small ? streak + 1. : size == 0. ? streak : V{}) : streak;
    v.afresh = sound & ((v.streak >= streak_limit) | is_fresh(s));
    v.fine = sound & (~huge | v.afresh);
    for (int i = 0; i < n; ++i) {
        v.z[i] = v.fine & ~v.afresh ? x[i] - s.anchor[i] : V{};
        sum += v.z[i] * v.z[i];
    }
    v.moves = v.fine & (v.afresh | (sum > law.slack2));
    for (int i = 0; i < n; ++i) s.last[i] = finite(x[i]) ? x[i] : s.last[i];
    for (int o = 0; o < K; ++o) s.errors[o] = v.afresh ? V{} : s.errors[o];
    return v;
}

// The Kalman update at z from the anchor, where the result is finite: these lanes are returned. Where the centers
// have moved, `before` has the squared errors in units of the variance that was predicted before they did.
template <typename Get, typename Put>
INLINE Mask update(const Functions &f, const Law &law, Filter &s, Get learned, Put put, const V *z, const V *y,
                   const Mask *seen, V lapse, Mask fine, Mask moved, const V *before) {
    V psi[M], known[M]{}, gain[M], change[K], spread = 1. + law.ratio, share, total{}, peak{};
    functions_at(f, z, psi);
    share = lapse == 1. ? law.forgetting : V{};
    if (any(lapse != 1.))
        for (int l = 0; l < lanes; ++l) share[l] = lapse[l] == 1. ? share[l] : std::pow(law.forgetting[l], lapse[l]);
    for (int i = 0, at = 0; i < M; ++i) {
        V sum{};
        for (int j = 0; j < i; ++j) {
            const V entry = learned(at++);
            sum += entry * psi[j], known[j] += entry * psi[i];
        }
        known[i] = sum + learned(at++) * psi[i];
    }
    for (int i = 0; i < M; ++i) {
        known[i] *= share;
        spread -= psi[i] * known[i];
        gain[i] = psi[i] - known[i];
        total += gain[i] * 0.;  // not a number where one of them is not finite
    }
    const V rate = maximum(1. / (s.since + 1.), all(error_rate)), inverse = 1. / spread;
    V size = s.largest, errors[K];
    for (int o = 0; o < K; ++o) {
        V error = y[o];
        for (int i = 0; i < M; ++i) error -= psi[i] * s.mean[o][i];
        const V square = minimum(moved & finite(before[o]) ? before[o] : error * error * inverse, all(law.most));
        const V limited = minimum(square, all(law.limit));
        V kept = all(1);
        if (any(law.robust < infinity))  // a fifth of the time of a small filter
            kept = minimum(law.robust * root(running_scale(law, s.errors[o], s.since) / square), all(1));
        change[o] = seen[o] ? kept * error * inverse : V{};
        const V counted = s.since < streak_limit ? limited : minimum(limited, surprise * s.errors[o]);
        errors[o] = seen[o] ? s.errors[o] + rate * (counted - s.errors[o]) : s.errors[o];
        size = maximum(size, absolute(y[o]));
        for (int i = 0; i < M; ++i) {
            const V next = s.mean[o][i] + gain[i] * change[o];
            total += next * 0., peak = maximum(peak, absolute(next));
        }
    }
    const Mask good = fine & (spread > 0.) & (total == 0.) & finite(spread) & (peak <= law.most);
    s.largest = good ? size : s.largest;
    s.since = good ? s.since + 1. : s.since;
    for (int o = 0; o < K; ++o) {
        s.errors[o] = good ? errors[o] : s.errors[o];
        for (int i = 0; i < M; ++i) s.mean[o][i] = good ? s.mean[o][i] + gain[i] * change[o] : s.mean[o][i];
    }
    for (int i = 0, at = 0; i < M; ++i) {
        const V part = gain[i] * inverse;
        for (int j = 0; j <= i; ++j, ++at) {
            const V old = learned(at), next = old * share + part * gain[j];
            put(at, good ? next : old * share);  // time passes, whatever becomes of the sample
        }
    }
    return good;
}
