"""The result of a gradient chase, and its certificate: contraction rate, excess and its bound."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from ..lanes.device.kernel import joined
from ..numerics.linalg import condition_number
from ..numerics.repr_text import count, span
from ..optim.objective import NativeError
from .problem import Problem
from .recursion import Corrected, Link

_ROUNDING = 1e3  # multiples of eps w'Kw by which a computed excess may miss


class Certificate(NamedTuple):
    """The measured terms of one inequality, and the inequality, at every time.

    Let e_k = |a_k - w_k|^2 in the norm |v|_k^2 = v'K(c(x_k))v, after the correction at x_k. From x_{k-1} to
    x_k the norm changes, the ideal weights move, and a predictor may move the weights along:

        |v|_k <= growth_k |v|_{k-1} for every v, growth_k^2 = lambda_max(K_{k-1}^-1 K_k),
        drift_k = |(a_k^- - a_{k-1}) - (w_k - w_{k-1})|_k, without a predictor |w_k - w_{k-1}|_k,
        sqrt(e_k) <= bound_k = delta_k^{its/2} (growth_k sqrt(e_{k-1}) + drift_k),

    by the triangle inequality for the weights a_k^- before the correction, and the law's contraction.
    growth_k is 1 + O(dt) and drift_k at most dt max |w'|: this is the bound of MATH.md with the factor that
    it leaves out. At the first time growth is 1 and drift is sqrt(e) before the correction. NaN where the law
    has no known rate, K is numerically singular, or the trajectory has diverged.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> states = systems.simulate(systems.Oscillator(), x0, dt=0.01, steps=50)
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> result = chase(states, basis, targets.Paper(), optim.SteepestDescent(), certificate=True)
        >>> bool(result.certificate.violated.any())
        False

        Shown by `staf certificate=true`.
    """

    rate: Tensor  # (B, T) delta_k^its, the factor in the excess that the law promises for the correction
    growth: Tensor  # (B, T)
    drift: Tensor  # (B, T)
    bound: Tensor  # (B, T) on sqrt(e_k)
    violated: Tensor  # (B, T) bool: e_k > bound_k^2 by more than rounding


@dataclasses.dataclass(frozen=True)
class ChaseResult:
    """A gradient chase over T times. "Before" is at x_k with the weights brought from x_{k-1}; without
    that word, after the correction at x_k.

    From the time at which a trajectory diverged its weights stay what they last were, and all that
    follows from them is NaN.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> states = systems.simulate(systems.Oscillator(), x0, dt=0.01, steps=50)
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> result = chase(states, basis, targets.Paper(), optim.Exact())
        >>> result.weights.shape, bool(result.excess.max() < 1e-9)
        (torch.Size([1, 51, 3]), True)

        Shown by `staf experiment=gradient_chase`.
    """

    state: Tensor  # (B, T, n) as given
    weights: Tensor  # (B, T, M) the paper's w
    ideal_weights: Tensor  # (B, T, M)
    coefficients: Tensor  # (B, T, M) b in V^(x+z) = e^{s(z)} sum_i b_i k0(z, d_i); never overflows
    value: Tensor  # (B, T) V(x)
    estimate: Tensor  # (B, T) V^(x)
    estimate_before: Tensor  # (B, T)
    ideal_estimate: Tensor  # (B, T) V^(x) with the ideal weights
    excess: Tensor  # (B, T) F(a) - F(w)
    excess_before: Tensor  # (B, T)
    diverged_at: Tensor  # (B,) int64 index of the first time that is not finite, -1 if none
    certificate: Certificate | None = None  # where it was asked for

    @property
    def diverged(self) -> Tensor:
        """(B,) bool: whether the trajectory, V, the Gram matrix or the weights became non-finite."""
        return self.diverged_at >= 0

    def __repr__(self) -> str:
        rows, times, centers = self.weights.shape
        return (
            f"ChaseResult({rows} trajectories, {times} times, {centers} centers; at the last time |V - V^| "
            f"{span((self.value - self.estimate)[:, -1].abs())}, excess {span(self.excess[:, -1])}; "
            f"{count(self.diverged)} diverged)"
        )


@dataclasses.dataclass(frozen=True)
class ChaseWeights:
    """The weights of a gradient chase alone.

    Example:
        >>> states = torch.ones(1, 20, 2).double()
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> law = optim.SteepestDescent()
        >>> chase_weights(states, basis, targets.Paper(), law, history=False).weights.shape
        torch.Size([1, 1, 3])

        Shown by `tests/benchmarks/README.md`.
    """

    weights: Tensor  # (B, T, M) the paper's w, corrected; (B, 1, M) at the last time for record="last"
    diverged_at: Tensor  # (B,) int64 index of the first time that is not finite, -1 if none

    @property
    def diverged(self) -> Tensor:
        """(B,) bool: whether the trajectory, V, the Gram matrix or the weights became non-finite."""
        return self.diverged_at >= 0

    def __repr__(self) -> str:
        rows, times, centers = self.weights.shape
        size = f"{rows} trajectories, {times} times, {centers} centers"
        return f"ChaseWeights({size}; {count(self.diverged)} diverged)"


def concatenate(pieces: Iterable[ChaseResult]) -> ChaseResult:
    """Consecutive pieces of time as one result."""
    parts = list(pieces)
    if len(parts) == 1:
        return parts[0]
    whole = {
        field.name: joined([getattr(part, field.name) for part in parts])
        for field in dataclasses.fields(ChaseResult)
        if field.name not in ("diverged_at", "certificate")
    }
    vouched = [part.certificate for part in parts if part.certificate is not None]
    return ChaseResult(
        **whole,
        diverged_at=parts[-1].diverged_at.to(whole["weights"].device),
        certificate=Certificate(*(joined(terms) for terms in zip(*vouched, strict=True)))
        if vouched
        else None,
    )


def certify(
    problem: Problem, gram: Tensor, run: Corrected, ideal: Tensor, last: Link
) -> tuple[Certificate, Link]:
    """Return the certificate of some times, and what the times after them need to know."""
    objective = NativeError(gram, run.values)
    error = run.after - ideal
    change = run.log_gain - last.log_gain
    held = last.error * change.exp().unsqueeze(-1)
    rate = problem.law.contraction(condition_number(gram))
    rate = (
        torch.full_like(run.log_gain, torch.nan)
        if rate is None
        else rate.expand(run.log_gain.shape) ** problem.inner_steps
    )
    growth = _growth(last.gram, gram) * (change / 2).exp()
    drift = _norm(run.before - ideal - held, gram, run.log_gain)
    bound = rate.sqrt() * (growth * _norm(last.error, last.gram, last.log_gain) + drift)
    native = torch.linalg.vecdot(ideal, run.values).abs()
    excess, inverse_gain = objective.excess(run.after, ideal), (-run.log_gain).exp()
    rounding = _ROUNDING * torch.finfo(gram.dtype).eps * native
    violated = excess * inverse_gain > bound.square() * (1 + 1e-9) + rounding * inverse_gain
    return Certificate(rate, growth, drift, bound, violated), Link(gram, run.log_gain, error)


def first_link(gram: Tensor, log_gain: Tensor, error: Tensor) -> Link:
    """Return what stands for the time before the first: its own matrix, and no error."""
    return Link(gram, log_gain, torch.zeros_like(error))


def before_each(link: Link, chunk: Link) -> Link:
    """Return the links of the times before those of a chunk: (B, ...), (B, C, ...) -> (B, C, ...)."""
    pairs = zip(link, chunk, strict=True)
    return Link(*(torch.cat((last.unsqueeze(1), each[:, :-1]), dim=1) for last, each in pairs))


def _norm(vector: Tensor, gram: Tensor, log_gain: Tensor) -> Tensor:
    square = torch.linalg.vecdot(vector, NativeError(gram, vector).curvature(vector))
    length: Tensor = (square.clamp(min=0) * (-log_gain).exp()).sqrt()  # negative by rounding alone
    return length


def _growth(before: Tensor, now: Tensor) -> Tensor:
    """sqrt(lambda_max(K_{k-1}^-1 K_k)): (..., M, M), (..., M, M) -> (...).

    By A = L_{k-1}^-1 L_k: forming K_{k-1}^-1 K_k would square the condition. The largest eigenvalue of A A'
    is as accurate as the largest singular value of A.
    """
    (there, failed), (here, failed_too) = torch.linalg.cholesky_ex(before), torch.linalg.cholesky_ex(now)
    fine = (failed == 0) & (failed_too == 0)
    for factor in (there, here):
        fine = fine & torch.isfinite(factor).all(-1).all(-1)
    identity = torch.eye(now.shape[-1], dtype=now.dtype, device=now.device)
    here = torch.where(fine[..., None, None], here, identity)
    there = torch.where(fine[..., None, None], there, identity)
    ratio = torch.linalg.solve_triangular(there, here, upper=False)
    largest = torch.linalg.eigvalsh(ratio @ ratio.mT)[..., -1]
    return torch.where(fine, largest.sqrt(), torch.nan)
