"""Gaussian processes on a few samples of the whole past, which fade, side by side: the definition.

The mean of a process with the samples z at x is k' w, its variance 1 + jitter - k' B k, where k = k(z, x);
the inverse Q of the kernels K between the samples tells whether a new one is known already. Processes are the
last dimension; each has its own samples.

Source: Van Vaerenbergh, Lazaro-Gredilla and Santamaria, "Kernel recursive least-squares tracker for
time-varying regression", IEEE Trans. Neural Netw. Learn. Syst. 23 (2012), in the numbers of Csato and Opper,
"Sparse on-line Gaussian processes", Neural Computation 14 (2002).
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
from torch import Tensor


class TrackerModels(NamedTuple):
    """L processes of K outputs with D places for samples in n dimensions, in place."""

    points: Tensor  # (D, n, L)
    weights: Tensor  # w, (K, D, L)
    known: Tensor  # B's lower triangle by rows, (D (D + 1) / 2, L)
    inverse: Tensor  # Q's
    counts: Tensor  # the place that is free, samples kept, the place that is checked next, (3, L)

    def predict(self, x: Tensor, rate: Tensor, noise: Tensor, jitter: float) -> tuple[Tensor, Tensor]:
        """Means (K, L) and variances of the next value (L,) at x (n, L)."""
        k = self._kernels(x, rate)
        spread = 1 + jitter - (k * _times(_whole(self.known), k)).sum(0)
        return (self.weights * k).sum(1), spread.clamp(min=0.0) + noise

    def learn(
        self,
        x: Tensor,
        values: Tensor,
        rate: Tensor,
        noise: Tensor,
        share: Tensor,
        jitter: float,
        wrong: float,
    ) -> None:
        """Learn values (K,) at x (n, L); share (L,) of what was known is still believed.

        A sample that the others span within 10 jitter leaves its mark on them alone. A full process gives up
        the one without which its means change least. Where rounding has added up to ``wrong`` it begins anew.
        """
        k, known, inverse = self._kernels(x, rate), _whole(self.known), _whole(self.inverse)
        size = min(int(self.counts[1].max()) + 1, len(k))  # places in use, and one
        b, q = _times(known, k), _times(inverse, k)
        spread = 1 + jitter - share * (k * b).sum(0)
        rest = 1 + jitter - (k * q).sum(0)
        novel = rest >= 10 * jitter
        grown = torch.where(novel, 1 / rest, 0.0)
        learned = 1 / (spread.clamp(min=0.0) + noise)
        places = torch.arange(len(k))[:, None]
        own = (novel & (self.counts[0] == places)).to(k)
        self.points.copy_(torch.where(own.bool()[:, None], x, self.points))
        s = torch.where(novel, 0.0, q) - share * b + own
        q = q - own
        fade = share.sqrt()
        error = (values[:, None] - (fade * self.weights * k).sum(1)) * learned
        weights = fade * self.weights + s * error[:, None]
        known = share * known + learned * _outer(s, s)
        inverse = inverse + grown * _outer(q, q)
        broken = ~torch.isfinite(learned + weights.sum((0, 1)))
        self.counts[1] += novel
        for lane in (novel & (self.counts[1] >= len(k))).nonzero().flatten().tolist():
            self.counts[0, lane] = _give_up(*(part[..., lane] for part in (weights, known, inverse)))
            self.counts[1, lane] -= 1
            novel[lane] = False
        self.counts[0].copy_(torch.where(novel, self.counts[1], self.counts[0]))
        self.weights.copy_(weights)
        first, second = _below(len(k))
        self.known.copy_(known[first, second])
        self.inverse.copy_(inverse[first, second])
        broken |= self._drifted(inverse, size, rate, jitter, wrong)
        for part in self:
            part.copy_(torch.where(broken, 0.0, part))

    def _drifted(self, inverse: Tensor, size: int, rate: Tensor, jitter: float, wrong: float) -> Tensor:
        """Whether the inverse times a column of the kernels is wrong, at one place a sample: (L,)."""
        lanes = torch.arange(len(rate))
        at = torch.where(self.counts[2] < size, self.counts[2], 0.0).long()
        self.counts[2] = at + 1
        apart = (self.points.permute(2, 0, 1) - self.points[at, :, lanes][:, None]).square().sum(-1)
        column = (-rate[:, None] * apart).exp()
        column[lanes, at] += jitter
        rows = inverse.permute(2, 0, 1)[lanes, at]  # (L, D)
        right = ((rows * column).sum(-1) - 1).abs() < wrong
        return torch.ne(rows[lanes, at], 0) & ~right

    def _kernels(self, x: Tensor, rate: Tensor) -> Tensor:
        """The kernels between the samples and x, (D, L)."""
        return (-rate * (self.points - x).square().sum(1)).exp()


@functools.cache
def _below(size: int) -> Tensor:
    return torch.tril_indices(size, size)


def _whole(lower: Tensor) -> Tensor:
    """The symmetric matrices (D, D, L) of lower triangles by rows."""
    size = int((2 * len(lower)) ** 0.5)
    first, second = _below(size)
    found = lower.new_zeros(size, size, lower.shape[-1])
    found[first, second] = lower
    found[second, first] = lower
    return found


def _times(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices * vectors).sum(1)


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a[:, None] * b


def _give_up(weights: Tensor, known: Tensor, inverse: Tensor) -> int:
    """Drop a sample of one process, (K, D), (D, D), (D, D), in place: its number is returned."""
    diagonal = inverse.diagonal()
    i = int((weights.square().sum(0) / diagonal.square()).argmin())
    direction = inverse[i] / diagonal[i]
    weights -= weights[:, i : i + 1] * direction
    half = known[i] - 0.5 * known[i, i] * direction
    known -= direction[:, None] * half + half[:, None] * direction
    inverse -= diagonal[i] * direction[:, None] * direction
    for matrix in (known, inverse):
        matrix[i] = matrix[:, i] = 0.0
    weights[:, i] = 0.0
    return i
