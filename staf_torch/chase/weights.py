"""The gradient chase for its weights alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from .._checks import integer
from ..basis import StaFBasis, Target
from ..optim.base import UpdateLaw
from .correct import correct_weights, last_weights
from .engine import check_law, check_states, chunk_length, start
from .layout import batch_last
from .result import ChaseWeights

_PIECE_BYTES = 2**22  # of V at the centers: a piece and what it is made from stay in the last cache


def chase_weights(
    states: Tensor | Iterable[Tensor],
    basis: StaFBasis,
    target: Target,
    law: UpdateLaw,
    *,
    inner_steps: int = 10,
    weights: Tensor | None = None,
    history: bool = True,
) -> ChaseWeights:
    """The weights of `chase`, and nothing that follows from them: several times faster.

    Example:
        >>> pieces = systems.trajectory(systems.Oscillator(), x0, dt=0.01, steps=10**6, chunk=100)
        >>> last = chase_weights(pieces, basis, targets.Paper(), optim.SteepestDescent(), history=False)

    Args:
        states: x, (B, T, n), or consecutive pieces (B, C, n) of it.
        basis, target, law, inner_steps, weights: as in `chase`.
        history: whether the weights of every time are kept, or those of the last alone; memory then
            does not grow with T where the states come in pieces.

    Raises:
        ValueError: if an argument breaks its rule, or the target returns another shape.

    Source: Rosenfeld et al., section 6.
    """
    integer("chase_weights", "inner_steps", inner_steps, least=0)
    check_law("chase_weights", law)
    carry, done = None, 0
    room: Tensor | None = None  # (T, M, B), so that every number is written once, where it stays
    parts: list[Tensor] = []  # (C, M, B) each, views of the room wherever that was possible
    for piece in _pieces(states, basis):
        at = batch_last(piece)
        if carry is None:
            carry = start(at, basis, law, weights)
        if history and (room is None or not isinstance(states, Tensor)):
            times = states.shape[1] if isinstance(states, Tensor) else at.shape[1]
            room, done = at.detach().new_empty(times, basis.count, at.shape[0]), 0
        into = None if room is None else room[done : done + at.shape[1]]
        structure, values = basis.gram_structure(at), basis.values(at, target)
        found, carry = correct_weights(structure, values, law, inner_steps, carry, into)
        done += at.shape[1]
        if found is not None:
            parts.append(found)
    if carry is None:
        raise ValueError("`chase_weights(states=...)` must have at least one piece of time; got none.")
    if not history:
        return ChaseWeights(last_weights(carry).unsqueeze(1), carry.diverged_at)
    in_place = room is not None and all(part._base is room for part in parts)
    joined = room if room is not None and in_place else torch.cat(parts)
    return ChaseWeights(joined.permute(2, 0, 1), carry.diverged_at)


def _pieces(states: Tensor | Iterable[Tensor], basis: StaFBasis) -> Iterator[Tensor]:
    """Pieces (B, C, n) that stay in the last cache with what is made from them."""
    for piece in [states] if isinstance(states, Tensor) else states:
        check_states("chase_weights", piece, basis)
        longest = chunk_length(piece.shape[0], basis, piece.element_size())
        cached = _PIECE_BYTES // (piece.shape[0] * basis.count * piece.element_size())
        yield from piece.split(max(1, min(longest, cached)), dim=1)
