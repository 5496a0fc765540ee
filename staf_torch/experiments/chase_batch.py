"""Gradient chases of many problems as one tensor batch. No problem influences another."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..chase import ChaseResult, chase_pieces, chunk_length
from ..metrics import ChaseMetrics, Member
from ..optim.stacked import stack_laws
from ..stacking import StackedBasis, StackedTarget
from ..systems import trajectory
from .build import ChaseProblem
from .progress import Progress

Sink = Callable[[Mapping[str, np.ndarray]], None]
"""Takes the next piece of time of a problem's history: name -> (b, C, ...)."""

HISTORY = ("state", "value", "estimate", "weights", "ideal_weights", "excess")
_DRAWN = (*HISTORY, "ideal_estimate")
_DRAWN_TIMES = 4000  # more could not be told apart in print


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a gradient chase leaves behind in memory."""

    metrics: dict[str, float | None]
    drawn: dict[str, np.ndarray]  # the first trajectory, thinned: name -> (T', ...); empty where not wanted
    diverged_at: Tensor  # (B,) index of time, -1 if none
    warnings: tuple[str, ...] = ()  # that the chase alone would have given


def simulate(
    problems: Sequence[ChaseProblem],
    sinks: Sequence[Sink | None],
    drawn: Sequence[bool],
    progress: Progress | None = None,
) -> list[Outcome]:
    """Run problems with the same number of steps and centers as one batch, in pieces of time.

    Args:
        problems: alike but for their initial states, scalar hyperparameters, targets, dt and settle_time.
        sinks: where the history of each goes, None where nobody wants it.
        drawn: whether the outcome of each has what its figure needs.
        progress: over times.

    Raises:
        ValueError: if the problems differ in more than that, or one is ill-posed.
    """
    order = _alike_together(problems)
    members = [_Member(problems[i], sinks[i], drawn[i]) for i in order]
    outcomes = _run(members, progress)
    return [outcome for _, outcome in sorted(zip(order, outcomes, strict=True), key=lambda pair: pair[0])]


def _run(members: Sequence[_Member], progress: Progress | None) -> list[Outcome]:
    batch = _Stacked.of([member.problem for member in members])
    first = members[0].problem
    times = first.steps + 1
    metrics = ChaseMetrics(
        batch.basis,
        batch.target,
        batch.law,
        inner_steps=first.inner_steps,
        members=[Member(m.rows, m.problem.dt, m.problem.settle_time) for m in members],
    )
    chunk = chunk_length(sum(m.rows for m in members), batch.basis, first.initial_states.element_size())
    # Some twenty pieces of a long run, so that progress is seen; the results do not depend on it.
    chunk = max(1, min(chunk, max(64, -(-times // 20))))
    chased = chase_pieces(
        _states(members, chunk),
        batch.basis,
        batch.target,
        batch.law,
        inner_steps=first.inner_steps,
        predictor=first.predictor,
        certificate=first.certificate,
    )
    with torch.no_grad():
        for result in chased:
            metrics.add(result)
            start = 0
            for member in members:
                member.take(result, slice(start, start + member.rows), alone=len(members) == 1)
                start += member.rows
            if progress is not None:
                progress.advance(result.state.shape[1])
    return [member.outcome(found) for member, found in zip(members, metrics.summaries(), strict=True)]


@dataclasses.dataclass(frozen=True)
class _Stacked:
    """What the engine takes, for all rows."""

    basis: Any
    target: Any
    law: Any

    @classmethod
    def of(cls, problems: Sequence[ChaseProblem]) -> _Stacked:
        if len(problems) == 1:
            return cls(problems[0].basis, problems[0].target, problems[0].law)
        counts = [len(problem.initial_states) for problem in problems]
        targets, rows = _runs([problem.target for problem in problems], counts)
        return cls(
            StackedBasis(*_runs([problem.basis for problem in problems], counts)),
            targets[0] if len(targets) == 1 else StackedTarget(targets, rows),
            stack_laws(*_runs([problem.law for problem in problems], counts), problems[0].initial_states),
        )


def _runs(parts: Sequence[Any], counts: Sequence[int]) -> tuple[list[Any], list[int]]:
    """Each object once for the consecutive problems that share it, and their rows together."""
    kept: list[Any] = []
    rows: list[int] = []
    for part, count in zip(parts, counts, strict=True):
        if kept and part is kept[-1]:
            rows[-1] += count
        else:
            kept.append(part)
            rows.append(count)
    return kept, rows


def _alike_together(problems: Sequence[ChaseProblem]) -> list[int]:
    """An order in which problems that share parts follow each other."""
    seen: dict[object, int] = {}

    def rank(part: object) -> int:
        return seen.setdefault(part if isinstance(part, float) else id(part), len(seen))

    keys = [tuple(rank(part) for part in (p.dt, p.target, p.law, p.basis)) for p in problems]
    return sorted(range(len(problems)), key=keys.__getitem__)


def _states(members: Sequence[_Member], chunk: int) -> Iterator[Tensor]:
    """The trajectories of all, in pieces of time; those with one step length run side by side."""
    first = members[0].problem
    runs: list[tuple[float, list[Tensor]]] = []
    for member in members:
        if not runs or runs[-1][0] != member.problem.dt:
            runs.append((member.problem.dt, []))
        runs[-1][1].append(member.problem.initial_states)
    pieces = [
        trajectory(first.system, torch.cat(starts), dt=dt, steps=first.steps, chunk=chunk)
        for dt, starts in runs
    ]
    for together in zip(*pieces, strict=True):
        yield together[0] if len(together) == 1 else torch.cat(together)


class _Member:
    """One problem of a batch: what is kept of its rows."""

    def __init__(self, problem: ChaseProblem, sink: Sink | None, drawn: bool) -> None:
        self.problem, self._sink = problem, sink
        self.rows = len(problem.initial_states)
        self._thinned = _Thinned(problem.steps + 1) if drawn else None
        self._warnings: list[str] = []
        self._diverged_at = torch.full((self.rows,), -1)

    def take(self, result: ChaseResult, rows: slice, *, alone: bool) -> None:
        if self._thinned is not None:
            self._thinned.add(result, rows.start)
        if self._sink is not None:
            self._sink({name: getattr(result, name)[rows].cpu().numpy() for name in HISTORY})
        self._diverged_at = result.diverged_at[rows]
        if not alone and not self._warnings:
            with warnings.catch_warnings(record=True) as given:
                warnings.simplefilter("always")
                self.problem.basis.check_reach(result.state[rows])
            self._warnings += [str(warning.message) for warning in given]

    def outcome(self, metrics: dict[str, float | None]) -> Outcome:
        drawn = {}
        if self._thinned is not None:
            time = np.arange(self.problem.steps + 1) * self.problem.dt
            drawn = self._thinned.arrays() | {"time": time[:: self._thinned.stride]}
        return Outcome(metrics, drawn, self._diverged_at.cpu().clone(), tuple(self._warnings))


class _Thinned:
    """The first trajectory at every so manieth time, for the figure."""

    def __init__(self, times: int) -> None:
        self.stride = -(-times // _DRAWN_TIMES)
        self._time = 0
        self._parts: dict[str, list[np.ndarray]] = {name: [] for name in _DRAWN}

    def add(self, result: ChaseResult, row: int) -> None:
        first = -self._time % self.stride
        for name, parts in self._parts.items():
            # A copy: a view would keep the whole piece in memory.
            parts.append(getattr(result, name)[row, first :: self.stride].cpu().numpy().copy())
        self._time += result.state.shape[1]

    def arrays(self) -> dict[str, np.ndarray]:
        return {name: np.concatenate(parts) for name, parts in self._parts.items()}
