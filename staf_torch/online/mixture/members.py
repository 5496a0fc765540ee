"""Models that a bank carries along, eight side by side: the definitions.

Models are the last dimension. **Quadratics**: least squares on the products of coordinates; the
covariance of the coefficients, in units of the noise, is U D U', U unit upper triangular, D diagonal: it
stays positive however long a stream is.

**Trackers**: Gaussian processes on a few samples of the whole past, which fade. The mean of a process
with the samples z at x is k' w, its variance 1 + jitter - k' B k, where k = k(z, x); the inverse Q of the
kernels K between the samples tells whether a new one is known already.

**Hyperparameters** of four trackers by their likelihood on a stretch of samples. A process with the
kernel exp(-rate |x - z|^2 - fade |t - s|), noise in units of its amplitude, and the likeliest amplitude
has the log likelihood -K/2 log det G - m/2 sum_o log(y_o' G^-1 y_o), G the kernels with noise. The best
of a grid is refined. One tracker takes it, one the best that fades, and two the same in coordinates A'x
in which directions count as the function changes along them: A A' is the mean outer product of the
process's gradients, plus a tenth of its trace.

Source: Bierman, Factorization Methods for Discrete Sequential Estimation (1977), chapter V; Van
Vaerenbergh, Lazaro-Gredilla and Santamaria, "Kernel recursive least-squares tracker for time-varying
regression", IEEE Trans. Neural Netw. Learn. Syst. 23 (2012), in the numbers of Csato and Opper, "Sparse
on-line Gaussian processes", Neural Computation 14 (2002); Rasmussen and Williams, Gaussian Processes for
Machine Learning (2006), chapter 5; Trivedi, Wang, Kpotufe and Shakhnarovich, "A consistent estimator of
the expected gradient outerproduct", UAI (2014).
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

LEAST_NOISE = 1e-7  # of the amplitude
FADES = (5e-4, 5e-3, 1.5e-2, 5e-2)  # of a unit of time
RIDGE = 0.1


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
        """Learn values (K,) at features (F,); the known fades by share (L,), no further than the prior."""
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
    first, second = torch.triu_indices(n, n, device="cpu")
    if count == 2 * n + 1:
        first = second = torch.arange(n, device="cpu")
    return torch.cat((torch.ones(1, dtype=u.dtype, device=u.device), u, u[first] * u[second]))[:count]


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
        places = torch.arange(len(k), device="cpu")[:, None]
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
        """Return whether the inverse times a column of the kernels is wrong, at one place a sample: (L,)."""
        lanes = torch.arange(len(rate), device=rate.device)
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
    return torch.tril_indices(size, size, device="cpu")


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


class Stretch(NamedTuple):
    """Samples, oldest first, in units."""

    at: Tensor  # (m, n)
    y: Tensor  # (m, K)
    when: Tensor  # (m,)


class Hyperparameters(NamedTuple):
    """Hyperparameters of a process, and its log likelihood."""

    rate: float
    noise: float
    fade: float
    score: float


class Learned(NamedTuple):
    """Hyperparameters of the four trackers that learn them."""

    turned: Hyperparameters  # in the coordinates of the metric
    plain: Hyperparameters
    fading: Hyperparameters
    turned_fading: Hyperparameters
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
    gram = gram + noise[:, None, None] * torch.eye(len(apart), dtype=apart.dtype, device=apart.device)
    factor = torch.linalg.cholesky(gram)
    squares = torch.linalg.solve_triangular(factor, s.y, upper=False).square().sum(1)  # (L, K)
    logs = factor.diagonal(dim1=1, dim2=2).log().sum(1)
    found: Tensor = -s.y.shape[1] * logs - 0.5 * len(apart) * squares.clamp(min=1e-300).log().sum(1)
    return found


def _better(s: Stretch, rate: Tensor, noise: Tensor, fade: Tensor, best: Hyperparameters) -> Hyperparameters:
    noise = noise.clamp(min=LEAST_NOISE)
    found = likelihoods(s, rate, noise, fade)
    i = int(found.argmax())
    if not float(found[i]) > best.score:
        return best
    return Hyperparameters(float(rate[i]), float(noise[i]), float(fade[i]), float(found[i]))


def _around(s: Stretch, of_width: float, of_noise: float, best: Hyperparameters) -> Hyperparameters:
    """The best and its eight neighbours, widths a factor apart and noises another."""
    steps = torch.tensor(
        [(a, b) for b in (-1, 0, 1) for a in (-1, 0, 1) if a or b], dtype=torch.float64, device="cpu"
    )
    rate, noise = best.rate * of_width ** (-2 * steps[:, 0]), best.noise * of_noise ** steps[:, 1]
    return _better(s, rate, noise, torch.full_like(rate, best.fade), best)


def search(s: Stretch) -> Hyperparameters:
    """The likeliest process that does not fade: widths from 1/4 to 32 sqrt(n)."""
    n = s.at.shape[1]
    best = Hyperparameters(1 / (2 * n), 1.0, 0.0, -math.inf)
    rate = 2.0 ** (4 - 2 * torch.arange(8, dtype=torch.float64, device="cpu")) / (2 * n)
    for noise in (1e-6, 1e-4, 1e-2, 0.3):
        best = _better(s, rate, torch.full_like(rate, noise), torch.zeros_like(rate), best)
    best = _around(s, 2**0.5, 10.0, best)
    return _around(s, 2**0.25, 10**0.5, best)


def _search_fading(s: Stretch, best: Hyperparameters) -> Hyperparameters:
    fade = torch.tensor(FADES * 2, dtype=torch.float64, device="cpu")
    wider = torch.arange(8, device="cpu") >= 4
    rate = best.rate / torch.where(wider, 4.0, 1.0).double()
    noise = best.noise / torch.where(wider, 10.0, 1.0).double()
    return _around(s, 2.0, 10.0, _better(s, rate, noise, fade, best))


def sensitivity(s: Stretch, c: Hyperparameters) -> Tensor:
    """A metric from the mean outer product of the process's gradients: (n, n), lower triangular."""
    m, n = s.at.shape
    ways = s.at - s.at[:, None]  # from i to j, (m, m, n)
    kernel = (-c.rate * ways.square().sum(-1)).exp()
    weights = torch.linalg.solve(
        kernel + c.noise * torch.eye(m, dtype=kernel.dtype, device=kernel.device), s.y
    )
    gradients = torch.einsum("ij,jo,ijp->iop", kernel, weights, ways).flatten(0, 1)
    outer = gradients.mT @ gradients
    trace, eye = outer.trace(), torch.eye(n, dtype=kernel.dtype, device=kernel.device)
    share = outer / trace if float(trace) > 0 else eye / n
    metric: Tensor = torch.linalg.cholesky((share * n + RIDGE * n * eye) / (1 + RIDGE * n))
    return metric
