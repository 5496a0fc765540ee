// Gaussian processes on few samples of the whole past, one in every lane: what tracker_models.py defines.

#pragma once

#include "_quadratics.hpp"

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
        for (int i = 0; i < size; ++i) {
            V sum{};
            for (int j = 0; j < i; ++j, ++matrix) sum += *matrix * k[j], found[j] += *matrix * k[i];
            found[i] = sum + *matrix++ * k[i];
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
        for (int i = 0; i < size; ++i) {
            const V si = learned * s[i], qi = grown * q[i], gi = g[i], ci = c[i], di = diagonal * g[i];
            for (int j = 0; j <= i; ++j, ++a, ++b) {
                *b = share * *b + si * s[j] - gi * c[j] - ci * g[j];
                *a += qi * q[j] - di * g[j];
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
