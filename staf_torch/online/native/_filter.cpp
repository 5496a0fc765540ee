// A call of `LocalFilter` on many streams: what kalman_filter.py defines. REAL is the type of the streams.

#include "_filter.hpp"

struct Streams {
    int64_t streams, stride, closed;  // closed: their owner changes them, and direct calls do nothing
    REAL *table;                       // see StreamState: blocks of the rows of `lanes` streams
    int64_t *counts;                   // (4, stride)
    const double *ratio, *forgetting;  // (streams); then numbers of all, or in blocks of those of `lanes` streams
    const Number *offsets, *squares, *newton, *gram, *rate, *reach, *slack2, *robust, *size;
    double tiny, most;
};
struct Given {  // what belongs to a call alone: another thread may ask the same streams
    const Streams *of;
    int64_t mode;             // 1 to predict, 2 to learn; 4 for a direct call
    const REAL *x, *y;        // (streams, n), (streams, K)
    const double *lapse;      // (streams), or null for ones
    REAL *mean, *deviation;   // (streams, K)
};
struct Call : Streams, Given {};
constexpr int tile = 64;  // streams that are worked on together stay in the cache
constexpr int row_mean = 2 * n, row_learned = row_mean + (K + 1) * M, row_errors = row_learned + M * (M + 1) / 2;
constexpr int rows_of_all = row_errors + 7 * K + 2, expectations = K + 2;

typedef REAL Stored __attribute__((vector_size(lanes * sizeof(REAL))));
INLINE REAL *block_of(const Call &call, int64_t first) { return call.table + first * rows_of_all; }
typedef float Singles __attribute__((vector_size(lanes * sizeof(float))));
INLINE V widened(V a) { return a; }
INLINE V widened(Mask a) { return __builtin_convertvector(a, V); }
INLINE V widened(Singles a) {
#if WHOLE_512  // one instruction, where g++ makes five of the general one
    return (V)_mm512_cvtps_pd((__m256)a);
#else
    return __builtin_convertvector(a, V);
#endif
}
INLINE void narrowed(V a, V &found) { found = a; }
INLINE void narrowed(V a, Singles &found) {
#if WHOLE_512
    found = (Singles)_mm512_cvtpd_ps((__m512d)a);
#else
    found = __builtin_convertvector(a, Singles);
#endif
}
INLINE V load(const REAL *from) {
    Stored found;
    __builtin_memcpy(&found, from, sizeof found);
    return widened(found);
}
INLINE void save(REAL *to, V value) {
    Stored found;
    narrowed(value, found);
    __builtin_memcpy(to, &found, sizeof found);
}
// As many numbers as there are streams, `step` apart: whole registers where that is possible.
template <typename From> INLINE V column(const From *from, int step, int count) {
    V found{};
    if (count == lanes && step == 1) {
        typedef From Whole __attribute__((vector_size(lanes * sizeof(From))));
        Whole whole;
        __builtin_memcpy(&whole, from, sizeof whole);
        return widened(whole);
    }
    for (int l = 0; l < count; ++l) found[l] = double(from[int64_t(l) * step]);
    return found;
}
INLINE int64_t *counts_of(const Call &call, int which, int64_t first) { return call.counts + which * call.stride + first; }
INLINE V count_of(const Call &call, int which, int64_t first, int count) {
    return column(counts_of(call, which, first), 1, count);
}
// Whole registers where there are so many streams: a copy of unknown size is a call.
INLINE void save_count(int64_t *to, Mask value, int count) {
    if (count == lanes) __builtin_memcpy(to, &value, sizeof value);
    else __builtin_memcpy(to, &value, count * sizeof *to);
}
INLINE Mask saved_count(const int64_t *from, int count) {
    Mask found{};
    if (count == lanes) __builtin_memcpy(&found, from, sizeof found);
    else __builtin_memcpy(&found, from, count * sizeof *from);
    return found;
}
// All but D, which is read where it is used.
INLINE void read(const Call &call, int64_t first, int count, Filter &s) {
    const REAL *at = block_of(call, first);
    int row = 0;
    auto next = [&] { return load(at + (row++) * lanes); };
    for (int i = 0; i < n; ++i) s.anchor[i] = next();
    for (int i = 0; i < n; ++i) s.last[i] = next();
    for (int o = 0; o <= K; ++o)
        for (int i = 0; i < M; ++i) s.mean[o][i] = next();
    row = row_errors;
    for (V *part = s.errors; part <= &s.largest; ++part) *part = next();
    s.since = count_of(call, 3, first, count);
}

INLINE int64_t own_block(int64_t first) { return sizeof(Number) == sizeof(V) ? first / lanes : 0; }
INLINE Law law_of(const Call &call, int64_t first, int count) {
    const V ratio = column(call.ratio + first, 1, count), forgetting = column(call.forgetting + first, 1, count);
    const int64_t at = own_block(first);
    return {ratio, forgetting, all(call.slack2[at]), all(call.robust[at]), call.size[at], call.tiny, call.most};
}
INLINE Functions functions_of(const Call &call, int64_t first) {
    const int64_t at = own_block(first);
    return {call.offsets + at * M * n, call.squares + at * M, call.newton + at * M * M, call.gram + at * M * M,
            call.rate[at], call.reach[at]};
}
#ifdef OWN
struct Gathered {  // functions of streams from anywhere in a tile
    V offsets[M * n], squares[M], newton[M * M], gram[M * M], rate, reach;
    Gathered(const Call &call, const int64_t *rows, int count) {
        auto gather = [&](V *to, const V *from, int size) {
            for (int k = 0; k < size; ++k) {
                to[k] = V{};
                for (int l = 0; l < lanes; ++l) {
                    const int64_t row = rows[l < count ? l : 0];
                    to[k][l] = from[row / lanes * size + k][row % lanes];
                }
            }
        };
        gather(offsets, call.offsets, M * n), gather(squares, call.squares, M), gather(newton, call.newton, M * M);
        gather(gram, call.gram, M * M), gather(&rate, call.rate, 1), gather(&reach, call.reach, 1);
    }
    Functions functions() const { return {offsets, squares, newton, gram, rate, reach}; }
};
#endif

static void tell(const Call &call) {
    for (int64_t first = 0; first < call.streams; first += lanes) {
        const int count = call.streams - first < lanes ? int(call.streams - first) : lanes;
        Filter s;
        read(call, first, count, s);
        const REAL *learned = block_of(call, first) + row_learned * lanes;
        V x[n], mean[K], deviation[K];
        for (int i = 0; i < n; ++i) x[i] = column(call.x + first * n + i, n, count);
        auto get = [&](int i) { return load(learned + i * lanes); };
        predict(functions_of(call, first), law_of(call, first, count), s, get, x, mean, deviation);
        if (K == 1 && count == lanes) {
            save(call.mean + first, mean[0]), save(call.deviation + first, deviation[0]);
            continue;
        }
        for (int o = 0; o < K; ++o)
            for (int l = 0; l < count; ++l) {
                call.mean[(first + l) * K + o] = REAL(mean[o][l]);
                call.deviation[(first + l) * K + o] = REAL(deviation[o][l]);
            }
    }
}

// Streams that move: gathered from anywhere in the tile, so that no others pay. Then `expected` has what was expected
// of every output, of one that is always 1, and the unknown share: (tile / lanes, K + 2).
static void move(const Call &call, const int64_t *rows, int count, const V *h, const Mask afresh, V *expected) {
    V mean[K + 1][M], learned[M * (M + 1) / 2], found[K + 2];
    REAL *place[lanes];
    for (int l = 0; l < count; ++l) place[l] = block_of(call, rows[l] / lanes * lanes) + rows[l] % lanes;
    auto at = [&](int row, int l) -> REAL & { return place[l][row * lanes]; };
    for (int o = 0; o <= K; ++o)
        for (int i = 0; i < M; ++i) {
            mean[o][i] = V{};
            for (int l = 0; l < count; ++l) mean[o][i][l] = at(row_mean + o * M + i, l);
        }
    for (int i = 0; i < row_errors - row_learned; ++i) {
        learned[i] = V{};
        for (int l = 0; l < count; ++l) learned[i][l] = at(row_learned + i, l);
    }
#ifdef OWN
    const Gathered gathered(call, rows, count);
    const Functions functions = gathered.functions();
#else
    const Functions functions = functions_of(call, 0);
#endif
    found[K + 1] = moments(functions, h, mean, [&](int i) { return learned[i]; }, found);
    for (int l = 0; l < count; ++l) {
        const double once = call.forgetting[rows[l]], lapse = call.lapse ? call.lapse[rows[l]] : 1;
        found[K + 1][l] = 1 - (lapse == 1 ? once : std::pow(once, lapse)) * found[K + 1][l];
    }
    for (int o = 0; o < expectations; ++o)
        for (int l = 0; l < count; ++l) expected[rows[l] % tile / lanes * expectations + o][rows[l] % lanes] = found[o][l];
    transfer(functions, h, mean, learned);
    for (int o = 0; o <= K; ++o)
        for (int i = 0; i < M; ++i)
            for (int l = 0; l < count; ++l) at(row_mean + o * M + i, l) = afresh[l] ? REAL(0) : REAL(mean[o][i][l]);
    for (int i = 0; i < row_errors - row_learned; ++i)
        for (int l = 0; l < count; ++l) at(row_learned + i, l) = afresh[l] ? REAL(0) : REAL(learned[i][l]);
    for (int i = 0; i < n; ++i)
        for (int l = 0; l < count; ++l) at(i, l) = at(n + i, l);  // the anchor goes to x
}

static void learn(const Call &call) {
    for (int64_t begin = 0; begin < call.streams; begin += tile) {
        const int64_t end = begin + tile < call.streams ? begin + tile : call.streams;
        Verdict verdicts[tile / lanes];
        V expected[tile / lanes * expectations];
        int64_t rows[lanes];
        V h[n]{};
        Mask afresh{};
        int moving = 0;
        for (int64_t first = begin; first < end; first += lanes) {
            const int count = end - first < lanes ? int(end - first) : lanes;
            Filter s;
            V x[n], y[K];
            Mask seen[K];
            read(call, first, count, s);
            for (int i = 0; i < n; ++i) x[i] = column(call.x + first * n + i, n, count);
            for (int o = 0; o < K; ++o) y[o] = column(call.y + first * K + o, K, count);
            Verdict &v = verdicts[(first - begin) / lanes];
            v = judge(law_of(call, first, count), s, x, y, seen, count_of(call, 2, first, count));
            REAL *block = block_of(call, first);
            for (int i = 0; i < n; ++i) save(block + (n + i) * lanes, s.last[i]);
            if (!any(v.moves)) continue;
            if (any(v.afresh))
                for (V *part = s.errors; part <= &s.largest; ++part) save(block + (row_errors + (part - s.errors)) * lanes, *part);
            for (int l = 0; l < count; ++l)
                if (v.moves[l]) {
                    rows[moving] = first + l;
                    for (int i = 0; i < n; ++i) h[i][moving] = v.z[i][l];
                    afresh[moving] = v.afresh[l];
                    if (v.afresh[l]) call.counts[3 * call.stride + first + l] = 0;
                    if (++moving == lanes) move(call, rows, moving, h, afresh, expected), moving = 0;
                }
        }
        if (moving) move(call, rows, moving, h, afresh, expected);
        for (int64_t first = begin; first < end; first += lanes) {
            const int count = end - first < lanes ? int(end - first) : lanes;
            const Verdict &v = verdicts[(first - begin) / lanes];
            Filter s;
            read(call, first, count, s);
            V y[K], z[n], lapse = all(1);
            Mask seen[K];
            for (int i = 0; i < n; ++i) z[i] = v.moves ? V{} : v.z[i];
            for (int o = 0; o < K; ++o) {
                y[o] = column(call.y + first * K + o, K, count);
                seen[o] = y[o] == y[o];
                y[o] = seen[o] ? y[o] : V{};
            }
            if (call.lapse)
                for (int l = 0; l < count; ++l) lapse[l] = call.lapse[first + l];
            REAL *block = block_of(call, first), *learned = block + row_learned * lanes;
            auto put = [&](int row, V value) { save(block + row * lanes, value); };
            const Mask good = update(
                functions_of(call, first), law_of(call, first, count), s, [&](int i) { return load(learned + i * lanes); },
                [&](int i, V value) { save(learned + i * lanes, value); }, z, y, seen, lapse, v.fine, v.stays,
                v.moves & ~v.afresh, expected + (first - begin) / lanes * expectations);
            for (int o = 0; o <= K; ++o)
                for (int i = 0; i < M; ++i) put(row_mean + o * M + i, s.mean[o][i]);
            for (V *part = s.errors; part <= &s.largest; ++part) put(row_errors + (part - s.errors), *part);
            int64_t *at = counts_of(call, 0, first), *skipped = counts_of(call, 1, first);
            save_count(at, saved_count(at, count) - good, count);
            save_count(skipped, saved_count(skipped, count) - ~good, count);
            const V streak = v.afresh & good ? V{} : v.streak;
            save_count(counts_of(call, 2, first), __builtin_convertvector(streak, Mask), count);
            save_count(counts_of(call, 3, first), __builtin_convertvector(s.since, Mask), count);
        }
    }
}

extern "C" int staf_filter(const Given *given) {
    const Call call{*given->of, *given};
    if (call.closed && call.mode & 4) return 0;
    if (call.mode & 1) tell(call);
    if (call.mode & 2) learn(call);
    return 1;
}
