// The rules and the table of `Bank`, see mixture/rules.py, and the local Gaussian processes on the samples in it.

#pragma once

#include "_members.hpp"

constexpr int near = NEIGHBOURS, sides = 2, groups = 3, locals = groups * lanes, carried = lanes;
constexpr int members = locals + carried + 2 * lanes + 2, clocks = 3;  // quadratics, trackers, the linear model, the last value
constexpr int unknowns = n + 1, groups_of_members = 11, blends = 4, knots = 33;
constexpr double least = 1e-30;  // of a variance

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
    double last_x[n], last_y[K], asked[n], answered;
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
    double correction_covariance[K][groups_of_members][groups_of_members], correction[K][groups_of_members];
    double away[K][groups_of_members], corrected[K][blends];
    double map[K][2][knots];  // corrections, and what is known of them
    double means[K][members], variances[K][members], mixed[K][clocks], mixed_variance[K][clocks];
    double blend[K][blends], straight[K], mean[K], variance[K];
    double x[C][n], y[C][K], when[C], order[C], gap[C];
    double unlearned;  // time that has passed in samples that were skipped
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
#ifdef __clang__  // which has no builtin of it for lanes that are not constants
    V found;
    for (int l = 0; l < lanes; ++l) found[l] = which[l] < lanes ? a[which[l]] : b[which[l] - lanes];
    return found;
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
                gram[g][i][j] = picked(e, e, width[g]) * picked(e, all(1), fade[g]);
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
