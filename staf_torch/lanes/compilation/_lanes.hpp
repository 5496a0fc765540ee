// Vectors with a row in every lane. No operation moves a number from one lane to another, so that the bits of
// a row do not depend on what stands beside it. REAL is double or float; the program follows in the same file.

#pragma once

#include <stdint.h>

#if defined(__AVX512F__)
#define LANES_BYTES 64
#elif defined(__AVX__)
#define LANES_BYTES 32
#else
#define LANES_BYTES 16
#endif
#ifdef __NO_INLINE__  // by -O0, where a copy for every call is what takes time to compile
#define INLINE_METHOD inline
#else
#define INLINE_METHOD inline __attribute__((always_inline))
#endif
#define INLINE static INLINE_METHOD
#if defined(__AVX512F__) && !defined(__clang__)
#define LANES_512 1
#else
#define LANES_512 0
#endif

typedef REAL V __attribute__((vector_size(LANES_BYTES)));
typedef decltype(V{} < V{}) M;  // lanes of 0 or -1
constexpr int W = sizeof(V) / sizeof(REAL);
constexpr bool single = sizeof(REAL) == 4;
template <bool, typename A, typename> struct Choice { typedef A type; };
template <typename A, typename B> struct Choice<false, A, B> { typedef B type; };
typedef Choice<single, int32_t, int64_t>::type Bits;
typedef Bits VB __attribute__((vector_size(LANES_BYTES)));

INLINE V splat(REAL x) { return x - V{}; }  // x - 0 is x, also for -0
INLINE M all_of(bool flag) { return flag ? M{} == M{} : M{} != M{}; }
INLINE V load(const REAL *from) {
    V x;
    __builtin_memcpy(&x, from, sizeof x);
    return x;
}
INLINE void store(REAL *to, V x) { __builtin_memcpy(to, &x, sizeof x); }
// Past the caches, where a line need not be read before it is written; `to` is a multiple of the vector.
INLINE void stream(REAL *to, V x) {
#if defined(__clang__)
    __builtin_nontemporal_store(x, reinterpret_cast<V *>(to));
#elif LANES_512 && LANES_SINGLE
    __builtin_ia32_movntps512(to, x);
#elif LANES_512
    __builtin_ia32_movntpd512(to, x);
#elif defined(__AVX__) && LANES_SINGLE
    __builtin_ia32_movntps256(to, x);
#elif defined(__AVX__)
    __builtin_ia32_movntpd256(to, x);
#else
    store(to, x);
#endif
}
INLINE void wait_for_streams() {
#if defined(__AVX__)
    __builtin_ia32_sfence();
#endif
}
INLINE void store_first(REAL *to, V x, int count) {  // fewer than W numbers
#if LANES_512 && LANES_SINGLE
    __builtin_ia32_storeups512_mask(to, x, (1 << count) - 1);
#elif LANES_512
    __builtin_ia32_storeupd512_mask(to, x, (1 << count) - 1);
#else
    REAL lane[W];
    store(lane, x);
    for (int l = 0; l < count; ++l) to[l] = lane[l];
#endif
}
INLINE M load_flag(const REAL *from) { return load(from) != V{}; }
INLINE V where(M m, V a, V b) { return m ? a : b; }
INLINE M where(M m, M a, M b) { return (m & a) | (~m & b); }
INLINE V number(M m) { return m ? splat(1) : V{}; }
INLINE VB bits(V x) { return (VB)x; }
INLINE V real(VB x) { return (V)x; }
INLINE V sign_of(V x) { return real(bits(x) & bits(splat(-REAL(0)))); }
INLINE V abs(V x) { return real(bits(x) & ~bits(splat(-REAL(0)))); }
INLINE V with_sign(V x, V s) { return real(bits(x) | bits(sign_of(s))); }

// To float32 and back. A sum, product, quotient or root of two floats, rounded to double first, is that of float.
INLINE V narrowed(V x) {
#if LANES_SINGLE
    return x;
#else
    typedef float Narrow __attribute__((vector_size(LANES_BYTES / 2)));
    return __builtin_convertvector(__builtin_convertvector(x, Narrow), V);
#endif
}

INLINE bool any(M m) {
#if LANES_512 && LANES_SINGLE
    return __builtin_ia32_ptestmd512((VB)m, (VB)m, -1) != 0;
#elif LANES_512
    typedef long long Longs __attribute__((vector_size(64)));
    return __builtin_ia32_ptestmq512((Longs)m, (Longs)m, -1) != 0;
#elif defined(__AVX__)
    typedef long long Longs __attribute__((vector_size(32)));
    return !__builtin_ia32_ptestz256((Longs)m, (Longs)m);
#else
    const M none = M{} != M{};
    return __builtin_memcmp(&m, &none, sizeof m) != 0;
#endif
}

// A NaN on either side is the result. The processor's own returns b where one is NaN or both are equal; that of
// `least` and `greatest` keeps a NaN of x.
#if LANES_512
#if LANES_SINGLE
#define PROCESSORS(name, a, b) (V)__builtin_ia32_##name##ps512_mask(a, b, a, -1, 4)
#else
#define PROCESSORS(name, a, b) (V)__builtin_ia32_##name##pd512_mask(a, b, a, -1, 4)
#endif
INLINE V max(V a, V b) { return a != a ? a : PROCESSORS(max, a, b); }
INLINE V min(V a, V b) { return a != a ? a : PROCESSORS(min, a, b); }
INLINE V greatest(V x, REAL bound) { return PROCESSORS(max, splat(bound), x); }
INLINE V least(V x, REAL bound) { return PROCESSORS(min, splat(bound), x); }
#else
INLINE V max(V a, V b) { return ((a > b) | (a != a)) ? a : b; }
INLINE V min(V a, V b) { return ((a < b) | (a != a)) ? a : b; }
INLINE V greatest(V x, REAL bound) { return x < bound ? splat(bound) : x; }
INLINE V least(V x, REAL bound) { return x > bound ? splat(bound) : x; }
#endif

#define EACH_LANE(call)                                     \
    REAL lane[W];                                           \
    __builtin_memcpy(lane, &x, sizeof x);                   \
    for (int l = 0; l < W; ++l) lane[l] = REAL(call);       \
    __builtin_memcpy(&x, lane, sizeof x);                   \
    return x;

// One rounding where the processor has it.
#if LANES_512
INLINE V fma(V a, V b, V c) {
#if LANES_SINGLE
    return (V)__builtin_ia32_vfmaddps512_mask(a, b, c, -1, 4);
#else
    return (V)__builtin_ia32_vfmaddpd512_mask(a, b, c, -1, 4);
#endif
}
INLINE V sqrt(V x) {
#if LANES_SINGLE
    return (V)__builtin_ia32_sqrtps512_mask(x, x, -1, 4);
#else
    return (V)__builtin_ia32_sqrtpd512_mask(x, x, -1, 4);
#endif
}
#else
#if defined(__FMA__) && defined(__AVX__) && !defined(__clang__)
INLINE V fma(V a, V b, V c) {
#if LANES_SINGLE
    return (V)__builtin_ia32_vfmaddps256(a, b, c);
#else
    return (V)__builtin_ia32_vfmaddpd256(a, b, c);
#endif
}
#elif defined(__clang__) && (defined(__FMA__) || defined(__ARM_FEATURE_FMA)) && __has_builtin(__builtin_elementwise_fma)
INLINE V fma(V a, V b, V c) { return __builtin_elementwise_fma(a, b, c); }
#elif defined(__FMA__) || defined(__ARM_FEATURE_FMA)
INLINE V fma(V a, V b, V c) {
    REAL p[W], q[W], r[W];
    store(p, a), store(q, b), store(r, c);
    for (int l = 0; l < W; ++l) r[l] = single ? REAL(__builtin_fmaf(p[l], q[l], r[l])) : REAL(__builtin_fma(p[l], q[l], r[l]));
    return load(r);
}
#else
INLINE V fma(V a, V b, V c) { return a * b + c; }
#endif
INLINE V sqrt(V x) { EACH_LANE(single ? __builtin_sqrtf(lane[l]) : __builtin_sqrt(lane[l])) }
#endif

#include "_lanes_functions.hpp"
