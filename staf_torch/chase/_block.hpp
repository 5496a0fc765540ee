// Blocks of vector registers, a lane a trajectory. No operation moves a number from one lane to another.

#pragma once

#include <cstdint>
#include <cstring>

#if defined(__AVX512F__)
constexpr int register_bytes = 64, registers = 32;
#elif defined(__AVX__)
constexpr int register_bytes = 32, registers = 16;
#else
constexpr int register_bytes = 16, registers = 32;
#endif

#define INLINE inline __attribute__((always_inline))
#define UNROLL _Pragma("GCC unroll 16")
#define LANES UNROLL for (int k = 0; k < N; ++k)

template <typename T, int N> struct Block {
    static constexpr int width = register_bytes / sizeof(T), lanes = N * width;
    typedef T Vector __attribute__((vector_size(register_bytes)));
    Vector v[N];
};
template <typename T, int N> INLINE Block<T, N> fill(T x) {
    Block<T, N> r;
    LANES r.v[k] = typename Block<T, N>::Vector{} + x;
    return r;
}
template <typename T, int N> INLINE Block<T, N> operator*(const Block<T, N> &a, const Block<T, N> &b) {
    Block<T, N> r;
    LANES r.v[k] = a.v[k] * b.v[k];
    return r;
}
template <typename T, int N> INLINE void add(Block<T, N> &sum, const Block<T, N> &a, const Block<T, N> &b) {
    LANES sum.v[k] += a.v[k] * b.v[k];
}
template <typename T, int N> INLINE void add(Block<T, N> &sum, T a, const Block<T, N> &b) {
    LANES sum.v[k] += a * b.v[k];
}
// where(lost, a, b)
template <typename T, int N> INLINE Block<T, N> choose(const Block<T, N> &lost, const Block<T, N> &a, const Block<T, N> &b) {
    Block<T, N> r;
    LANES r.v[k] = lost.v[k] != 0 ? a.v[k] : b.v[k];
    return r;
}
template <typename T, int N> INLINE Block<T, N> load(const T *from, int64_t stride, int rows) {
    constexpr int lanes = Block<T, N>::lanes;
    if (stride == 0) return fill<T, N>(*from);
    Block<T, N> r;
    if (rows == lanes && stride == 1) {
        std::memcpy(&r, from, sizeof r);
    } else {
        T lane[lanes];
        for (int l = 0; l < lanes; ++l) lane[l] = from[l < rows ? l * stride : 0];
        std::memcpy(&r, lane, sizeof r);
    }
    return r;
}
template <typename T, int N> INLINE void store(T *to, int rows, const Block<T, N> &x) {
    if (rows == Block<T, N>::lanes) {
        std::memcpy(to, &x, sizeof x);
    } else {
        T lane[Block<T, N>::lanes];
        std::memcpy(lane, &x, sizeof x);
        for (int l = 0; l < rows; ++l) to[l] = lane[l];
    }
}

// e^x = 2^n e^r, |r| <= log(2) / 2, by the Taylor polynomial of e^r: within two units in the last place,
// inf, 0, subnormal and NaN as they should be.
template <typename T> struct Exponential;
template <> struct Exponential<double> {
    typedef int64_t Integer;
    static constexpr int degree = 13, digits = 52, bias = 1023;
    static constexpr double low = -750, high = 710, round = 0x1.8p52;
    static constexpr double log2_high = 0x1.62e42feep-1, log2_low = 0x1.a39ef35793c76p-33;
};
template <> struct Exponential<float> {
    typedef int32_t Integer;
    static constexpr int degree = 7, digits = 23, bias = 127;
    static constexpr float low = -110, high = 90, round = 0x1.8p23f;
    static constexpr float log2_high = 0x1.62ep-1f, log2_low = 0x1.0bfbe8p-15f;
};
template <typename T, int N> INLINE Block<T, N> exponential(const Block<T, N> &x) {
    using E = Exponential<T>;
    using Vector = typename Block<T, N>::Vector;
    typedef typename E::Integer Bits __attribute__((vector_size(register_bytes)));
    Block<T, N> result;
    LANES {
        Vector at = x.v[k] < E::low ? Vector{} + E::low : x.v[k];
        at = at > E::high ? Vector{} + E::high : at;
        const Vector rounded = at * T(1.4426950408889634) + E::round, n = rounded - E::round;
        const Vector r = (at - n * E::log2_high) - n * E::log2_low;
        Vector sum = Vector{} + 1;
        UNROLL for (int j = E::degree; j > 0; --j) sum = 1 + sum * (r * T(1.0 / j));
        const Bits whole = (Bits)rounded - (Bits)(Vector{} + E::round), half = whole >> 1;
        // In two factors: 2^n alone need not be a normal number.
        result.v[k] = sum * (Vector)((half + E::bias) << E::digits) * (Vector)((whole - half + E::bias) << E::digits);
    }
    return result;
}

