// The weight recursion of a gradient chase with steepest descent: what recursion.py defines, one call a piece.
//
// A lane is a trajectory. A block holds a few vector registers of lanes, and no lane reads another's numbers;
// the tail of a block repeats its first row, so that every row runs through the same instructions whatever
// stands beside it. A plain C interface without dependencies, loaded by fused.py.

#include <algorithm>
#include <atomic>
#include <thread>
#include <type_traits>
#include <vector>

#include "_block.hpp"

constexpr int unrolled_count = 6;  // up to this M the Gram matrix is unrolled, above it is a loop over panels
constexpr int panel = 4;           // rows of the Gram matrix in one pass over a vector
constexpr int tile_lanes = 256;    // rows that advance together: what they carry stays in the first cache

// Strides count elements; a null pointer stands for ones, or for a history that nobody asked for.
struct Array {  // (batch, times, count)
    const void *data;
    int64_t row, time, entry;
};
struct Problem {
    int64_t batch, times, count, inner_steps, start, threads;
    const void *core;  // K0, or one a state where core_row or core_time is not 0
    int64_t core_row, core_time, core_i, core_j;
    Array values, log_scale, log_gain;  // V(c), s(x, d), g(x)
    void *last_gain;          // (batch) in and out: g in whose units e^{-g} the weights stand
    void *weights;            // (count, batch) in and out
    int64_t *diverged_at;     // (batch) in and out
    void *before, *after;     // (times, count, batch), whose last stride is 1
    int64_t history_time, history_entry;
    int64_t papers;           // whether "after" is the paper's w in place of its units of e^{-g}
    void (*parallel)(void (*)(void *), void *, unsigned, unsigned);  // the GOMP_parallel that torch uses, or null
};

// A block of rows between two times.
template <typename T, int N> struct Standing {
    int64_t first;
    int rows;
    Block<T, N> lost;          // not 0 where the row has diverged
    Block<T, N> gain, factor;  // g and e^{-g} of the last time that was finite
};

// The numbers of one time for a block of rows; entry i of the count.
template <typename T, int N> INLINE Block<T, N> load(const Array &from, const Standing<T, N> &at, int64_t t, int i) {
    const T *data = static_cast<const T *>(from.data) + at.first * from.row + t * from.time + i * from.entry;
    return load<T, N>(data, from.row, at.rows);
}
template <typename T, int N> INLINE Block<T, N> scale(const Problem &p, const Standing<T, N> &at, int64_t t, int i) {
    return exponential(load(p.log_scale, at, t, i));
}

// K of one state, M known to the compiler: its lower triangle.
template <typename T, int N, int M> struct Unrolled {
    using B = Block<T, N>;
    struct Vector {
        B entry[M];
        explicit Vector(int) {}
        INLINE B &operator[](int i) { return entry[i]; }
        INLINE const B &operator[](int i) const { return entry[i]; }
    };
    B K[M * (M + 1) / 2];
    explicit Unrolled(const Problem &) {}
    static constexpr int count(const Problem &) { return M; }

    INLINE void prepare(const Problem &p, const Standing<T, N> &at, int64_t t) {
        const T *core = static_cast<const T *>(p.core) + at.first * p.core_row + t * p.core_time;
        B s[M];
        for (int i = 0; i < M; ++i) s[i] = p.log_scale.data ? scale(p, at, t, i) : fill<T, N>(1);
        for (int i = 0, n = 0; i < M; ++i)
            for (int j = 0; j <= i; ++j, ++n) {
                const T *entry = core + i * p.core_i + j * p.core_j;
                K[n] = s[i] * load<T, N>(entry, p.core_row, at.rows) * s[j];
            }
    }
    INLINE void product(const Vector &v, Vector &y) const {
        UNROLL for (int i = 0; i < M; ++i) {
            y[i] = K[i * (i + 1) / 2] * v[0];
            UNROLL for (int j = 1; j < M; ++j) add(y[i], K[j <= i ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i], v[j]);
        }
    }
};

// K of one state, any M, in panels of rows; E is T where all states share one K0, and a Block where they do not.
template <typename T, int N, typename E> struct Panels {
    using B = Block<T, N>;
    using Vector = std::vector<B>;
    static constexpr bool shared = std::is_same_v<E, T>;
    int m;
    std::vector<E> K;  // (panels, M, panel), zero beyond the last row
    std::vector<B> s, u;
    bool scaled = false;

    explicit Panels(const Problem &p) : m(int(p.count)), K((m + panel) / panel * panel * m), s(m), u(m) {
        if constexpr (shared)
            for (int i = 0; i < m; ++i)
                for (int j = 0; j < m; ++j) at(i, j) = static_cast<const T *>(p.core)[i * p.core_i + j * p.core_j];
    }
    int count(const Problem &) const { return m; }
    E &at(int i, int j) { return K[(i / panel * m + j) * panel + i % panel]; }

    void prepare(const Problem &p, const Standing<T, N> &at_, int64_t t) {
        const T *core = static_cast<const T *>(p.core) + at_.first * p.core_row + t * p.core_time;
        scaled = p.log_scale.data != nullptr;
        for (int i = 0; scaled && i < m; ++i) s[i] = scale(p, at_, t, i);
        if constexpr (!shared)
            for (int i = 0; i < m; ++i)
                for (int j = 0; j < m; ++j)
                    at(i, j) = load<T, N>(core + i * p.core_i + j * p.core_j, p.core_row, at_.rows);
    }
    void product(const Vector &v, Vector &y) {
        for (int j = 0; scaled && j < m; ++j) u[j] = s[j] * v[j];
        const B *x = scaled ? u.data() : v.data();
        const E *entry = K.data();
        for (int i = 0; i < m; i += panel) {
            B sum[panel];
            UNROLL for (int r = 0; r < panel; ++r) sum[r] = fill<T, N>(0);
            for (int j = 0; j < m; ++j, entry += panel) {
                UNROLL for (int r = 0; r < panel; ++r) add(sum[r], entry[r], x[j]);
            }
            for (int r = 0; r < panel && i + r < m; ++r) y[i + r] = scaled ? s[i + r] * sum[r] : sum[r];
        }
    }
};

template <typename T, int N, typename Gram> struct Solver {
    using B = Block<T, N>;
    const Problem &p;
    Gram gram;
    explicit Solver(const Problem &problem) : p(problem), gram(problem) {}

    // One time of one block: correct, freeze what is not finite, record.
    void step(Standing<T, N> &at, int64_t t) {
        const int m = gram.count(p);
        typename Gram::Vector a(m), g(m), y(m), old(m);
        T *weights = static_cast<T *>(p.weights) + at.first;
        B gain = at.gain, unit = fill<T, N>(1);
        if (p.last_gain) {
            gain = load(p.log_gain, at, t, 0);
            LANES unit.v[k] = gain.v[k] - at.gain.v[k];
            unit = exponential(unit);
        }
        gram.prepare(p, at, t);
        for (int i = 0; i < m; ++i) old[i] = load<T, N>(weights + i * p.batch, 1, at.rows);
        for (int i = 0; i < m; ++i) g[i] = load(p.values, at, t, i);
        UNROLL for (int i = 0; i < m; ++i) a[i] = old[i] * unit;
        gram.product(a, y);
        UNROLL for (int i = 0; i < m; ++i) LANES g[i].v[k] = 2 * (g[i].v[k] - y[i].v[k]);
        for (int64_t n = 0; n < p.inner_steps; ++n) descend(m, a, g, y);

        B lost = at.lost;
        UNROLL for (int i = 0; i < m; ++i) LANES lost.v[k] = a[i].v[k] - a[i].v[k] == 0 ? lost.v[k] : fill<T, N>(1).v[k];
        if (std::memcmp(&at.lost, &lost, sizeof lost) != 0) note(at, lost, t);
        if (p.last_gain) at.gain = choose(lost, at.gain, gain);
        if (p.last_gain && p.papers) at.factor = inverse(at.gain);
        const int64_t here = t * p.history_time + at.first;
        for (int i = 0; p.before && i < m; ++i)
            store(static_cast<T *>(p.before) + here + i * p.history_entry, at.rows, choose(lost, old[i], old[i] * unit));
        for (int i = 0; i < m; ++i) {
            const B kept = choose(lost, old[i], a[i]);
            store(weights + i * p.batch, at.rows, kept);
            if (p.after) store(static_cast<T *>(p.after) + here + i * p.history_entry, at.rows, kept * at.factor);
        }
    }

    static INLINE B inverse(B gain) {
        LANES gain.v[k] = -gain.v[k];
        return exponential(gain);
    }

    // a += lambda g, g -= 2 lambda K g, lambda = g'g / 2 g'Kg, zero where it is 0/0.
    INLINE void descend(int m, typename Gram::Vector &a, typename Gram::Vector &g, typename Gram::Vector &y) {
        gram.product(g, y);
        B slope = g[0] * g[0], curvature = g[0] * y[0];
        UNROLL for (int i = 1; i < m; ++i) {
            add(slope, g[i], g[i]);
            add(curvature, g[i], y[i]);
        }
        B twice, length;
        LANES {
            twice.v[k] = curvature.v[k] > 0 ? slope.v[k] / curvature.v[k] : typename B::Vector{};
            length.v[k] = twice.v[k] * T(0.5);
        }
        UNROLL for (int i = 0; i < m; ++i) {
            add(a[i], length, g[i]);
            LANES g[i].v[k] -= twice.v[k] * y[i].v[k];
        }
    }

    void note(Standing<T, N> &at, const B &lost, int64_t t) {
        T now[B::lanes];
        std::memcpy(now, &lost, sizeof now);
        for (int l = 0; l < at.rows; ++l)
            if (now[l] != 0 && p.diverged_at[at.first + l] < 0) p.diverged_at[at.first + l] = p.start + t;
        at.lost = lost;
    }

    // Rows first..last through all times, side by side, so that memory is read in its own order.
    void run(int64_t first, int64_t last) {
        std::vector<Standing<T, N>> tile;
        for (int64_t b = first; b < last; b += B::lanes) {
            Standing<T, N> at{b, int(std::min<int64_t>(B::lanes, last - b)), {}, {}, fill<T, N>(1)};
            if (p.last_gain) at.gain = load<T, N>(static_cast<const T *>(p.last_gain) + b, 1, at.rows);
            T lost[B::lanes] = {};
            for (int l = 0; l < at.rows; ++l) lost[l] = p.diverged_at[b + l] >= 0;
            std::memcpy(&at.lost, lost, sizeof lost);
            tile.push_back(at);
        }
        for (int64_t t = 0; t < p.times; ++t)
            for (auto &at : tile) step(at, t);
        for (auto &at : tile)
            if (p.last_gain) store(static_cast<T *>(p.last_gain) + at.first, at.rows, at.gain);
    }
};

// Tiles of rows, taken by whichever thread is free.
template <typename T, int N, typename Gram> struct Work {
    const Problem &p;
    int64_t rows;
    std::atomic<int64_t> next{0};

    static void run(void *data) {
        Work &work = *static_cast<Work *>(data);
        Solver<T, N, Gram> solver(work.p);
        for (int64_t b; (b = work.next.fetch_add(work.rows)) < work.p.batch;)
            solver.run(b, std::min(b + work.rows, work.p.batch));
    }
};

template <typename T, int N, typename Gram> void share(const Problem &p) {
    const int64_t lanes = Block<T, N>::lanes, even = (p.batch + p.threads - 1) / p.threads;
    const int64_t rows = std::min<int64_t>(tile_lanes, (even + lanes - 1) / lanes * lanes);
    const int64_t threads = std::min(p.threads, (p.batch + rows - 1) / rows);
    Work<T, N, Gram> work{p, rows};
    if (threads > 1 && p.parallel) return p.parallel(work.run, &work, unsigned(threads), 0);
    std::vector<std::thread> others;
    for (int64_t n = 1; n < threads; ++n) others.emplace_back(work.run, &work);
    work.run(&work);
    for (auto &other : others) other.join();
}

template <typename T, int N, int M = 1> void unrolled(const Problem &p) {
    if (p.count == M) return share<T, N, Unrolled<T, N, M>>(p);
    if constexpr (M < unrolled_count) unrolled<T, N, M + 1>(p);
}

template <typename T> void solve(const Problem &p) {
    constexpr int wide = registers / (2 * panel);
    const bool narrow = p.batch <= Block<T, 1>::lanes;
    if (p.count <= unrolled_count) return narrow ? unrolled<T, 1>(p) : unrolled<T, 2>(p);
    if (p.core_row || p.core_time) return share<T, 1, Panels<T, 1, Block<T, 1>>>(p);
    return narrow ? share<T, 1, Panels<T, 1, T>>(p) : share<T, wide, Panels<T, wide, T>>(p);
}

extern "C" void staf_recursion(const Problem *problem) { solve<REAL>(*problem); }
