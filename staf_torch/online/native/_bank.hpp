// The rules and the table of `Bank`, see mixture/rules.py, and the local Gaussian processes on the samples in it.

#pragma once

#include "_members.hpp"

constexpr int near = NEIGHBOURS, sides = 2, groups = 3, locals = groups * lanes, carried = lanes;
constexpr int members = locals + carried + 2 * lanes + 2, clocks = 3;  // quadratics, trackers, the linear model, the last value
constexpr int unknowns = n + 1, groups_of_members = 11, blends = 4, knots = 33;
constexpr double least = 1e-30;  // of a variance
constexpr int judged_member = 2;  // by whose unknown share x is away from the samples
constexpr double still = 1e-4;    // variance, in units, of what has been constant so far

struct Rules {  // in the order of mixture/rules.py, which says what they are
    double width_rates[3], tracker_rate[lanes], scaling, carried_slack, fade_rates[2], noise[locals];
    double discounts[clocks], discount, share, doubts[clocks], doubt, drop, heavy, likelihood, members_rate, error_rate;
    double linear_forgetting, linear_prior, recent, floor, uncalibrated, margin, far, doubtful, doubtful_outside, outside;
    double rare, doubted_rate, settled, outlying, learned_at[8], carried_forgetting[carried], carried_ratio;
    double quadratic_forgetting[lanes], quadratic_prior[lanes], pace, correction_prior, correction_forgetting;
    double correction_most, correction_discount, correction_share, squares_discount, squares_rate, squares_share;
    double own_rate, best_rate, largest, searched_at, map_step, map_prior, map_forgetting;
    double tracker_noise[lanes], tracker_forgetting[lanes], tracker_jitter, tracker_wrong, least;
    Functions functions;
};

struct Stream {  // the row of a stream in the table of mixture/rules.py
    double clock, count, far, skipped, learned, time;
    double last_x[n], last_y[K];
    double waiting, trust, doubted, waiting_time, waiting_lapse, waiting_x[n], waiting_y[K];
    double center[n + K], spread[n + K];
    double covariance[unknowns][unknowns], linear[K][unknowns];
    double filters[sizeof(Filter) / sizeof(double)];
    Quadratics quadratics;
    double quadratic_error[K][lanes];
    Trackers trackers;
    Row tracker_rate, tracker_noise, tracker_forgetting;  // in place of those of the rules, once they are learned
    double metric[n][n];
    double weights[K][clocks][members], clock_weights[K][clocks], excess[K][members], usual[K][members];
    double squares[K][members];
    double error[K], pace[K], own[K], best[K], low[K], high[K], calibration[K];
    double level[K], wide[K], leaps[K], told[K];  // mean and spread of y
    double surprises[K];   // in a row
    double usual_unknown;  // running share of the variance of a local process that is unknown
    double correction_covariance[K][groups_of_members][groups_of_members], correction[K][groups_of_members];
    double corrected[K][blends];
    double map[K][2][knots];  // corrections, and what is known of them
    double x[C][n], y[C][K], when[C], order[C], gap[C];
    double unlearned;  // time that has passed in samples that were skipped
};

struct Answer {  // of a stream to a question, see mixture/rules.py: it belongs to who asks
    double asked[n], answered, unknown, weight[K], away[K][groups_of_members];
    double means[K][members], variances[K][members], mixed[K][clocks], mixed_variance[K][clocks];
    double blend[K][blends], straight[K], mean[K], variance[K];
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

// Lane which[l] of a, or of b from `lanes` on.
INLINE V picked(V a, V b, Mask which) {
#if defined(__clang__) || !WHOLE_512  // clang has no builtin of it, and g++ none that is fast elsewhere
    double from[2 * lanes], found[lanes];
    __builtin_memcpy(from, &a, sizeof a), __builtin_memcpy(from + lanes, &b, sizeof b);
    for (int l = 0; l < lanes; ++l) found[l] = from[which[l]];
    __builtin_memcpy(&a, found, sizeof a);
    return a;
#else
    return __builtin_shuffle(a, b, which);
#endif
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

// Takes what the columns before column k of a factor explain off some of its entries, which stay in registers.
template <int some> INLINE void take_off(V (*a)[near + 1], int k, int i, int p) {
    Piece left[some];
    for (int q = 0; q < some; ++q) left[q] = piece(&a[k][i + q], p);
    for (int j = 0; j < k; ++j) {
        const Piece factor = piece(&a[j][k], p);
        for (int q = 0; q < some; ++q) left[q] -= piece(&a[j][i + q], p) * factor;
    }
    for (int q = 0; q < some; ++q) piece(&a[k][i + q], p) = left[q];
}

// The local Gaussian processes of what the linear model leaves: means and variances at x, in units.
static void local_processes(const Rules &r, const Stream &s, double now, const double *x, const double *u,
                            const double *line, Answer &found) {
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
    when[count] = now;
    static thread_local V gram[groups][near][near + 1];  // by columns: where factors are taken off, they are read along
    const double *w = r.width_rates, *f = r.fade_rates;
    const V exponents = -V{w[0], w[1], w[2], w[0], w[1], w[2], f[0], f[1]};  // nearest, latest, by age
    Mask width[groups], fade[groups];
    V noise[groups];
    for (int g = 0; g < groups; ++g)
        for (int l = 0; l < lanes; ++l) {
            const int member = g * lanes + l, select = member / 6;  // nearest, with two rates of fading, latest
            width[g][l] = member % 6 / 2 + (select == 3 ? 3 : 0);
            fade[g][l] = select == 1 || select == 2 ? 5 + select : lanes;
            noise[g][l] = r.noise[member];
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
                gram[g][j][i] = picked(e, e, width[g]) * picked(e, all(1), fade[g]);
        }
    for (int g = 0; g < groups; ++g) {
        auto &a = gram[g];
        V beta[K][near], mean[K], amplitude[K], seen{}, zero{};
        for (int o = 0; o < K; ++o) mean[o] = amplitude[o] = zero;
        for (int k = 0; k < count; ++k) {  // the columns of the factor, and the solutions with them
            for (int p = 0; p < pieces; ++p) {
                int i = k;
                for (; i + 4 <= count + 1; i += 4) take_off<4>(a, k, i, p);
                for (; i <= count; ++i) take_off<1>(a, k, i, p);
            }
            V pivot = maximum(a[k][k] + noise[g], noise[g]);  // a Schur complement is no smaller than the noise
            const V inverse = 1. / root(pivot);
            for (int i = k + 1; i <= count; ++i) a[k][i] *= inverse;
            for (int o = 0; o < K; ++o) {
                V sum;
                for (int l = 0; l < lanes; ++l) sum[l] = rest[(g * lanes + l) / 18][o][k];
                for (int j = 0; j < k; ++j) sum -= a[j][k] * beta[o][j];
                beta[o][k] = sum * inverse;
                mean[o] += beta[o][k] * a[k][count];
                amplitude[o] += beta[o][k] * beta[o][k];
            }
            seen += a[k][count] * a[k][count];
            if (g == 0) found.unknown = std::max(1 - seen[judged_member], 0.);
        }
        for (int o = 0; o < K; ++o) {
            amplitude[o] /= double(count);
            const V variance = maximum(amplitude[o] * (1. + noise[g] - seen), amplitude[o] * noise[g]);
            for (int l = 0; l < lanes; ++l) {
                found.means[o][g * lanes + l] = line[o] + mean[o][l];
                found.variances[o][g * lanes + l] = variance[l];
            }
        }
    }
}

// The members are mixed and judged: what mixture/rules.py defines.

// The group of a member: see mixture/rules.py.
constexpr int group_of(int i) {
    return i < 18                     ? i % 6
           : i < locals               ? 6
           : i < locals + carried     ? 7
           : i < members - 2 - lanes  ? 8
           : i < members - 2          ? 9
           : i == members - 2         ? 10
                                      : -1;
}

// Where a mean stands among the knots of the map: the knot below it, and the part of the way to the next.
static int knot_of(const Rules &r, double mean, double &part) {
    const double place = std::min(knots - 1., std::max(0., mean / r.map_step + knots / 2));  // 0 for NaN
    const int knot = std::min(int(place), knots - 2);
    part = place - knot;
    return knot;
}

// y has been constant so far.
static bool constant(const Stream &s, int o) { return !(s.wide[o] > 1e-15 * std::fabs(s.level[o])); }

// Away from the samples the band goes over to the spread of y around its mean.
static void let_go(const Rules &r, const Stream &s, int o, Answer &a) {
    const double most = std::min(novel * s.usual_unknown, 1 - (1 - s.usual_unknown) / 4);
    const double away = std::min(std::max((a.unknown - most) / std::max(1 - most, 1e-9), 0.), 1.);
    const double middle = in_units(r, s, o, s.level[o]);
    const double far = square(a.mean[o] - middle) + (constant(s, o) ? 1 : square(s.wide[o] / scale_of(r, s, n + o)));
    const double near = a.variance[o] = std::max(a.variance[o], constant(s, o) ? still : 0);
    a.variance[o] = near + away * (far - near);
    a.weight[o] = near < far ? (1 - away) * near / a.variance[o] : 1;
}

// The mixture of what the members say of an output, its correction, and its variance; within low and high.
static void mix(const Rules &r, const Stream &s, int o, double low, double high, Answer &a) {
    const double *means = a.means[o], *variances = a.variances[o];
    double whole = 0, first = 0, second = 0, top = -infinity;
    for (int c = 0; c < clocks; ++c) top = std::max(top, s.clock_weights[o][c]);
    double doubts[members], claims[members], behind[members], surest = infinity;  // logarithms of variances
    for (int i = 0; i < members; ++i) {
        claims[i] = std::log(std::max(variances[i], least)), behind[i] = claims[i] + std::log(s.excess[o][i]);
        surest = std::min(surest, behind[i]);
    }
    for (int i = 0; i < members; ++i)
        doubts[i] = std::max(std::min(claims[i] - s.usual[o][i], behind[i] - surest), 0.);
    const double slow = r.doubts[clocks - 1];
    double total[groups_of_members]{}, sum[groups_of_members]{}, highest[groups_of_members];
    std::fill(highest, highest + groups_of_members, -infinity);
    for (int i = 0; i < members - 1; ++i)
        highest[group_of(i)] = std::max(highest[group_of(i)], s.weights[o][clocks - 1][i] - slow * doubts[i]);
    for (int c = 0; c < clocks; ++c) {
        double all_of = 0, middle = 0, around = 0, most = -infinity, weights[members];
        for (int i = 0; i < members; ++i) weights[i] = s.weights[o][c][i] - r.doubts[c] * doubts[i], most = std::max(most, weights[i]);
        for (int i = 0; i < members; ++i) {
            weights[i] = std::exp(weights[i] - most);
            if (weights[i] < r.drop) weights[i] = 0;
            all_of += weights[i], middle += weights[i] * means[i];
        }
        middle /= all_of;
        for (int i = 0; i < members; ++i)
            around += weights[i] * (variances[i] * s.excess[o][i] + square(means[i] - middle));
        a.mixed[o][c] = middle, a.mixed_variance[o][c] = around / all_of;
        const double weight = std::exp(s.clock_weights[o][c] - top);
        whole += weight, first += weight * middle;
    }
    first /= whole;
    for (int c = 0; c < clocks; ++c)
        second += std::exp(s.clock_weights[o][c] - top) / whole *
                  (a.mixed_variance[o][c] + square(a.mixed[o][c] - first));
    for (int i = 0; i < members - 1; ++i) {
        const int g = group_of(i);
        const double weight = std::exp(s.weights[o][clocks - 1][i] - slow * doubts[i] - highest[g]);
        total[g] += weight, sum[g] += weight * means[i];
    }
    const double unit = std::sqrt(std::max(s.pace[o], least)), most = r.correction_most;
    double stacked = 0;
    for (int g = 0; g < groups_of_members; ++g) {
        a.away[o][g] = std::min(std::max((sum[g] / total[g] - first) / unit, -most), most);
        stacked += s.correction[o][g] * a.away[o][g];
    }
    stacked = std::max(std::min(first + unit * stacked, high), low);
    double logs[members], peak = -infinity, whole_of = 0, squared = 0;
    for (int i = 0; i < members; ++i) logs[i] = s.squares[o][i] - r.doubt * doubts[i], peak = std::max(peak, logs[i]);
    for (int i = 0; i < members; ++i) {
        const double weight = std::exp(logs[i] - peak);
        whole_of += weight, squared += weight * means[i];
    }
    double *blend = a.blend[o];
    blend[0] = first, blend[1] = stacked, blend[2] = squared / whole_of;
    auto mixed = [&](int count) {
        double best = -infinity, parts = 0, sum = 0;
        for (int b = 0; b < count; ++b) best = std::max(best, s.corrected[o][b]);
        for (int b = 0; b < count; ++b) {
            const double share = std::exp(s.corrected[o][b] - best);
            if (share >= r.drop) parts += share, sum += share * blend[b];
        }
        return sum / parts;
    };
    a.straight[o] = mixed(blends - 1);
    double part;
    const int knot = knot_of(r, a.straight[o], part);
    const double mapped = a.straight[o] + (1 - part) * s.map[o][0][knot] + part * s.map[o][0][knot + 1];
    blend[blends - 1] = std::max(std::min(mapped, high), low);
    a.mean[o] = mixed(blends);
    second += square(a.mean[o] - first);
    a.variance[o] = std::max(second, r.floor * s.pace[o]) * s.calibration[o];
    let_go(r, s, o, a);
}

static double student(const Rules &r, double error, double variance) {
    return -.5 * (r.heavy + 1) * std::log1p(error * error / (r.heavy * variance));
}
static double score(const Rules &r, double error, double variance, double common) {
    variance = std::max(variance, least), common = std::max(common, least);
    return r.likelihood * (student(r, error, variance) - .5 * std::log(variance)) +
           (1 - r.likelihood) * student(r, error, common);
}
static void reweigh(double *logs, const double *scores, int count, double discount, double share) {
    double top = -infinity, total = 0;
    for (int i = 0; i < count; ++i) logs[i] = discount * logs[i] + scores[i], top = std::max(top, logs[i]);
    for (int i = 0; i < count; ++i) total += std::exp(logs[i] - top);
    for (int i = 0; i < count; ++i) logs[i] = std::log((1 - share) * std::exp(logs[i] - top) / total + share / count);
}

// Least squares of the mixture's error on the groups' distance from it, both in running errors.
static void learn_correction(const Rules &r, Stream &s, const Answer &a, int o, double blended) {
    constexpr int G = groups_of_members;
    auto &covariance = s.correction_covariance[o];
    const double most = r.correction_most, *away = a.away[o];
    double error = blended / std::sqrt(std::max(s.pace[o], least)), gain[G], total = r.correction_forgetting, widest = 0;
    error = std::min(std::max(error, -most), most);
    for (int g = 0; g < G; ++g) {
        gain[g] = 0;
        for (int h = 0; h < G; ++h) gain[g] += covariance[g][h] * away[h];
        total += away[g] * gain[g], error -= s.correction[o][g] * away[g];
    }
    for (int g = 0; g < G; ++g) {
        s.correction[o][g] += gain[g] * error / total;
        for (int h = 0; h < G; ++h) covariance[g][h] -= gain[g] * gain[h] / total;
        widest = std::max(widest, covariance[g][g]);
    }
    if (widest < r.correction_prior)
        for (auto &row : covariance)
            for (double &entry : row) entry /= r.correction_forgetting;
}

// The map of the mean learns by least squares, each of two knots as if it stood alone.
static void learn_map(const Rules &r, Stream &s, const Answer &a, int o, double value) {
    double part;
    const int knot = knot_of(r, a.straight[o], part);
    auto &correction = s.map[o][0], &known = s.map[o][1];
    const double of[] = {1 - part, part};
    const double error = value - a.straight[o] - of[0] * correction[knot] - of[1] * correction[knot + 1];
    for (int i = 0; i < 2; ++i) {
        double &k = known[knot + i];
        k = k * (1 - (1 - r.map_forgetting) * of[i]) + of[i] * of[i];
        correction[knot + i] += of[i] * error / (k + r.map_prior);
    }
}

// The members and their mixtures are judged by their prediction of an output, in units.
static void judge_members(const Rules &r, Stream &s, const Answer &a, int o, double value) {
    const double t = s.clock, error = value - a.mean[o], blended = value - a.blend[o][0];
    learn_correction(r, s, a, o, blended);
    learn_map(r, s, a, o, value);
    const double z2 = error * error / std::max(a.variance[o], 1e-300), since = t - r.uncalibrated;
    const double row = std::pow(surprise, s.surprises[o]);  // each in a row may be so many times larger
    const double surprised = std::min(std::max(a.weight[o] * (z2 - 1), -1.), surprise * row - 1) * s.calibration[o];
    if (since > 0) s.calibration[o] += std::max(r.error_rate, 1 / (since + 5)) * surprised;
    s.calibration[o] = std::min(std::max(s.calibration[o], 1e-6), 1e2);
    auto follow = [&](double &running, double found, double rate, double most) {
        running = std::max(running + std::max(rate, 1 / (t + 1)) * (std::min(found, most * row * running) - running), least);
    };
    double scores[members], over[clocks], of_blends[blends], least_square = infinity;
    for (int b = 0; b < blends; ++b) {
        const double e = value - a.blend[o][b];
        of_blends[b] = student(r, e, std::max(s.own[o], least)), least_square = std::min(least_square, e * e);
    }
    reweigh(s.corrected[o], of_blends, blends, r.correction_discount, r.correction_share);
    for (int i = 0; i < members; ++i)
        scores[i] = -r.squares_rate * std::min(square(value - a.means[o][i]) / std::max(s.best[o], least), 1e9);
    reweigh(s.squares[o], scores, members, r.squares_discount, r.squares_share);
    follow(s.error[o], blended * blended, r.error_rate, surprise);
    follow(s.pace[o], blended * blended, r.pace, surprise);
    follow(s.own[o], error * error, r.own_rate, r.largest);
    follow(s.best[o], least_square, r.best_rate, r.largest);
    for (int i = 0; i < members; ++i) {
        const double e = value - a.means[o][i], v = a.variances[o][i], ratio = e * e / std::max(v, least);
        double &excess = s.excess[o][i], &usual = s.usual[o][i];
        usual += std::max(r.members_rate, 1 / (t + 1)) * (std::log(std::max(v, least)) - usual);
        scores[i] = score(r, e, v * excess, s.error[o]);
        excess += std::max(r.members_rate, 1 / (t + 3)) * (std::min(ratio, surprise * row * excess) - excess);
        excess = std::min(std::max(excess, r.least), 1e8);
        const int l = i - locals - carried;
        if (l < 0 || l >= lanes) continue;
        double &size = s.quadratic_error[o][l];
        size = std::max(size * (1 + std::max(r.pace, 1 / (t + 2)) * (std::min(ratio, surprise * row) - 1)), 1e-26);
    }
    s.surprises[o] = z2 > surprise ? std::min(s.surprises[o] + 1, 40.) : 0;
    for (int c = 0; c < clocks; ++c) {
        over[c] = score(r, value - a.mixed[o][c], a.mixed_variance[o][c], s.error[o]);
        reweigh(s.weights[o][c], scores, members, r.discounts[c], r.share);
    }
    reweigh(s.clock_weights[o], over, clocks, r.discount, r.share);
}
