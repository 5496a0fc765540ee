"""Tensors to numbers: what a gradient chase reached, and the largest error in the ball around a state."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..approximation.basis import StaFBasis, Target
from ..centers import probe_points
from ..engine import ChaseResult
from ..lanes import Program, reduce, shared_program
from ..lanes.calls.choice import PlainTime, undecided, worth
from ..lanes.gradients import grad
from ..lanes.per_row.objects import made_by_rows
from ..lanes.row_numbers import RowNumbers, over_rows, points_of_rows, some_rows
from ..local_basis import NewtonSpace, evaluate_scaled, scale
from ..numerics.linalg import condition_number
from ..optim import UpdateLaw
from . import Metric

PROBES = 97  # points of the ball to take a supremum over; in the plane 64 of them on its edge
_BLOCK = 2**18  # numbers in a temporary of plain torch, so that it stays in cache
_PAYS = 30_000  # states in plain torch (some 30 us each) after which it is compiled, however short they are


class StateErrors(NamedTuple):
    """Errors and ball suprema at states (..., T, n)."""

    ball_error: Tensor  # (..., T) sup |V - V^| over the closed ball of radius nu(x)
    ball_floor_error: Tensor  # (..., T) that supremum with the ideal weights, in the local basis
    gradient_error: Tensor  # (..., T) |grad V - grad V^| at the state, the centers frozen
    condition_number: Tensor  # (..., T) kappa(K(c(x)))
    native_square: Tensor  # (..., T) w'V(c), the square of the native norm of V^ with the ideal weights w


class StateErrorPass:
    """Finds `StateErrors` in one pass over states; consecutive pieces share what is set up once.

    Suprema are over fixed points of the ball, at least 2. The floor is the best that kernel, radius and
    layout allow, without the rounding of large weights. Plain torch is the definition; once so many states
    have been asked for that it pays (``expected`` says how many will be: they then pay from the first on, or
    from the second call where the first has to be counted), a program of `lanes` keeps a state in every lane
    and V at a point serves all. `compiled` says whether the last call used it.
    """

    def __init__(
        self,
        basis: StaFBasis,
        target: Target,
        points: int = PROBES,
        *,
        compile: bool | str = "auto",
        expected: int = 0,
    ) -> None:
        self._basis, self._target, self._points, self._compile = basis, target, points, compile
        self._fixed: _Fixed | None = None
        self._seen, self._expected, self.compiled = 0, expected, False
        self._share = 0.0  # of a build that a state takes in plain torch, by the operations of the first ones
        self._program: Program | None = None

    def __call__(self, x: Tensor, coefficients: Tensor, ideal: Tensor) -> StateErrors:
        """The errors at the states.

        Args:
            x: (..., T, n); after the first call states of the same rows.
            coefficients: b of `ChaseResult.coefficients`, (..., T, M).
            ideal: the paper's w with the ideal weights, (..., T, M).
        """
        if self._fixed is None:
            with some_rows(None):
                self._fixed = made_by_rows(lambda: _Fixed.of(self._basis, x, self._points))
        self._seen += x.numel() // x.shape[-1]
        found = self._compiled(x, coefficients, ideal) if self._pays() else None
        if found is not None:
            return found
        width = self._points * self._basis.count * max(1, x.numel() // x.shape[-1] // x.shape[-2])
        times, at = max(1, _BLOCK // width), functools.partial(self._at, pieces=-(-width // _BLOCK))
        blocks = zip(*(part.split(times, dim=-2) for part in (x, coefficients, ideal)), strict=True)
        errors = [self._counted(at, next(blocks)), *(over_rows(at, *block) for block in blocks)]
        columns = zip(*errors, strict=True)
        return StateErrors(*(torch.cat(column, dim=-1) for column in columns))

    def _compiled(self, *given: Tensor) -> StateErrors | None:
        """The errors at the states by a program; None where it cannot be compiled."""
        shape = given[0].shape[:-1]
        assert self._fixed is not None
        # What is fixed for a row's own numbers comes once a row: its states are times.
        timed = isinstance(self._fixed.core, RowNumbers) and len(shape) == 2
        if self._program is None:
            parts = self._basis, self._target, self._fixed
            name = "the errors on balls of rows" if timed else "the errors on a ball"

            def step(_: Any, now: Any, row: Any) -> Any:
                return (), self._at(*(now if timed else row))

            self._program = shared_program(name, step, *parts)
        times = shape[-1] if len(shape) > 1 else 1
        row = () if timed else tuple(part.reshape(-1, part.shape[-1]) for part in given)
        steps = times if timed else 1
        points = contextlib.nullcontext() if timed else points_of_rows(shape.numel() // times, times)
        with points:
            call = (), given if timed else (), row
            self.compiled = self._program.compiles(*call, steps=steps)
            if not self.compiled:
                return None
            found: tuple[Tensor, ...] = self._program(*call, steps=steps)[1]
        return StateErrors(*(part.reshape(shape) for part in found))

    def _pays(self) -> bool:
        states = max(self._seen, self._expected)
        pays = states >= _PAYS or states * self._share >= 1
        return worth(pays) if self._compile == "auto" else bool(self._compile)

    def _counted(self, at: Callable[..., StateErrors], block: tuple[Tensor, ...]) -> StateErrors:
        """The errors at the first states, and how long they take."""
        if self._share or not undecided(self._compile):
            return over_rows(at, *block)
        with PlainTime() as plain:
            errors = over_rows(at, *block)
        self._share = plain.seconds() / plain.build / max(1, errors.ball_error.numel())
        return errors

    def _at(self, x: Tensor, coefficients: Tensor, ideal: Tensor, *, pieces: int = 1) -> StateErrors:
        """The definition, in which no state sees another: (..., n), (..., M), (..., M).

        Args:
            pieces: in which the points of the ball are gone through, for less memory.
        """
        basis, target, fixed = self._basis, self._target, self._fixed
        assert fixed is not None
        nu, offsets = basis.centers.radius(x)[..., None, None], basis.centers.offsets(x)
        values, space = basis.values(x, target), basis.local(x)
        fitted = space.fit(values)

        def errors(at: tuple[Tensor, Tensor | None, Tensor | None]) -> Tensor:
            probes, core, cardinal = at
            z = nu * probes
            value, gain = target(x.unsqueeze(-2) + z), scale(basis.kernel, x, z)
            core = basis.kernel.core(x, z, offsets) if core is None else core
            estimate = (core * coefficients.unsqueeze(-2)).sum(-1) * gain
            if cardinal is None:
                ideal = space.evaluate(z, fitted)
            else:
                ideal = (cardinal * fitted.unsqueeze(-2)).sum(-1) * gain
            return torch.stack(((value - estimate).abs(), (value - ideal).abs()), dim=-1)

        worst = fixed.largest(errors, x, pieces)
        kappa = condition_number(basis.gram_structure(x).scaled())

        def local(z: Tensor) -> Tensor:
            return evaluate_scaled(basis.kernel, offsets, x, z.unsqueeze(-2), coefficients)

        approximate, exact = _gradient(local, torch.zeros_like(x)), _gradient(target, x.detach())
        return StateErrors(
            ball_error=worst[..., 0],
            ball_floor_error=worst[..., 1],
            gradient_error=(exact - approximate).square().sum(-1).sqrt(),
            condition_number=kappa.expand(x.shape[:-1]),
            native_square=(ideal * values).sum(-1),
        )


def _gradient(function: Target, at: Tensor) -> Tensor:
    """grad f, row by row: (..., n). Not by torch.func, whose first use imports the compiler for a second."""
    if torch._C._functorch.is_functorch_wrapped_tensor(at):  # numbers of rows, in plain torch
        gradient: Tensor = grad(lambda x: function(x).sum())(at)
        return gradient
    with torch.enable_grad():
        at = at.clone().requires_grad_()
        values = function(at)
        if not values.requires_grad:  # a constant
            return torch.zeros_like(at).detach()
        (gradient,) = torch.autograd.grad(values.sum(), at)
    return gradient


class _Fixed(NamedTuple):
    """Quantities at the points of the ball that all states share; None where they depend on the state."""

    probes: Tensor  # (P, n) in units of the radius
    core: Tensor | None  # k0(z, d), (P, M), or (..., 1, P, M) where each row has its own
    cardinal: Tensor | None  # psi(z), likewise: one product then evaluates the ideal weights of all states

    @classmethod
    def of(cls, basis: StaFBasis, x: Tensor, points: int) -> _Fixed:
        """For states (..., T, n) and what follows them in the same rows."""
        probes = probe_points(points, basis.dim).to(x)
        origin = x.new_zeros(basis.dim)
        if not (basis.kernel.state_free and basis.centers.radius.constant):
            two = torch.zeros_like(x[..., :1, :]).expand(*x.shape[:-2], 2, -1)
            parts = basis.centers.offsets(two), basis.gram_structure(two).core
            if any(part.dim() > 2 and part.shape[-3] > 1 for part in parts):
                return cls(probes, None, None)
            origin = two[..., :1, :] if any(part.dim() > 2 for part in parts) else origin
        space, z = basis.local(origin), basis.centers.radius(origin)[..., None, None] * probes
        # A Newton space has none: its coefficients are nodal values, and cardinal functions, one by one,
        # lose the digits that a smooth V keeps.
        cardinal = None
        if not isinstance(space, NewtonSpace):
            ones = torch.eye(basis.count, dtype=x.dtype, device=x.device)
            gain = scale(basis.kernel, origin, z)
            functions = [space.evaluate(z, one.expand(*origin.shape[:-1], -1)) / gain for one in ones]
            cardinal = torch.stack(functions, dim=-1)
        return cls(probes, basis.kernel.core(origin, z, basis.centers.offsets(origin)), cardinal)

    def largest(self, body: Callable[[Any], Tensor], x: Tensor, pieces: int) -> Tensor:
        """Return the largest of what ``body`` computes at the points, at states x: (..., n) to (..., 2)."""

        def along(part: Tensor | None) -> Tensor | None:
            return None if part is None else part[(None,) * (x.dim() + 1 - part.dim())]

        size = -(-len(self.probes) // pieces)
        parts = [[None] * pieces if part is None else part.split(size, dim=-2) for part in map(along, self)]
        found = [reduce(body, points, "max", dim=x.dim() - 1) for points in zip(*parts, strict=False)]
        return functools.reduce(torch.maximum, found)


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
        self._chased = Chased(basis, target, law)
        self._inner_steps, self._members = inner_steps, members
        self._sizes = torch.tensor([each.rows for each in members], dtype=torch.int64, device="cpu")
        self._first = torch.tensor([each.first for each in members], dtype=torch.int64, device="cpu")
        self._own = tuple(own)
        self._errors = StateErrorPass(basis, target) if errors is None else errors
        self._rows, self._all = _RowRecord(0), _RowRecord(0)  # those taken in now, and all of the batch

    def next_rows(self) -> None:
        """Say that the next pieces begin at time 0 again, with further rows of the batch."""
        self._gathered()
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
            **{metric.name: metric.badness(result, self._chased)[:, at] for metric in self._own},
        )
        rate = over_rows(self._chased.law.contraction, errors.condition_number)
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
        self._all.fill(self._rows.finished(), int(self._sizes.sum()))
        return self._all

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
        """Return this, without the history of the excess, which has been read."""
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
