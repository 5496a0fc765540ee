// The Kalman filter of kalman_filter.py with a Gaussian kernel, a stream in every lane.
//
// All arithmetic is double, whatever the table holds. No number passes from one lane to another, and a stream
// alone takes the same path as a thousand: the bits of a stream do not depend on what stands beside it.
// DIM, COUNT (centers), OUTPUTS and LANES are given on the command line of the compiler. Vectors wider than the
// registers would live in memory, where g++ moves them number by number: a filter takes six times as long.

#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#ifndef LANES
#define LANES 8  // of `Bank`, whose members stand in eights
#endif
#if defined(__AVX512F__) && LANES == 8
#define WHOLE_512 1
#else
#define WHOLE_512 0
#endif
#if WHOLE_512 && defined(__clang__)
#include <immintrin.h>
#elif WHOLE_512  // by the builtins alone: g++ reads that header for a tenth of all its time
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
#ifdef __NO_INLINE__  // by -O0, where a copy for every call is what takes time to compile
#define INLINE static inline
#else
#define INLINE static inline __attribute__((always_inline))
#endif
typedef double V __attribute__((vector_size(8 * LANES)));
typedef int64_t Mask __attribute__((vector_size(8 * LANES)));  // lanes of 0 or -1
constexpr int lanes = LANES, n = DIM, M = COUNT, K = OUTPUTS;
constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr double surprise = 25, streak_limit = 8, error_rate = .05, spread_rate = 1e-3, least_part = 1e-3, novel = 4;

INLINE V all(double x) { return V{} + x; }
INLINE V maximum(V a, V b) { return a > b ? a : b; }
INLINE V minimum(V a, V b) { return a < b ? a : b; }
INLINE V absolute(V a) { return a < 0 ? -a : a; }
INLINE V root(V a) {
#if WHOLE_512  // the loop is scalar, as std::sqrt may set errno
    return (V)_mm512_sqrt_pd((__m512d)a);
#elif defined(__AVX__) && LANES == 4
    return (V)__builtin_ia32_sqrtpd256(a);
#else
    for (int l = 0; l < lanes; ++l) a[l] = std::sqrt(a[l]);
    return a;
#endif
}
// sqrt(a^2 + b^2), whose squares may be no numbers.
INLINE V hypotenuse(V a, V b) {
    const V size = maximum(maximum(absolute(a), absolute(b)), all(1e-300));
    a /= size, b /= size;
    return size * root(a * a + b * b);
}
INLINE Mask finite(V a) { return a - a == V{}; }
INLINE bool any(Mask m) {
    int64_t found = 0;
    for (int l = 0; l < lanes; ++l) found |= m[l];
    return found != 0;
}

// A vector in the pieces that registers hold: what takes time goes through them one after the other, as g++
// moves a vector of several number by number.
#if WHOLE_512
#define PIECE 64
#elif defined(__AVX__) && LANES >= 4
#define PIECE 32
#else
#define PIECE 16
#endif
typedef double Piece __attribute__((vector_size(PIECE), aligned(8), may_alias));
constexpr int pieces = sizeof(V) / sizeof(Piece);
INLINE Piece &piece(void *of, int p) { return static_cast<Piece *>(of)[p]; }
INLINE const Piece &piece(const void *of, int p) { return static_cast<const Piece *>(of)[p]; }

// e^x to an ulp or two, where streams are of floats to 3e-10; 0 below -708, e^709 above it.
INLINE Piece exponential_of(Piece x) {
    const Piece least = Piece{} - 708., most = Piece{} + 709., middle = Piece{} + 0x1.8p52;
    Piece at = x > least ? x : least;
    at = at < most ? at : most;
    const Piece shifted = at * 1.4426950408889634 + middle, whole = shifted - middle;
    const Piece r = (at - whole * 0x1.62e42feep-1) - whole * 0x1.a39ef35793c76p-33;
    constexpr double over[] = {1. / 6227020800, 1. / 479001600, 1. / 39916800, 1. / 3628800, 1. / 362880,
                               1. / 40320, 1. / 5040, 1. / 720, 1. / 120, 1. / 24, 1. / 6, 1. / 2, 1, 1};
    constexpr int first = sizeof(REAL) == sizeof(float) ? 5 : 0;
    Piece sum = Piece{} + over[first];
    for (int j = first + 1; j < 14; ++j) sum = sum * r + over[j];
#if WHOLE_512
    const Piece found = (Piece)_mm512_scalef_pd((__m512d)sum, (__m512d)whole);
#else
    typedef decltype(x < x) Lanes;
    const Lanes power = ((Lanes)shifted - (Lanes)middle + 1022) << 52;  // 2^709 e^.3 fits in two steps
    const Piece found = sum * (Piece)power * 2.;
#endif
    return x < -708. ? Piece{} : x != x ? x : found;
}
INLINE V exponential(V x) {
#if PIECE == 8 * LANES
    return exponential_of(x);
#else
    for (int p = 0; p < pieces; ++p) piece(&x, p) = exponential_of(piece(&x, p));
    return x;
#endif
}

#ifdef OWN
typedef V Number;  // a stream's own, of local_functions.py
#else
typedef double Number;
#endif
INLINE V all(V x) { return x; }
struct Functions {  // of local_functions.py, in float64
    const Number *offsets, *squares, *newton, *gram;  // d (M, n), |d|^2 (M), C (M, M) upper triangular, K0 (M, M)
    Number rate, reach;                               // q; the largest |d|
};

struct Filter {  // of lanes streams
    V anchor[n], last[n], mean[K + 1][M], learned[M * (M + 1) / 2];  // D's lower triangle
    V errors[K], surprises[K], told[K], level[K], spread[K], leaps[K], value[K], usual, largest, since;
};

struct Law {
    V ratio, forgetting, slack2, robust;
    Number size;  // standard deviation of the process in the units of y, at first
    double tiny, most;  // the square root of the precision of the streams, their largest number
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
static void transfer(const Functions &f, const V *h, V mean[K + 1][M], V *learned) {
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
    for (int o = 0; o <= K; ++o) {
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

INLINE Mask is_fresh(const Filter &s) {
    V sum{};
    for (int i = 0; i < n; ++i) sum += s.anchor[i];
    return sum != sum;
}

// V's mean; psi'D psi, by which samples have made its variance less than 1, is returned. D's lower triangle is asked
// for by numbers.
template <typename Get>
INLINE V moments(const Functions &f, const V *z, const V known[K + 1][M], Get learned, V mean[K + 1]) {
    V psi[M], total{};
    functions_at(f, z, psi);
    for (int i = 0, at = 0; i < M; ++i) {
        V sum{};
        for (int j = 0; j < i; ++j) sum += learned(at++) * psi[j];
        total += psi[i] * (sum + sum + learned(at++) * psi[i]);
    }
    for (int o = 0; o <= K; ++o) {
        mean[o] = V{};
        for (int i = 0; i < M; ++i) mean[o] += psi[i] * known[o][i];
    }
    return total;
}

// The deviation of y, that of the prior where it has been constant; and the amplitude that the errors say.
INLINE V spread_of(const Law &law, const Filter &s, int o) {
    return s.spread[o] > 1e-15 * absolute(s.level[o]) ? s.spread[o] : all(law.size);
}
INLINE V amplitude_of(const Law &law, const Filter &s, int o) {
    V found = s.errors[o];
    if (any(s.told[o] < 22.)) {  // roots take time
        const V trust = minimum(maximum(s.told[o] - 2., V{}), all(20)) / 20.;
        found = hypotenuse(s.errors[o] * root(trust), law.size * root(1. - trust));
    }
    return maximum(found, least_part * spread_of(law, s, o));
}

struct Outlook {  // on the next y
    V mean[K], deviation[K], weight[K], amplitude[K];  // weight: of the square, what the amplitude makes
};
// From psi'u of every output and of one that is always 1, and the share of V's variance that is unknown.
INLINE Outlook outlook(const Law &law, const Filter &s, const V *expected, V unknown) {
    Outlook found;
    const V most = minimum(novel * s.usual, 1. - (1. - s.usual) / 4.), one = expected[K];
    const V away = minimum(maximum((unknown - most) / maximum(1. - most, all(1e-9)), V{}), all(1));
    const V part = root(minimum(unknown, most) + law.ratio);
    for (int o = 0; o < K; ++o) {
        found.amplitude[o] = amplitude_of(law, s, o);
        const V near = found.amplitude[o] * part, far = maximum(spread_of(law, s, o), near);
        const V square = (near / far) * (near / far), whole = away + (1. - away) * square;
        found.mean[o] = expected[o] + s.level[o] * (1. - one);
        found.deviation[o] = far * root(whole), found.weight[o] = square < 1. ? (1. - away) * square / whole : all(1);
    }
    return found;
}

// Mean and deviation of the next y at x, a unit of time after the latest.
template <typename Get>
INLINE void predict(const Functions &f, const Law &law, const Filter &s, Get learned, const V *x, V mean[K],
                    V deviation[K]) {
    V z[n], expected[K + 1];
    for (int i = 0; i < n; ++i) z[i] = (x[i] != x[i] ? s.last[i] : x[i]) - s.anchor[i];
    const V unknown = 1. - law.forgetting * moments(f, z, s.mean, learned, expected);
    const Outlook found = outlook(law, s, expected, minimum(maximum(unknown, V{}), all(1)));
    const Mask fresh = is_fresh(s);
    for (int o = 0; o < K; ++o) {
        mean[o] = fresh ? V{} : found.mean[o];
        deviation[o] = fresh ? law.size * root(1. + law.ratio) : found.deviation[o];
    }
}

struct Verdict {  // on a sample
    Mask fine, afresh, moves, stays;  // stays: x is what it was
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
    v.stays = Mask{} == Mask{};
    for (int i = 0; i < n; ++i) v.stays &= x[i] == s.last[i], s.last[i] = finite(x[i]) ? x[i] : s.last[i];
    if (any(v.afresh))
        for (V *part = s.errors; part <= &s.since; ++part) *part = v.afresh ? V{} : *part;
    return v;
}

// A value, at most so many times its running size, each in a row so many more; and how many are in a row.
INLINE V limited(V value, V running, V told, V &row) {
    const double step = std::sqrt(surprise);
    const Mask large = (told >= streak_limit + 2.) & (value > step * running);
    if (any(large)) value = large ? minimum(value, exponential((1. + row) * std::log(step)) * running) : value;
    row = large ? minimum(row + 1., all(100)) : V{};
    return value;
}
// The running errors of an output after one of so many deviations, and the running mean and deviation of y.
INLINE void learn_scales(const Law &law, Filter &s, int o, V y, V away, V weight, V amplitude, Mask good) {
    const V inside = maximum(1. + weight * (away * away - 1.), V{}), told = s.told[o], spread = spread_of(law, s, o);
    const V counted = minimum(amplitude * root(inside), all(1e300));
    V surprises = s.surprises[o], leaps = s.leaps[o];
    const V size = limited(counted, maximum(s.errors[o], least_part * spread), told, surprises);
    V kept = all(std::sqrt(1 - error_rate)), taken = all(std::sqrt(error_rate));
    V slow = all(spread_rate), fading = all(std::sqrt(1 - spread_rate)), coming = all(std::sqrt(spread_rate));
    if (any(told < 2 / spread_rate)) {  // roots take time
        const V rate = maximum(1. / maximum(told - 1., all(1)), all(error_rate));
        kept = root(1. - rate), taken = root(rate);
        slow = maximum(minimum(3. / (told + 3.), 1. / maximum(told - 40., all(1))), all(spread_rate));
        fading = root(1. - slow), coming = root(slow);
    }
    const V errors = minimum(hypotenuse(kept * s.errors[o], taken * size), all(law.most));
    s.errors[o] = good ? (told >= 2. ? errors : V{}) : s.errors[o];
    s.surprises[o] = good ? surprises : s.surprises[o];
    const V apart = limited(absolute(y - s.level[o]), spread, told > 0. ? s.since : V{}, leaps), step = y < s.level[o] ? -apart : apart;
    const V deviation = minimum(fading * hypotenuse(s.spread[o], coming * step), all(law.most));
    const V level = minimum(maximum(s.level[o] + slow * step, all(-law.most)), all(law.most));
    s.told[o] = good & ((deviation > 0.) | (told == 0.)) ? minimum(told + 1., all(2 / spread_rate)) : told;
    s.level[o] = good ? level : s.level[o], s.spread[o] = good ? deviation : s.spread[o];
    s.leaps[o] = good ? leaps : s.leaps[o];
}

// The Kalman update at z from the anchor, where the result is finite: these lanes are returned. Where the centers
// have moved, `before` has what was expected before they did, and the unknown share behind it.
template <typename Get, typename Put>
INLINE Mask update(const Functions &f, const Law &law, Filter &s, Get learned, Put put, const V *z, const V *y,
                   const Mask *seen, V lapse, Mask fine, Mask stays, Mask moved, const V *before) {
    V psi[M], known[M]{}, gain[M], left[K + 1], expected[K + 1], kept[K], away[K], spread = 1. + law.ratio, share, total{}, peak{};
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
    V inverse = 1. / spread, unknown = moved ? before[K + 1] : spread - law.ratio;
    unknown = minimum(maximum(unknown, V{}), all(1));
    for (int o = 0; o <= K; ++o) {
        V sum{};
        for (int i = 0; i < M; ++i) sum += psi[i] * s.mean[o][i];
        left[o] = (o < K ? y[o] : all(1)) - sum;
        expected[o] = moved ? before[o] : sum;
    }
    const Outlook view = outlook(law, s, expected, unknown);
    V size = s.largest;
    V next[K + 1][M];
    for (int i = 0; i < M; ++i) {
        next[K][i] = s.mean[K][i] + gain[i] * left[K] * inverse;
        total += next[K][i] * 0., peak = maximum(peak, absolute(next[K][i]));
    }
    for (int o = 0; o < K; ++o) {
        const V of_level = s.level[o] * left[K];
        // nothing was expected of the first value, nor where a number overflows
        const Mask expects = (s.told[o] > 0.) & finite(view.mean[o]) & finite(view.deviation[o]);
        away[o] = expects ? minimum(absolute(y[o] - view.mean[o]) / view.deviation[o], all(1e150)) : V{};
        kept[o] = away[o] > law.robust ? law.robust / away[o] : all(1);
        const V change = seen[o] ? (kept[o] < 1. ? kept[o] * (left[o] - of_level) + of_level : left[o]) * inverse : V{};
        const Mask first = seen[o] & (s.told[o] == 0.);  // as if it had always been so
        size = maximum(size, absolute(y[o]));
        for (int i = 0; i < M; ++i) {
            next[o][i] = first ? y[o] * next[K][i] : s.mean[o][i] + gain[i] * change;
            total += next[o][i] * 0., peak = maximum(peak, absolute(next[o][i]));
        }
    }
    const Mask good = fine & (spread > 0.) & (total == 0.) & finite(spread) & (peak <= law.most);
    s.largest = good ? size : s.largest;
    Mask some{};
    for (int o = 0; o < K; ++o) {  // a sample that repeats the last one says nothing of errors, unless all have been alike
        const Mask says = good & seen[o] & ~(stays & (y[o] == s.value[o]) & (s.told[o] >= 2.));
        learn_scales(law, s, o, y[o], away[o], view.weight[o], view.amplitude[o], says);
        s.value[o] = good & seen[o] ? y[o] : s.value[o], some |= says;
    }
    const V followed = maximum(1. / maximum(s.since, all(1)), all(error_rate));
    s.usual = some ? (s.since > 0. ? s.usual + followed * (unknown - s.usual) : V{}) : s.usual;
    s.since = good ? s.since + 1. : s.since;
    for (int o = 0; o <= K; ++o)
        for (int i = 0; i < M; ++i) s.mean[o][i] = good ? next[o][i] : s.mean[o][i];
    for (int i = 0, at = 0; i < M; ++i) {
        const V part = gain[i] * inverse;
        for (int j = 0; j <= i; ++j, ++at) {
            const V old = learned(at), next = old * share + part * gain[j];
            put(at, good ? next : old * share);  // time passes, whatever becomes of the sample
        }
    }
    return good;
}
