// Blocks of vector registers, a lane a trajectory or a time of one. No operation moves a number from one
// lane to another, so that no lane's bits depend on what stands beside it.

#pragma once

#include <stdint.h>

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
// The scalar is of a type of its own, so that `2 * x` holds for every T.
#define OPERATOR(op)                                                                              \
    template <typename T, int N> INLINE Block<T, N> operator op(Block<T, N> a, const Block<T, N> &b) { \
        LANES a.v[k] = a.v[k] op b.v[k];                                                          \
        return a;                                                                                 \
    }                                                                                             \
    template <typename T, int N, typename S> INLINE Block<T, N> operator op(S a, Block<T, N> b) { \
        LANES b.v[k] = T(a) op b.v[k];                                                            \
        return b;                                                                                 \
    }                                                                                             \
    template <typename T, int N, typename S> INLINE Block<T, N> operator op(Block<T, N> a, S b) { \
        LANES a.v[k] = a.v[k] op T(b);                                                            \
        return a;                                                                                 \
    }
OPERATOR(+)
OPERATOR(-)
OPERATOR(*)
OPERATOR(/)
template <typename T, int N> INLINE Block<T, N> operator-(Block<T, N> a) {
    LANES a.v[k] = -a.v[k];
    return a;
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
template <typename T, int N> INLINE Block<T, N> load(const T *from) {
    Block<T, N> r;
    __builtin_memcpy(&r, from, sizeof r);
    return r;
}
// One number a row; beyond the rows the first again.
template <typename T, int N> INLINE Block<T, N> load(const T *from, int64_t stride, int rows) {
    constexpr int lanes = Block<T, N>::lanes;
    if (stride == 0) return fill<T, N>(*from);
    if (rows == lanes && stride == 1) return load<T, N>(from);
    T lane[lanes];
    for (int l = 0; l < lanes; ++l) lane[l] = from[l < rows ? l * stride : 0];
    return load<T, N>(lane);
}
template <typename T, int N> INLINE void store(T *to, int rows, const Block<T, N> &x) {
    if (rows == Block<T, N>::lanes) {
        __builtin_memcpy(to, &x, sizeof x);
    } else {
        T lane[Block<T, N>::lanes];
        __builtin_memcpy(lane, &x, sizeof x);
        for (int l = 0; l < rows; ++l) to[l] = lane[l];
    }
}
// Past the caches, where whole lines are written that nobody reads soon: they need not be fetched first.
#if defined(__AVX__) && !defined(__clang__)
template <typename T, int N> INLINE void stream(T *to, int rows, const Block<T, N> &x) {
    if (rows < Block<T, N>::lanes || reinterpret_cast<uintptr_t>(to) % register_bytes != 0) return store(to, rows, x);
    typedef long long Line __attribute__((vector_size(register_bytes)));
    Line line[N];
    __builtin_memcpy(line, &x, sizeof x);
#ifdef __AVX512F__
    LANES __builtin_ia32_movntdq512(reinterpret_cast<Line *>(to) + k, line[k]);
#else
    LANES __builtin_ia32_movntdq256(reinterpret_cast<Line *>(to) + k, line[k]);
#endif
}
INLINE void streamed() { __builtin_ia32_sfence(); }
#else
template <typename T, int N> INLINE void stream(T *to, int rows, const Block<T, N> &x) { store(to, rows, x); }
INLINE void streamed() {}
#endif

extern "C" void *aligned_alloc(__SIZE_TYPE__, __SIZE_TYPE__) noexcept;
INLINE void *allocate(__SIZE_TYPE__ bytes) { return aligned_alloc(64, (bytes + 63) / 64 * 64); }
