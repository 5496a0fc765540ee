"""Gradient chases of many problems, as few tensor batches as they allow. No problem influences another."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..approximation.basis import REACH, StaFBasis, Target
from ..engine import ChaseResult, chase_pieces, chunk_length
from ..engine.predictors import Predictor
from ..lanes.row_numbers import over_rows
from ..metrics.chase import ChaseMetrics, Member, StateErrorPass
from ..optim import UpdateLaw
from ..settings.chase import ChaseProblem, warnings_to
from ..systems import ControlAffineSystem, trajectory
from .registry import RowsOfJobs, in_calls

Sink = Callable[[Mapping[str, np.ndarray], int, int], None]
"""Takes a piece of a problem's history, name -> (b, C, ...), with its first row and its first time."""

HISTORY = ("state", "value", "estimate", "weights", "ideal_weights", "excess")
_DRAWN = (*HISTORY, "ideal_estimate")
_ROWS = 4096  # at most that go through time together: memory does not grow with rows
_ROWS_OF_JOBS = 512  # the same of several problems, whose results are small: their memory counts
_ON_DEVICE = 32  # times as many rows there, and as much memory: a launch costs as much for few as for many
_FEW, _BYTES = 64, 2**26  # rows at least, and bytes at most, where a history is kept: it is written by rows
_TIMES, _SEEN = 64, 20  # of a piece, at least; pieces
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
    """Run problems in pieces of time, and return their outcomes in order; those that differ in numbers run as
    one batch.

    What differs between problems, a radius, a width, a gain, a mass, is then a column with a number a row.
    Objects that differ in more, or with which a row's own numbers are not served, run one after the other. No
    problem sees another.

    Args:
        problems: with the same number of steps and centers, the same iterations, predictor and certificate.
        sinks: where the history of each goes, None where nobody wants it.
        drawn: whether the outcome of each has what its figure needs.
        advance: is told how many more times are done, those of every problem.
        errors: of their metrics, where all have the same basis, target and initial states.
    """
    objects = [_Objects.of(problem) for problem in problems]
    asked = [*zip(problems, sinks, drawn, strict=True)]

    def alike(i: int) -> tuple[object, ...]:
        own = problems[i].metrics  # of the user's, which see one problem at a time
        return problems[i].dt, *map(id, own), *(map(id, objects[i]) if own else ())

    counts = [len(problem.initial_states) for problem in problems]
    run = functools.partial(_run, asked, errors)
    return in_calls(run, objects, counts, [alike(i) for i in range(len(problems))], advance)


def histories(problem: ChaseProblem) -> dict[str, Tensor]:
    """Return the chase of a problem as one piece: name -> (B, T, ...)."""
    (found,) = _chased(problem, _Objects.of(problem), problem.initial_states, problem.steps + 1)
    return {name: x for name, x in vars(found).items() if isinstance(x, Tensor) and x.dim() > 1}


class _Objects(NamedTuple):
    """Objects of a problem in which numbers may differ from row to row."""

    system: ControlAffineSystem
    basis: StaFBasis
    target: Target
    law: UpdateLaw
    predictor: Predictor | None

    @classmethod
    def of(cls, problem: ChaseProblem) -> _Objects:
        return cls(*(getattr(problem, name) for name in cls._fields))


def _run(
    asked: Sequence[tuple[ChaseProblem, Sink | None, bool]],
    errors: StateErrorPass | None,
    jobs: Sequence[int],
    parts: _Objects,
    rows: RowsOfJobs,
    advance: Callable[[int], None] | None,
) -> list[Outcome]:
    """Run ``jobs`` of all that is ``asked``, of the same dt, as one batch with their objects and rows.

    Unless there is one problem in all, each member keeps the warnings about its own rows.
    """
    members, alone = [_BatchMember(*asked[i]) for i in jobs], len(asked) == 1
    first, basis = members[0].problem, parts.basis
    times, starts = first.steps + 1, torch.cat([member.problem.initial_states for member in members])
    windows = [Member(m.rows, m.problem.dt, m.problem.settle_time) for m in members]
    if rows.differ or errors is None:
        states = sum(window.rows * max(0, times - window.first) for window in windows)
        slower = 8 if rows.differ else 1  # in plain torch, for a state with numbers of its own
        errors = StateErrorPass(basis, parts.target, expected=slower * states)
    metrics = ChaseMetrics(
        *(basis, parts.target, parts.law),
        inner_steps=first.inner_steps,
        members=windows,
        own=first.metrics,
        errors=errors,
    )
    blocks, chunk = _pieces(
        starts, times, basis, jobs=len(members), kept=any(member.sink is not None for member in members)
    )
    warned = alone and len(blocks) == 1  # the engine warns of the reach, else each member of its own
    done_times = told = 0
    done, reaches = 0, list[Tensor]()  # largest |x| nu(x) of the rows of each block
    with torch.no_grad(), warnings.catch_warnings():
        if not warned:
            warnings.filterwarnings("ignore", message=REACH)
        for block in blocks:
            reach, time = torch.zeros(len(block), dtype=starts.dtype, device=starts.device), 0
            if done:
                metrics.next_rows()
            with rows.of(slice(done, done + len(block))):
                for result in _chased(first, parts, block, chunk):
                    metrics.add(result)
                    if not warned:
                        reach = torch.maximum(reach, _reach(basis, result.state))
                    start = -done  # of a member, from the first row of the piece
                    for member in members:
                        low, high = max(start, 0), min(start + member.rows, len(result.state))
                        if low < high:
                            member.take(result, slice(low, high), low - start, time)
                        start += member.rows
                    time += result.state.shape[1]
                    done_times += result.state.shape[0] * result.state.shape[1]
                    whole = done_times * len(members) // len(starts)  # times of whole problems, for progress
                    if advance is not None and whole > told:
                        advance(whole - told)
                        told = whole
                    del result  # before the next one is made
            done += len(block)
            reaches.append(reach)
    reach = torch.cat(reaches)
    if alone and not warned:
        basis.warn_reach(float(reach.max()), stacklevel=2)
    found = zip(members, metrics.summaries(), reach.split([member.rows for member in members]), strict=True)
    return [member.outcome(summary, float(own.max()), alone=alone) for member, summary, own in found]


def _chased(first: ChaseProblem, parts: _Objects, starts: Tensor, chunk: int) -> Iterator[ChaseResult]:
    """Pieces of ``chunk`` times of the chases from initial states (B, n)."""
    return chase_pieces(
        trajectory(parts.system, starts, dt=first.dt, steps=first.steps, chunk=chunk),
        parts.basis,
        parts.target,
        parts.law,
        inner_steps=first.inner_steps,
        predictor=parts.predictor,
        certificate=first.certificate,
    )


def _pieces(
    starts: Tensor, times: int, basis: StaFBasis, *, jobs: int, kept: bool
) -> tuple[Sequence[Tensor], int]:
    """Return initial states (B, n) in blocks that go through time together, and the times of a piece.

    They are the rows of so many ``jobs``; ``kept`` says whether a history is.
    """
    share, size = 1 if starts.is_cpu else _ON_DEVICE, starts.element_size()
    together = share * (_ROWS_OF_JOBS if starts.is_cpu and jobs > 1 else _ROWS)
    if starts.is_cpu:  # so few that a piece has as many times as a program needs to be worth while
        together = min(together, max(_FEW, chunk_length(min(times, _TIMES), basis, size)))
    if kept:
        numbers = starts.shape[1] + 3 + 2 * basis.count  # of a row and time, of `HISTORY`
        whole = _BYTES // (times * numbers * size)  # rows with all times
        together = min(together, max(_FEW, whole))
        whole = chunk_length(times, basis, size)  # rows whose times are all in one piece
        if starts.is_cpu and len(starts) > together and whole >= _FEW:
            together = min(together, whole)
    blocks = starts.split(together)
    chunk = chunk_length(-(-min(together, len(starts)) // share), basis, size)
    if len(blocks) < _SEEN:  # so many pieces of a long run show its progress; the results do not depend on it
        chunk = max(1, min(chunk, max(_TIMES, -(-times // _SEEN))))
    return blocks, chunk


def _reach(basis: StaFBasis, states: Tensor) -> Tensor:
    """Return the largest finite |x| nu(x) of each row of states (B, C, n); 0 for kernels that do not mind."""
    if basis.kernel.log_gain(states[0, 0]) is None:
        return states.new_zeros(len(states))
    reach = over_rows(lambda at: at.norm(dim=-1) * basis.centers.radius(at), states)
    return torch.where(torch.isfinite(reach), reach, 0.0).amax(1)


class _BatchMember:
    """A problem of a batch, with the metrics and records of its rows."""

    def __init__(self, problem: ChaseProblem, sink: Sink | None, drawn: bool) -> None:
        self.problem, self.sink = problem, sink
        self.rows = len(problem.initial_states)
        self._stride = -(-(problem.steps + 1) // _DRAWN_TIMES)
        self._drawn: dict[str, list[np.ndarray]] | None = {name: [] for name in _DRAWN} if drawn else None
        self._diverged_at = torch.full((self.rows,), -1, dtype=torch.int64, device="cpu")

    def take(self, result: ChaseResult, rows: slice, place: int, time: int) -> None:
        """Take in ``rows`` of a piece of time, which are this problem's from ``place`` on."""
        if self._drawn is not None and place == 0:  # the first trajectory, thinned to every k-th time
            for name, parts in self._drawn.items():  # copies: a view would keep the whole piece in memory
                thinned = getattr(result, name)[rows.start, -time % self._stride :: self._stride]
                parts.append(thinned.cpu().numpy().copy())
        if self.sink is not None:
            history = {name: getattr(result, name)[rows].cpu().numpy() for name in HISTORY}
            self.sink(history, place, time)
        self._diverged_at[place : place + rows.stop - rows.start] = result.diverged_at[rows].cpu()

    def outcome(self, metrics: dict[str, float | None], reach: float, *, alone: bool) -> Outcome:
        """Return the result; the largest |x| nu(x) of a problem that is not ``alone`` may be warned of."""
        drawn, said = {}, list[str]()
        if self._drawn is not None:
            time = np.arange(0, self.problem.steps + 1, self._stride) * self.problem.dt
            drawn = {name: np.concatenate(parts) for name, parts in self._drawn.items()} | {"time": time}
        if not alone:
            with warnings_to(said):
                self.problem.basis.warn_reach(reach)
        return Outcome(metrics, drawn, self._diverged_at, tuple(said))
