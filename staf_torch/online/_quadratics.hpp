// Least squares on products of coordinates, a rate of forgetting in every lane: what quadratic_models.py defines.

#pragma once

#include "_filter.hpp"

constexpr int most_features = 120;
constexpr int features = (n + 1) * (n + 2) / 2 <= most_features ? (n + 1) * (n + 2) / 2
                         : 2 * n + 1 <= most_features           ? 2 * n + 1
                                                                : n + 1;
typedef double Row __attribute__((vector_size(64), aligned(8), may_alias));  // lanes in a table of doubles

struct Quadratics {
    Row factor[features * (features + 1) / 2];  // columns of U above the diagonal, each followed by its entry of D
    Row coefficients[K][features];

    Row *column(int j) { return factor + j * (j + 1) / 2; }

    void restart(V prior, Mask where) {
        for (int j = 0; j < features; ++j)
            for (int i = 0; i <= j; ++i) column(j)[i] = where ? (i < j ? V{} : prior) : V(column(j)[i]);
        for (int o = 0; o < K; ++o)  // by index: a reference to a row of them would promise 64 bytes of alignment
            for (int j = 0; j < features; ++j) coefficients[o][j] = where ? V{} : V(coefficients[o][j]);
    }

    // U' phi
    void along(const double *phi, V *found) {
        for (int j = 0; j < features; ++j) {
            const Row *own = column(j);
            V sum = all(phi[j]);
            for (int i = 0; i < j; ++i) sum += own[i] * phi[i];
            found[j] = sum;
        }
    }

    // The means, and the variance in units of the noise.
    V predict(const double *phi, V *mean) {
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
