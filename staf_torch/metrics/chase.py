"""Tensors to numbers: what a gradient chase reached over its window of settled times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..approximation.basis import StaFBasis, Target
from ..engine import ChaseResult
from ..numerics.linalg import condition_number
from ..optim import UpdateLaw
from . import Metric
from .ball_error import PROBES, BallFloor, ball_error, gradient_error


class Member(NamedTuple):
    """One of several problems in a batch, with rows and a window of its own."""

    rows: int  # trajectories, the next so many of the batch
    dt: float  # s
    settle_time: float  # s

    @property
    def first(self) -> int:
        """Index of the first settled time."""
        return math.ceil(self.settle_time / self.dt - 1e-9)


class Chased(NamedTuple):
    """What a `Metric` is told of a gradient chase beside its result."""

    basis: StaFBasis
    target: Target
    law: UpdateLaw


class ChaseMetrics:
    """The metrics of a gradient chase, gathered piece by piece so that memory does not grow with time.

    Each is the worst over the times t >= settle_time and over the trajectories that did not diverge;
    None where there is no such time or trajectory.

    Attributes of the dictionary that `summary` returns:
        ultimate_error, ultimate_error_before, floor_error: max |V - V^| at the state after correction,
            before it, and with the ideal weights.
        ultimate_excess, ultimate_excess_before: max (a - w)'K(a - w).
        ball_error: max over the closed ball of radius nu(x) of |V - V^|, after correction.
        ball_floor_error: that maximum with the ideal weights: what kernel, radius and layout allow at best.
        rounding_floor: eps max |V(x)|, with eps of the precision; no error below it means anything.
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
        own: metrics of the user's own, reported beside these under their names.
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
        own: Sequence[Metric] = (),
    ) -> None:
        self._basis, self._target, self._law = basis, target, law
        self._inner_steps = inner_steps
        self._whole = Member(0, dt, settle_time)
        self._members = members
        self._own = tuple(own)
        firsts = [member.first for member in members or (self._whole,)]
        # Where the first window begins, and the last.
        self._first, self._last_first = min(firsts), max(firsts)
        self._time = 0
        self._worst: dict[str, Tensor] = {}  # name -> (B,)
        self._early: list[Tensor] = []  # excess before the window, -inf in it, (B, C) a piece
        self._violations: Tensor | None = None  # (B,) int64
        self._uncertified: Tensor | None = None  # (B,) int64, of the certificate
        self._diverged = torch.zeros(0, dtype=torch.bool)
        self._floor = BallFloor(basis, target, PROBES)

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
            ball_floor_error=self._floor(x),
            rounding_floor=torch.finfo(value.dtype).eps * value.abs(),
            gradient_error=gradient_error(self._basis, self._target, x, coefficients),
            condition_number=kappa,
            **{metric.name: self._badness(metric, result)[:, at] for metric in self._own},
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
        """Name to number over the rows of each member, in the order of the members."""
        assert self._members is not None
        summaries, start = [], 0
        for member in self._members:
            summaries.append(self._summary(member, slice(start, start + member.rows)))
            start += member.rows
        return summaries

    def _badness(self, metric: Metric, result: ChaseResult) -> Tensor:
        return metric.badness(result, Chased(self._basis, self._target, self._law))

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

    def _keep_worst(self, settled: Tensor, **quantities: Tensor) -> None:
        for name, quantity in quantities.items():
            worst = torch.where(settled, quantity, -torch.inf).amax(dim=1)
            self._worst[name] = torch.maximum(self._worst[name], worst) if name in self._worst else worst

    def _summary(self, member: Member, rows: slice) -> dict[str, float | None]:
        kept = ~self._diverged[rows]
        metrics: dict[str, float | None] = dict.fromkeys((*_WORST, *(metric.name for metric in self._own)))
        any_time = self._time > member.first and bool(kept.any())
        if any_time:
            metrics |= {name: float(worst[rows][kept].max()) for name, worst in self._worst.items()}
        for metric in self._own:
            worst = metrics[metric.name]
            metrics[metric.name] = None if worst is None else metric.from_badness(worst)
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
    "ball_floor_error",
    "rounding_floor",
    "gradient_error",
    "condition_number",
)
