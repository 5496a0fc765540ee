// Models that a bank carries along, eight side by side: what mixture/members.py defines.

#pragma once

#include "_filter.hpp"

#include <algorithm>

constexpr int C = CAPACITY;

// Least squares on products of coordinates, a rate of forgetting in every lane.

constexpr int most_features = 120;
constexpr int features = (n + 1) * (n + 2) / 2 <= most_features ? (n + 1) * (n + 2) / 2
                         : 2 * n + 1 <= most_features           ? 2 * n + 1
                                                                : n + 1;
typedef double Row __attribute__((vector_size(64), aligned(8), may_alias));  // lanes in a table of doubles

struct Quadratics {
    Row factor[features * (features + 1) / 2];  // columns of U above the diagonal, each followed by its entry of D
    Row coefficients[K][features];

    Row *column(int j) { return factor + j * (j + 1) / 2; }
    const Row *column(int j) const { return factor + j * (j + 1) / 2; }

    void restart(V prior, Mask where) {
        for (int j = 0; j < features; ++j)
            for (int i = 0; i <= j; ++i) column(j)[i] = where ? (i < j ? V{} : prior) : V(column(j)[i]);
        for (int o = 0; o < K; ++o)  // by index: a reference to a row of them would promise 64 bytes of alignment
            for (int j = 0; j < features; ++j) coefficients[o][j] = where ? V{} : V(coefficients[o][j]);
    }

    // U' phi
    void along(const double *phi, V *found) const {
        for (int j = 0; j < features; ++j) {
            const Row *own = column(j);
            V sum = all(phi[j]);
            for (int i = 0; i < j; ++i) sum += own[i] * phi[i];
            found[j] = sum;
        }
    }

    // The means, and the variance in units of the noise.
    V predict(const double *phi, V *mean) const {
        V f[features], spread = all(1);
        along(phi, f);
        for (int j = 0; j < features; ++j) spread += column(j)[j] * f[j] * f[j];
        for (int o = 0; o < K; ++o) {
            mean[o] = V{};
            for (int j = 0; j < features; ++j) mean[o] += coefficients[o][j] * phi[j];
        }
        return spread;
    }

    // Bierman's update; what was known fades by share, no further than the prior.
    void learn(const double *phi, const double *value, V share, V prior) {
        V f[features], gain[features], total = share, check{};
        along(phi, f);
        for (int j = 0; j < features; ++j) {
            Row *own = column(j);
            const V v = own[j] * f[j], following = total + f[j] * v, back = -f[j] / total;
            own[j] = minimum(own[j] * (total / following) / share, prior);
            check += own[j];
            for (int i = 0; i < j; ++i) {
                const V old = own[i];
                own[i] = old + gain[i] * back;
                gain[i] += old * v;
                check += own[i];
            }
            gain[j] = v, total = following;
        }
        for (int o = 0; o < K; ++o) {
            V error = all(value[o]);
            for (int j = 0; j < features; ++j) error -= coefficients[o][j] * phi[j];
            error /= total;
            for (int j = 0; j < features; ++j) check += coefficients[o][j] += gain[j] * error;
        }
        const Mask broken = ~finite(check);
        if (any(broken)) restart(prior, broken);  // the features overflow: these models begin anew
    }
};

INLINE void quadratic_features(const double *u, double *phi) {
    int count = 0;
    phi[count++] = 1;
    for (int i = 0; i < n; ++i) phi[count++] = u[i];
    if (features == n + 1) return;
    for (int i = 0; i < n; ++i)
        for (int j = i; j < (features == 2 * n + 1 && n > 1 ? i + 1 : n); ++j) phi[count++] = u[i] * u[j];
}

// Gaussian processes on few samples of the whole past, one in every lane.

constexpr int D = TRACKED, entries = D * (D + 1) / 2;  // places for samples; one is free in a full process

struct TrackerRules {
    Row rate, noise, forgetting;  // of the exponent; a variance; of a unit of time
    double jitter, wrong;
};

struct Trackers {
    Row points[D][n], weights[K][D];
    Row known[entries], inverse[entries];  // lower triangles, by rows
    Row vacant, count, turn;               // the free place, samples kept, the place that is checked next

    static int triangle(int i, int j) { return i > j ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i; }

    static void clear(Row *from, int count, Mask where) {
        for (int i = 0; i < count; ++i) from[i] = where ? V{} : V(from[i]);
    }
    void restart(Mask where) {
        for (int i = 0; i < D; ++i) clear(points[i], n, where);
        for (int o = 0; o < K; ++o) clear(weights[o], D, where);
        clear(known, entries, where), clear(inverse, entries, where);
        clear(&vacant, 1, where), clear(&count, 1, where), clear(&turn, 1, where);
    }

    int used() const {
        double most = 0;
        for (int l = 0; l < lanes; ++l) most = count[l] > most ? count[l] : most;
        return most + 1 < D ? int(most) + 1 : D;
    }

    void kernels(const TrackerRules &r, const V *x, int size, V *k) const {
        for (int i = 0; i < size; ++i) {
            V apart{};
            for (int j = 0; j < n; ++j) apart += (points[i][j] - x[j]) * (points[i][j] - x[j]);
            k[i] = exponential(-r.rate * apart);
        }
    }
    static void product(const Row *matrix, const V *k, int size, V *found) {
        for (int i = 0; i < size; matrix += ++i)
            for (int p = 0; p < pieces; ++p) {
                const Piece own = piece(k + i, p);
                Piece sum{};
                for (int j = 0; j < i; ++j) {
                    const Piece entry = piece(matrix + j, p);
                    sum += entry * piece(k + j, p);
                    piece(found + j, p) += entry * own;
                }
                piece(found + i, p) = sum + piece(matrix + i, p) * own;
            }
    }
    // Entry j of a row of its own in every lane.
    static V entry_of(const Row *matrix, const int *row, int j) {
        V found{};
        for (int l = 0; l < lanes; ++l) found[l] = matrix[triangle(row[l], j)][l];
        return found;
    }

    // Means, and the variance of the next value.
    V predict(const TrackerRules &r, const V *x, V *mean) const {
        const int size = used();
        V k[D], b[D], spread = all(1 + r.jitter);
        kernels(r, x, size, k);
        product(known, k, size, b);
        for (int i = 0; i < size; ++i) spread -= k[i] * b[i];
        for (int o = 0; o < K; ++o) {
            mean[o] = V{};
            for (int i = 0; i < size; ++i) mean[o] += weights[o][i] * k[i];
        }
        return maximum(spread, V{}) + r.noise;
    }

    void learn(const TrackerRules &r, const V *x, const V *value, V share) {
        const int size = used();
        V k[D], s[D], q[D], rest = all(1 + r.jitter), spread = rest;
        kernels(r, x, size, k);
        product(known, k, size, s);
        product(inverse, k, size, q);
        for (int i = 0; i < size; ++i) spread -= share * k[i] * s[i], rest -= k[i] * q[i];
        const Mask novel = rest >= 10 * r.jitter;
        const V grown = novel ? 1. / rest : V{}, learned = 1. / (maximum(spread, V{}) + r.noise);
        for (int i = 0; i < size; ++i) {
            const Mask own = novel & (vacant == double(i));
            s[i] = (novel ? V{} : q[i]) - share * s[i] + (own ? all(1) : V{});
            q[i] -= own ? all(1) : V{};
            for (int j = 0; j < n; ++j) points[i][j] = own ? x[j] : V(points[i][j]);
        }
        V squares[D]{}, check = learned * 0.;
        const V fade = root(share);
        for (int o = 0; o < K; ++o) {
            V error = value[o];
            for (int i = 0; i < size; ++i) error -= fade * weights[o][i] * k[i];
            error *= learned;
            for (int i = 0; i < size; ++i) {
                const V weight = fade * weights[o][i] + s[i] * error;
                weights[o][i] = weight, squares[i] += weight * weight, check += weight * 0.;
            }
        }
        count += novel ? all(1) : V{};
        const Mask full = novel & (count >= double(D));
        V g[D]{}, c[D]{}, diagonal{};
        int place[lanes]{};
        if (any(full)) give_up(share, learned, grown, s, q, squares, full, place, g, c, diagonal);
        Row *b = known, *a = inverse;
        for (int i = 0; i < size; ++i, a += i, b += i) {
            const V by_s = learned * s[i], by_q = grown * q[i], by_g = diagonal * g[i];
            for (int p = 0; p < pieces; ++p) {
                const Piece si = piece(&by_s, p), qi = piece(&by_q, p), gi = piece(g + i, p), ci = piece(c + i, p);
                const Piece di = piece(&by_g, p), kept = piece(&share, p);
                for (int j = 0; j <= i; ++j) {
                    const Piece gj = piece(g + j, p), sj = piece(s + j, p), qj = piece(q + j, p), cj = piece(c + j, p);
                    piece(b + j, p) = kept * piece(b + j, p) + si * sj - gi * cj - ci * gj;
                    piece(a + j, p) += qi * qj - di * gj;
                }
            }
        }
        for (int l = 0; l < lanes; ++l) {
            if (full[l]) {
                for (int j = 0; j < size; ++j) known[triangle(place[l], j)][l] = inverse[triangle(place[l], j)][l] = 0;
                for (int o = 0; o < K; ++o) weights[o][place[l]][l] = 0;
                count[l] -= 1, vacant[l] = place[l];
            } else if (novel[l]) vacant[l] = count[l];
        }
        const Mask broken = ~finite(check) | drifted(r, size);
        if (any(broken)) restart(broken);
    }

    // What leaves with the sample whose loss changes the means least: known loses g c' + c g', inverse diagonal g g'.
    void give_up(V share, V learned, V grown, const V *s, const V *q, const V *squares, Mask full, int *place, V *g,
                 V *c, V &diagonal) {
        V least = all(infinity), dropped{}, at_q{}, at_s{}, at_known{}, at_weight[K]{};
        for (int i = 0; i < D; ++i) {
            const V own = inverse[triangle(i, i)] + grown * q[i] * q[i], loss = squares[i] / (own * own);
            const Mask less = loss < least;
            least = less ? loss : least, dropped = less ? all(i) : dropped, diagonal = less ? own : diagonal;
        }
        for (int l = 0; l < lanes; ++l) {
            const int i = place[l] = int(dropped[l]);
            at_q[l] = q[i][l], at_s[l] = s[i][l], at_known[l] = known[triangle(i, i)][l];
            for (int o = 0; o < K; ++o) at_weight[o][l] = weights[o][i][l];
        }
        at_known = share * at_known + learned * at_s * at_s;
        for (int j = 0; j < D; ++j) {
            const V with = share * entry_of(known, place, j) + learned * at_s * s[j];
            g[j] = full ? (entry_of(inverse, place, j) + grown * at_q * q[j]) / diagonal : V{};
            c[j] = full ? with - .5 * at_known * g[j] : V{};
            for (int o = 0; o < K; ++o) weights[o][j] -= g[j] * at_weight[o];
        }
    }

    // Whether rounding has added up: the inverse times a column of the kernels, at one place a sample.
    Mask drifted(const TrackerRules &r, int size) {
        int at[lanes];
        V x[n], k[D], sum{}, own{};
        for (int l = 0; l < lanes; ++l) {
            const int i = at[l] = turn[l] < size ? int(turn[l]) : 0;
            turn[l] = i + 1;
            for (int j = 0; j < n; ++j) x[j][l] = points[i][j][l];
            own[l] = inverse[triangle(i, i)][l];
        }
        kernels(r, x, size, k);
        for (int j = 0; j < size; ++j) {
            for (int l = 0; l < lanes; ++l) k[j][l] += at[l] == j ? r.jitter : 0;
            sum += entry_of(inverse, at, j) * k[j];
        }
        return (own != 0.) & ~(absolute(sum - 1.) < r.wrong);
    }
};

// Hyperparameters of four trackers from the samples in the store.

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
