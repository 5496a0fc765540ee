"""The gradient chase for its weights alone."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from .._checks import fail, integer
from ..basis import GramStructure, StaFBasis, Target
from ..objective import Known
from ..optim.base import UpdateLaw
from ._pages import fresh
from .correct import Dense, Native, dense, last_weights, native, paper_units, runs_fused
from .engine import chunk_length
from .fused import History, fused
from .known import known, state_row
from .native import NativeStructure
from .recursion import Carry, recursion
from .result import ChaseWeights
from .start import check_law, check_states, start

_PIECE_BYTES = 2**20  # of V at the centers: a piece and what it is made from stay in the inner caches


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
    """The weights of `chase`, and nothing that follows from them: several times faster.

    Fastest with the paper's law, a constant radius and a target that gives its `targets.Formula`: the states
    are then read and the weights written once, and nothing else reaches memory. A callable of yours is called
    with some times of all rows at once; `torch.compile` makes it one pass.

    Example:
        >>> pieces = systems.trajectory(systems.Oscillator(), x0, dt=0.01, steps=10**6, chunk=100)
        >>> last = chase_weights(pieces, basis, targets.Paper(), optim.SteepestDescent(), history=False)

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
    integer("chase_weights", "inner_steps", inner_steps, least=0)
    check_law("chase_weights", law)
    if predictor is not None:
        raise fail("chase_weights", "predictor", "must be None; `chase` has predictors", predictor)
    run: _Run | None = None
    recorded: list[Tensor] = []  # (C, M, B) a piece
    for piece in [states] if isinstance(states, Tensor) else states:
        check_states("chase_weights", piece, basis)
        if run is None:
            run = _Run(basis, target, law, inner_steps, start("chase_weights", piece, basis, law, weights))
        recorded += run.advance(piece, history)
    if run is None:
        raise ValueError("`chase_weights(states=...)` must have at least one piece of time; got none.")
    if history:
        joined = recorded[0] if len(recorded) == 1 else torch.cat(recorded)
        return ChaseWeights(joined.permute(2, 0, 1), run.carry.diverged_at)
    return ChaseWeights(last_weights(run.carry).unsqueeze(1), run.carry.diverged_at)


class _Run:
    """All rows on their way through time."""

    def __init__(
        self, basis: StaFBasis, target: Target, law: UpdateLaw, inner_steps: int, carry: Carry
    ) -> None:
        self._basis, self._target, self._law, self._inner_steps = basis, target, law, inner_steps
        self.carry, self._warned = carry, False

    def advance(self, states: Tensor, history: bool) -> list[Tensor]:
        """Through the states (B, C, n): the paper's weights (C, M, B) in parts; none without history."""
        own = native(states, self._basis, self._target, self._law, self._inner_steps, self.carry)
        batch, times, _ = states.shape
        # The room of the whole piece at once, so that every number is written once, where it stays.
        room = fresh(states, times, self._basis.count, batch) if history else None
        most = states.new_zeros(1)
        found, done = [], 0
        for at in states.split(times if own.formula else self._longest(states), dim=1):
            into = None if room is None else room[done : done + at.shape[1]]
            part = self._piece(at, own, into, most)
            done += at.shape[1]
            found.append((part, into))
        self._check_reach(states, own, most)
        if room is None:
            return []
        if all(part is into for part, into in found):
            return [room]
        return [part for part, _ in found if part is not None]

    def _check_reach(self, states: Tensor, own: Native, most: Tensor) -> None:
        """Warn once of centers beyond the kernel's reach; the fused recursion has seen the largest x'x."""
        if self._warned:
            return
        if own.structure is not None and own.structure.exponential:
            worst = self._basis.centers.radius(states[0, 0]) * most.sqrt()
            self._warned = self._basis.warn_reach(float(worst), stacklevel=5)
        else:
            self._warned = self._basis.check_reach(states, stacklevel=5)

    def _longest(self, states: Tensor) -> int:
        """Times a piece, where torch computes what depends on the states."""
        batch, size = states.shape[0], states.element_size()
        cached = _PIECE_BYTES // (batch * size * self._basis.count)
        return max(1, min(chunk_length(batch, self._basis, size), cached))

    def _piece(self, at: Tensor, own: Native, into: Tensor | None, most: Tensor) -> Tensor | None:
        """Through the states (B, C, n): the weights (C, M, B), ``into`` itself from the fused recursion."""
        law, steps, carry = self._law, self._inner_steps, self.carry
        values = own.formula or self._basis.values(at, self._target)
        structure: NativeStructure | GramStructure | None = own.structure
        if structure is None or not runs_fused(at, structure, values, law, steps, carry):
            structure = self._basis.gram_structure(at)
        if runs_fused(at, structure, values, law, steps, carry):
            self.carry = fused(at, structure, values, steps, carry, History(recorded=into), most)
            return into
        assert isinstance(structure, GramStructure)
        assert isinstance(values, Tensor)
        needed, whole = self._needed(at, structure, values)
        run = recursion(whole.gram, values, whole.log_gain, law, steps, carry, needed)
        self.carry = run.carry
        if into is None:
            return None
        return (run.after * paper_units(structure, run.carry, at.shape[1])).permute(1, 2, 0)

    def _needed(self, at: Tensor, structure: GramStructure, values: Tensor) -> tuple[Known, Dense]:
        """What the law needs beside the structure of a piece, and that as matrices."""
        whole = dense(structure, values)
        if not self._law.needs:
            return Known(), whole
        space = self._basis.local(at)
        ideal = space.scaled_weights(space.fit(values))
        row = state_row(self._basis, at, space)
        row = row if structure.scale is None else structure.scale * row
        return known(self._law.needs, space, whole.gram, ideal, row, self._target(at)), whole
