"""The gradient chase: rows compiled from `row_program`, or the definition in bulk over chunks of time."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from ..approximation.basis import StaFBasis, Target
from ..lanes import Program, Shared
from ..lanes.calls.choice import ShortCall, undecided
from ..lanes.device.kernel import beside_history, joined
from ..lanes.row_numbers import over_rows
from ..lanes.torch_compile.operators import one_operator
from ..lanes.tree import plain
from ..numerics.default_device import beside
from ..optim.base import UpdateLaw
from ..signs import Sign
from . import row_program
from .predictors import Predictor
from .problem import Problem
from .quantities import Known, know, numbers, precompute, with_certificate
from .recursion import Carry, Corrected, Inputs, Recursion, kept_gain, last_weights, lost, recursion, start
from .result import ChaseResult, ChaseWeights, before_each, certify, concatenate, first_link
from .row_program import key_of, remember, repeated

_WORKING_BYTES = 2**26


@one_operator
@Sign("chase")
def chase(
    states: Tensor,
    basis: StaFBasis,
    target: Target,
    law: UpdateLaw,
    *,
    inner_steps: int = 10,
    predictor: Predictor | None = None,
    weights: Tensor | None = None,
    certificate: bool = False,
) -> ChaseResult:
    """Chase the ideal weights of ``target`` along given trajectories.

    At every time the weights are corrected at x_k by ``inner_steps`` iterations of ``law`` and recorded.
    No trajectory influences another.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
        >>> states = systems.simulate(systems.Oscillator(), x0, dt=0.01, steps=100)
        >>> basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> chase(states, basis, targets.Paper(), optim.SteepestDescent()).weights.shape
        torch.Size([1, 101, 3])

        Shown by `staf experiment=gradient_chase`.

    Args:
        states: x, (B, T, n).
        basis: kernel and centers.
        target: V, (..., n) -> (...).
        law: the update law.
        inner_steps: iterations at every time, at least 0.
        predictor: how the weights move between times, `predictors.Secant()` or `predictors.Tangent()`;
            None keeps them.
        weights: the paper's w before the first correction, (M,) or (B, M); zero by default.
        certificate: whether the result has a `Certificate`.

    Raises:
        ValueError: if an argument breaks its rule, or the target returns another shape.

    Source: Rosenfeld et al., section 6.
    """
    parts, key = (basis, target, law, predictor), None
    if weights is None:
        key = key_of(states, parts, inner_steps, bool(certificate), "chase")
        again = None if key is None else repeated(key)
        rooms = None if again is None else again.rooms(states)
        if again is not None and rooms is not None:
            return again.results(states, rooms)
    problem = Problem("chase", basis, target, law, inner_steps, predictor, certificate)
    problem.check_states(states)
    run = _ChaseRun(problem, states, weights, everything=True)
    found = concatenate([run.results(chunk) for chunk in run.chunks(states)])
    remember(key, run.program, problem, states, everything=True, history=True)
    return found


def chase_pieces(
    pieces: Iterable[Tensor],
    basis: StaFBasis,
    target: Target,
    law: UpdateLaw,
    *,
    inner_steps: int = 10,
    predictor: Predictor | None = None,
    weights: Tensor | None = None,
    certificate: bool = False,
) -> Iterator[ChaseResult]:
    """Yield the results of `chase` over consecutive chunks of time (B, C, n), one a chunk.

    Example:
        >>> pieces = torch.ones(1, 20, 2).double().split(8, dim=1)
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> chased = chase_pieces(pieces, basis, targets.Paper(), optim.SteepestDescent())
        >>> [piece.state.shape[1] for piece in chased]
        [8, 8, 4]

        Shown by `staf trajectories=100`.
    """
    problem = Problem("chase", basis, target, law, inner_steps, predictor, certificate)
    run: _ChaseRun | None = None
    for states in pieces:
        problem.check_states(states)
        run = _ChaseRun(problem, states, weights, everything=True) if run is None else run
        yield run.results(states)


@one_operator
@Sign("chase_weights")
def chase_weights(
    states: Tensor | Iterable[Tensor],
    basis: StaFBasis,
    target: Target,
    law: UpdateLaw,
    *,
    inner_steps: int = 10,
    predictor: Predictor | None = None,
    weights: Tensor | None = None,
    history: bool = True,
) -> ChaseWeights:
    """Return the weights of `chase`, and nothing that follows from them: several times faster.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
        >>> pieces = systems.trajectory(systems.Oscillator(), x0, dt=0.01, steps=300, chunk=100)
        >>> basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> law = optim.SteepestDescent()
        >>> chase_weights(pieces, basis, targets.Paper(), law, history=False).weights.shape  # the last ones
        torch.Size([1, 1, 3])

        Shown by `tests/benchmarks/README.md`.

    Args:
        states: x, (B, T, n), or consecutive pieces (B, C, n) of it.
        basis, target, law, inner_steps, predictor, weights: as in `chase`.
        history: whether the weights of every time are kept, or those of the last alone; memory then
            does not grow with T where the states come in pieces.

    Raises:
        ValueError: if an argument breaks its rule, or the target returns another shape.

    Source: Rosenfeld et al., section 6.
    """
    parts, key = (basis, target, law, predictor), None
    if weights is None:
        key = key_of(states, parts, inner_steps, bool(history))
        again = None if key is None else repeated(key)
        rooms = again.rooms(states) if again is not None and isinstance(states, Tensor) else None
        if again is not None and rooms is not None:
            return again.weights(rooms)
    problem = Problem("chase_weights", basis, target, law, inner_steps, predictor)
    run: _ChaseRun | None = None
    recorded: list[Tensor] = []  # (B, C, M) a chunk
    one = hasattr(states, "__array__") or not isinstance(states, Iterable)  # also what is refused
    pieces: Iterable[Any] = [states] if one else states
    for piece in pieces:
        problem.check_states(piece)
        run = _ChaseRun(problem, piece, weights, everything=False) if run is None else run
        for chunk in run.chunks(piece):
            found = run.weights(chunk, history)
            recorded += [found] if history else []
    if run is None:
        raise ValueError("`chase_weights(states=...)` must have at least one piece of time; got none.")
    if one:
        remember(key, run.program, problem, piece, everything=False, history=bool(history))
    if history:
        found = joined(recorded)
        return ChaseWeights(found, beside_history(run.carry.diverged_at, found))
    return ChaseWeights(last_weights(run.carry).unsqueeze(1), run.carry.diverged_at)


def chunk_length(batch: int, basis: StaFBasis, itemsize: int) -> int:
    """Return the times a chunk, so that `chase_pieces` works in some 64 MiB at any horizon.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> chunk_length(1, basis, itemsize=8) > chunk_length(1000, basis, itemsize=8) > 0
        True

        Shown by `staf trajectories=100`.
    """
    numbers = 4 * basis.count**2 + (basis.count + 2) * (basis.dim + 8)
    return max(1, _WORKING_BYTES // (batch * numbers * itemsize))


class _ChaseRun:
    """The rows of a chase on their way through time."""

    @beside
    def __init__(self, problem: Problem, states: Tensor, weights: Tensor | None, *, everything: bool) -> None:
        self._problem, self._warned = problem, False
        given = () if weights is None else (weights if weights.dim() > 1 else Shared(weights),)
        self.carry = over_rows(lambda at, *w: start(problem, at, plain(w[0]) if w else None), states, *given)
        self._first = row_program.first_carry(problem, self.carry)
        self._unit = self._first.unit  # of the last chunk, bit by bit: a row that diverged stays as it was
        self.program = row_program.program(problem, states, self._first, everything=everything)
        self._few = states.shape[1] < row_program.SHORTEST
        self._warns = row_program.settings_of(problem, states, everything)[-1]

    def chunks(self, states: Tensor) -> tuple[Tensor, ...]:
        """Return the states (B, T, n) in chunks of time that fit into memory."""
        if self.program is not None:  # nothing but what it returns is kept
            return (states,)
        length = chunk_length(states.shape[0], self._problem.basis, states.element_size())
        parts: tuple[Tensor, ...] = states.split(length, dim=1)
        return parts

    @beside
    def weights(self, states: Tensor, history: bool) -> Tensor:
        """Return the paper's weights at the states (B, C, n): (B, C, M), or those of the first time alone."""
        if self.program is not None:
            recorded = self._compiled(self.program, states, 1 if history else states.shape[1]).weights
            assert recorded is not None
            return recorded
        self._warned = self._warned or self._problem.basis.check_reach(states, stacklevel=5)

        def defined(states: Tensor, carry: Carry) -> tuple[Tensor, Carry]:
            known = know(self._problem, states, local=bool(self._problem.law.needs))
            run, _ = self._corrected(known, carry)
            return run.after * (-kept_gain(known.log_gain, run.carry)).exp().unsqueeze(-1), run.carry

        with self._short():
            found, self.carry = over_rows(defined, states, self.carry)
        return found

    @beside
    def results(self, states: Tensor) -> ChaseResult:
        """Return everything at the states (B, C, n)."""
        problem = self._problem
        if self.program is not None:
            found = self._compiled(self.program, states, 1)
            assert found.numbers is not None
            return found.numbers.result(states, self.carry.diverged_at, found.certificate)
        self._warned = self._warned or problem.basis.check_reach(states, stacklevel=5)

        def defined(states: Tensor, carry: Carry) -> tuple[dict[str, Any], Carry]:
            result, carry = self._defined(states, carry)
            return {each.name: getattr(result, each.name) for each in fields(result)}, carry

        with self._short():
            every, self.carry = over_rows(defined, states, self.carry)
        return ChaseResult(**every)

    def _short(self) -> contextlib.AbstractContextManager[None]:
        """Return what counts a call whose few times alone leave it in plain torch."""
        if self.program is not None or not self._few or not undecided():
            return contextlib.nullcontext()
        problem = self._problem
        return ShortCall("the chase", tuple(map(type, (problem.basis.kernel, problem.law, problem.target))))

    def _defined(self, states: Tensor, carry: Carry) -> tuple[ChaseResult, Carry]:
        """Return everything at the states (B, C, n) by the definition, and the carry after them."""
        problem, link = self._problem, carry.link
        known = know(problem, states, local=True)
        run, inputs = self._corrected(known, carry)
        gone = lost(run.carry, states.shape[1])
        at = Corrected(run.before, run.after, known.values, known.log_gain)
        unit = (-kept_gain(known.log_gain, run.carry)).exp()
        result = numbers(known, at, unit, gone).result(states, run.carry.diverged_at)
        if not problem.certificate:
            return result, run.carry
        assert known.local is not None
        ideal = known.local.ideal
        here = first_link(inputs.gram, known.log_gain, ideal)._replace(error=run.after - ideal)
        before = before_each(first_link(*(part[:, 0] for part in here)) if link is None else link, here)
        vouched, links = certify(problem, inputs.gram, at, ideal, before)
        after = run.carry._replace(link=type(links)(*(part[:, -1] for part in links)))
        return with_certificate(result, vouched, gone), after

    def _corrected(self, known: Known, carry: Carry) -> tuple[Recursion, Inputs]:
        """Run the definition over a chunk."""
        problem = self._problem
        inputs = Inputs.of(known.structure, known.values)
        inputs = inputs._replace(precomputed=precompute(problem, known, inputs.gram))
        if problem.predictor is not None:
            assert carry.states is not None
            assert isinstance(carry.time, int)
            around = torch.cat((carry.states, known.state), dim=1)
            prepared = problem.predictor.prepare(problem.basis, problem.target, around, carry.time)
            inputs, carry = inputs._replace(prediction=prepared), carry._replace(states=around[:, -2:])
        return recursion(problem, inputs, carry), inputs

    def _compiled(self, program: Program, states: Tensor, every: int) -> row_program.Outputs:
        """Run the program over a chunk; within it times count from 0, or from 2 where others were before."""
        carry, start = self.carry, self.carry.time
        assert isinstance(start, int)
        if start == 0:
            after, outputs = program(self._first, states, every=every)
            diverged_at = after.chase.diverged_at
        else:
            begins, old = min(start, 2), carry.diverged_at
            given = row_program.RowCarry(
                carry._replace(time=torch.full_like(old, begins), diverged_at=old.clamp(max=0)),
                torch.zeros_like(carry.log_gain),
                self._unit,
            )
            after, outputs = program(given, states, every=every)
            found_at = after.chase.diverged_at
            fresh = torch.where(found_at >= 0, found_at + (start - begins), -1)
            diverged_at = torch.where(old >= 0, old, fresh)
        self.carry = after.chase._replace(time=start + states.shape[1], diverged_at=diverged_at)
        self._unit = after.unit
        if self._warns and not self._warned:
            self._warned = self._problem.basis.warn_reach(float(after.reach.detach().max()), stacklevel=6)
        found: row_program.Outputs = outputs
        return found
