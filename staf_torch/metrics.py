"""Tensors to numbers: what a gradient chase reached over its window of settled times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .basis import StaFBasis, Target
from .centers import probe_points
from .chase import ChaseResult
from .linalg import condition_number
from .local import evaluate_scaled
from .optim import UpdateLaw

_PROBES = 97  # points of the ball to take a supremum over; in the plane 64 of them on its edge
_BLOCK = 2**18  # numbers in a temporary of `ball_error`, so that it stays in cache


class Member(NamedTuple):
    """One of several problems in a batch, with rows and a window of its own."""

    rows: int  # trajectories, the next so many of the batch
    dt: float  # s
    settle_time: float  # s

    @property
    def first(self) -> int:
        """Index of the first settled time."""
        return math.ceil(self.settle_time / self.dt - 1e-9)


class ChaseMetrics:
    """The metrics of a gradient chase, gathered piece by piece so that memory does not grow with time.

    Each is the worst over the times t >= settle_time and over the trajectories that did not diverge;
    None where there is no such time or trajectory.

    Attributes of the dictionary that `summary` returns:
        ultimate_error, ultimate_error_before, floor_error: max |V - V^| at the state after correction,
            before it, and with the ideal weights.
        ultimate_excess, ultimate_excess_before: max (a - w)'K(a - w).
        ball_error: max over the closed ball of radius nu(x) of |V - V^|, after correction.
        gradient_error: max |grad V - grad V^| at the state, centers frozen.
        condition_number: max kappa(K(c(x))).
        settling_time: the first time (s) from which the excess never again exceeds `ultimate_excess`.
        contraction_violations: steps whose excess shrank by less than the law's rate promises.
        certificate_violations: times that break the bound of their `Certificate`; only where one was made.
        diverged_fraction: diverged trajectories / all.

    Args:
        basis: kernel and centers.
        target: V.
        law: the update law.
        inner_steps: its iterations at every time.
        dt: step, in seconds.
        settle_time: in seconds.
        members: where the batch holds several problems: `summaries` then has one dictionary a member, and dt
            and settle_time are theirs.
    """

    def __init__(
        self,
        basis: StaFBasis,
        target: Target,
        law: UpdateLaw,
        *,
        inner_steps: int,
        dt: float = 1.0,
        settle_time: float = 0.0,
        members: Sequence[Member] | None = None,
    ) -> None:
        self._basis, self._target, self._law = basis, target, law
        self._inner_steps = inner_steps
        self._whole = Member(0, dt, settle_time)
        self._members = members
        firsts = [member.first for member in members or (self._whole,)]
        self._first, self._last_first = (
            min(firsts),
            max(firsts),
        )  # where the first window begins, and the last
        self._time = 0
        self._worst: dict[str, Tensor] = {}  # name -> (B,)
        self._early: list[Tensor] = []  # excess before the window, -inf in it, (B, C) a piece
        self._violations: Tensor | None = None  # (B,) int64
        self._uncertified: Tensor | None = None  # (B,) int64, of the certificate
        self._diverged = torch.zeros(0, dtype=torch.bool)

    def add(self, result: ChaseResult) -> None:
        """Take in the next piece of time."""
        length = result.state.shape[1]
        skip = min(max(self._first - self._time, 0), length)
        early = min(max(self._last_first - self._time, 0), length)
        settled = self._settled(result.state)  # (B, C) or (1, C)
        self._time += length
        self._diverged = result.diverged
        if early > 0:
            self._early.append(torch.where(settled[:, :early], -torch.inf, result.excess[:, :early]))
        if skip == length:
            return
        at = slice(skip, None)
        settled = settled[:, at]
        x, excess, before = result.state[:, at], result.excess[:, at], result.excess_before[:, at]
        value, coefficients = result.value[:, at], result.coefficients[:, at]
        gram = self._basis.gram_structure(x).scaled()
        kappa = condition_number(gram).expand(value.shape)
        self._keep_worst(
            settled,
            ultimate_error=(value - result.estimate[:, at]).abs(),
            ultimate_error_before=(value - result.estimate_before[:, at]).abs(),
            floor_error=(value - result.ideal_estimate[:, at]).abs(),
            ultimate_excess=excess,
            ultimate_excess_before=before,
            ball_error=ball_error(self._basis, self._target, x, coefficients),
            gradient_error=gradient_error(self._basis, self._target, x, coefficients),
            condition_number=kappa,
        )
        rate = self._law.contraction(kappa)
        if rate is None:
            return
        native = (result.ideal_weights[:, at] * self._basis.values(x, self._target)).sum(-1)
        rounding = 1e3 * torch.finfo(x.dtype).eps * native.abs()
        broken = excess > rate**self._inner_steps * before * (1 + 1e-9) + rounding
        self._violations = _more(self._violations, broken & settled)
        if result.certificate is not None:
            self._uncertified = _more(self._uncertified, result.certificate.violated[:, at] & settled)

    def summary(self) -> dict[str, float | None]:
        """Name to number over all rows; None where there is nothing to report."""
        return self._summary(self._whole, slice(None))

    def summaries(self) -> list[dict[str, float | None]]:
        """The same of each member's rows, in the order of the members."""
        assert self._members is not None
        found, start = [], 0
        for member in self._members:
            found.append(self._summary(member, slice(start, start + member.rows)))
            start += member.rows
        return found

    def _settled(self, states: Tensor) -> Tensor:
        """Which of the next times are in the window of a row: (B, C), or (1, C) for all rows."""
        members = self._members or (self._whole,)
        firsts = torch.tensor([m.first for m in members], device=states.device)
        if self._first != self._last_first:
            rows = torch.tensor([m.rows for m in members], device=states.device)
            firsts = firsts.repeat_interleave(rows)
        else:
            firsts = firsts[:1]
        index = torch.arange(self._time, self._time + states.shape[1], device=states.device)
        return index >= firsts.unsqueeze(-1)

    def _keep_worst(self, settled: Tensor, **found: Tensor) -> None:
        for name, quantity in found.items():
            worst = torch.where(settled, quantity, -torch.inf).amax(dim=1)
            self._worst[name] = torch.maximum(self._worst[name], worst) if name in self._worst else worst

    def _summary(self, member: Member, rows: slice) -> dict[str, float | None]:
        kept = ~self._diverged[rows]
        metrics: dict[str, float | None] = dict.fromkeys(_WORST)
        any_time = self._time > member.first and bool(kept.any())
        if any_time:
            metrics |= {name: float(worst[rows][kept].max()) for name, worst in self._worst.items()}
        metrics["settling_time"] = self._settling_time(member, rows, kept) if any_time else None
        metrics["contraction_violations"] = _count(self._violations, rows, kept) if any_time else None
        if self._uncertified is not None and self._time > member.first:
            metrics["certificate_violations"] = _count(self._uncertified, rows, kept)
        metrics["diverged_fraction"] = float(self._diverged[rows].double().mean())
        return {
            name: number if number is not None and math.isfinite(number) else None
            for name, number in metrics.items()
        }

    def _settling_time(self, member: Member, rows: slice, kept: Tensor) -> float:
        if member.first <= 0:
            return 0.0
        self._early = [torch.cat(self._early, dim=1)]
        above = self._early[0][rows] > self._worst["ultimate_excess"][rows, None]
        index = torch.arange(1, above.shape[1] + 1, device=above.device)
        last = torch.where(above, index, 0).amax(dim=1)
        return float(last[kept].max()) * member.dt


def _more(count: Tensor | None, happened: Tensor) -> Tensor:
    """The count of each row (B,) with the times of a piece (B, C) at which it happened."""
    new = happened.sum(dim=1)
    return new if count is None else count + new


def _count(violations: Tensor | None, rows: slice, kept: Tensor) -> float | None:
    return None if violations is None or not bool(kept.any()) else float(violations[rows][kept].sum())


_WORST = (
    "ultimate_error",
    "ultimate_error_before",
    "floor_error",
    "ultimate_excess",
    "ultimate_excess_before",
    "ball_error",
    "gradient_error",
    "condition_number",
)


def ball_error(basis: StaFBasis, target: Target, x: Tensor, coefficients: Tensor) -> Tensor:
    """sup |V - V^| over a fixed set of points of the closed ball of radius nu(x) around x.

    Args:
        x: states, (..., T, n).
        coefficients: b of `ChaseResult.coefficients`, (..., T, M).

    Returns:
        (..., T).
    """
    probes = probe_points(_PROBES, basis.dim).to(x)
    times = max(1, _BLOCK // (_PROBES * max(1, x.numel() // x.shape[-2])))
    blocks = zip(x.split(times, dim=-2), coefficients.split(times, dim=-2), strict=True)
    return torch.cat([_ball_error(basis, target, probes, *block) for block in blocks], dim=-1)


def _ball_error(basis: StaFBasis, target: Target, probes: Tensor, x: Tensor, b: Tensor) -> Tensor:
    nu, offsets = basis.centers.radius(x)[..., None, None], basis.centers.offsets(x)
    worst = x.new_zeros(x.shape[:-1])
    for some in probes.split(64):
        z = nu * some
        estimate = evaluate_scaled(basis.kernel, offsets, x, z, b)
        error = (target(x.unsqueeze(-2) + z) - estimate).abs().amax(-1)
        worst = torch.maximum(worst, error)
    return worst


def gradient_error(basis: StaFBasis, target: Target, x: Tensor, coefficients: Tensor) -> Tensor:
    """|grad V - grad V^| at the state, with the centers frozen: (..., n), (..., M) -> (...)."""
    offsets = basis.centers.offsets(x)

    def estimate(z: Tensor) -> Tensor:
        return evaluate_scaled(basis.kernel, offsets, x, z.unsqueeze(-2), coefficients)

    approximate, exact = _gradient(estimate, torch.zeros_like(x)), _gradient(target, x.detach())
    error: Tensor = (exact - approximate).norm(dim=-1)
    return error


def _gradient(function: Target, at: Tensor) -> Tensor:
    """grad f, row by row: (..., n). Not by torch.func, whose first use imports the compiler for a second."""
    with torch.enable_grad():
        at = at.clone().requires_grad_()
        values = function(at)
        if not values.requires_grad:  # a constant
            return torch.zeros_like(at).detach()
        (gradient,) = torch.autograd.grad(values.sum(), at)
    return gradient
