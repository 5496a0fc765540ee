// A call of `LocalFilter` on many streams: what kalman_filter.py defines. REAL is the type of the streams.

#include "_filter.hpp"

struct Call {
    int64_t streams, stride, mode;  // 1 to predict, 2 to learn
    REAL *table;                    // see StreamState, a row every stride
    int64_t *counts;                // (4, stride)
    const REAL *x, *y;              // (streams, n), (streams, K)
    const double *lapse;            // (streams), or null for ones
    const double *ratio, *forgetting;  // (streams)
    REAL *mean, *variance;          // (streams, K)
    Functions functions;
    double slack2, robust, base, tiny, most, limit;
};
constexpr int tile = 64;  // streams that are worked on together stay in the cache
constexpr int row_mean = 2 * n, row_learned = row_mean + K * M, row_errors = row_learned + M * M;

typedef REAL Stored __attribute__((vector_size(lanes * sizeof(REAL))));
INLINE V load(const REAL *from, int count) {
    Stored found{};
    if (count == lanes) __builtin_memcpy(&found, from, sizeof found);
    else __builtin_memcpy(&found, from, count * sizeof(REAL));
    return __builtin_convertvector(found, V);
}
INLINE void save(REAL *to, V value, int count) {
    const Stored found = __builtin_convertvector(value, Stored);
    if (count == lanes) __builtin_memcpy(to, &found, sizeof found);
    else __builtin_memcpy(to, &found, count * sizeof(REAL));
}
INLINE V column(const REAL *from, int step, int count) {
    V found{};
    for (int l = 0; l < count; ++l) found[l] = from[int64_t(l) * step];
    return found;
}
INLINE V count_of(const Call &call, int which, int64_t first, int count) {
    V found{};
    for (int l = 0; l < count; ++l) found[l] = double(call.counts[which * call.stride + first + l]);
    return found;
}
INLINE void read(const Call &call, int64_t first, int count, Filter &s, bool whole) {
    const REAL *at = call.table + first;
    int row = 0;
    auto next = [&] { return load(at + (row++) * call.stride, count); };
    for (int i = 0; i < n; ++i) s.anchor[i] = next();
    for (int i = 0; i < n; ++i) s.last[i] = next();
    for (int o = 0; o < K; ++o)
        for (int i = 0; i < M; ++i) s.mean[o][i] = next();
    if (whole)
        for (int i = 0; i < M; ++i)
            for (int j = 0; j < M; ++j) s.learned[i][j] = next();
    row = row_errors;
    for (int o = 0; o < K; ++o) s.errors[o] = next();
    s.largest = next();
    s.since = count_of(call, 3, first, count);
}

INLINE Law law_of(const Call &call, int64_t first, int count) {
    Law law{all(1), all(1), all(call.slack2), all(call.robust), all(call.base), call.tiny, call.most, call.limit};
    for (int l = 0; l < count; ++l) law.ratio[l] = call.ratio[first + l], law.forgetting[l] = call.forgetting[first + l];
    return law;
}

static void tell(const Call &call) {
    for (int64_t first = 0; first < call.streams; first += lanes) {
        const int count = call.streams - first < lanes ? int(call.streams - first) : lanes;
        Filter s{};
        read(call, first, count, s, true);
        V x[n], mean[K], variance[K];
        for (int i = 0; i < n; ++i) x[i] = column(call.x + first * n + i, n, count);
        predict(call.functions, law_of(call, first, count), s, x, mean, variance);
        for (int o = 0; o < K; ++o)
            for (int l = 0; l < count; ++l) {
                call.mean[(first + l) * K + o] = REAL(mean[o][l]);
                call.variance[(first + l) * K + o] = REAL(variance[o][l]);
            }
    }
}

// Streams that move: gathered from anywhere in the tile, so that no others pay.
static void move(const Call &call, const int64_t *rows, int count, const V *h, const Mask afresh) {
    V mean[K][M], learned[M][M], *flat = &learned[0][0];
    auto at = [&](int row, int l) -> REAL & { return call.table[row * call.stride + rows[l]]; };
    for (int o = 0; o < K; ++o)
        for (int i = 0; i < M; ++i) {
            mean[o][i] = V{};
            for (int l = 0; l < count; ++l) mean[o][i][l] = at(row_mean + o * M + i, l);
        }
    for (int i = 0; i < M * M; ++i) {
        flat[i] = V{};
        for (int l = 0; l < count; ++l) flat[i][l] = at(row_learned + i, l);
    }
    transfer(call.functions, h, mean, learned);
    for (int o = 0; o < K; ++o)
        for (int i = 0; i < M; ++i)
            for (int l = 0; l < count; ++l) at(row_mean + o * M + i, l) = afresh[l] ? REAL(0) : REAL(mean[o][i][l]);
    for (int i = 0; i < M * M; ++i)
        for (int l = 0; l < count; ++l) at(row_learned + i, l) = afresh[l] ? REAL(0) : REAL(flat[i][l]);
    for (int i = 0; i < n; ++i)
        for (int l = 0; l < count; ++l) at(i, l) = at(n + i, l);  // the anchor goes to x
}

static void learn(const Call &call) {
    for (int64_t begin = 0; begin < call.streams; begin += tile) {
        const int64_t end = begin + tile < call.streams ? begin + tile : call.streams;
        Verdict verdicts[tile / lanes];
        int64_t rows[lanes];
        V h[n]{};
        Mask afresh{};
        int moving = 0;
        for (int64_t first = begin; first < end; first += lanes) {
            const int count = end - first < lanes ? int(end - first) : lanes;
            Filter s;
            V x[n], y[K];
            Mask seen[K];
            read(call, first, count, s, false);
            for (int i = 0; i < n; ++i) x[i] = column(call.x + first * n + i, n, count);
            for (int o = 0; o < K; ++o) y[o] = column(call.y + first * K + o, K, count);
            Verdict &v = verdicts[(first - begin) / lanes];
            v = judge(law_of(call, first, count), s, x, y, seen, count_of(call, 2, first, count));
            for (int i = 0; i < n; ++i) save(call.table + (n + i) * call.stride + first, s.last[i], count);
            for (int o = 0; o < K; ++o) save(call.table + (row_errors + o) * call.stride + first, s.errors[o], count);
            if (!any(v.moves)) continue;
            for (int l = 0; l < count; ++l)
                if (v.moves[l]) {
                    rows[moving] = first + l;
                    for (int i = 0; i < n; ++i) h[i][moving] = v.z[i][l];
                    afresh[moving] = v.afresh[l];
                    if (v.afresh[l]) {
                        call.counts[3 * call.stride + first + l] = 0;
                        call.table[(row_errors + K) * call.stride + first + l] = 0;
                    }
                    if (++moving == lanes) move(call, rows, moving, h, afresh), moving = 0;
                }
        }
        if (moving) move(call, rows, moving, h, afresh);
        for (int64_t first = begin; first < end; first += lanes) {
            const int count = end - first < lanes ? int(end - first) : lanes;
            const Verdict &v = verdicts[(first - begin) / lanes];
            Filter s;
            read(call, first, count, s, true);
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
            const Mask good = update(call.functions, law_of(call, first, count), s, z, y, seen, lapse, v.fine);
            auto put = [&](int row, V value) { save(call.table + row * call.stride + first, value, count); };
            for (int o = 0; o < K; ++o) {
                put(row_errors + o, s.errors[o]);
                for (int i = 0; i < M; ++i) put(row_mean + o * M + i, s.mean[o][i]);
            }
            for (int i = 0; i < M; ++i)
                for (int j = 0; j < M; ++j) put(row_learned + i * M + j, s.learned[i][j]);
            put(row_errors + K, s.largest);
            for (int l = 0; l < count; ++l) {
                int64_t *at = call.counts + first + l;
                at[0] += good[l] != 0, at[call.stride] += good[l] == 0;
                at[2 * call.stride] = v.afresh[l] && good[l] ? 0 : int64_t(v.streak[l]);
                at[3 * call.stride] = int64_t(s.since[l]);
            }
        }
    }
}

extern "C" void staf_filter(const Call *call) {
    if (call->mode & 1) tell(*call);
    if (call->mode & 2) learn(*call);
}
