"""The gradient chase: everything that does not depend on the weights in bulk over time, then the weight
recursion, then everything that follows from the weights in bulk again."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from ..approximation.basis import GramStructure, StaFBasis, Target
from ..lanes.pages import fresh
from ..numerics.checks import fail
from ..optim.base import UpdateLaw
from . import compiled
from .certificate import Certificate, certify
from .predictors import Predictor
from .problem import Problem
from .recursion import (
    Carry,
    Inputs,
    Recursion,
    last_weights,
    lost,
    paper_units,
    precompute,
    recursion,
    start,
    state_row,
)
from .result import ChaseResult, ChaseWeights, concatenate

_WORKING_BYTES = 2**26
_PIECE_BYTES = 2**20  # of V at the centers: a chunk and what it is made from stay in the inner caches


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
    problem = Problem("chase", basis, target, law, inner_steps, predictor, certificate)
    problem.check_states(states)
    chunks = states.split(chunk_length(states.shape[0], basis, states.element_size()), dim=1)
    return concatenate(_chase(problem, chunks, weights))


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
    yield from _chase(problem, pieces, weights)


def chase_weights(
    states: Tensor | Iterable[Tensor],
    basis: StaFBasis,
    target: Target,
    law: UpdateLaw,
    *,
    inner_steps: int = 10,
    predictor: None = None,
    weights: Tensor | None = None,
    history: bool = True,
) -> ChaseWeights:
    """Return the weights of `chase`, and nothing that follows from them: several times faster.

    Fastest with the paper's law, a constant radius and a target that gives its `targets.Formula`: the states
    are then read and the weights written once, and nothing else reaches memory. A callable of yours is called
    with some times of all rows at once; `torch.compile` makes it one pass.

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
        basis, target, law, inner_steps, weights: as in `chase`.
        predictor: None; `chase` has predictors.
        history: whether the weights of every time are kept, or those of the last alone; memory then
            does not grow with T where the states come in pieces.

    Raises:
        ValueError: if an argument breaks its rule, or the target returns another shape.

    Source: Rosenfeld et al., section 6.
    """
    if predictor is not None:
        raise fail("chase_weights", "predictor", "must be None; `chase` has predictors", predictor)
    problem = Problem("chase_weights", basis, target, law, inner_steps)
    run: _WeightRun | None = None
    recorded: list[Tensor] = []  # (C, M, B) a chunk
    for chunk in [states] if isinstance(states, Tensor) else states:
        problem.check_states(chunk)
        if run is None:
            run = _WeightRun(problem, start(problem, chunk, weights))
        recorded += run.advance(chunk, history)
    if run is None:
        raise ValueError("`chase_weights(states=...)` must have at least one piece of time; got none.")
    if history:
        joined = recorded[0] if len(recorded) == 1 else torch.cat(recorded)
        return ChaseWeights(joined.permute(2, 0, 1), run.carry.diverged_at)
    return ChaseWeights(last_weights(run.carry).unsqueeze(1), run.carry.diverged_at)


class _WeightRun:
    """The rows of `chase_weights` on their way through time."""

    def __init__(self, problem: Problem, carry: Carry) -> None:
        self._problem, self.carry, self._warned = problem, carry, False

    def advance(self, states: Tensor, history: bool) -> list[Tensor]:
        """Return the paper's weights at the states (B, C, n), (C, M, B) in parts; none without history."""
        inside = compiled.evaluated_inside(self._problem, states, self.carry)
        batch, times, _ = states.shape
        # The room of the whole chunk at once, so that every number is written once, where it stays.
        room = fresh(states, times, self._problem.basis.count, batch) if history else None
        largest = states.new_zeros(1)  # x'x, where the compiled recursion evaluates it
        found, done = [], 0
        for at in states.split(times if inside.formula else self._longest(states), dim=1):
            into = None if room is None else room[done : done + at.shape[1]]
            part = self._piece(at, inside, into, largest)
            done += at.shape[1]
            found.append((part, into))
        self._check_reach(states, inside, largest)
        if room is None:
            return []
        if all(part is into for part, into in found):
            return [room]
        return [part for part, _ in found if part is not None]

    def _check_reach(self, states: Tensor, inside: compiled.EvaluatedInside, largest: Tensor) -> None:
        """Warn once of centers beyond the kernel's reach; the compiled recursion has seen the largest x'x."""
        if self._warned:
            return
        basis = self._problem.basis
        if inside.structure is not None and inside.structure.exponential and bool(largest > 0):
            worst = basis.centers.radius(states[0, 0]) * largest.sqrt()
            self._warned = basis.warn_reach(float(worst), stacklevel=5)
        else:
            self._warned = basis.check_reach(states, stacklevel=5)

    def _longest(self, states: Tensor) -> int:
        """Return the times a piece, where torch computes what depends on the states."""
        (batch, _, _), size, basis = states.shape, states.element_size(), self._problem.basis
        cached = _PIECE_BYTES // (batch * size * basis.count)
        return max(1, min(chunk_length(batch, basis, size), cached))

    def _piece(
        self, at: Tensor, inside: compiled.EvaluatedInside, into: Tensor | None, largest: Tensor
    ) -> Tensor | None:
        """Return the weights at the states (B, C, n), (C, M, B): ``into`` where compiled code wrote it."""
        problem, carry = self._problem, self.carry
        given, values = None, inside.formula or problem.basis.values(at, problem.target)
        if inside.structure is not None:
            given = compiled.CompiledInputs(inside.structure, values)
        if given is None or not compiled.runs(problem, at, given, carry):
            given = compiled.CompiledInputs(problem.basis.gram_structure(at), values)
        if compiled.runs(problem, at, given, carry):
            history = compiled.History(recorded=into)
            self.carry = compiled.advance(problem.inner_steps, at, given, carry, history, largest)
            return into
        structure = given.structure
        assert isinstance(structure, GramStructure)
        assert isinstance(values, Tensor)
        run = recursion(problem, self._inputs(at, structure, values), carry)
        self.carry = run.carry
        if into is None:
            return None
        return (run.after * paper_units(structure, run.carry, at.shape[1])).permute(1, 2, 0)

    def _inputs(self, at: Tensor, structure: GramStructure, values: Tensor) -> Inputs:
        """Return what the recursion reads at the states (B, C, n), what the law needs to know included."""
        basis, needs = self._problem.basis, self._problem.law.needs
        inputs = Inputs.of(structure, values)
        if not needs:
            return inputs
        space = basis.local(at)
        ideal = space.scaled_weights(space.fit(values))
        row = state_row(basis, at, space)
        row = row if structure.scale is None else structure.scale * row
        found = precompute(needs, space, inputs.gram, ideal, row, self._problem.target(at))
        return inputs._replace(precomputed=found)


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


def _chase(problem: Problem, chunks: Iterable[Tensor], weights: Tensor | None) -> Iterator[ChaseResult]:
    carry, warned = None, False
    for states in chunks:
        warned = warned or problem.basis.check_reach(states)
        carry = start(problem, states, weights) if carry is None else carry
        result, carry = _chunk(problem, states, carry)
        yield result


def _chunk(problem: Problem, states: Tensor, carry: Carry) -> tuple[ChaseResult, Carry]:
    """Return the result of one chunk of time (B, C, n), and the carry to the next."""
    basis, target, times = problem.basis, problem.target, states.shape[1]
    structure, values = basis.gram_structure(states), basis.values(states, target)
    space = basis.local(states)
    fitted = space.fit(values)
    ideal = space.scaled_weights(fitted)
    scale = states.new_ones(()) if structure.scale is None else structure.scale
    row = state_row(basis, states, space)
    value = target(states)

    run = None if problem.predictor is not None else _compiled(problem, states, structure, values, carry)
    # A matrix K a time only where somebody asks for it: the compiled recursion does not.
    inputs = Inputs.of(structure, values) if run is None or problem.certificate else None
    if run is None:
        assert inputs is not None
        found = precompute(problem.law.needs, space, inputs.gram, ideal, scale * row, value)
        inputs, carry = _with_prediction(problem, states, inputs._replace(precomputed=found), carry)
        run = recursion(problem, inputs, carry)

    reached = _Reached(lost(run.carry, times))
    gain = states.new_zeros(()) if structure.log_gain is None else structure.log_gain
    inverse_gain = (-gain).exp()

    def at_state(scaled_weights: Tensor) -> Tensor:
        return reached(torch.linalg.vecdot(row, scale * scaled_weights))

    result = ChaseResult(
        state=states,
        weights=_paper_weights(run.after, paper_units(structure, run.carry, times)),
        ideal_weights=reached(_paper_weights(ideal, inverse_gain[..., None])),
        coefficients=reached(scale * run.after),
        value=reached(value),
        estimate=at_state(run.after),
        estimate_before=at_state(run.before),
        ideal_estimate=reached(space.evaluate(states.new_zeros(1, basis.dim), fitted).squeeze(-1)),
        excess=reached(structure.quadratic(run.after - ideal) * inverse_gain),
        excess_before=reached(structure.quadratic(run.before - ideal) * inverse_gain),
        diverged_at=run.carry.diverged_at,
    )
    if not problem.certificate:
        return result, run.carry
    assert inputs is not None
    vouched, link = certify(problem, inputs, run, ideal, carry.link)
    result = dataclasses.replace(result, certificate=reached.certificate(vouched))
    return result, run.carry._replace(link=link)


def _compiled(
    problem: Problem, states: Tensor, structure: GramStructure, values: Tensor, carry: Carry
) -> Recursion | None:
    """Return what the compiled recursion makes of a chunk; None where `compiled.runs` says no."""
    inside = compiled.evaluated_inside(problem, states, carry)
    given = compiled.CompiledInputs(inside.structure or structure, inside.formula or values)
    if not compiled.runs(problem, states, given, carry):
        return None
    batch, times, count = values.shape
    before, after = (fresh(values, times, count, batch) for _ in range(2))
    end = compiled.advance(problem.inner_steps, states, given, carry, compiled.History(before, after))
    return Recursion(before.permute(2, 0, 1), after.permute(2, 0, 1), end)


def _with_prediction(problem: Problem, states: Tensor, inputs: Inputs, carry: Carry) -> tuple[Inputs, Carry]:
    """Add what the predictor prepares for a chunk; it looks at the two states before it as well."""
    if problem.predictor is None:
        return inputs, carry
    assert carry.states is not None
    around = torch.cat((carry.states, states), dim=1)
    prepared = problem.predictor.prepare(problem.basis, problem.target, around, carry.time)
    return inputs._replace(prediction=prepared), carry._replace(states=around[:, -2:])


def _paper_weights(scaled: Tensor, units: Tensor) -> Tensor:
    """Return w = e^{-g} (e^g w): (B, C, M), (B, C, 1); NaN where e^{-g} underflows and w is not zero."""
    underflow = (units < torch.finfo(units.dtype).tiny) & (scaled != 0)
    return torch.where(underflow, torch.nan, scaled * units)


class _Reached:
    """NaN in place of what a trajectory did not reach."""

    def __init__(self, gone: Tensor) -> None:
        self._gone = gone  # (B, C) bool

    def __call__(self, quantity: Tensor) -> Tensor:
        """Return the quantity (B, C, ...) with NaN where the trajectory is lost."""
        gone = self._gone.view(*self._gone.shape, *[1] * (quantity.dim() - 2))
        return torch.where(gone, torch.nan, quantity)

    def certificate(self, vouched: Certificate) -> Certificate:
        """Return the certificate with NaN, and nothing violated, where the trajectory is lost."""
        return Certificate(
            rate=self(vouched.rate),
            growth=self(vouched.growth),
            drift=self(vouched.drift),
            bound=self(vouched.bound),
            violated=vouched.violated & ~self._gone,
        )
