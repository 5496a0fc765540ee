"""Tensors to numbers: what a gradient chase reached over its window of settled times."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..approximation.basis import StaFBasis, Target
from ..engine import ChaseResult
from ..lanes.row_numbers import over_rows
from ..optim import UpdateLaw
from . import Metric
from .ball_error import StateErrorPass


class Member(NamedTuple):
    """A problem of a batch, with rows and a window of its own."""

    rows: int  # trajectories, the next so many of the batch
    dt: float  # s
    settle_time: float  # s

    @property
    def first(self) -> int:
        """Index of the first settled time."""
        return math.ceil(self.settle_time / self.dt - 1e-9)


class Chased(NamedTuple):
    """Arguments of a `Metric` of a gradient chase beside the result."""

    basis: StaFBasis
    target: Target
    law: UpdateLaw


class ChaseMetrics:
    """The metrics of a gradient chase, gathered piece by piece so that memory does not grow with time.

    Each is the worst over the times t >= settle_time (s, with the step dt) and over the trajectories that did
    not diverge; None where there is no such time or trajectory. `results.run.MEANINGS` says what each is;
    `certificate_violations` is there only where certificates were made.

    A batch holds ``members``, problems with a dt and settle_time of their own, and `summaries` has a
    dictionary of each. ``own`` are metrics of the user's own, reported beside these under their names;
    ``errors`` finds the errors on a ball, where several chases along the same states share one.
    """

    def __init__(
        self,
        basis: StaFBasis,
        target: Target,
        law: UpdateLaw,
        *,
        inner_steps: int,
        members: Sequence[Member],
        own: Sequence[Metric] = (),
        errors: StateErrorPass | None = None,
    ) -> None:
        self._basis, self._target, self._law = basis, target, law
        self._inner_steps = inner_steps
        self._members = members
        self._sizes = torch.tensor([each.rows for each in members], dtype=torch.int64, device="cpu")
        self._first = torch.tensor([each.first for each in members], dtype=torch.int64, device="cpu")
        self._own = tuple(own)
        self._errors = StateErrorPass(basis, target) if errors is None else errors
        self._rows = _RowRecord(0)
        self._kept: _RowRecord | None = None  # of all rows, the ones before those taken in now filled in

    def next_rows(self) -> None:
        """Say that the next pieces begin at time 0 again, with further rows of the batch."""
        if self._kept is None:
            self._kept = _RowRecord(0)
        self._kept.fill(self._rows.finished(), int(self._sizes.sum()))
        self._rows = _RowRecord(self._rows.first + len(self._rows.diverged))

    def add(self, result: ChaseResult) -> None:
        """Take in the next piece of time."""
        rows = self._rows
        batch, length, _ = result.state.shape
        firsts = self._firsts(rows.first, batch)  # of the window, of each row
        early, skip = (min(max(int(k) - rows.time, 0), length) for k in (firsts.max(), firsts.min()))
        where = result.state.device
        index = torch.arange(rows.time, rows.time + length, device=where)
        settled = index >= firsts.to(where).unsqueeze(-1)  # (B, C)
        rows.time += length
        rows.diverged = result.diverged
        if early > 0:
            rows.early.append(torch.where(settled[:, :early], -torch.inf, result.excess[:, :early]))
        if skip == length:
            return
        at = slice(skip, None)
        settled = settled[:, at]
        x, excess, before = result.state[:, at], result.excess[:, at], result.excess_before[:, at]
        value = result.value[:, at]
        errors = self._errors(x, result.coefficients[:, at], result.ideal_weights[:, at])
        chased = Chased(self._basis, self._target, self._law)
        rows.keep_worst(
            settled,
            ultimate_error=(value - result.estimate[:, at]).abs(),
            ultimate_error_before=(value - result.estimate_before[:, at]).abs(),
            floor_error=(value - result.ideal_estimate[:, at]).abs(),
            ultimate_excess=excess,
            ultimate_excess_before=before,
            ball_error=errors.ball_error,
            ball_floor_error=errors.ball_floor_error,
            rounding_floor=torch.finfo(value.dtype).eps * value.abs(),
            gradient_error=errors.gradient_error,
            condition_number=errors.condition_number,
            **{metric.name: metric.badness(result, chased)[:, at] for metric in self._own},
        )
        rate = over_rows(self._law.contraction, errors.condition_number)
        if rate is None:
            return
        rounding = 1e3 * torch.finfo(x.dtype).eps * errors.native_square.abs()
        broken = excess > rate**self._inner_steps * before * (1 + 1e-9) + rounding
        rows.count("contraction_violations", broken & settled)
        if result.certificate is not None:
            rows.count("certificate_violations", result.certificate.violated[:, at] & settled)

    def summaries(self) -> list[dict[str, float | None]]:
        """Name to number over the rows of each member, in order; None where there is nothing to report."""
        found, members = self._gathered(), self._members
        whose = torch.arange(len(members), device="cpu").repeat_interleave(self._sizes)
        whose = whose.to(found.diverged.device)
        kept = ~found.diverged

        def of_each(quantity: Tensor, none: float, how: str) -> list[float]:
            """The largest or the sum over the rows of each member that did not diverge."""
            known = torch.where(kept, quantity, torch.full_like(quantity, none))
            start = known.new_full((len(members),), none)
            each: list[float] = start.scatter_reduce(0, whose, known, how).tolist()
            return each

        whole = of_each(torch.ones_like(whose), 0, "sum")
        worst = {name: of_each(column, -math.inf, "amax") for name, column in found.worst.items()}
        counts = {
            name: of_each(column, 0, "amax" if name == "settling_time" else "sum")
            for name, column in found.counts.items()
        }
        return [
            self._summary(
                member,
                found.time,
                whole[i],
                {name: column[i] for name, column in worst.items()},
                {name: column[i] for name, column in counts.items()},
            )
            for i, member in enumerate(members)
        ]

    def _firsts(self, start: int, batch: int) -> Tensor:
        """The index of the first settled time of each of the rows from ``start`` on: (B,)."""
        rows = torch.arange(start, start + batch, device="cpu")
        return self._first[torch.searchsorted(self._sizes.cumsum(0), rows, right=True)]

    def _gathered(self) -> _RowRecord:
        """All rows as one."""
        last = self._rows.finished()
        if self._kept is None:
            return last
        self._kept.fill(last, len(self._kept.diverged))
        return self._kept

    def _summary(
        self,
        member: Member,
        times: int,
        kept: float,
        worst: Mapping[str, float],
        counts: Mapping[str, float],
    ) -> dict[str, float | None]:
        """Name to number of a member of whose rows so many did not diverge, by their reductions."""
        metrics: dict[str, float | None] = dict.fromkeys((*_WORST, *(metric.name for metric in self._own)))
        any_time = times > member.first and kept > 0
        if any_time:
            metrics |= worst
        for metric in self._own:
            bad = metrics[metric.name]
            metrics[metric.name] = None if bad is None else metric.from_badness(bad)
        metrics |= {"settling_time": None, "contraction_violations": None}
        if times > member.first:
            metrics |= {name: float(count) if any_time else None for name, count in counts.items()}
        if any_time:
            last = counts.get("settling_time", 0.0) if member.first > 0 else 0.0
            metrics["settling_time"] = float(last) * member.dt
        metrics["diverged_fraction"] = (member.rows - kept) / member.rows
        return {k: v if v is not None and math.isfinite(v) else None for k, v in metrics.items()}


class _RowRecord:
    """Running reductions over rows that share their times."""

    def __init__(self, first: int) -> None:
        self.first = first  # index of the first of them in the batch
        self.time = 0
        self.worst: dict[str, Tensor] = {}  # name -> (B,)
        self.counts: dict[str, Tensor] = {}  # name -> (B,) int64; times until the excess settles among them
        self.early: list[Tensor] = []  # excess before the window, -inf in it, (B, C) a piece
        self.diverged = torch.zeros(0, dtype=torch.bool, device="cpu")

    def count(self, name: str, happened: Tensor) -> None:
        """Add the times of a piece (B, C) at which something happened."""
        new = happened.sum(dim=1)
        self.counts[name] = self.counts[name] + new if name in self.counts else new

    def keep_worst(self, settled: Tensor, **quantities: Tensor) -> None:
        for name, quantity in quantities.items():
            worst = torch.where(settled, quantity, -torch.inf).amax(dim=1)
            self.worst[name] = torch.maximum(self.worst[name], worst) if name in self.worst else worst

    def finished(self) -> _RowRecord:
        """Return a copy without the history of the excess, which has been read."""
        if self.early and self.worst:
            early = torch.cat(self.early, dim=1)
            index = torch.arange(1, early.shape[1] + 1, device=early.device)
            above = early > self.worst["ultimate_excess"].unsqueeze(-1)
            self.counts["settling_time"] = torch.where(above, index, 0).amax(dim=1)
        self.early = []
        return self

    def fill(self, part: _RowRecord, total: int) -> None:
        """Take over the numbers of some finished rows of ``total``.

        Into tensors for all of them: many small ones that stay would leave holes in memory between them.
        """
        rows = slice(part.first, part.first + len(part.diverged))
        self.time = part.time
        for name, worst in part.worst.items():
            self.worst.setdefault(name, worst.new_full((total,), -torch.inf))[rows] = worst
        for name, count in part.counts.items():
            self.counts.setdefault(name, count.new_zeros(total))[rows] = count
        if len(self.diverged) < total:
            self.diverged = part.diverged.new_zeros(total)
        self.diverged[rows] = part.diverged


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
