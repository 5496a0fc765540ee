"""Least squares on the products of coordinates, several rates of forgetting side by side: the definition.

The covariance of the coefficients, in units of the noise, is U D U', U unit upper triangular, D diagonal: it
stays positive however long a stream is. Models are the last dimension.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class QuadraticModels(NamedTuple):
    """L models of K outputs in F features, in place."""

    factor: Tensor  # columns of U above the diagonal, each followed by its entry of D: (F (F + 1) / 2, L)
    coefficients: Tensor  # (K, F, L)

    def restart(self, prior: Tensor) -> None:
        """Nothing learned: coefficients N(0, prior), (L,)."""
        self.factor.zero_()
        for j in range(self.coefficients.shape[1]):
            self._column(j)[-1] = prior
        self.coefficients.zero_()

    def _column(self, j: int) -> Tensor:
        return self.factor[j * (j + 1) // 2 : (j + 1) * (j + 2) // 2]

    def predict(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Means (K, L) and variances in units of the noise (L,) at features (F,)."""
        along = self._along(features)
        parts = torch.stack([self._column(j)[-1] for j in range(len(features))])
        return (self.coefficients * features[:, None]).sum(1), 1 + (parts * along.square()).sum(0)

    def _along(self, features: Tensor) -> Tensor:
        """U' phi: (F, L)."""
        found = [phi + (self._column(j)[:-1] * features[:j, None]).sum(0) for j, phi in enumerate(features)]
        return torch.stack(found)

    def learn(self, features: Tensor, values: Tensor, share: Tensor, prior: Tensor) -> None:
        """Learn values (K,) at features (F,); what was known fades by share (L,), no further than the prior.

        Source: Bierman, Factorization Methods for Discrete Sequential Estimation (1977), chapter V.
        """
        along, total = self._along(features), share
        gain = torch.zeros_like(along)
        for j, f in enumerate(along):
            column = self._column(j)
            v = column[-1] * f
            following = total + f * v
            column[-1] = torch.minimum(column[-1] * (total / following) / share, prior)
            old = column[:-1].clone()
            column[:-1] += gain[:j] * (-f / total)
            gain[:j] += old * v
            gain[j], total = v, following
        gain = gain / total
        error = values[:, None] - (self.coefficients * features[:, None]).sum(1)
        self.coefficients.add_(gain * error[:, None])
        broken = ~torch.isfinite(self.coefficients.sum((0, 1)) + self.factor.sum(0))
        if bool(broken.any()):  # the features overflow: these models begin anew
            fresh = QuadraticModels(torch.empty_like(self.factor), torch.empty_like(self.coefficients))
            fresh.restart(prior)
            for own, new in zip(self, fresh, strict=True):
                own.copy_(torch.where(broken, new, own))


def quadratic_features(u: Tensor, count: int) -> Tensor:
    """1, the coordinates u (n,), and as far as ``count`` goes their products or their squares: (count,)."""
    n = len(u)
    first, second = torch.triu_indices(n, n)
    if count == 2 * n + 1:
        first = second = torch.arange(n)
    return torch.cat((torch.ones(1, dtype=u.dtype), u, u[first] * u[second]))[:count]
