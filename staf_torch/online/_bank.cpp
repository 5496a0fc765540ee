// A call of `Bank` on many streams, one after the other: what bank.py defines. The members of the bank are
// the lanes. DIM, COUNT, OUTPUTS, CAPACITY, NEIGHBOURS are given on the command line of the compiler.

#include "_filter.hpp"

#include <algorithm>
#include <cstring>

constexpr int C = CAPACITY, near = NEIGHBOURS, sides = 2, groups = 3, locals = groups * lanes, carried = lanes;
constexpr int members = locals + carried + 2, clocks = 3;  // the linear model and the last value beside them
constexpr int unknowns = n + 1;

struct Rules {  // see bank.py
    double rates[sides * 3 + 2];       // of the exponents: nearest by width, latest by width, the two fades
    double noise[locals];              // variances, in units of a member's amplitude
    double width[locals], fade[locals];  // which of the eight exponentials a member takes; fade -1 for none
    double discounts[clocks], discount, share, drop, heavy, likelihood;
    double members_rate, error_rate, linear_forgetting, linear_prior, recent, floor, margin, far, outlying;
    double rescaled[6], scaling, carried_forgetting[carried], carried_ratio, carried_slack2;
    Functions functions;
};

struct Local {  // a coordinate or an output
    double shift, scale;
};

struct Stream {  // the row of a stream in the table of bank.py
    double clock, count, far, skipped, learned, time;
    double last_x[n], last_y[K], asked[n], answered;
    double center[n + K], spread[n + K];
    double covariance[unknowns][unknowns], linear[K][unknowns];
    double filters[sizeof(Filter) / sizeof(double)];
    double weights[K][clocks][members], clock_weights[K][clocks], excess[K][members];
    double error[K], low[K], high[K], calibration[K];
    double means[K][members], variances[K][members], mixed[K][clocks], mixed_variance[K][clocks];
    double mean[K], variance[K];
    double x[C][n], y[C][K], when[C], order[C], gap[C];
};

struct Call {
    int64_t streams, mode;  // 1 to predict, 2 to learn
    double *table;  // of rows that began with zeros and were cleared

    const double *x, *y, *lapse;  // (streams, n), (streams, K), (streams)
    double *mean, *variance;      // (streams, K)
    const Rules *rules;
};

static double square(double a) { return a * a; }
static double shift_of(const Rules &r, const Stream &s, int i) { return r.scaling ? s.center[i] : 0; }
static double scale_of(const Rules &r, const Stream &s, int i) { return r.scaling ? s.spread[i] : 1; }

static void scaled(const Rules &r, const Stream &s, const double *x, double *u) {
    for (int i = 0; i < n; ++i) u[i] = (x[i] - shift_of(r, s, i)) / scale_of(r, s, i);
}
static double in_units(const Rules &r, const Stream &s, int o, double y) {
    return (y - shift_of(r, s, n + o)) / scale_of(r, s, n + o);
}
static double apart(const Rules &r, const Stream &s, const double *a, const double *b) {
    double sum = 0;
    for (int i = 0; i < n; ++i) sum += square((a[i] - b[i]) / scale_of(r, s, i));
    return sum;
}
static Filter filters_of(const Stream &s) {
    Filter f;
    std::memcpy(&f, s.filters, sizeof f);
    return f;
}
static Law law_of(const Rules &r) {
    Law law{all(r.carried_ratio), V{}, all(r.carried_slack2), all(infinity), all(1), 0, std::numeric_limits<double>::max(), 1e231};
    for (int l = 0; l < lanes; ++l) law.forgetting[l] = r.carried_forgetting[l];
    return law;
}

static void restart_linear(const Rules &r, Stream &s) {
    std::memset(s.covariance, 0, sizeof s.covariance + sizeof s.linear + sizeof s.filters);
    for (int i = 0; i < unknowns; ++i) s.covariance[i][i] = r.linear_prior;
    Filter f{};
    for (int i = 0; i < n; ++i) f.anchor[i] = f.last[i] = all(NAN);
    std::memcpy(s.filters, &f, sizeof f);
}

static void clear(const Rules &r, Stream &s) {
    const double skipped = s.skipped, learned = s.learned;
    std::memset(&s, 0, sizeof s);
    s.skipped = skipped, s.learned = learned;
    std::fill(s.last_x, s.last_x + n, NAN);
    std::fill(s.asked, s.asked + n, NAN);
    std::fill(s.spread, s.spread + n + K, 1);
    std::fill(s.order, s.order + C, -1);
    std::fill(s.gap, s.gap + C, infinity);
    std::fill(&s.excess[0][0], &s.excess[0][0] + K * members, 1);
    for (int o = 0; o < K; ++o) s.error[o] = s.calibration[o] = 1, s.low[o] = infinity, s.high[o] = -infinity;
    restart_linear(r, s);
}

// The carried models learn (x, y), the linear one and the filters.
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
    Filter f = filters_of(s);
    const Law law = law_of(r);
    V at[n], value[K], z[n];
    Mask seen[K];
    for (int i = 0; i < n; ++i) at[i] = all(u[i + 1]);
    for (int o = 0; o < K; ++o) value[o] = all(v[o]);
    const Verdict verdict = judge(law, f, at, value, seen, V{});
    for (int i = 0; i < n; ++i) z[i] = verdict.moves ? V{} : verdict.z[i];
    if (any(verdict.moves)) {
        Filter moved = f;
        transfer(r.functions, verdict.z, moved.mean, moved.learned);
        for (int i = 0; i < n; ++i) f.anchor[i] = verdict.moves ? at[i] : f.anchor[i];
        for (int o = 0; o < K; ++o)
            for (int i = 0; i < M; ++i)
                f.mean[o][i] = verdict.moves ? (verdict.afresh ? V{} : moved.mean[o][i]) : f.mean[o][i];
        for (int i = 0; i < M; ++i)
            for (int j = 0; j < M; ++j)
                f.learned[i][j] = verdict.moves ? (verdict.afresh ? V{} : moved.learned[i][j]) : f.learned[i][j];
    }
    update(r.functions, law, f, z, value, seen, all(lapse), verdict.fine);
    std::memcpy(s.filters, &f, sizeof f);
}

static bool beyond(const Rules &r, const Stream &s, const double *x, const double *y) {
    for (int i = 0; i < n + K; ++i) {
        const double value = i < n ? x[i] : y[i - n];
        if (!(std::fabs(value) < 1e150)) return true;
        if (s.clock >= 40 && !(std::fabs(value - s.center[i]) < r.far * s.spread[i])) return true;
    }
    return false;
}

template <typename Value> static double median(int count, Value value) {
    double sorted[C];
    for (int j = 0; j < count; ++j) sorted[j] = value(j);
    std::nth_element(sorted, sorted + (count - 1) / 2, sorted + count);
    return sorted[(count - 1) / 2];
}

// Units from the samples in the store, which has all of them; the carried models learn these again.
static void rescale(const Rules &r, Stream &s) {
    const int count = int(s.count);
    for (int i = 0; i < n + K; ++i) {
        auto value = [&](int j) { return i < n ? s.x[j][i] : s.y[j][i - n]; };
        double middle = median(count, value);
        const double typical = median(count, [&](int j) { return std::fabs(value(j) - middle); });
        double mean = 0, sum = 0, inside = 0;
        auto usual = [&](int j) { return typical == 0 || std::fabs(value(j) - middle) <= r.outlying * typical; };
        for (int j = 0; j < count; ++j)
            if (usual(j)) mean += value(j), inside += 1;
        mean /= inside;
        for (int j = 0; j < count; ++j)
            if (usual(j)) sum += square(value(j) - mean);
        const double spread = std::sqrt(sum / inside);
        s.center[i] = mean, s.spread[i] = spread > 1e-12 * std::fabs(mean) ? spread : 1;
    }
    std::fill(s.low, s.low + K, infinity);
    std::fill(s.high, s.high + K, -infinity);
    restart_linear(r, s);
    for (int j = 0; j < count; ++j) {
        if (beyond(r, s, s.x[j], s.y[j])) continue;
        for (int o = 0; o < K; ++o)
            s.low[o] = std::min(s.low[o], s.y[j][o]), s.high[o] = std::max(s.high[o], s.y[j][o]);
        carry(r, s, s.x[j], s.y[j], j ? s.when[j] - s.when[j - 1] : 1);
    }
}

// The nearest and the latest samples, nearest or latest first: indices, and how many there are.
static int choose(const Rules &r, const Stream &s, const double *x, int chosen[sides][near]) {
    const int count = int(s.count), most = std::min(near, count);
    double distance[C];
    int index[C];
    for (int j = 0; j < count; ++j) distance[j] = apart(r, s, s.x[j], x), index[j] = j;
    std::partial_sort(index, index + most, index + count, [&](int a, int b) {
        return distance[a] < distance[b] || (distance[a] == distance[b] && s.order[a] > s.order[b]);
    });
    std::copy(index, index + most, chosen[0]);
    for (int j = 0; j < count; ++j) index[j] = j;
    std::partial_sort(index, index + most, index + count, [&](int a, int b) { return s.order[a] > s.order[b]; });
    std::copy(index, index + most, chosen[1]);
    return most;
}

// The local Gaussian processes of what the linear model leaves: means and variances at x, in units.
static void local_processes(const Rules &r, Stream &s, const double *x, const double *u, const double *line) {
    int chosen[sides][near];
    const int count = choose(r, s, x, chosen);
    double at[sides][near + 1][n], when[near + 1], rest[sides][K][near];
    for (int h = 0; h < sides; ++h) {
        for (int i = 0; i < count; ++i) {
            const int j = chosen[h][i];
            scaled(r, s, s.x[j], at[h][i]);
            if (h == 0) when[i] = s.when[j];
            for (int o = 0; o < K; ++o) {
                double sum = in_units(r, s, o, s.y[j][o]) - s.linear[o][0];
                for (int k = 0; k < n; ++k) sum -= s.linear[o][k + 1] * at[h][i][k];
                rest[h][o][i] = sum;
            }
        }
        std::copy(u, u + n, at[h][count]);
    }
    when[count] = s.time;
    static thread_local V gram[groups][near + 1][near + 1];
    V exponents;
    for (int l = 0; l < lanes; ++l) exponents[l] = -r.rates[l];
    Mask width[groups], fade[groups];
    V noise[groups];
    for (int g = 0; g < groups; ++g)
        for (int l = 0; l < lanes; ++l) {
            width[g][l] = int64_t(r.width[g * lanes + l]);
            fade[g][l] = r.fade[g * lanes + l] < 0 ? lanes : int64_t(r.fade[g * lanes + l]);
            noise[g][l] = r.noise[g * lanes + l];
        }
    for (int i = 0; i <= count; ++i)
        for (int j = 0; j < std::min(i + 1, count); ++j) {
            double nearest = 0, latest = 0;
            for (int k = 0; k < n; ++k) {
                nearest += square(at[0][i][k] - at[0][j][k]);
                latest += square(at[1][i][k] - at[1][j][k]);
            }
            const double age = std::fabs(when[i] - when[j]);
            const V e = exponential(exponents * V{nearest, nearest, nearest, latest, latest, latest, age, age});
            for (int g = 0; g < groups; ++g)
                gram[g][i][j] = __builtin_shuffle(e, width[g]) * __builtin_shuffle(e, all(1), fade[g]);
        }
    for (int g = 0; g < groups; ++g) {
        auto &a = gram[g];
        V beta[K][near], mean[K], amplitude[K], seen{}, zero{};
        for (int o = 0; o < K; ++o) mean[o] = amplitude[o] = zero;
        for (int k = 0; k < count; ++k) {  // right-looking: the columns of the factor, and the solutions with them
            V pivot = maximum(a[k][k] + noise[g], noise[g]);  // a Schur complement is no smaller than the noise
            const V inverse = 1. / root(pivot);
            for (int i = k + 1; i <= count; ++i) a[i][k] *= inverse;
            for (int o = 0; o < K; ++o) {
                V sum;
                for (int l = 0; l < lanes; ++l) sum[l] = rest[(g * lanes + l) / 18][o][k];
                for (int j = 0; j < k; ++j) sum -= a[k][j] * beta[o][j];
                beta[o][k] = sum * inverse;
                mean[o] += beta[o][k] * a[count][k];
                amplitude[o] += beta[o][k] * beta[o][k];
            }
            seen += a[count][k] * a[count][k];
            for (int j = k + 1; j < count; ++j) {
                const V factor = a[j][k];
                for (int i = j; i <= count; ++i) a[i][j] -= a[i][k] * factor;
            }
        }
        for (int o = 0; o < K; ++o) {
            amplitude[o] /= double(count);
            const V variance = maximum(amplitude[o] * (1. + noise[g] - seen), amplitude[o] * noise[g]);
            for (int l = 0; l < lanes; ++l) {
                s.means[o][g * lanes + l] = line[o] + mean[o][l];
                s.variances[o][g * lanes + l] = variance[l];
            }
        }
    }
}

// What every member says at x, and their mixture.
static void ask(const Rules &r, Stream &s, const double *x) {
    double u[unknowns] = {1}, line[K], spread = 1;
    scaled(r, s, x, u + 1);
    for (int o = 0; o < K; ++o) {
        line[o] = 0;
        for (int i = 0; i < unknowns; ++i) line[o] += s.linear[o][i] * u[i];
    }
    for (int i = 0; i < unknowns; ++i)
        for (int j = 0; j < unknowns; ++j) spread += u[i] * s.covariance[i][j] * u[j];
    local_processes(r, s, x, u + 1, line);
    V at[n], mean[K], variance[K];
    for (int i = 0; i < n; ++i) at[i] = all(u[i + 1]);
    predict(r.functions, law_of(r), filters_of(s), at, mean, variance);
    for (int o = 0; o < K; ++o) {
        double *means = s.means[o], *variances = s.variances[o];
        for (int l = 0; l < carried; ++l) means[locals + l] = mean[o][l], variances[locals + l] = variance[o][l];
        means[members - 2] = line[o], variances[members - 2] = spread;
        means[members - 1] = in_units(r, s, o, s.last_y[o]), variances[members - 1] = 1;
        const double low = in_units(r, s, o, s.low[o]), high = in_units(r, s, o, s.high[o]);
        const double wide = r.margin * (high - low);
        for (int i = 0; i < members; ++i) {
            if (!(means[i] - means[i] == 0)) means[i] = means[members - 1];  // x itself may not be finite
            means[i] = std::min(std::max(means[i], low - wide), high + wide);
            if (!(variances[i] < 1e300)) variances[i] = 1e300;
        }
        double whole = 0, first = 0, second = 0, top = -infinity;
        for (int c = 0; c < clocks; ++c) top = std::max(top, s.clock_weights[o][c]);
        for (int c = 0; c < clocks; ++c) {
            const double *logs = s.weights[o][c], most = *std::max_element(logs, logs + members);
            double total = 0, middle = 0, around = 0, weights[members];
            for (int i = 0; i < members; ++i) {
                weights[i] = std::exp(logs[i] - most);
                if (weights[i] < r.drop) weights[i] = 0;
                total += weights[i], middle += weights[i] * means[i];
            }
            middle /= total;
            for (int i = 0; i < members; ++i)
                around += weights[i] * (variances[i] * s.excess[o][i] + square(means[i] - middle));
            s.mixed[o][c] = middle, s.mixed_variance[o][c] = around / total;
            const double weight = std::exp(s.clock_weights[o][c] - top);
            whole += weight, first += weight * middle;
        }
        first /= whole;
        for (int c = 0; c < clocks; ++c)
            second += std::exp(s.clock_weights[o][c] - top) / whole *
                      (s.mixed_variance[o][c] + square(s.mixed[o][c] - first));
        s.mean[o] = first, s.variance[o] = std::max(second, r.floor * s.error[o]) * s.calibration[o];
    }
    std::copy(x, x + n, s.asked);
    s.answered = 1;
}

static double score(const Rules &r, double error, double variance, double common) {
    auto student = [&](double v) {
        return -.5 * (r.heavy + 1) * std::log1p(error * error / (r.heavy * v));
    };
    variance = std::max(variance, 1e-30), common = std::max(common, 1e-30);
    return r.likelihood * (student(variance) - .5 * std::log(variance)) + (1 - r.likelihood) * student(common);
}
static void reweigh(const Rules &r, double *logs, const double *scores, int count, double discount) {
    double top = -infinity, total = 0;
    for (int i = 0; i < count; ++i) logs[i] = discount * logs[i] + scores[i], top = std::max(top, logs[i]);
    for (int i = 0; i < count; ++i) total += std::exp(logs[i] - top);
    for (int i = 0; i < count; ++i)
        logs[i] = std::log((1 - r.share) * std::exp(logs[i] - top) / total + r.share / count);
}

// The members are judged by their prediction of y.
static void judge_members(const Rules &r, Stream &s, int o, double y) {
    const double value = in_units(r, s, o, y), t = s.clock, error = value - s.mean[o];
    double z2 = error * error / std::max(s.variance[o] / s.calibration[o], 1e-300);
    s.calibration[o] += std::max(r.error_rate, 1 / (t + 5)) * (std::min(z2, surprise * s.calibration[o]) - s.calibration[o]);
    s.calibration[o] = std::min(std::max(s.calibration[o], 1e-6), 1e2);
    s.error[o] += std::max(r.error_rate, 1 / (t + 1)) * (std::min(error * error, surprise * s.error[o]) - s.error[o]);
    double scores[members], over[clocks];
    for (int i = 0; i < members; ++i) {
        const double e = value - s.means[o][i], v = s.variances[o][i], ratio = e * e / std::max(v, 1e-30);
        double &excess = s.excess[o][i];
        scores[i] = score(r, e, v * excess, s.error[o]);
        excess += std::max(r.members_rate, 1 / (t + 3)) * (std::min(ratio, surprise * excess) - excess);
        excess = std::min(std::max(excess, 1e-4), 1e8);
    }
    for (int c = 0; c < clocks; ++c) {
        over[c] = score(r, value - s.mixed[o][c], s.mixed_variance[o][c], s.error[o]);
        reweigh(r, s.weights[o][c], scores, members, r.discounts[c]);
    }
    reweigh(r, s.clock_weights[o], over, clocks, r.discount);
}

// Keep (x, y). A full store gives up the older of the closest pair of those that are not recent.
static void keep(const Rules &r, Stream &s, const double *x, const double *y) {
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
    s.when[slot] = s.time, s.order[slot] = s.clock, s.gap[slot] = infinity;
    for (int i = 0; i < count; ++i)
        if (s.order[i] == old + 1)  // it is recent no more from the next sample on
            for (int j = 0; j < count; ++j)
                if (s.order[j] <= old) {
                    const double d = apart(r, s, s.x[i], s.x[j]);
                    s.gap[i] = std::min(s.gap[i], d), s.gap[j] = std::min(s.gap[j], d);
                }
}

static void learn(const Rules &r, Stream &s, const double *given, const double *told, double lapse) {
    double x[n], y[K];
    bool some = false, measured = false, sound = true;
    for (int i = 0; i < n; ++i) x[i] = given[i] == given[i] ? given[i] : s.last_x[i], sound &= std::isfinite(x[i]);
    for (int i = 0; i < n; ++i) measured |= given[i] == given[i];
    for (int o = 0; o < K; ++o) some |= told[o] == told[o], sound &= !std::isinf(told[o]);
    for (int i = 0; i < n; ++i)
        if (std::isfinite(given[i]) && std::fabs(given[i]) < 1e150) s.last_x[i] = given[i];
    s.time += lapse;
    if (!sound || !some || !measured) {
        s.skipped += 1;
        return;
    }
    const bool known = s.count > 0;
    if (known && !(s.answered && std::equal(x, x + n, s.asked))) ask(r, s, x);
    for (int o = 0; o < K; ++o)
        y[o] = told[o] == told[o] ? told[o] : s.mean[o] * scale_of(r, s, n + o) + shift_of(r, s, n + o);
    s.answered = 0;
    s.far = beyond(r, s, x, y) ? s.far + 1 : 0;
    if (s.far >= streak_limit) {  // the stream has gone elsewhere for good
        const double time = s.time;
        clear(r, s);
        std::copy(x, x + n, s.last_x);
        s.time = time;
        if (beyond(r, s, x, y)) s.skipped += 1;
        else s.far = 0;
    } else if (s.far > 0) s.skipped += 1;
    else if (known)
        for (int o = 0; o < K; ++o)
            if (told[o] == told[o]) judge_members(r, s, o, y[o]);
    if (s.far > 0) return;
    for (int o = 0; o < K; ++o) {
        s.low[o] = std::min(s.low[o], y[o]), s.high[o] = std::max(s.high[o], y[o]);
        s.last_y[o] = y[o];
    }
    s.clock += 1, s.learned += 1;
    keep(r, s, x, y);
    if (std::find(r.rescaled, r.rescaled + 6, s.clock) != r.rescaled + 6) {
        rescale(r, s);
        return;
    }
    carry(r, s, x, y, lapse);
}

static void tell(const Rules &r, Stream &s, const double *given, double *mean, double *variance) {
    double x[n];
    for (int i = 0; i < n; ++i) x[i] = given[i] == given[i] ? given[i] : s.last_x[i];
    if (s.count > 0) ask(r, s, x);
    for (int o = 0; o < K; ++o) {
        const double scale = scale_of(r, s, n + o);
        mean[o] = s.count > 0 ? s.mean[o] * scale + shift_of(r, s, n + o) : 0;
        variance[o] = s.count > 0 ? s.variance[o] * scale * scale : 1;
    }
}

extern "C" void staf_bank(const Call *call) {
    Stream *streams = reinterpret_cast<Stream *>(call->table);
    for (int64_t i = 0; i < call->streams; ++i) {
        Stream &s = streams[i];
        if (call->mode & 1) tell(*call->rules, s, call->x + i * n, call->mean + i * K, call->variance + i * K);
        if (call->mode & 2)
            learn(*call->rules, s, call->x + i * n, call->y + i * K, call->lapse ? call->lapse[i] : 1);
    }
}
extern "C" int64_t staf_size() { return sizeof(Stream) / sizeof(double); }
