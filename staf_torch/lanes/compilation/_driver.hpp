// Tiles of rows through pieces of time. What a program must define before: the numbers of entries ROWS, NOWS,
// AHEAD, CARRIES, FIXED, the slots SLOTS_*, which inputs of times are READ, COPIES of a vector that advance together,
// the operations WORK_ROW of a row and WORK_STEP of a step, and `prepare`, `ahead` and `advance`.

#pragma once

struct Slot {  // strides of (rows, times, entries), in numbers
    int64_t row, time, entry, entries;
};
struct Again;
struct Call {
    int64_t rows, times, every;
    const REAL *table;
    const Slot *slots;
    void (*parallel)(void (*)(void *), void *, unsigned, unsigned);
    const Again *again;
};
// Another program that makes inputs of times, tile by tile: they stay in a cache. It runs from the first time to the
// last, this one from the last to the first.
struct Again {
    void (*run)(const Call *, REAL *const *, int64_t);
    const Call *call;
    REAL *const *data;
    int64_t inputs, results;
    const int64_t *to;  // of each result: the input of a time here, or -1
};

constexpr int lanes = COPIES * W, tile_rows = TILE > lanes ? TILE : lanes, room = tile_rows + lanes;
constexpr int now_bytes = 1 << 15, most_times = 256, least_times = 8, most_kept = 1 << 22;
constexpr int64_t most_cached = 1 << 22;  // bytes of an output that the caches may hold until somebody reads it

struct Frame {
    REAL *fixed, *carry, *now;
    const REAL *c;
    const Slot *outputs;
    REAL *const *data;  // of the outputs
    int rows, times, span, step;  // of `now`: from number to number, from time to time
    int64_t first, time, every, recorded;
};
static void prepare(const Frame &f, int b);
static void ahead(const Frame &f);
static void advance(const Frame &f, int b, int rows);

INLINE void copy(const REAL *from, int count, REAL *to) {
    int r = 0;
    for (; r + W <= count; r += W) store(to + r, load(from + r));
    for (; r < count; ++r) to[r] = from[r];
}
// One number a row; beyond the rows they come again.
INLINE void gather(const Slot *slot, REAL *const *data, int slots, int64_t first, int rows, REAL *to) {
    const int whole = (rows + lanes - 1) / lanes * lanes;
    for (int s = 0; s < slots; ++s, ++slot)
        for (int64_t e = 0; e < slot->entries; ++e, to += room) {
            const REAL *from = data[s] + first * slot->row + e * slot->entry;
            if (slot->row == 1)
                copy(from, rows, to);
            else
                for (int r = 0; r < rows; ++r) to[r] = from[r * slot->row];
            for (int r = rows; r < whole; ++r) to[r] = to[r - rows];
        }
}
#if defined(__GNUC__) && !defined(__clang__)
#define TRANSPOSES 1
// W vectors of W numbers change rows and columns: blocks of W / 2 places, of W / 4, ... of 1.
template <int...> struct Places {};
template <int S, int... L> INLINE void exchange(V &a, V &b, Places<L...>) {
    const VB low = {(L & S ? W + L - S : L)...}, high = {(L & S ? W + L : L + S)...};
    const V first = __builtin_shuffle(a, b, low);
    b = __builtin_shuffle(a, b, high), a = first;
}
template <int S> INLINE void transpose(V *v) {
    if constexpr (S > 0) {
        UNROLLED for (int i = 0; i < W; ++i)
            if (!(i & S)) exchange<S>(v[i], v[i + S], Places<__integer_pack(W)...>());
        transpose<S / 2>(v);
    }
}
#else
#define TRANSPOSES 0
#endif

// Of every row one number after the other, of f.times times and `entries` entries: vectors of rows. `from` is the
// first of them in memory, and of the last time where times go back. By itself a compiler takes a tenth less time for
// the program than inlined.
__attribute__((noinline)) static int transposed(const REAL *from, int64_t row, int entries, bool back, const Frame &f, REAL *to) {
#if TRANSPOSES
    const int rows = f.rows, span = f.span, numbers = f.times * entries, whole = numbers / W * W;
    const int next = back ? -numbers : numbers, later = back ? -rows : rows, begin = back ? (f.times - 1) * rows : 0;
    for (int r = 0; r + W <= rows; r += W)
        for (int first = 0, t = begin, e = 0; first < whole; first += W) {
            V v[W];
            UNROLLED for (int k = 0; k < W; ++k) {
                v[k] = load(from + (r + k) * row + first);
                __builtin_prefetch(from + (r + k) * row + first + next);  // of the next piece of time
            }
            transpose<W / 2>(v);
            UNROLLED for (int k = 0; k < W; ++k) {
                store(to + int64_t(e) * span + t + r, v[k]);
                if (++e == entries) e = 0, t += later;
            }
        }
    return whole;
#else
    return 0;
#endif
}
INLINE void gather_times(const Slot *slot, REAL *const *data, int slots, const Frame &f, REAL *to) {
    for (int s = 0; s < slots; to += slot->entries * f.span, ++s, ++slot) {
        if (!READ[s]) continue;
        const REAL *const from = data[s] + f.first * slot->row + f.time * slot->time;
        const int entries = int(slot->entries);
        const bool back = slot->time == -entries;
        const bool dense = (slot->time == entries || back) && (slot->entry == 1 || entries == 1) && slot->row > 1;
        const REAL *const least = back ? from + (f.times - 1) * slot->time : from;
        const int done = dense && f.rows >= W ? transposed(least, slot->row, entries, back, f, to) : 0;
        const bool far = slot->time * slot->time > int64_t(entries) * entries * f.rows * f.rows;
        const int there = done ? f.rows / W * W : 0;  // rows of which `done` numbers are there
        for (int e = 0; e < entries; ++e) {
            const REAL *const at = from + e * slot->entry;
            REAL *const column = to + int64_t(e) * f.span;
            for (int r = 0; r < lanes; ++r) column[f.times * f.rows + r] = at[0];
            if (slot->row == 1) {
                if (far)  // from time to time
                    for (int t = 0; t < f.times; ++t)
                        for (int r = 0; r < f.rows; r += W) __builtin_prefetch(at + (t + f.times) * slot->time + r);
                for (int t = 0; t < f.times; ++t) copy(at + t * slot->time, f.rows, column + t * f.rows);
            } else
                for (int r = 0; r < f.rows; ++r) {
                    const int met = r < there ? (done - e + entries - 1) / entries : 0;
                    const int first = back ? 0 : met, last = back ? f.times - met : f.times;
                    for (int t = first; t < last; ++t) column[t * f.rows + r] = at[r * slot->row + t * slot->time];
                }
        }
    }
}
extern "C" void *aligned_alloc(__SIZE_TYPE__, __SIZE_TYPE__);  // of the C library: clang has no builtin of it
INLINE REAL *allocate(int64_t numbers) {
    return static_cast<REAL *>(aligned_alloc(64, (numbers * sizeof(REAL) + 127) / 64 * 64));
}

// Sums of COUNT products of a table's numbers and vectors, some of them in registers at once.
template <int SOME, int COUNT, int ROW, int STEP, int NEXT> INLINE void panel(const REAL *c, const V *x, V *to) {
    V sum[SOME];
    UNROLLED for (int r = 0; r < SOME; ++r) sum[r] = splat(c[r * ROW]) * x[0];
    for (int q = 1; q < COUNT; ++q) {
        const V one = x[q * NEXT];
        UNROLLED for (int r = 0; r < SOME; ++r) sum[r] = fma(splat(c[r * ROW + q * STEP]), one, sum[r]);
    }
    UNROLLED for (int r = 0; r < SOME; ++r) to[r] = sum[r];
}
template <int OUTS, int COUNT, int ROW, int STEP, int NEXT>
__attribute__((noinline)) static void products(const REAL *c, const V *x, V *to) {
    constexpr int panels = (OUTS + 7) / 8, some = (OUTS + panels - 1) / panels;
    for (int p = 0; p + some <= OUTS; p += some) panel<some, COUNT, ROW, STEP, NEXT>(c + p * ROW, x, to + p);
    constexpr int rest = OUTS % some;
    if constexpr (rest > 0) panel<rest, COUNT, ROW, STEP, NEXT>(c + (OUTS - rest) * ROW, x, to + OUTS - rest);
}

// A thread's memory stays with it from call to call: fresh pages cost more than a short program.
struct Memory {
    REAL *data = nullptr;
    int64_t held = 0;
    REAL *of(int64_t numbers) {
        if (numbers > held) __builtin_free(data), data = allocate(held = numbers);
        return data;
    }
    void give_back() {
        if (held * int64_t(sizeof(REAL)) > most_kept) __builtin_free(data), data = nullptr, held = 0;
    }
    ~Memory() { __builtin_free(data); }
};
static thread_local Memory memory;

// Inputs of times that another program makes of the rows of a tile.
static thread_local Memory made;
struct Remade {
    const Call &call;
    const Again *again;  // null: none
    Slot *now, *slots;  // of this program's inputs of times, and of all of the other's
    REAL **now_data, **data;
    bool whole = false;  // whether it is all that times bring, number after number

    void begin(REAL *const *from, int64_t tile) {
        int64_t size = 0, other = 0;  // of a time
        for (int s = 0; s < SLOTS_NOW; ++s) now[s] = call.slots[SLOTS_ROW + s], now_data[s] = from[SLOTS_ROW + s];
        for (int64_t s = 0; s < again->inputs + again->results; ++s) slots[s] = again->call->slots[s];
        for (int64_t k = 0; k < again->results; ++k)
            (again->to[k] < 0 ? other : size) += slots[again->inputs + k].entries * tile;
        REAL *to = made.of(size * call.times + other), *rest = to + size * call.times;
        for (int64_t k = 0; k < again->results; ++k) {
            Slot &slot = slots[again->inputs + k];
            const int64_t here = again->to[k];
            REAL *&place = here < 0 ? rest : to;
            data[again->inputs + k] = place, place += slot.entries * tile;
            slot = {1, here < 0 ? 0 : size, tile, slot.entries};
            if (here >= 0) now[here] = {1, -size, tile, slot.entries};
        }
        int64_t met = 0;
        whole = AHEAD == 0;
        for (int s = 0; s < SLOTS_NOW; met += now[s++].entries)
            whole = whole && (now[s].time == -size || !READ[s]);
        whole = whole && met * tile == size;
    }
    void run(int64_t first, int rows) {
        Call part = *again->call;
        part.rows = rows, part.slots = slots, part.parallel = nullptr;
        for (int64_t s = 0; s < again->inputs; ++s) data[s] = again->data[s] + first * slots[s].row;
        for (int64_t k = 0; k < again->results; ++k)
            if (again->to[k] >= 0)
                now_data[again->to[k]] = data[again->inputs + k] + (call.times - 1) * slots[again->inputs + k].time - first;
        again->run(&part, data, 1);
    }
};

struct Work {
    const Call &call;
    REAL *const *data;
    int64_t tile, next;

    void run() {
        int most = now_bytes / int(sizeof(REAL)) / (tile * (NOWS + AHEAD > 0 ? NOWS + AHEAD : 1));
        most = most < 1 ? 1 : most < most_times ? most : most_times;
        // A piece also reads and writes the whole carry.
        most = (AHEAD > 0 || CARRIES > NOWS) && most < least_times ? least_times : most;
        most = most < call.times ? most : int(call.times);
        const int span = most * int(tile) + lanes;
        const int64_t numbers = int64_t(ROWS + FIXED + CARRIES) * room + int64_t(NOWS + AHEAD) * span;
        const Slot *now = call.slots + SLOTS_ROW, *carry = now + SLOTS_NOW, *out = carry + SLOTS_CARRY;
        REAL *const *now_data = data + SLOTS_ROW, *const *carry_data = now_data + SLOTS_NOW;
        REAL *const *out_data = carry_data + SLOTS_CARRY;
        const int64_t others = call.again ? call.again->inputs + call.again->results : 0;
        Slot made_slots[SLOTS_NOW + others + 1];
        REAL *made_data[SLOTS_NOW + others + 1];
        Remade remade{call, call.again, made_slots, made_slots + SLOTS_NOW, made_data, made_data + SLOTS_NOW};
        if (call.again) remade.begin(data, tile), now = made_slots, now_data = made_data;
        Frame f;
        f.fixed = memory.of(numbers + lanes), f.carry = f.fixed + (ROWS + FIXED) * room;
        REAL *const gathered = f.carry + CARRIES * room;
        f.c = call.table, f.outputs = out + SLOTS_CARRY, f.data = out_data + SLOTS_CARRY;
        f.every = call.every, f.recorded = (call.times + call.every - 1) / call.every;
        for (int64_t first; (first = __atomic_fetch_add(&next, tile, __ATOMIC_RELAXED)) < call.rows;) {
            f.first = first, f.rows = int(call.rows - first < tile ? call.rows - first : tile);
            if (call.again) remade.run(first, f.rows);
            gather(call.slots, data, SLOTS_ROW, first, f.rows, f.fixed);
            gather(carry, carry_data, SLOTS_CARRY, first, f.rows, f.carry);
            for (int b = 0; b < (f.rows + lanes - 1) / lanes * lanes; b += W) prepare(f, b);
            const bool there = remade.whole && f.rows % lanes == 0;  // read where it lies
            f.span = there ? int(now->entry) : span, f.step = there ? int(now->time) : f.rows;
            for (f.time = 0; f.time < call.times; f.time += most) {
                f.times = int(call.times - f.time < most ? call.times - f.time : most);
                f.now = there ? now_data[0] + f.first + f.time * now->time : gathered;
                if (!there) gather_times(now, now_data, SLOTS_NOW, f, f.now);
                ahead(f);
                for (int b = 0; b < f.rows; b += lanes) advance(f, b, f.rows - b < lanes ? f.rows - b : lanes);
            }
            const REAL *from = f.carry;
            for (int s = 0; s < SLOTS_CARRY; ++s)
                for (int64_t e = 0; e < out[s].entries; ++e, from += room) {
                    REAL *to = out_data[s] + first * out[s].row + e * out[s].entry;
                    if (out[s].row == 1)
                        copy(from, f.rows, to);
                    else
                        for (int r = 0; r < f.rows; ++r) to[r * out[s].row] = from[r];
                }
        }
        wait_for_streams();
        memory.give_back(), made.give_back();
    }
    static void task(void *data) { static_cast<Work *>(data)->run(); }
};

// Counts the times from one that is recorded to the next, and writes to the place of the latest.
struct Recorder {
    const Frame &f;
    int64_t left, place;  // times to go, and recorded ones
    INLINE_METHOD Recorder(const Frame &f) : f(f), place((f.time + f.every - 1) / f.every) {
        left = place * f.every - f.time, --place;
    }
    INLINE_METHOD bool due() {
        if (left--) return false;
        left = f.every - 1, ++place;
        return true;
    }
    // Entry e of output s: rows b.. of the tile.
    INLINE_METHOD void put(int s, int64_t e, int b, int rows, V x) const {
        const Slot &slot = f.outputs[s];
        REAL *to = f.data[s] + f.first + b + place * slot.time + e * slot.entry;
        const bool far = slot.time * f.recorded > most_cached / int64_t(sizeof(REAL));
        if (rows >= W && far && reinterpret_cast<uintptr_t>(to) % sizeof(V) == 0) return stream(to, x);
        if (rows >= W) return store(to, x);
        if (rows > 0) store_first(to, x, rows);
    }
};

// Operations of vectors, .4 ns each, that repay another thread: 100 us, where it takes 20 to wake one. Up to `brief`
// of them, 20 ms, a call is not to wait for a thread that something else interrupts.
constexpr double grain = 250000, brief = 5e7;

extern "C" void lanes_run(const Call *call, REAL *const *data, int64_t most_threads) {
    const double operations = double((call->rows + W - 1) / W) * (WORK_ROW + double(call->times) * WORK_STEP);
    if (operations < grain * double(most_threads)) most_threads = operations < grain ? 1 : int64_t(operations / grain);
    const int64_t even = (call->rows + most_threads - 1) / most_threads;
    const int64_t wanted = (even + lanes - 1) / lanes * lanes, most = call->again ? lanes : tile_rows;
    const int64_t tile = wanted < most ? wanted : most;
    const int64_t tiles = (call->rows + tile - 1) / tile, few = call->rows < tile ? call->rows : tile;
    Work work{*call, data, few, 0};
    const int threads = int(tiles < most_threads ? tiles : most_threads);
    if (threads > 1 && call->parallel) return call->parallel(Work::task, &work, unsigned(threads), operations < brief ? 8 : 0);
    work.run();
}
