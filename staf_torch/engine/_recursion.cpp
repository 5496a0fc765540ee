// The weight recursion of a gradient chase with steepest descent: what recursion.py defines, one call a piece.
//
// Tiles of rows, some times of each at once. What does not depend on the weights is found first, its lanes
// being rows and times alike, and stays in the cache; then the weights go through these times in registers,
// their lanes being rows. A plain C interface without dependencies, loaded by compiled.py. REAL, COUNT and
// SHARED (one K0 for all states) are given on the command line of the compiler.

#include <pthread.h>

#include "_functions.hpp"

// K = S K0 S at one state of every lane, and its product with a vector.

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

constexpr int unrolled_count = 6;      // up to this M the Gram matrix is unrolled, above it comes in panels
#if COUNT <= 6
#define EACH UNROLL
#else
#define EACH _Pragma("GCC unroll 1")
#endif
constexpr int tile_bytes = 4096;       // of one number a row and time: what a tile needs stays in the cache
constexpr int tile_rows = 64;
constexpr int most_threads = 256;

// Strides count elements.
struct Array {  // (batch, times, count)
    const void *data;
    int64_t row, time, entry;
};
struct Problem {
    int64_t batch, times, dim, inner_steps, start, threads;
    const void *core;
    Strides core_at;
    Array states;         // x
    const void *offsets;  // d, (COUNT, dim), where they are the same for all states
    int64_t exponential;  // whether s(x, d) = x'd and g(x) = x'x are found here
    void (*evaluate)(int64_t, int64_t, int64_t, const void *, const void *, const void *, void *);  // V, or null
    const void *parameters;             // of V
    Array values, log_scale, log_gain;  // else V(c), s(x, d) and g(x) are given; null stands for zeros
    void *most;           // in and out, where exponential: the largest finite g(x)
    void *last_gain;      // (batch) in and out: g in whose units e^{-g} the weights stand; null: always 0
    void *weights;        // (COUNT, batch) in and out
    int64_t *diverged_at; // (batch) in and out
    void *before, *after; // (times, COUNT, batch), whose last stride is 1; null: nobody wants it
    int64_t history_time, history_entry;
    int64_t papers;       // whether "after" is the paper's w in place of its units of e^{-g}
    void (*parallel)(void (*)(void *), void *, unsigned, unsigned);  // the GOMP_parallel that torch uses, or null
};

// Consecutive rows over consecutive times, one number each: time-major, so that a row is a lane.
struct Tile {
    int64_t first, time;
    int rows, times;
    INLINE int size() const { return rows * times; }
};

template <typename T> INLINE const T *at(const Array &array, int64_t row, int64_t time, int64_t entry) {
    return static_cast<const T *>(array.data) + row * array.row + time * array.time + entry * array.entry;
}

template <typename T, int M> struct Prepared {
    static constexpr int N = 4, lanes = Block<T, N>::lanes, limit = tile_bytes / sizeof(T);
    static constexpr int room = limit + tile_rows + Block<T, 8>::lanes;  // vectors are read beyond the end
    using B = Block<T, N>;
    const Problem &p;
    T *x, *scale, *value, *gain, *unit, *factor;  // unit e^{g - g of the time before}, factor e^{-g}
    B most = fill<T, N>(0);

    explicit Prepared(const Problem &problem) : p(problem) {
        const int64_t numbers = (p.dim + 2 * M + 3) * room;
        x = static_cast<T *>(allocate(numbers * sizeof(T)));
        for (int64_t n = 0; n < numbers; ++n) x[n] = n < p.dim * room ? 0 : 1;
        scale = x + p.dim * room, value = scale + M * room;
        gain = value + M * room, unit = gain + room, factor = unit + room;
    }
    ~Prepared() {
        T each[lanes], *into = static_cast<T *>(p.most);
        store(each, lanes, most);
        for (int l = 0; l < lanes && p.exponential; ++l) {
            T seen = *into;
            while (each[l] > seen && !__atomic_compare_exchange(into, &seen, each + l, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
        }
        __builtin_free(x);
    }
    Prepared(const Prepared &) = delete;

    // A row's numbers lie together in memory where the states come so; a time's, where torch made them so.
    static INLINE void copy(const Array &from, int entry, const Tile &tile, T *to) {
        const T *data = at<T>(from, tile.first, tile.time, entry);
        if (from.row == 1)
            for (int t = 0; t < tile.times; ++t)
                for (int r = 0; r < tile.rows; ++r) to[t * tile.rows + r] = data[t * from.time + r];
        else
            for (int r = 0; r < tile.rows; ++r)
                for (int t = 0; t < tile.times; ++t) to[t * tile.rows + r] = data[r * from.row + t * from.time];
    }
    __attribute__((noinline)) void run(const Tile &tile) {
        const int size = tile.size();
        for (int k = 0; k < p.dim && (p.exponential || p.evaluate); ++k) copy(p.states, k, tile, x + k * room);
        if (p.evaluate) p.evaluate(size, room, M, x, p.offsets, p.parameters, value);
        for (int i = 0; i < M && !p.evaluate; ++i) copy(p.values, i, tile, value + i * room);
        if (p.exponential) exponential(size, tile.rows);
        else given(tile);
        for (int n = 0; n < size && p.last_gain; n += lanes) {
            const B now = load<T, N>(gain + tile.rows + n);
            store(unit + n, lanes, exp(now - load<T, N>(gain + n)));
            if (p.papers) store(factor + n, lanes, exp(-now));
        }
        for (int r = 0; r < tile.rows; ++r) gain[r] = gain[size + r];
    }
    INLINE void exponential(int size, int rows) {
        const T *d = static_cast<const T *>(p.offsets);
        for (int n = 0; n < size; n += lanes) {
            B square = fill<T, N>(0);
            for (int k = 0; k < p.dim; ++k) {
                const B at = load<T, N>(x + k * room + n);
                add(square, at, at);
            }
            store(gain + rows + n, lanes, square);
            LANES most.v[k] = square.v[k] > most.v[k] && square.v[k] - square.v[k] == 0 ? square.v[k] : most.v[k];
        }
        for (int i = 0; i < M; ++i)
            for (int n = 0; n < size; n += lanes) {
                B sum = fill<T, N>(0);
                for (int k = 0; k < p.dim; ++k) add(sum, d[i * p.dim + k], load<T, N>(x + k * room + n));
                store(scale + i * room + n, lanes, exp(sum));
            }
    }
    INLINE void given(const Tile &tile) {
        for (int i = 0; i < M && p.log_scale.data; ++i) {
            copy(p.log_scale, i, tile, scale + i * room);
            for (int n = 0; n < tile.size(); n += lanes)
                store(scale + i * room + n, lanes, exp(load<T, N>(scale + i * room + n)));
        }
        if (p.last_gain) copy(p.log_gain, 0, tile, gain + tile.rows);
    }
};

template <typename T, int N, int M, typename Gram> struct Solver {
    using B = Block<T, N>;
    using Vector = Entries<B, M>;
    const Problem &p;
    Prepared<T, M> ready;
    Gram gram;
    T lost[tile_rows + B::lanes] = {};  // not 0 where the row has diverged

    explicit Solver(const Problem &problem)
        : p(problem), ready(problem), gram(static_cast<const T *>(problem.core), problem.core_at) {}

    // Rows first..last through all times.
    void run(int64_t first, int64_t last) {
        const int rows = int(last - first), most = Prepared<T, M>::limit / rows;
        T *last_gain = static_cast<T *>(p.last_gain) + first;
        for (int r = 0; r < rows; ++r) lost[r] = p.diverged_at[first + r] >= 0;
        for (int r = 0; r < rows && p.last_gain; ++r) ready.gain[r] = last_gain[r];
        for (int64_t t = 0; t < p.times; t += most) {
            const Tile tile{first, t, rows, int(p.times - t < most ? p.times - t : most)};
            ready.run(tile);
            for (int b = 0; b < rows; b += B::lanes) advance(tile, b, rows - b < B::lanes ? rows - b : B::lanes);
        }
    }

    // Some rows of a tile through its times.
    void advance(const Tile &tile, int row, int rows) {
        const int64_t first = tile.first + row;
        T *weights = static_cast<T *>(p.weights) + first;
        const T *core = static_cast<const T *>(p.core) + first * p.core_at.row;
        Vector a;
        B gone = load<T, N>(lost + row), gain = fill<T, N>(0), factor = fill<T, N>(1);
        for (int i = 0; i < M; ++i) a[i] = load<T, N>(weights + i * p.batch, 1, rows);
        if (p.last_gain) {
            gain = load<T, N>(static_cast<T *>(p.last_gain) + first, 1, rows);
            if (p.papers) factor = exp(-gain);
        }
        for (int t = 0; t < tile.times; ++t) {
            const int here = t * tile.rows + row;
            Vector old;
            const B unit = load<T, N>(ready.unit + here);
            Vector s, g, y;
            EACH for (int i = 0; i < M; ++i) {
                old[i] = a[i];
                s[i] = load<T, N>(ready.scale + i * Prepared<T, M>::room + here);
                a[i] = old[i] * unit;
            }
            gram.prepare(s, core + (tile.time + t) * p.core_at.time, p.core_at, rows);
            gram.product(s, a, y);
            EACH for (int i = 0; i < M; ++i)
                g[i] = 2 * (load<T, N>(ready.value + i * Prepared<T, M>::room + here) - y[i]);
            for (int64_t n = 0; n < p.inner_steps; ++n) descend(s, a, g, y);

            // What is not finite stays behind: the row as it was, for ever.
            B now = gone;
            EACH for (int i = 0; i < M; ++i)
                LANES now.v[k] = a[i].v[k] - a[i].v[k] == 0 ? now.v[k] : fill<T, N>(1).v[k];
            if (__builtin_memcmp(&gone, &now, sizeof now) != 0) note(now, first, row, rows, tile.time + t);
            gone = now;
            if (p.last_gain) {
                gain = choose(gone, gain, load<T, N>(ready.gain + tile.rows + here));
                if (p.papers) factor = choose(gone, factor, load<T, N>(ready.factor + here));
            }
            const int64_t place = (tile.time + t) * p.history_time + first;
            for (int i = 0; p.before && i < M; ++i)
                stream(static_cast<T *>(p.before) + place + i * p.history_entry, rows, choose(gone, old[i], old[i] * unit));
            EACH for (int i = 0; i < M; ++i) {
                a[i] = choose(gone, old[i], a[i]);
                if (p.after) stream(static_cast<T *>(p.after) + place + i * p.history_entry, rows, a[i] * factor);
            }
        }
        for (int i = 0; i < M; ++i) store(weights + i * p.batch, rows, a[i]);
        if (p.last_gain) store(static_cast<T *>(p.last_gain) + first, rows, gain);
    }

    // a += lambda g, g -= 2 lambda K g, lambda = g'g / 2 g'Kg, zero where it is 0/0.
    INLINE void descend(const Vector &s, Vector &a, Vector &g, Vector &y) {
        gram.product(s, g, y);
        B slope = g[0] * g[0], curvature = g[0] * y[0];
        EACH for (int i = 1; i < M; ++i) {
            add(slope, g[i], g[i]);
            add(curvature, g[i], y[i]);
        }
        B twice, length;
        LANES {
            twice.v[k] = curvature.v[k] > 0 ? slope.v[k] / curvature.v[k] : typename B::Vector{};
            length.v[k] = twice.v[k] * T(0.5);
        }
        EACH for (int i = 0; i < M; ++i) {
            add(a[i], length, g[i]);
            LANES g[i].v[k] -= twice.v[k] * y[i].v[k];
        }
    }

    __attribute__((noinline)) void note(const B &now, int64_t first, int row, int rows, int64_t t) {
        store(lost + row, rows, now);
        for (int l = 0; l < rows; ++l)
            if (lost[row + l] != 0 && p.diverged_at[first + l] < 0) p.diverged_at[first + l] = p.start + t;
    }
};

// Tiles of rows, taken by whichever thread is free.
template <typename Solve> struct Work {
    const Problem &p;
    int64_t rows, next = 0;

    static void *run(void *data) {
        Work &work = *static_cast<Work *>(data);
        Solve solve(work.p);
        for (int64_t b; (b = __atomic_fetch_add(&work.next, work.rows, __ATOMIC_RELAXED)) < work.p.batch;)
            solve.run(b, b + work.rows < work.p.batch ? b + work.rows : work.p.batch);
        streamed();
        return nullptr;
    }
    static void task(void *data) { run(data); }
};

template <typename T, int N> void solve(const Problem &p) {
    constexpr int M = COUNT;
    constexpr bool small = M <= unrolled_count;
    typedef Unrolled<T, N, small ? M : 1, SHARED> Few;
    typedef Panels<T, N, M, SHARED> Many;
    typedef typename Choice<small, Few, Many>::type Gram;
    typedef Work<Solver<T, N, M, Gram>> Tiles;
    const int64_t lanes = Block<T, N>::lanes, even = (p.batch + p.threads - 1) / p.threads;
    const int64_t wanted = (even + lanes - 1) / lanes * lanes, rows = wanted < tile_rows ? wanted : tile_rows;
    const int64_t tiles = (p.batch + rows - 1) / rows;
    const int threads = int(tiles < p.threads ? tiles : p.threads);
    Tiles work{p, rows};
    if (threads > 1 && p.parallel) return p.parallel(Tiles::task, &work, unsigned(threads), 0);
    pthread_t others[most_threads];
    int started = 0;
    while (started + 1 < threads && started < most_threads && pthread_create(others + started, nullptr, Tiles::run, &work) == 0)
        ++started;
    Tiles::task(&work);
    while (started > 0) pthread_join(others[--started], nullptr);
}

extern "C" void staf_recursion(const Problem *problem) {
    constexpr int wide = COUNT <= unrolled_count ? 2 : SHARED ? registers / 8 : 1;
    if (wide == 1 || problem->batch <= Block<REAL, 1>::lanes) return solve<REAL, 1>(*problem);
    solve<REAL, wide>(*problem);
}
