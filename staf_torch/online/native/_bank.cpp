// A call of `Bank` on many streams, one after the other: what mixture/definition.py defines. The members of the bank are
// the lanes. DIM, COUNT, OUTPUTS, CAPACITY, NEIGHBOURS are given on the command line of the compiler.

#include "_bank.hpp"

#include <cstring>

struct Streams {
    int64_t count;
    double *table;  // of rows that began with zeros and were cleared
    const Rules *rules;
};
struct Call {  // what belongs to a call alone: another thread may ask the same streams
    const Streams *streams;
    int64_t mode;                 // 1 to predict, 2 to learn
    const double *x, *y, *lapse;  // (count, n), (count, K), (count)
    double *mean, *deviation;     // (count, K)
    double *answers;              // of the streams as they are, to what was asked last
};

static Filter filters_of(const Stream &s) {
    Filter f;
    std::memcpy(&f, s.filters, sizeof f);
    return f;
}
static Law law_of(const Rules &r) {
    Law law{all(r.carried_ratio), V{}, all(square(r.carried_slack)), all(infinity), 1, 0, std::numeric_limits<double>::max()};
    for (int l = 0; l < lanes; ++l) law.forgetting[l] = r.carried_forgetting[l];
    return law;
}

INLINE V row(const double *from) {
    V found;
    std::memcpy(&found, from, sizeof found);
    return found;
}

// The trackers whose hyperparameters are learned.
constexpr int turned_lane = 0, plain_lane = 1, fading_lane = 4, turned_fading_lane = 5;

INLINE TrackerRules tracker_rules(const Rules &r, const Stream &s) {
    return {s.tracker_rate, s.tracker_noise, s.tracker_forgetting, r.tracker_jitter, r.tracker_wrong};
}
// Where the trackers see u: some in the coordinates of the metric.
INLINE void tracked_at(const Stream &s, const double *u, V *at) {
    double turned[n];
    turn(s.metric, u, turned);
    for (int i = 0; i < n; ++i) {
        at[i] = all(u[i]);
        at[i][turned_lane] = at[i][turned_fading_lane] = turned[i];
    }
}

static void restart_linear(const Rules &r, Stream &s) {
    std::memset(s.covariance, 0, sizeof s.covariance + sizeof s.linear + sizeof s.filters);
    s.trackers.restart(Mask{} == Mask{});
    for (int i = 0; i < unknowns; ++i) s.covariance[i][i] = r.linear_prior;
    s.quadratics.restart(row(r.quadratic_prior), Mask{} == Mask{});
    Filter f{};
    for (int i = 0; i < n; ++i) f.anchor[i] = f.last[i] = all(NAN);
    std::memcpy(s.filters, &f, sizeof f);
}

static void clear(const Rules &r, Stream &s) {
    const double skipped = s.skipped, learned = s.learned;
    std::memset(&s, 0, sizeof s);
    s.skipped = skipped, s.learned = learned;
    std::fill(s.last_x, s.last_x + n, NAN);
    std::fill(s.spread, s.spread + n + K, 1);
    std::fill(s.order, s.order + C, -1);
    std::fill(s.gap, s.gap + C, infinity);
    std::fill(&s.excess[0][0], &s.excess[0][0] + K * members, 1);
    std::fill(&s.quadratic_error[0][0], &s.quadratic_error[0][0] + K * lanes, 1);
    for (int o = 0; o < K; ++o) {
        s.error[o] = s.pace[o] = s.own[o] = s.best[o] = s.calibration[o] = 1, s.low[o] = infinity, s.high[o] = -infinity;
        for (int g = 0; g < groups_of_members; ++g) s.correction_covariance[o][g][g] = r.correction_prior;
    }
    s.tracker_rate = row(r.tracker_rate), s.tracker_noise = row(r.tracker_noise);
    s.tracker_forgetting = row(r.tracker_forgetting);
    for (int i = 0; i < n; ++i) s.metric[i][i] = 1;
    restart_linear(r, s);
}

// The carried models learn (x, y): the linear one, the quadratics, the trackers and the filters.
static void carry(const Rules &r, Stream &s, const double *x, const double *y, double lapse) {
    double u[unknowns] = {1}, v[K], gain[unknowns], spread = 1, most = 0;
    scaled(r, s, x, u + 1);
    for (int o = 0; o < K; ++o) v[o] = in_units(r, s, o, y[o]);
    for (int i = 0; i < unknowns; ++i) {
        gain[i] = 0;
        for (int j = 0; j < unknowns; ++j) gain[i] += s.covariance[i][j] * u[j];
        spread += u[i] * gain[i];
    }
    for (int o = 0; o < K; ++o) {
        double error = v[o];
        for (int i = 0; i < unknowns; ++i) error -= s.linear[o][i] * u[i];
        for (int i = 0; i < unknowns; ++i) s.linear[o][i] += gain[i] * error / spread;
    }
    for (int i = 0; i < unknowns; ++i) {
        for (int j = 0; j < unknowns; ++j) s.covariance[i][j] -= gain[i] * gain[j] / spread;
        most = std::max(most, s.covariance[i][i]);
    }
    const double faded = std::pow(r.linear_forgetting, lapse);
    if (most < 100 * r.linear_prior)  // what no sample says anything about would wind up
        for (auto &row : s.covariance)
            for (double &entry : row) entry /= faded;
    double phi[features];
    quadratic_features(u + 1, phi);
    auto after = [&](V share) {
        if (lapse != 1)
            for (int l = 0; l < lanes; ++l) share[l] = std::pow(share[l], lapse);
        return share;
    };
    s.quadratics.learn(phi, v, after(row(r.quadratic_forgetting)), row(r.quadratic_prior));
    Filter f = filters_of(s);
    const Law law = law_of(r);
    V at[n], value[K], z[n], place[n];
    Mask seen[K];
    for (int i = 0; i < n; ++i) at[i] = all(u[i + 1]);
    for (int o = 0; o < K; ++o) value[o] = all(v[o]);
    tracked_at(s, u + 1, place);
    s.trackers.learn(tracker_rules(r, s), place, value, after(s.tracker_forgetting));
    const Verdict verdict = judge(law, f, at, value, seen, V{});
    for (int i = 0; i < n; ++i) z[i] = verdict.moves ? V{} : verdict.z[i];
    V before[K + 2];
    if (any(verdict.moves)) {
        const V known = moments(r.functions, verdict.z, f.mean, [&](int i) { return f.learned[i]; }, before);
        before[K + 1] = 1. - after(law.forgetting) * known;
        Filter moved = f;
        transfer(r.functions, verdict.z, moved.mean, moved.learned);
        for (int i = 0; i < n; ++i) f.anchor[i] = verdict.moves ? at[i] : f.anchor[i];
        for (int o = 0; o <= K; ++o)
            for (int i = 0; i < M; ++i)
                f.mean[o][i] = verdict.moves ? (verdict.afresh ? V{} : moved.mean[o][i]) : f.mean[o][i];
        for (int i = 0; i < M * (M + 1) / 2; ++i)
            f.learned[i] = verdict.moves ? (verdict.afresh ? V{} : moved.learned[i]) : f.learned[i];
    }
    auto get = [&](int i) { return f.learned[i]; };
    update(r.functions, law, f, get, [&](int i, V value) { f.learned[i] = value; }, z, value, seen, all(lapse), verdict.fine, verdict.stays,
           verdict.moves & ~verdict.afresh, before);
    std::memcpy(s.filters, &f, sizeof f);
}

static bool beyond(const Rules &r, const Stream &s, const double *x, const double *y) {
    for (int i = 0; i < n + K; ++i) {
        const double value = i < n ? x[i] : y[i - n];
        if (!(std::fabs(value) < 1e150)) return true;
        const double most = s.clock >= 40 ? r.far : 1e100;  // young units may be tiny: squares must be numbers
        if (s.clock >= 2 && !(std::fabs(value - s.center[i]) < most * s.spread[i])) return true;
    }
    return false;
}

template <typename Value> static double median(int count, Value value) {
    double sorted[C];
    for (int j = 0; j < count; ++j) sorted[j] = value(j);
    std::nth_element(sorted, sorted + (count - 1) / 2, sorted + count);
    return sorted[(count - 1) / 2];
}

// Four trackers' hyperparameters, from the latest samples in the store, which has all of them in their order.
static void learn_trackers(const Rules &r, Stream &s) {
    static thread_local Stretch stretch;
    static thread_local Learned found;
    const int count = int(s.count);
    stretch.count = 0;
    int usable[most_searched];
    for (int j = count; j-- > 0 && stretch.count < most_searched;)
        if (!beyond(r, s, s.x[j], s.y[j])) usable[stretch.count++] = j;
    for (int i = 0; i < stretch.count; ++i) {
        const int j = usable[stretch.count - 1 - i];
        scaled(r, s, s.x[j], stretch.at[i]);
        for (int o = 0; o < K; ++o) stretch.y[o][i] = in_units(r, s, o, s.y[j][o]);
        stretch.when[i] = s.when[j];
    }
    learn_hyperparameters(stretch, found);
    std::memcpy(s.metric, found.metric, sizeof s.metric);
    auto take = [&](int lane, const Choice &c) {
        s.tracker_rate[lane] = c.rate, s.tracker_noise[lane] = c.noise, s.tracker_forgetting[lane] = std::exp(-2 * c.fade);
    };
    take(turned_lane, found.turned), take(plain_lane, found.plain);
    take(fading_lane, found.fading), take(turned_fading_lane, found.turned_fading);
}

// Units from the samples in the store, which has all of them; the carried models learn these again.
static void rescale(const Rules &r, Stream &s) {
    const int count = int(s.count);
    for (int i = 0; i < n + K; ++i) {
        auto value = [&](int j) { return i < n ? s.x[j][i] : s.y[j][i - n]; };
        double middle = median(count, value);
        const double typical = median(count, [&](int j) { return std::fabs(value(j) - middle); });
        double mean = 0, sum = 0, inside = 0, largest = 0;
        auto usual = [&](int j) { return typical == 0 || std::fabs(value(j) - middle) <= r.outlying * typical; };
        for (int j = 0; j < count; ++j)
            if (usual(j)) mean += value(j), inside += 1;
        mean /= inside;
        for (int j = 0; j < count; ++j)
            if (usual(j)) largest = std::max(largest, std::fabs(value(j) - mean));
        for (int j = 0; j < count; ++j)  // of the largest, whose square may be no number
            if (usual(j) && largest > 0) sum += square((value(j) - mean) / largest);
        const double spread = largest * std::sqrt(sum / inside);
        s.center[i] = mean, s.spread[i] = spread > std::max(1e-12 * std::fabs(mean), 1e-150) ? spread : 1;
    }
    bool never[K];  // measured so far
    for (int o = 0; o < K; ++o) never[o] = s.low[o] == infinity;
    std::fill(s.low, s.low + K, infinity);
    std::fill(s.high, s.high + K, -infinity);
    if (count >= r.searched_at) learn_trackers(r, s);
    std::memset(s.map, 0, sizeof s.map);
    restart_linear(r, s);
    for (int j = 0; j < count; ++j) {
        if (beyond(r, s, s.x[j], s.y[j])) continue;
        for (int o = 0; o < K; ++o)
            if (!never[o]) s.low[o] = std::min(s.low[o], s.y[j][o]), s.high[o] = std::max(s.high[o], s.y[j][o]);
        carry(r, s, s.x[j], s.y[j], j ? s.when[j] - s.when[j - 1] : 1);
    }
}

// What every member says at x and a time, and their mixture.
static void ask(const Rules &r, const Stream &s, double now, const double *x, Answer &a) {
    double u[unknowns] = {1}, line[K], spread = 1;
    scaled(r, s, x, u + 1);
    for (int o = 0; o < K; ++o) {
        line[o] = 0;
        for (int i = 0; i < unknowns; ++i) line[o] += s.linear[o][i] * u[i];
    }
    for (int i = 0; i < unknowns; ++i)
        for (int j = 0; j < unknowns; ++j) spread += u[i] * s.covariance[i][j] * u[j];
    local_processes(r, s, now, x, u + 1, line, a);
    V at[n], place[n], mean[K], deviation[K], bent[K], tracked[K];
    double phi[features];
    quadratic_features(u + 1, phi);
    const V bent_spread = s.quadratics.predict(phi, bent);
    for (int i = 0; i < n; ++i) at[i] = all(u[i + 1]);
    tracked_at(s, u + 1, place);
    const V tracked_spread = s.trackers.predict(tracker_rules(r, s), place, tracked);
    const V unknown = minimum(tracked_spread - s.tracker_noise, all(1));
    const Filter f = filters_of(s);
    predict(r.functions, law_of(r), f, [&](int i) { return f.learned[i]; }, at, mean, deviation);
    for (int o = 0; o < K; ++o) {
        double *means = a.means[o], *variances = a.variances[o];
        for (int l = 0; l < carried; ++l) means[locals + l] = mean[o][l], variances[locals + l] = square(deviation[o][l]);
        for (int l = 0; l < lanes; ++l) {
            means[locals + carried + l] = bent[o][l];
            variances[locals + carried + l] = bent_spread[l] * s.quadratic_error[o][l];
            means[locals + carried + lanes + l] = tracked[o][l] + square(unknown[l]) * line[o];
            variances[locals + carried + lanes + l] = tracked_spread[l];
        }
        means[members - 2] = line[o], variances[members - 2] = spread;
        const double last = s.waiting ? s.waiting_y[o] : s.last_y[o];
        means[members - 1] = in_units(r, s, o, last), variances[members - 1] = 1;
        const double low = in_units(r, s, o, std::min(s.low[o], last)), high = in_units(r, s, o, std::max(s.high[o], last));
        const double wide = r.margin * (high - low);
        for (int i = 0; i < members; ++i) {
            if (!(means[i] - means[i] == 0)) means[i] = means[members - 1];  // x itself may not be finite
            means[i] = std::min(std::max(means[i], low - wide), high + wide);
            if (!(variances[i] < 1e300)) variances[i] = 1e300;
        }
        mix(r, s, o, low - wide, high + wide, a);
    }
    std::copy(x, x + n, a.asked);
    a.answered = 1;
}

// Keep (x, y). A full store gives up the older of the closest pair of those that are not recent.
static void keep(const Rules &r, Stream &s, const double *x, const double *y, double time) {
    const double old = s.clock - r.recent;
    int slot = int(s.count), count = slot;
    if (count < C) {
        s.count = ++count;
    } else {
        slot = -1;
        for (int j = 0; j < C; ++j)
            if (s.order[j] <= old && (slot < 0 || s.gap[j] < s.gap[slot] ||
                                      (s.gap[j] == s.gap[slot] && s.order[j] < s.order[slot])))
                slot = j;
        slot = std::max(slot, 0);  // of a loaded table, in which every sample may call itself recent
        for (int i = 0; i < C; ++i) {
            if (i == slot || s.order[i] > old || apart(r, s, s.x[i], s.x[slot]) != s.gap[i]) continue;
            s.gap[i] = infinity;
            for (int j = 0; j < C; ++j)
                if (j != i && j != slot && s.order[j] <= old)
                    s.gap[i] = std::min(s.gap[i], apart(r, s, s.x[i], s.x[j]));
        }
    }
    std::copy(x, x + n, s.x[slot]);
    std::copy(y, y + K, s.y[slot]);
    s.when[slot] = time, s.order[slot] = s.clock, s.gap[slot] = infinity;
    for (int i = 0; i < count; ++i)
        if (s.order[i] == old + 1)  // it is recent no more from the next sample on
            for (int j = 0; j < count; ++j)
                if (s.order[j] <= old) {
                    const double d = apart(r, s, s.x[i], s.x[j]);
                    s.gap[i] = std::min(s.gap[i], d), s.gap[j] = std::min(s.gap[j], d);
                }
}

// The running mean and spread of y, as the filter's: what learn_scales of _filter.hpp does of it.
static void learn_spread(Stream &s, int o, double y) {
    const double told = s.told[o], spread = constant(s, o) ? 1 : s.wide[o], step = std::sqrt(surprise);
    double size = std::fabs(y - s.level[o]);
    const bool large = told > 0 && s.clock >= streak_limit + 2 && size > step * spread;
    if (large) size = std::min(size, std::pow(step, 1 + s.leaps[o]) * spread);
    s.leaps[o] = large ? std::min(s.leaps[o] + 1, 100.) : 0;
    const double rate = std::max(std::min(3 / (told + 3), 1 / std::max(told - 40, 1.)), spread_rate);
    s.wide[o] = std::sqrt(1 - rate) * std::hypot(s.wide[o], std::sqrt(rate) * size);
    s.level[o] += y < s.level[o] ? -rate * size : rate * size;
    if (s.wide[o] > 0 || told == 0) s.told[o] = std::min(told + 1, 2 / spread_rate);
}

// The range of y, of outputs that are measured now or have been before.
static void notice(Stream &s, const double *y, const bool *measured) {
    for (int o = 0; o < K; ++o) {
        if (!(measured && measured[o]) && s.low[o] == infinity) continue;
        s.low[o] = std::min(s.low[o], y[o]), s.high[o] = std::max(s.high[o], y[o]);
        s.last_y[o] = y[o];
        learn_spread(s, o, y[o]);
    }
}

static void accept(const Rules &r, Stream &s, const double *x, const double *y, double time, double lapse,
                   bool anew) {
    s.clock += 1, s.learned += 1;
    keep(r, s, x, y, time);
    anew |= std::find(r.learned_at, r.learned_at + 8, s.clock) != r.learned_at + 8;
    if (anew && s.clock <= C) rescale(r, s);
    else carry(r, s, x, y, lapse);
}

// Whether a sample that nobody expected waits: it is learned if the next one is as far off, else skipped.
static bool waits(const Rules &r, Stream &s, const Answer &a, const double *x, const double *y, const double *told,
                  double &lapse) {
    bool doubtful = false;
    for (int o = 0; o < K; ++o) {
        const double error = std::fabs(in_units(r, s, o, y[o]) - a.mean[o]);
        const double most = error > r.outside ? r.doubtful_outside : r.doubtful;
        doubtful |= told[o] == told[o] && square(error) > square(most) * std::max(a.variance[o], s.pace[o]);
    }
    const bool waiting = s.waiting, rare = s.doubted < r.rare;
    s.doubted += r.doubted_rate * (doubtful - s.doubted);
    if (doubtful && rare && s.clock >= r.settled && s.trust == 0) {
        s.waiting = !waiting;
        if (!waiting) {
            std::copy(x, x + n, s.waiting_x);
            std::copy(y, y + K, s.waiting_y);
            s.waiting_time = s.time, s.waiting_lapse = lapse;
            return true;
        }
        s.trust = streak_limit;
        notice(s, s.waiting_y, nullptr);
        accept(r, s, s.waiting_x, s.waiting_y, s.waiting_time, s.waiting_lapse, false);
        return false;
    }
    if (waiting) s.waiting = 0, s.skipped += 1, lapse += s.waiting_lapse;
    s.trust = std::max(s.trust - 1, 0.);
    return false;
}

static void learn(const Rules &r, Stream &s, Answer &a, const double *given, const double *told, double lapse) {
    double x[n], y[K], judged[K];
    bool first[K], seen[K], anew = false;  // the first value of an output says nothing of predictions
    bool some = false, measured = false, sound = true;
    for (int i = 0; i < n; ++i) x[i] = given[i] == given[i] ? given[i] : s.last_x[i], sound &= std::isfinite(x[i]);
    for (int i = 0; i < n; ++i) measured |= given[i] == given[i];
    bool repeats = std::equal(x, x + n, s.last_x);
    for (int o = 0; o < K; ++o) some |= told[o] == told[o], sound &= !std::isinf(told[o]);
    const bool known = s.count > 0, learns = sound && some && measured;
    // Judged is what was to be expected right after the sample before, whether or not somebody has asked for it.
    if (!known) a = Answer{};
    else if (learns && !(a.answered && s.unlearned == 0 && std::equal(x, x + n, a.asked)))
        ask(r, s, s.time - s.unlearned, x, a);
    a.answered = 0;
    for (int i = 0; i < n; ++i)
        if (std::isfinite(given[i]) && std::fabs(given[i]) < 1e150) s.last_x[i] = given[i];
    s.time += lapse, s.unlearned += lapse;
    if (!learns) {
        s.skipped += 1;
        return;
    }
    for (int o = 0; o < K; ++o) {
        seen[o] = told[o] == told[o];
        first[o] = known && seen[o] && s.low[o] == infinity && std::fabs(told[o]) < 1e150;
        judged[o] = first[o] ? NAN : told[o];
        y[o] = seen[o] && !first[o] ? told[o] : a.mean[o] * scale_of(r, s, n + o) + shift_of(r, s, n + o);
    }
    s.far = beyond(r, s, x, y) ? s.far + 1 : 0;
    if (s.far >= streak_limit) {  // the stream has gone elsewhere for good
        const double time = s.time;
        clear(r, s);
        std::copy(x, x + n, s.last_x);
        s.time = time;
        s.far = beyond(r, s, x, y) ? streak_limit : 0;
        s.skipped += s.far > 0;
    } else if (s.far > 0) s.skipped += 1;
    else if (known) {
        lapse = s.unlearned, s.unlearned = 0;
        if (waits(r, s, a, x, y, judged, lapse)) return;
        s.usual_unknown += std::max(error_rate, 1 / std::max(s.clock - 1, 1.)) * (a.unknown - s.usual_unknown);
        for (int o = 0; o < K; ++o)  // a sample that repeats the last one says nothing of errors
            if (judged[o] == judged[o] && !(repeats && y[o] == s.last_y[o] && !constant(s, o)))
                judge_members(r, s, a, o, in_units(r, s, o, y[o]));
    }
    if (s.far > 0) return;
    s.unlearned = 0;
    for (int o = 0; o < K; ++o)
        if (first[o]) {  // until now nothing was known of it: it counts as if it had always been so
            for (int j = 0; j < s.count; ++j) s.y[j][o] = told[o];
            y[o] = told[o], anew = true;
        }
    notice(s, y, seen);
    accept(r, s, x, y, s.time, lapse, anew);
}

static void tell(const Rules &r, const Stream &s, Answer &a, const double *given, double *mean, double *deviation) {
    double x[n];
    for (int i = 0; i < n; ++i) x[i] = given[i] == given[i] ? given[i] : s.last_x[i];
    if (s.count > 0) ask(r, s, s.time, x, a);
    else a = Answer{};
    for (int o = 0; o < K; ++o) {
        const double scale = scale_of(r, s, n + o);
        mean[o] = s.count > 0 ? a.mean[o] * scale + shift_of(r, s, n + o) : 0;
        deviation[o] = s.count > 0 ? std::sqrt(a.variance[o]) * scale : 1;
    }
}

extern "C" void staf_bank(const Call *call) {
    const Rules &r = *call->streams->rules;
    for (int64_t i = 0; i < call->streams->count; ++i) {
        Stream &s = reinterpret_cast<Stream *>(call->streams->table)[i];
        Answer &a = reinterpret_cast<Answer *>(call->answers)[i];
        if (call->mode & 1) tell(r, s, a, call->x + i * n, call->mean + i * K, call->deviation + i * K);
        if (call->mode & 2) learn(r, s, a, call->x + i * n, call->y + i * K, call->lapse ? call->lapse[i] : 1);
    }
}
