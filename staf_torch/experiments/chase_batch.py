"""Gradient chases of many problems, as few tensor batches as they allow. No problem influences another."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from ..approximation.basis import REACH
from ..engine import ChaseResult, chase_pieces, chunk_length
from ..metrics.ball_error import StateErrorPass
from ..metrics.chase import ChaseMetrics, Member
from ..results.files import grouped
from ..settings.chase import ChaseProblem, warnings_to
from ..systems import trajectory

Sink = Callable[[Mapping[str, np.ndarray], int], None]
"""Takes the next piece of time of a block of a problem's rows, name -> (b, C, ...), and its first row."""

HISTORY = ("state", "value", "estimate", "weights", "ideal_weights", "excess")
_DRAWN = (*HISTORY, "ideal_estimate")
_ROWS = 4096  # at most that go through time together: memory does not grow with rows
_FEW, _BYTES = 64, 2**26  # rows at least, and bytes at most, where a history is kept: it is written by rows
_DRAWN_TIMES = 4000  # more could not be told apart in print


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Result of a gradient chase in memory."""

    metrics: dict[str, float | None]
    drawn: dict[str, np.ndarray]  # the first trajectory, thinned: name -> (T', ...); empty where not wanted
    diverged_at: Tensor  # (B,) index of time, -1 if none
    warnings: tuple[str, ...] = ()  # that the chase alone would have given


def simulate(
    problems: Sequence[ChaseProblem],
    sinks: Sequence[Sink | None],
    drawn: Sequence[bool],
    advance: Callable[[int], None] | None = None,
    errors: StateErrorPass | None = None,
) -> list[Outcome]:
    """Run problems in pieces of time; those that share basis, target, law and dt run as one batch.

    Sharing means one object: `Parts` makes equal settings one. Different hyperparameters never meet in a
    tensor. One batch over 5 radii x 5 seeds, or over 3 radii x 40 seeds, took as long as a batch a radius
    (.95 and 1.12 times its CPU seconds); over 30 radii with steepest descent .48 to .56 times.

    Args:
        problems: with the same number of steps and centers, the same iterations, predictor and certificate.
        sinks: where the history of each goes, None where nobody wants it.
        drawn: whether the outcome of each has what its figure needs.
        advance: is told how many more times are done, those of every problem.
        errors: of their metrics, where all have the same basis, target and initial states.

    Returns:
        In the order of the problems.
    """

    def shared(i: int) -> tuple[object, ...]:
        one = problems[i]
        return (*map(id, (one.basis, one.target, one.law, *one.metrics)), one.dt)

    found: dict[int, Outcome] = {}
    for indices in grouped(range(len(problems)), shared).values():
        members = [_BatchMember(problems[i], sinks[i], drawn[i]) for i in indices]
        found |= zip(indices, _run(members, advance, errors, alone=len(problems) == 1), strict=True)
    return [found[i] for i in range(len(problems))]


def _run(
    members: Sequence[_BatchMember],
    advance: Callable[[int], None] | None,
    errors: StateErrorPass | None,
    *,
    alone: bool,
) -> list[Outcome]:
    """Run problems that differ in initial states and settle_time alone as one batch.

    Unless one problem is ``alone``, each member keeps the warnings about its own rows.
    """
    first = members[0].problem
    times, starts = first.steps + 1, torch.cat([member.problem.initial_states for member in members])
    metrics = ChaseMetrics(
        first.basis,
        first.target,
        first.law,
        inner_steps=first.inner_steps,
        members=[Member(m.rows, m.problem.dt, m.problem.settle_time) for m in members],
        own=first.metrics,
        errors=errors,
    )
    tell = _of_whole_problems(advance, len(starts), len(members))
    together = _ROWS
    if any(member.sink is not None for member in members):
        kept = starts.shape[1] + 3 + 2 * first.basis.count  # numbers of a row and time, of `HISTORY`
        whole = _BYTES // (times * kept * starts.element_size())  # rows with all times
        together = min(_ROWS, max(_FEW, whole))
    blocks = starts.split(together)
    chunk = chunk_length(min(together, len(starts)), first.basis, starts.element_size())
    # Some twenty pieces of a long run, so that progress is seen; the results do not depend on it.
    chunk = max(1, min(chunk, max(64, -(-times // 20))))
    done, reach = 0, 0.0  # rows, and the largest |x| nu(x): blocks give one warning at the end
    with torch.no_grad(), warnings.catch_warnings():
        if len(blocks) > 1 or not alone:
            warnings.filterwarnings("ignore", message=REACH)
        for block in blocks:
            if done:
                metrics.next_rows()
            chased = chase_pieces(
                trajectory(first.system, block, dt=first.dt, steps=first.steps, chunk=chunk),
                first.basis,
                first.target,
                first.law,
                inner_steps=first.inner_steps,
                predictor=first.predictor,
                certificate=first.certificate,
            )
            for result in chased:
                metrics.add(result)
                if len(blocks) > 1:
                    reach = max(reach, first.basis.largest_reach(result.state))
                _distribute(result, done, members, alone=alone)
                tell(result.state.shape[0] * result.state.shape[1])
            done += len(block)
    if len(blocks) > 1 and alone:
        first.basis.warn_reach(reach, stacklevel=2)
    return [member.outcome(found) for member, found in zip(members, metrics.summaries(), strict=True)]


def _distribute(result: ChaseResult, first: int, members: Sequence[_BatchMember], *, alone: bool) -> None:
    """Give every member what a piece has of its rows; the piece begins at row ``first`` of the batch."""
    start, count = 0, result.state.shape[0]
    for member in members:
        low, high = max(start - first, 0), min(start + member.rows - first, count)
        if low < high:
            member.take(result, slice(low, high), first + low - start, alone=alone)
        start += member.rows


def _of_whole_problems(
    advance: Callable[[int], None] | None, rows: int, problems: int
) -> Callable[[int], None]:
    """Return a function that turns times of rows into times of whole problems, for a display of progress."""
    done = told = 0

    def tell(count: int) -> None:
        nonlocal done, told
        done += count
        new = done * problems // rows - told
        told += new
        if advance is not None and new:
            advance(new)

    return tell


class _BatchMember:
    """A problem of a batch, with the metrics and records of its rows."""

    def __init__(self, problem: ChaseProblem, sink: Sink | None, drawn: bool) -> None:
        self.problem, self.sink = problem, sink
        self.rows = len(problem.initial_states)
        self._thinned = _Thinned(problem.steps + 1) if drawn else None
        self._warnings: list[str] = []
        self._diverged_at = torch.full((self.rows,), -1, dtype=torch.int64, device="cpu")

    def take(self, result: ChaseResult, rows: slice, place: int, *, alone: bool) -> None:
        """Take in ``rows`` of a piece of time, which are this problem's from ``place`` on."""
        if self._thinned is not None and place == 0:
            self._thinned.add(result, rows.start)
        if self.sink is not None:
            self.sink({name: getattr(result, name)[rows].cpu().numpy() for name in HISTORY}, place)
        self._diverged_at[place : place + rows.stop - rows.start] = result.diverged_at[rows].cpu()
        if not alone and not self._warnings:
            with warnings_to(self._warnings):
                self.problem.basis.check_reach(result.state[rows])

    def outcome(self, metrics: dict[str, float | None]) -> Outcome:
        drawn = {}
        if self._thinned is not None:
            time = np.arange(self.problem.steps + 1) * self.problem.dt
            drawn = self._thinned.arrays() | {"time": time[:: self._thinned.stride]}
        return Outcome(metrics, drawn, self._diverged_at, tuple(self._warnings))


class _Thinned:
    """The first trajectory, thinned to every k-th time, for the figure."""

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
