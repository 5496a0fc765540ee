"""Hyperparameters of four trackers by their likelihood on a stretch of samples: the definition.

A process with the kernel exp(-rate |x - z|^2 - fade |t - s|), noise in units of its amplitude, and the
likeliest amplitude has the log likelihood -K/2 log det G - m/2 sum_o log(y_o' G^-1 y_o), G the kernels with
noise.
The best of a grid is refined. One tracker takes it, one the best that fades, and two the same in coordinates
A'x in which directions count as the function changes along them: A A' is the mean outer product of the
process's gradients, plus a tenth of its trace.

Source: Rasmussen and Williams, Gaussian Processes for Machine Learning (2006), chapter 5; Trivedi, Wang,
Kpotufe and Shakhnarovich, "A consistent estimator of the expected gradient outerproduct", UAI (2014).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

LEAST_NOISE = 1e-7  # of the amplitude
FADES = (5e-4, 5e-3, 1.5e-2, 5e-2)  # of a unit of time
RIDGE = 0.1


class Stretch(NamedTuple):
    """Samples, oldest first, in units."""

    at: Tensor  # (m, n)
    y: Tensor  # (m, K)
    when: Tensor  # (m,)


class Choice(NamedTuple):
    """Of a process, and its log likelihood."""

    rate: float
    noise: float
    fade: float
    score: float


class Learned(NamedTuple):
    """Of the four trackers."""

    turned: Choice  # in the coordinates of the metric
    plain: Choice
    fading: Choice
    turned_fading: Choice
    metric: Tensor  # A, (n, n), lower triangular


def learn_hyperparameters(s: Stretch) -> Learned:
    """The best of the grid, the best that fades, and the best in the metric of the best."""
    plain = search(s)
    metric = sensitivity(s, plain)
    turned_s = s._replace(at=s.at @ metric)
    turned = search(turned_s)
    return Learned(turned, plain, _search_fading(s, plain), _search_fading(turned_s, turned), metric)


def likelihoods(s: Stretch, rate: Tensor, noise: Tensor, fade: Tensor) -> Tensor:
    """Log marginal likelihoods of processes with these (L,)."""
    apart = torch.cdist(s.at, s.at, compute_mode="donot_use_mm_for_euclid_dist").square()
    age = (s.when[:, None] - s.when).abs()
    gram = (-rate[:, None, None] * apart - fade[:, None, None] * age).exp()
    gram = gram + noise[:, None, None] * torch.eye(len(apart), dtype=apart.dtype)
    factor = torch.linalg.cholesky(gram)
    squares = torch.linalg.solve_triangular(factor, s.y, upper=False).square().sum(1)  # (L, K)
    logs = factor.diagonal(dim1=1, dim2=2).log().sum(1)
    found: Tensor = -s.y.shape[1] * logs - 0.5 * len(apart) * squares.clamp(min=1e-300).log().sum(1)
    return found


def _better(s: Stretch, rate: Tensor, noise: Tensor, fade: Tensor, best: Choice) -> Choice:
    noise = noise.clamp(min=LEAST_NOISE)
    found = likelihoods(s, rate, noise, fade)
    i = int(found.argmax())
    if not float(found[i]) > best.score:
        return best
    return Choice(float(rate[i]), float(noise[i]), float(fade[i]), float(found[i]))


def _around(s: Stretch, of_width: float, of_noise: float, best: Choice) -> Choice:
    """The best and its eight neighbours, widths a factor apart and noises another."""
    steps = torch.tensor([(a, b) for b in (-1, 0, 1) for a in (-1, 0, 1) if a or b], dtype=torch.float64)
    rate, noise = best.rate * of_width ** (-2 * steps[:, 0]), best.noise * of_noise ** steps[:, 1]
    return _better(s, rate, noise, torch.full_like(rate, best.fade), best)


def search(s: Stretch) -> Choice:
    """The likeliest process that does not fade: widths from 1/4 to 32 sqrt(n)."""
    n = s.at.shape[1]
    best = Choice(1 / (2 * n), 1.0, 0.0, -math.inf)
    rate = 2.0 ** (4 - 2 * torch.arange(8, dtype=torch.float64)) / (2 * n)
    for noise in (1e-6, 1e-4, 1e-2, 0.3):
        best = _better(s, rate, torch.full_like(rate, noise), torch.zeros_like(rate), best)
    best = _around(s, 2**0.5, 10.0, best)
    return _around(s, 2**0.25, 10**0.5, best)


def _search_fading(s: Stretch, best: Choice) -> Choice:
    fade = torch.tensor(FADES * 2, dtype=torch.float64)
    wider = torch.arange(8) >= 4
    rate = best.rate / torch.where(wider, 4.0, 1.0).double()
    noise = best.noise / torch.where(wider, 10.0, 1.0).double()
    return _around(s, 2.0, 10.0, _better(s, rate, noise, fade, best))


def sensitivity(s: Stretch, c: Choice) -> Tensor:
    """A metric from the mean outer product of the process's gradients: (n, n), lower triangular."""
    m, n = s.at.shape
    ways = s.at - s.at[:, None]  # from i to j, (m, m, n)
    kernel = (-c.rate * ways.square().sum(-1)).exp()
    weights = torch.linalg.solve(kernel + c.noise * torch.eye(m, dtype=kernel.dtype), s.y)
    gradients = torch.einsum("ij,jo,ijp->iop", kernel, weights, ways).flatten(0, 1)
    outer = gradients.mT @ gradients
    trace, eye = outer.trace(), torch.eye(n, dtype=kernel.dtype)
    share = outer / trace if float(trace) > 0 else eye / n
    metric: Tensor = torch.linalg.cholesky((share * n + RIDGE * n * eye) / (1 + RIDGE * n))
    return metric
