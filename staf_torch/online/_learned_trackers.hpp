// Hyperparameters of four trackers from the samples in the store: what learned_trackers.py defines.

#pragma once

#include "_bank.hpp"

#include <algorithm>

constexpr int most_searched = SEARCHED < C ? SEARCHED : C;

struct Stretch {  // samples, oldest first, in units
    int count;
    double at[most_searched][n], y[K][most_searched], when[most_searched];
};
struct Choice {
    double rate, noise, fade, score;
};
struct Learned {
    Choice turned, plain, fading, turned_fading;  // turned: in the coordinates of the metric
    double metric[n][n];
};

static double squared_distance(const Stretch &s, int i, int j) {
    double sum = 0;
    for (int k = 0; k < n; ++k) sum += (s.at[i][k] - s.at[j][k]) * (s.at[i][k] - s.at[j][k]);
    return sum;
}

// Logarithms of the marginal likelihood of a process in every lane, its amplitude the likeliest.
__attribute__((noinline)) static V likelihoods(const Stretch &s, V rate, V noise, V fade) {
    static thread_local V gram[most_searched][most_searched];  // the upper triangle, so that rows are eliminated
    V rest[K][most_searched], squares[K]{}, product = all(1), found{};
    for (int i = 0; i < s.count; ++i)
        for (int j = i; j < s.count; ++j)
            gram[i][j] = exponential(-rate * squared_distance(s, i, j) - fade * std::fabs(s.when[i] - s.when[j]));
    for (int o = 0; o < K; ++o)
        for (int i = 0; i < s.count; ++i) rest[o][i] = all(s.y[o][i]);
    for (int k = 0; k < s.count; ++k) {
        const V pivot = maximum(gram[k][k] + noise, noise), inverse = 1. / pivot;
        product *= pivot;
        if (k % 16 == 15 || k == s.count - 1) {  // sixteen pivots of at least 1e-7 do not underflow
            for (int l = 0; l < lanes; ++l) found[l] -= .5 * K * std::log(product[l]);
            product = all(1);
        }
        for (int o = 0; o < K; ++o) squares[o] += rest[o][k] * rest[o][k] * inverse;
        for (int j = k + 1; j < s.count; ++j) {
            const V factor = gram[k][j] * inverse;
            for (int o = 0; o < K; ++o) rest[o][j] -= rest[o][k] * factor;
            for (int i = j; i < s.count; ++i) gram[j][i] -= gram[k][i] * factor;
        }
    }
    for (int o = 0; o < K; ++o)
        for (int l = 0; l < lanes; ++l) found[l] -= .5 * s.count * std::log(std::max(squares[o][l], 1e-300));
    return found;
}

static void take_better(const Stretch &s, V rate, V noise, V fade, Choice &best) {
    noise = maximum(noise, all(1e-7));
    const V found = likelihoods(s, rate, noise, fade);
    for (int l = 0; l < lanes; ++l)
        if (found[l] > best.score) best = {rate[l], noise[l], fade[l], found[l]};
}

// The best and its eight neighbours, widths a factor apart and noises another.
static void take_around(const Stretch &s, double of_width, double of_noise, Choice &best) {
    V rate, noise;
    for (int l = 0; l < lanes; ++l) {
        const int place = l < 4 ? l : l + 1;
        rate[l] = best.rate * std::pow(of_width, -2 * (place % 3 - 1));
        noise[l] = best.noise * std::pow(of_noise, place / 3 - 1);
    }
    take_better(s, rate, noise, all(best.fade), best);
}

static Choice search(const Stretch &s) {
    Choice best{1. / (2 * n), 1, 0, -infinity};
    V rate;
    for (int l = 0; l < lanes; ++l) rate[l] = std::exp2(4 - 2 * l) / (2 * n);
    for (double noise : {1e-6, 1e-4, 1e-2, .3}) take_better(s, rate, all(noise), V{}, best);
    take_around(s, std::sqrt(2.), 10, best);
    take_around(s, std::sqrt(std::sqrt(2.)), std::sqrt(10.), best);
    return best;
}

static Choice search_fading(const Stretch &s, Choice best) {
    V rate = all(best.rate), noise = all(best.noise), fade;
    for (int l = 0; l < lanes; ++l) fade[l] = (const double[]){5e-4, 5e-3, 1.5e-2, 5e-2}[l % 4];
    for (int l = 4; l < lanes; ++l) rate[l] /= 4, noise[l] /= 10;
    take_better(s, rate, noise, fade, best);
    take_around(s, 2, 10, best);
    return best;
}

// A metric from the mean outer product of the process's gradients; lower triangular, squares of sum n.
static void sensitivity(const Stretch &s, const Choice &c, double metric[n][n]) {
    static thread_local double kernel[most_searched][most_searched], factor[most_searched][most_searched];
    double weights[K][most_searched], outer[n][n]{}, trace = 0;
    const int m = s.count;
    for (int i = 0; i < m; ++i)
        for (int j = 0; j <= i; ++j) kernel[i][j] = kernel[j][i] = std::exp(-c.rate * squared_distance(s, i, j));
    for (int j = 0; j < m; ++j)
        for (int i = j; i < m; ++i) {
            double sum = kernel[i][j] + (i == j ? c.noise : 0);
            for (int k = 0; k < j; ++k) sum -= factor[i][k] * factor[j][k];
            factor[i][j] = i == j ? std::sqrt(std::max(sum, c.noise)) : sum / factor[j][j];
        }
    for (int o = 0; o < K; ++o) {
        for (int i = 0; i < m; ++i) {
            double sum = s.y[o][i];
            for (int k = 0; k < i; ++k) sum -= factor[i][k] * weights[o][k];
            weights[o][i] = sum / factor[i][i];
        }
        for (int i = m; i-- > 0;) {
            double sum = weights[o][i];
            for (int k = i + 1; k < m; ++k) sum -= factor[k][i] * weights[o][k];
            weights[o][i] = sum / factor[i][i];
        }
        for (int i = 0; i < m; ++i) {
            double gradient[n]{};
            for (int j = 0; j < m; ++j)
                for (int p = 0; p < n; ++p) gradient[p] += kernel[i][j] * weights[o][j] * (s.at[j][p] - s.at[i][p]);
            for (int p = 0; p < n; ++p)
                for (int q = 0; q <= p; ++q) outer[p][q] += gradient[p] * gradient[q];
        }
    }
    for (int p = 0; p < n; ++p) trace += outer[p][p];
    constexpr double ridge = .1;
    for (int j = 0; j < n; ++j)
        for (int i = 0; i < n; ++i) {
            metric[i][j] = 0;
            if (i < j) continue;
            const double share = trace > 0 ? outer[i][j] / trace : i == j ? 1. / n : 0;
            double sum = (share * n + (i == j ? ridge * n : 0)) / (1 + ridge * n);
            for (int k = 0; k < j; ++k) sum -= metric[i][k] * metric[j][k];
            metric[i][j] = i == j ? std::sqrt(sum) : sum / metric[j][j];
        }
}

// What a metric makes of a point.
static void turn(const double metric[n][n], const double *u, double *turned) {
    for (int j = 0; j < n; ++j) {
        turned[j] = 0;
        for (int i = j; i < n; ++i) turned[j] += u[i] * metric[i][j];
    }
}

static void learn_hyperparameters(const Stretch &s, Learned &found) {
    static thread_local Stretch turned;
    found.plain = search(s), found.fading = search_fading(s, found.plain);
    sensitivity(s, found.plain, found.metric);
    turned = s;
    for (int i = 0; i < s.count; ++i) turn(found.metric, s.at[i], turned.at[i]);
    found.turned = search(turned), found.turned_fading = search_fading(turned, found.turned);
}
