// Elementary functions of a vector, within the bounds that tests/lanes/test_functions.py states; infinities, NaN,
// signed zeros and subnormal numbers come out as they should. A polynomial is a Taylor polynomial on a range that
// a reduction makes small, in two chains, odd and even, so that the processor can run them side by side.

#pragma once

// A text with many calls is compiled in a fifth of the time where a function is there once.
#if LANES_CALLS
#define FUNCTION static __attribute__((noinline, unused))
#else
#define FUNCTION INLINE
#endif

template <bool> struct Format;
template <> struct Format<false> {
    static constexpr int digits = 52, bias = 1023, exp_terms = 13, log_terms = 11, sine_terms = 8, cosine_terms = 8;
    static constexpr double magic = 0x1.8p52, whole = 0x1p51, tiny = 0x1p-1022;
    static constexpr double log2_high = 0x1.62e42feep-1, log2_low = 0x1.a39ef35793c76p-33;
    static constexpr double most = 750, high = 710, flat = 20, minus_one = -40;
    static constexpr double quarter[] = {0x1.921fb5444p+0, 0x1.68c234c4cp-39, 0x1.98a2e037p-77, 0x1.cd129024e088ap-115};
    static constexpr double far = 0x1p16;  // beyond it the quarter turns need more digits than these
    static constexpr int64_t root_half = 0x3fe6a09e667f3bcd;
};
template <> struct Format<true> {
    static constexpr int digits = 23, bias = 127, exp_terms = 7, log_terms = 5, sine_terms = 4, cosine_terms = 5;
    static constexpr float magic = 0x1.8p23f, whole = 0x1p22f, tiny = 0x1p-126f;
    static constexpr float log2_high = 0x1.62e4p-1f, log2_low = 0x1.7f7d1cp-20f;
    static constexpr float most = 110, high = 89, flat = 10, minus_one = -18;
    static constexpr float quarter[] = {0x1.92p+0f, 0x1.fb4p-12f, 0x1.444p-24f, 0x1.68c234p-39f};
    static constexpr float far = 0x1p12f;
    static constexpr int32_t root_half = 0x3f3504f3;
};
typedef Format<single> F;

INLINE V rounded_even(V x) {
    const V size = abs(x), near = (size + F::magic) - F::magic;  // beyond `whole` every number is whole
    return with_sign(size < F::whole ? near : size, x);
}
INLINE V floor(V x) {
    const V near = rounded_even(x);
    return with_sign(near > x ? near - 1 : near, x);
}
INLINE V ceil(V x) { return -floor(-x); }
INLINE V trunc(V x) { return with_sign(floor(abs(x)), x); }
INLINE V round(V x) { return rounded_even(x); }

constexpr REAL over_factorial[] = {
    1, 1, REAL(1. / 2), REAL(1. / 6), REAL(1. / 24), REAL(1. / 120), REAL(1. / 720), REAL(1. / 5040), REAL(1. / 40320),
    REAL(1. / 362880), REAL(1. / 3628800), REAL(1. / 39916800), REAL(1. / 479001600), REAL(1. / 6227020800),
    REAL(1. / 87178291200), REAL(1. / 1307674368000), REAL(1. / 20922789888000), REAL(1. / 355687428096000),
};
#define UNROLLED _Pragma("GCC unroll 16")
INLINE V power_of_two(VB n) { return real((n + F::bias) << F::digits); }

// x 2^n, rounded once: 2^n alone need not be a normal number. n as bits, and as the number `whole`.
INLINE V times_power(V x, VB n, V whole) {
#if LANES_512
    (void)n;
#if LANES_SINGLE
    return (V)__builtin_ia32_scalefps512_mask(x, whole, x, -1, 4);
#else
    return (V)__builtin_ia32_scalefpd512_mask(x, whole, x, -1, 4);
#endif
#else
    (void)whole;
    const VB half = n >> 1;
    return x * power_of_two(half) * power_of_two(n - half);
#endif
}

// x = n log(2) + r, |r| <= log(2) / 2: n as bits and as a number, and e^r - 1 = r + r^2 (even + r odd) by its parts.
struct Reduced {
    VB n;
    V whole, r, square, even, odd;
    INLINE_METHOD V rest() const { return fma(square, fma(r, odd, even), r); }
    INLINE_METHOD V rest_of_minus() const { return fma(square, fma(-r, odd, even), -r); }
};
INLINE Reduced reduced_exponential(V x) {
    const V rounded = fma(x, splat(REAL(1.4426950408889634)), splat(F::magic)), whole = rounded - F::magic;
    const V r = fma(-whole, splat(F::log2_low), fma(-whole, splat(F::log2_high), x)), square = r * r;
    constexpr int top = F::exp_terms;
    V odd = splat(over_factorial[top]), even = splat(over_factorial[top - 1]);
    UNROLLED for (int k = top - 2; k > 1; k -= 2) {
        odd = fma(odd, square, splat(over_factorial[k]));
        if (k > 2) even = fma(even, square, splat(over_factorial[k - 1]));
    }
    return {bits(rounded) - bits(splat(F::magic)), whole, r, square, even, odd};
}
INLINE V clamped(V x, REAL low, REAL high) { return least(greatest(x, low), high); }
FUNCTION V exp(V x) {
    const Reduced parts = reduced_exponential(clamped(x, -F::most, F::most));
    return times_power(1 + parts.rest(), parts.n, parts.whole);
}
// exp(-x), bit by bit: beside an exp(x) it costs next to nothing, for the compiler finds their parts once.
FUNCTION V exp_of_minus(V x) {
    const Reduced parts = reduced_exponential(clamped(x, -F::most, F::most));
    return times_power(1 + parts.rest_of_minus(), -parts.n, -parts.whole);
}
FUNCTION V expm1(V x) {
    const Reduced parts = reduced_exponential(clamped(x, F::minus_one, F::high));
    const V rest = parts.rest(), half = power_of_two(parts.n - 1);
    const V found = 2 * fma(half, rest, half - REAL(0.5));
    return with_sign(abs(parts.n == 0 ? rest : found), x);  // half of the smallest number is none
}
// e / (e + 2) with e = e^{2|x|} - 1, which loses no digit of a small x.
FUNCTION V tanh(V x) {
    const V at = least(abs(x), F::flat);
    const Reduced parts = reduced_exponential(2 * at);
    const V power = power_of_two(parts.n), e = fma(power, parts.rest(), power - 1);
    return with_sign(e / (e + 2), x);
}

// log(1 + f) + k log(2) + low, f - f^2/2 + s (f^2/2 + q) with s = f / (2 + f) and the series of 2 artanh(s).
INLINE V logarithm(V f, V k, V low) {
    const V s = f / (2 + f), z = s * s, half = REAL(0.5) * f * f;
    constexpr int top = F::log_terms;
    V q = splat(REAL(2. / (2 * top + 1)));
    UNROLLED for (int j = top - 1; j > 0; --j) q = fma(q, z, splat(REAL(2. / (2 * j + 1))));
    const V tail = fma(s, fma(q, z, half), fma(k, splat(F::log2_low), low));
    return fma(k, splat(F::log2_high), f - (half - tail));
}
// x = 2^k m with m between the roots of 1/2 and 2, x positive and normal.
INLINE V mantissa(V x, V &k) {
    const VB e = (bits(x) - F::root_half) >> F::digits;
    k = real(e + bits(splat(F::magic))) - F::magic;
    return real(bits(x) - (e << F::digits));
}
FUNCTION V log(V x) {
    const M small = x < F::tiny;
    V k;
    const V m = mantissa(small ? x * (REAL(2) * (Bits(1) << F::digits)) : x, k);
    V result = logarithm(m - 1, small ? k - (F::digits + 1) : k, V{});
    result = x == REAL(__builtin_inf()) ? x : result;
    result = x == 0 ? splat(REAL(-__builtin_inf())) : result;
    return (x < 0) | (x != x) ? splat(REAL(__builtin_nan(""))) : result;
}
INLINE V with_zero(V found, V x) { return x == 0 ? x : found; }  // -0 stays
FUNCTION V log1p(V x) {
    V k;
    const V u = 1 + x, m = mantissa(u, k), lost = x - (u - 1);
    V result = k == 0 ? logarithm(x, k, V{}) : logarithm(m - 1, k, lost / u);
    result = x == REAL(__builtin_inf()) ? x : result;
    result = x == -1 ? splat(REAL(-__builtin_inf())) : result;
    return (x < -1) | (x != x) ? splat(REAL(__builtin_nan(""))) : with_zero(result, x);
}

// x = n pi/2 + r + rest, |r| <= pi/4: every product but the last is exact, every sum is kept with what it lost.
INLINE V reduced_angle(V x, VB &n, V &rest) {
    const V rounded = x * REAL(0.63661977236758134) + F::magic, whole = rounded - F::magic;
    n = bits(rounded);
    V r = x - whole * F::quarter[0], lost = V{};
    UNROLLED for (int k = 1; k < 4; ++k) {
        const V product = whole * F::quarter[k], next = r - product, back = next - r;
        lost += (r - (next - back)) - (product + back);
        r = next;
    }
    rest = lost;
    return r;
}
INLINE V sine_of(V r, V rest) {
    const V z = r * r;
    V sum = splat(over_factorial[2 * F::sine_terms + 1] * (F::sine_terms % 2 ? -1 : 1));
    UNROLLED for (int k = F::sine_terms - 1; k > 0; --k) sum = fma(sum, z, splat(over_factorial[2 * k + 1] * (k % 2 ? -1 : 1)));
    return r + fma(r * z, sum, fma(rest, z * REAL(-0.5), rest));
}
INLINE V cosine_of(V r, V rest) {
    const V z = r * r, half = z * REAL(0.5), near = 1 - half;
    V sum = splat(over_factorial[2 * F::cosine_terms] * (F::cosine_terms % 2 ? -1 : 1));
    UNROLLED for (int k = F::cosine_terms - 1; k > 1; --k) sum = fma(sum, z, splat(over_factorial[2 * k] * (k % 2 ? -1 : 1)));
    return near + (((1 - near) - half) + fma(z * z, sum, -r * rest));
}
// A lane with a large argument goes to the library's own function, which knows pi to a thousand digits.
#define WITH_FAR(name, near)                                                                                \
    static __attribute__((noinline)) V far_##name(V x, V found) {                                           \
        REAL at[W], out[W];                                                                                 \
        store(at, x), store(out, found);                                                                    \
        for (int l = 0; l < W; ++l)                                                                         \
            if (!(at[l] <= F::far && at[l] >= -F::far))                                                     \
                out[l] = single ? __builtin_##name##f(at[l]) : __builtin_##name(at[l]);                     \
        return load(out);                                                                                   \
    }                                                                                                       \
    FUNCTION V name(V x) {                                                                                  \
        const M distant = ~(abs(x) <= F::far);                                                              \
        VB n;                                                                                               \
        V rest;                                                                                             \
        const V r = reduced_angle(distant ? V{} : x, n, rest);                                              \
        const V found = near;                                                                               \
        return __builtin_expect(any(distant), 0) ? far_##name(x, found) : found;                            \
    }
INLINE V turned(V r, V rest, VB n) {  // the sine of r + n pi/2
    const V found = (n & 1) != 0 ? cosine_of(r, rest) : sine_of(r, rest);
    return real(bits(found) ^ ((n & 2) << (8 * sizeof(REAL) - 2)));
}
WITH_FAR(sin, with_zero(turned(r, rest, n), x))
WITH_FAR(cos, turned(r, rest, n + 1))
WITH_FAR(tan, with_zero(turned(r, rest, n) / turned(r, rest, n + 1), x))

#define LIBM(name)                                                                                          \
    static __attribute__((noinline)) V name(V x) {                                                          \
        EACH_LANE(single ? __builtin_##name##f(lane[l]) : __builtin_##name(lane[l]))                        \
    }
LIBM(asin) LIBM(acos) LIBM(atan) LIBM(sinh) LIBM(cosh) LIBM(log2) LIBM(log10) LIBM(exp2) LIBM(erf)
LIBM(asinh) LIBM(acosh) LIBM(atanh) LIBM(erfc) LIBM(lgamma)
#define LIBM_TWO(name)                                                                                      \
    static __attribute__((noinline)) V name(V x, V y) {                                                     \
        REAL other[W];                                                                                      \
        store(other, y);                                                                                    \
        EACH_LANE(single ? __builtin_##name##f(lane[l], other[l]) : __builtin_##name(lane[l], other[l]))    \
    }
LIBM_TWO(atan2) LIBM_TWO(pow) LIBM_TWO(hypot)
INLINE V copysign(V size, V sign) { return with_sign(abs(size), sign); }

// Philox 4x32-10 (lanes/philox.py): words of 32 bits in lanes of 64. The numbers that come in are whole and small.
typedef uint64_t Words __attribute__((vector_size(8 * W)));
typedef int64_t Wholes __attribute__((vector_size(8 * W)));
INLINE Words word_of(V low, V high) {
    return (Words)__builtin_convertvector(low, Wholes) | (Words)__builtin_convertvector(high, Wholes) << 16;
}
INLINE Words product_of(Words x, Words y) {  // of numbers below 2^32, for which the processor has an instruction
#if defined(__clang__) || LANES_SINGLE
    return x * y;
#elif LANES_512
    typedef int Ints __attribute__((vector_size(64)));
    typedef long long Longs __attribute__((vector_size(64)));
    return (Words)__builtin_ia32_pmuludq512_mask((Ints)x, (Ints)y, Longs{}, -1);
#elif defined(__AVX2__)
    typedef int Ints __attribute__((vector_size(32)));
    return (Words)__builtin_ia32_pmuludq256((Ints)x, (Ints)y);
#else
    return x * y;
#endif
}
INLINE V philox(V a, V b, V c, V d, V low, V high, V place, bool second) {
    const uint64_t word = 0xFFFFFFFF;
    Words one = word_of(a, b), other = word_of(c, d);
    Words x = word_of(low, high), y = (Words)__builtin_convertvector(place, Wholes), z = {}, w = {};
    UNROLLED for (int k = 0; k < 10; ++k) {
        const Words p = product_of(x, Words{} + 0xD2511F53u), q = product_of(z, Words{} + 0xCD9E8D57u);
        x = (q >> 32) ^ y ^ one, y = q & word, z = (p >> 32) ^ w ^ other, w = p & word;
        one = (one + 0x9E3779B9u) & word, other = (other + 0xBB67AE85u) & word;
    }
    const Words whole = second ? z << 21 | w >> 11 : x << 21 | y >> 11;
    return __builtin_convertvector((Wholes)(whole - (Words{} + (uint64_t(1) << 52))), V) * REAL(0x1p-52);
}
INLINE V philox_first(V a, V b, V c, V d, V e, V f, V g) { return philox(a, b, c, d, e, f, g, false); }
INLINE V philox_second(V a, V b, V c, V d, V e, V f, V g) { return philox(a, b, c, d, e, f, g, true); }

// x - q y with q = x / y towards 0. The quotient as it is rounded may be one off, also across a whole number; the
// rest is exact with one rounding, and so is the step back. Large quotients go to the library's own function.
#if defined(__AVX512F__) || defined(__FMA__) || defined(__ARM_FEATURE_FMA)
static __attribute__((noinline)) V far_fmod(V x, V y, V found, M distant) {
    const V chosen = number(distant);
    REAL a[W], b[W], out[W], other[W];
    store(a, x), store(b, y), store(out, found), store(other, chosen);
    for (int l = 0; l < W; ++l)
        if (other[l] != 0) out[l] = single ? __builtin_fmodf(a[l], b[l]) : __builtin_fmod(a[l], b[l]);
    return load(out);
}
INLINE V fmod(V x, V y) {
    const V size = abs(x), unit = abs(y), whole = floor(size / unit);
    const M near = (whole < F::whole) & (unit < REAL(__builtin_inf()));
    V rest = fma(-whole, unit, size);
    rest = rest < 0 ? rest + unit : rest;
    rest = rest >= unit ? rest - unit : rest;
    const V found = with_sign(abs(rest), x);
    return __builtin_expect(any(~near), 0) ? far_fmod(x, y, found, ~near) : found;
}
#else
LIBM_TWO(fmod)
#endif
