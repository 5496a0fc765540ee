// K = S K0 S at one state of every lane, and its product with a vector.

#pragma once

#include "_block.hpp"

struct Strides {
    int64_t row, time, i, j;
};
template <bool, typename A, typename> struct Choice { typedef A type; };
template <typename A, typename B> struct Choice<false, A, B> { typedef B type; };

template <typename B, int M> struct Entries {
    B entry[M];
    INLINE B &operator[](int i) { return entry[i]; }
    INLINE const B &operator[](int i) const { return entry[i]; }
};

// Small M: K itself, its lower triangle, in registers where there are enough.
template <typename T, int N, int M, bool shared> struct Unrolled {
    using B = Block<T, N>;
    using Vector = Entries<B, M>;
    B K[M * (M + 1) / 2];

    explicit Unrolled(const T *, const Strides &) {}

    INLINE void prepare(const Vector &s, const T *core, const Strides &at, int rows) {
        int n = 0;
        UNROLL for (int i = 0; i < M; ++i)
            UNROLL for (int j = 0; j <= i; ++j, ++n)
                K[n] = s[i] * load<T, N>(core + i * at.i + j * at.j, shared ? 0 : at.row, rows) * s[j];
    }
    INLINE void product(const Vector &, const Vector &v, Vector &y) const {
        UNROLL for (int i = 0; i < M; ++i) {
            y[i] = K[i * (i + 1) / 2] * v[0];
            UNROLL for (int j = 1; j < M; ++j) add(y[i], K[j <= i ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i], v[j]);
        }
    }
};

constexpr int rounded_up(int m, int by) { return (m + by - 1) / by * by; }
constexpr int best_panel(int m) {
    int best = 4;
    for (int by = 5; by <= 6; ++by)
        if (rounded_up(m, by) <= rounded_up(m, best)) best = by;
    return best;
}

// Any M: K0 in panels of rows; a number an entry where all states share it, a block where they do not.
template <typename T, int N, int M, bool shared> struct Panels {
    using B = Block<T, N>;
    using Vector = Entries<B, M>;
    static constexpr int panel = best_panel(M), whole = rounded_up(M, panel);
    using E = typename Choice<shared, T, B>::type;
    E *K;  // (panels, M, panel), zero beyond the last row

    explicit Panels(const T *core, const Strides &at) {
        K = static_cast<E *>(allocate(sizeof(E) * whole * M));
        __builtin_memset(K, 0, sizeof(E) * whole * M);
        if constexpr (shared) fill_in(core, at, 0);
    }
    ~Panels() { __builtin_free(K); }
    Panels(const Panels &) = delete;

    INLINE void fill_in(const T *core, const Strides &at, int rows) {
        for (int i = 0; i < M; ++i)
            for (int j = 0; j < M; ++j) {
                E &entry = K[(i / panel * M + j) * panel + i % panel];
                const T *from = core + i * at.i + j * at.j;
                if constexpr (shared) entry = *from;
                else entry = load<T, N>(from, at.row, rows);
            }
    }
    INLINE void prepare(const Vector &, const T *core, const Strides &at, int rows) {
        if constexpr (!shared) fill_in(core, at, rows);
    }
    INLINE void product(const Vector &s, const Vector &v, Vector &y) const {
        Vector u;
        _Pragma("GCC unroll 1") for (int j = 0; j < M; ++j) u[j] = s[j] * v[j];
        const E *entry = K;
        for (int i = 0; i < M; i += panel) {
            B sum[panel];
            UNROLL for (int r = 0; r < panel; ++r) sum[r] = fill<T, N>(0);
            _Pragma("GCC unroll 1") for (int j = 0; j < M; ++j, entry += panel)
                UNROLL for (int r = 0; r < panel; ++r) add(sum[r], entry[r], u[j]);
            for (int r = 0; r < panel && i + r < M; ++r) y[i + r] = s[i + r] * sum[r];
        }
    }
};
