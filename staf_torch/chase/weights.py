"""The gradient chase for its weights alone."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from .._checks import fail, integer
from ..basis import GramStructure, StaFBasis, Target
from ..objective import Known
from ..optim import SteepestDescent, UpdateLaw
from ._workers import Workers, thread_count
from .correct import Dense, correct_weights, dense, last_weights
from .engine import chunk_length
from .known import known, state_row
from .layout import batch_last, library_only
from .recursion import Carry
from .result import ChaseWeights
from .start import check_law, check_states, start

_PIECE_BYTES = 2**20  # of V at the centers: a piece and what it is made from stay in the inner caches
_ROWS = 4096  # trajectories a block
_FEW_ROWS = 64  # fewer are one block


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

    Rows are shared out to threads, as many as torch has, where the law is the paper's and the target, the
    kernel and the radius are the library's own. Anything else is called from this thread alone and with
    all rows at once: a callable of yours may keep state, or hold a number a row.

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
    apart = type(law) is SteepestDescent and library_only(basis, target)
    threads = thread_count() if apart else 1
    blocks: list[_Block] = []
    recorded: list[Tensor] = []  # (C, M, B) a piece
    warned = False
    with Workers(threads) as workers:
        for piece in [states] if isinstance(states, Tensor) else states:
            check_states("chase_weights", piece, basis)
            warned = warned or basis.check_reach(piece)
            height = _height(piece, basis, threads) if apart else piece.shape[0]
            if not blocks:
                carry = start("chase_weights", piece, basis, law, weights)
                blocks = [_Block(basis, target, law, inner_steps, part) for part in _split(carry, height)]
            # The room of the whole piece at once, so that every number is written once, where it stays.
            shape = (piece.shape[1], basis.count, piece.shape[0])
            room = piece.detach().new_empty(shape) if history else None
            rooms = [None] * len(blocks) if room is None else list(room.split(height, dim=2))
            found = workers.map(_Block.advance, blocks, piece.split(height), rooms)
            if room is not None:
                recorded.append(room if all(part is None for part in found) else _joined(found, rooms))
    if not blocks:
        raise ValueError("`chase_weights(states=...)` must have at least one piece of time; got none.")
    diverged_at = torch.cat([block.carry.diverged_at for block in blocks])
    if history:
        joined = recorded[0] if len(recorded) == 1 else torch.cat(recorded)
        return ChaseWeights(joined.permute(2, 0, 1), diverged_at)
    last = torch.cat([last_weights(block.carry) for block in blocks])
    return ChaseWeights(last.unsqueeze(1), diverged_at)


class _Block:
    """Some rows on their way through time."""

    def __init__(
        self, basis: StaFBasis, target: Target, law: UpdateLaw, inner_steps: int, carry: Carry
    ) -> None:
        self._basis, self._target, self._law, self._inner_steps = basis, target, law, inner_steps
        self._own = library_only(basis, target)
        self.carry = carry

    def advance(self, states: Tensor, room: Tensor | None) -> Tensor | None:
        """Through the states (B, C, n): the weights (C, M, B), or None if they are in the room."""
        size = states.shape[0] * states.element_size()
        longest = min(
            chunk_length(states.shape[0], self._basis, states.element_size()),
            _PIECE_BYTES // (size * self._basis.count),
        )
        found, done = [], 0
        for piece in states.split(max(1, longest), dim=1):
            at = batch_last(piece) if self._own else piece
            structure, values = self._basis.gram_structure(at), self._basis.values(at, self._target)
            into = None if room is None else room[done : done + at.shape[1]]
            part, self.carry = correct_weights(
                structure,
                values,
                self._law,
                self._inner_steps,
                self.carry,
                into,
                *self._needed(at, structure, values),
            )
            done += at.shape[1]
            found.append((part, into))
        if room is None or all(part is into for part, into in found):
            return None
        return torch.cat([part for part, _ in found if part is not None])

    def _needed(self, at: Tensor, structure: GramStructure, values: Tensor) -> tuple[Known, Dense | None]:
        """What the law needs beside the structure of a piece."""
        if not self._law.needs:
            return Known(), None
        space, whole = self._basis.local(at), dense(structure, values)
        ideal = space.scaled_weights(space.fit(values))
        row = state_row(self._basis, at, space)
        row = row if structure.scale is None else structure.scale * row
        return known(self._law.needs, space, whole.gram, ideal, row, self._target(at)), whole


def _joined(found: list[Tensor | None], rooms: list[Tensor | None]) -> Tensor:
    """Blocks of rows (C, M, B) side by side, each as it came back or in its room."""
    parts = [room if part is None else part for part, room in zip(found, rooms, strict=True)]
    return torch.cat([part for part in parts if part is not None], dim=2)


def _height(states: Tensor, basis: StaFBasis, threads: int) -> int:
    """Rows a block; all of them where a hyperparameter has a value a row."""
    modules = (basis.kernel, basis.centers.radius)
    held = [held for module in modules for held in (*module.parameters(), *module.buffers())]
    batch = states.shape[0]
    if any(each.dim() > 0 for each in held) or batch < _FEW_ROWS:
        return batch
    return min(_ROWS, -(-batch // threads))


def _split(carry: Carry, height: int) -> list[Carry]:
    """The carries of blocks of rows, each with memory of its own."""
    batch = carry.diverged_at.shape[0]
    return [
        Carry(
            carry.weights[at].clone(),
            tuple(part[at].clone() for part in carry.law_state),
            carry.log_gain[at].clone(),
            carry.time,
            carry.diverged_at[at].clone(),
        )
        for at in (slice(first, first + height) for first in range(0, batch, height))
    ]
