// Elementary functions of a block, each within a few units in the last place; inf, subnormal numbers and
// NaN come out as they should.

#pragma once

#include "_block.hpp"

template <typename T> struct Format;
template <> struct Format<double> {
    typedef int64_t Integer;
    static constexpr int degree = 13, digits = 52, bias = 1023;
    static constexpr double low = -750, high = 710, round = 0x1.8p52;
    static constexpr double log2_high = 0x1.62e42feep-1, log2_low = 0x1.a39ef35793c76p-33;
    static constexpr double flat = 20;  // tanh is 1 beyond it
};
template <> struct Format<float> {
    typedef int32_t Integer;
    static constexpr int degree = 7, digits = 23, bias = 127;
    static constexpr float low = -110, high = 90, round = 0x1.8p23f;
    static constexpr float log2_high = 0x1.62ep-1f, log2_low = 0x1.0bfbe8p-15f;
    static constexpr float flat = 10;
};

constexpr double over_factorial[] = {
    1, 1, 1. / 2, 1. / 6, 1. / 24, 1. / 120, 1. / 720, 1. / 5040, 1. / 40320, 1. / 362880, 1. / 3628800,
    1. / 39916800, 1. / 479001600, 1. / 6227020800,
};

// x = n log(2) + r, |r| <= log(2) / 2: the bits of n and e^r - 1 by its Taylor polynomial.
template <typename T, typename Vector, typename Bits> INLINE Vector reduced(Vector x, Bits &n) {
    using F = Format<T>;
    const Vector rounded = x * T(1.4426950408889634) + F::round, whole = rounded - F::round;
    const Vector r = (x - whole * F::log2_high) - whole * F::log2_low;
    Vector sum = Vector{} + T(over_factorial[F::degree]);
    UNROLL for (int j = F::degree - 1; j > 0; --j) sum = T(over_factorial[j]) + sum * r;
    n = (Bits)rounded - (Bits)(Vector{} + F::round);
    return sum * r;
}
template <typename T, int N> INLINE Block<T, N> exp(const Block<T, N> &x) {
    using F = Format<T>;
    using Vector = typename Block<T, N>::Vector;
    typedef typename F::Integer Bits __attribute__((vector_size(register_bytes)));
    Block<T, N> result;
    LANES {
        Vector at = x.v[k] < F::low ? Vector{} + F::low : x.v[k];
        at = at > F::high ? Vector{} + F::high : at;
        Bits whole;
        const Vector power = 1 + reduced<T>(at, whole);
        const Bits half = whole >> 1;
        // In two factors: 2^n alone need not be a normal number.
        result.v[k] = power * (Vector)((half + F::bias) << F::digits) * (Vector)((whole - half + F::bias) << F::digits);
    }
    return result;
}
// e / (e + 2) with e = e^{2|x|} - 1, which loses no digit of a small x.
template <typename T, int N> INLINE Block<T, N> tanh(const Block<T, N> &x) {
    using F = Format<T>;
    using Vector = typename Block<T, N>::Vector;
    typedef typename F::Integer Bits __attribute__((vector_size(register_bytes)));
    Block<T, N> result;
    LANES {
        const Bits sign = (Bits)x.v[k] & (Bits)(-Vector{});
        Vector at = (Vector)((Bits)x.v[k] ^ sign);
        at = at > F::flat ? Vector{} + F::flat : at;
        Bits n;
        const Vector rest = reduced<T>(2 * at, n), power = (Vector)((n + F::bias) << F::digits);
        const Vector e = power * rest + (power - 1);
        result.v[k] = (Vector)((Bits)(e / (e + 2)) | sign);
    }
    return result;
}
// Lane by lane: a large argument needs a reduction of hundreds of bits.
template <typename T, int N> INLINE Block<T, N> cos(Block<T, N> x) {
    LANES for (int l = 0; l < Block<T, N>::width; ++l) x.v[k][l] = T(__builtin_cos(x.v[k][l]));
    return x;
}
