// How the members of a bank are mixed and judged: what mixture/mixing.py defines.

#pragma once

#include "_bank.hpp"

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

// The mixture of what the members say of an output, its correction, and its variance; within low and high.
static void mix(const Rules &r, Stream &s, int o, double low, double high) {
    const double *means = s.means[o], *variances = s.variances[o];
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
        s.mixed[o][c] = middle, s.mixed_variance[o][c] = around / all_of;
        const double weight = std::exp(s.clock_weights[o][c] - top);
        whole += weight, first += weight * middle;
    }
    first /= whole;
    for (int c = 0; c < clocks; ++c)
        second += std::exp(s.clock_weights[o][c] - top) / whole *
                  (s.mixed_variance[o][c] + square(s.mixed[o][c] - first));
    for (int i = 0; i < members - 1; ++i) {
        const int g = group_of(i);
        const double weight = std::exp(s.weights[o][clocks - 1][i] - slow * doubts[i] - highest[g]);
        total[g] += weight, sum[g] += weight * means[i];
    }
    const double unit = std::sqrt(std::max(s.pace[o], least)), most = r.correction_most;
    double stacked = 0;
    for (int g = 0; g < groups_of_members; ++g) {
        s.away[o][g] = std::min(std::max((sum[g] / total[g] - first) / unit, -most), most);
        stacked += s.correction[o][g] * s.away[o][g];
    }
    stacked = std::max(std::min(first + unit * stacked, high), low);
    double logs[members], peak = -infinity, whole_of = 0, squared = 0;
    for (int i = 0; i < members; ++i) logs[i] = s.squares[o][i] - r.doubt * doubts[i], peak = std::max(peak, logs[i]);
    for (int i = 0; i < members; ++i) {
        const double weight = std::exp(logs[i] - peak);
        whole_of += weight, squared += weight * means[i];
    }
    double *blend = s.blend[o];
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
    s.straight[o] = mixed(blends - 1);
    double part;
    const int knot = knot_of(r, s.straight[o], part);
    const double mapped = s.straight[o] + (1 - part) * s.map[o][0][knot] + part * s.map[o][0][knot + 1];
    blend[blends - 1] = std::max(std::min(mapped, high), low);
    s.mean[o] = mixed(blends);
    second += square(s.mean[o] - first);
    s.variance[o] = std::max(second, r.floor * s.pace[o]) * s.calibration[o];
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
static void learn_correction(const Rules &r, Stream &s, int o, double blended) {
    constexpr int G = groups_of_members;
    auto &covariance = s.correction_covariance[o];
    const double most = r.correction_most, *away = s.away[o];
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
static void learn_map(const Rules &r, Stream &s, int o, double value) {
    double part;
    const int knot = knot_of(r, s.straight[o], part);
    auto &correction = s.map[o][0], &known = s.map[o][1];
    const double of[] = {1 - part, part};
    const double error = value - s.straight[o] - of[0] * correction[knot] - of[1] * correction[knot + 1];
    for (int i = 0; i < 2; ++i) {
        double &k = known[knot + i];
        k = k * (1 - (1 - r.map_forgetting) * of[i]) + of[i] * of[i];
        correction[knot + i] += of[i] * error / (k + r.map_prior);
    }
}

// The members and their mixtures are judged by their prediction of an output, in units.
static void judge_members(const Rules &r, Stream &s, int o, double value) {
    const double t = s.clock, error = value - s.mean[o], blended = value - s.blend[o][0];
    learn_correction(r, s, o, blended);
    learn_map(r, s, o, value);
    const double z2 = error * error / std::max(s.variance[o] / s.calibration[o], 1e-300);
    const double surprised = std::min(z2, surprise * s.calibration[o]) - s.calibration[o], since = t - r.uncalibrated;
    if (since > 0) s.calibration[o] += std::max(r.error_rate, 1 / (since + 5)) * surprised;
    s.calibration[o] = std::min(std::max(s.calibration[o], 1e-6), 1e2);
    auto follow = [&](double &running, double found, double rate, double most) {
        running += std::max(rate, 1 / (t + 1)) * (std::min(found, most * running) - running);
    };
    double scores[members], over[clocks], of_blends[blends], least_square = infinity;
    for (int b = 0; b < blends; ++b) {
        const double e = value - s.blend[o][b];
        of_blends[b] = student(r, e, std::max(s.own[o], least)), least_square = std::min(least_square, e * e);
    }
    reweigh(s.corrected[o], of_blends, blends, r.correction_discount, r.correction_share);
    for (int i = 0; i < members; ++i)
        scores[i] = -r.squares_rate * std::min(square(value - s.means[o][i]) / std::max(s.best[o], least), 1e9);
    reweigh(s.squares[o], scores, members, r.squares_discount, r.squares_share);
    follow(s.error[o], blended * blended, r.error_rate, surprise);
    follow(s.pace[o], blended * blended, r.pace, surprise);
    follow(s.own[o], error * error, r.own_rate, r.largest);
    follow(s.best[o], least_square, r.best_rate, r.largest);
    for (int i = 0; i < members; ++i) {
        const double e = value - s.means[o][i], v = s.variances[o][i], ratio = e * e / std::max(v, least);
        double &excess = s.excess[o][i], &usual = s.usual[o][i];
        usual += std::max(r.members_rate, 1 / (t + 1)) * (std::log(std::max(v, least)) - usual);
        scores[i] = score(r, e, v * excess, s.error[o]);
        excess += std::max(r.members_rate, 1 / (t + 3)) * (std::min(ratio, surprise * excess) - excess);
        excess = std::min(std::max(excess, r.least), 1e8);
        const int l = i - locals - carried;
        if (l < 0 || l >= lanes) continue;
        double &size = s.quadratic_error[o][l];
        size = std::max(size * (1 + std::max(r.pace, 1 / (t + 2)) * (std::min(ratio, surprise) - 1)), 1e-26);
    }
    for (int c = 0; c < clocks; ++c) {
        over[c] = score(r, value - s.mixed[o][c], s.mixed_variance[o][c], s.error[o]);
        reweigh(s.weights[o][c], scores, members, r.discounts[c], r.share);
    }
    reweigh(s.clock_weights[o], over, clocks, r.discount, r.share);
}
