"""The weight recursion of a piece of time: fused where that is wanted and can run, else the reference."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..basis import GramStructure
from ..objective import Known
from ..optim.base import UpdateLaw
from .fused import History, fused, fusible
from .recursion import Carry, Recursion, recursion

# `chase` keeps the reference: the first build of the fused recursion takes longer than most chases, and a
# rule by size would let a trajectory's rounding depend on how many run beside it. `chase_weights` is always
# fused where it can be.
_FUSE_CHASE = False


class Dense(NamedTuple):
    """What the reference recursion takes of a `GramStructure`."""

    gram: Tensor  # e^{-g} K(c(x_k)), (B, C, M, M)
    log_gain: Tensor  # g(x_k), (B, C)


def correct(
    structure: GramStructure,
    values: Tensor,
    law: UpdateLaw,
    inner_steps: int,
    carry: Carry,
    known: Known = Known(),  # noqa: B008
    whole: Dense | None = None,
) -> Recursion:
    """Correct the weights at every time of a piece (B, C), see `recursion`.

    Args:
        structure: the factors of K(c(x_k)), (B, C).
        values: V(c(x_k)), (B, C, M).
        law: the update law.
        inner_steps: iterations a time.
        carry: from the piece before.
        known: of the objectives, what the law needs, (B, C, ...).
        whole: `dense` of the structure, where it is at hand.
    """
    given = (*structure, values, carry.weights, carry.log_gain)
    if _FUSE_CHASE and fusible(law, inner_steps, given):
        before, after = _batch_last(values), _batch_last(values)
        carry = fused(structure, values, inner_steps, carry, History(before, after))
        return Recursion(before.permute(2, 0, 1), after.permute(2, 0, 1), carry)
    whole = dense(structure, values) if whole is None else whole
    return recursion(whole.gram, values, whole.log_gain, law, inner_steps, carry, known)


def dense(structure: GramStructure, values: Tensor) -> Dense:
    """The matrices of a piece with the values (B, C, M), every time its own."""
    gram, gain = structure.scaled().expand(*values.shape, values.shape[-1]), structure.log_gain
    return Dense(gram, values.new_zeros(values.shape[:2]) if gain is None else gain)


def correct_weights(
    structure: GramStructure,
    values: Tensor,
    law: UpdateLaw,
    inner_steps: int,
    carry: Carry,
    into: Tensor | None,
    known: Known = Known(),  # noqa: B008
    whole: Dense | None = None,
) -> tuple[Tensor | None, Carry]:
    """As `correct`, and only the paper's w comes back, (C, M, B): ``into`` itself from the fused recursion.

    Args:
        into: (C, M, B) contiguous; None where nobody wants the history.
        known, whole: as in `correct`.
    """
    given = (*structure, values, carry.weights, carry.log_gain)
    if fusible(law, inner_steps, given):
        carry = fused(structure, values, inner_steps, carry, History(recorded=into))
        return into, carry
    run = correct(structure, values, law, inner_steps, carry, known, whole)
    if into is None:
        return None, run.carry
    recorded = run.after * paper_units(structure, run.carry, values.shape[1])
    return recorded.permute(1, 2, 0), run.carry


def last_weights(carry: Carry) -> Tensor:
    """The paper's w where the recursion stands, (B, M)."""
    return carry.weights * (-carry.log_gain).exp().unsqueeze(-1)


def paper_units(structure: GramStructure, carry: Carry, times: int) -> Tensor:
    """e^{-g} of the last `times` times, (B, C, 1): a row that diverged keeps the last that it had.

    Args:
        carry: after the piece.
    """
    gain = carry.log_gain.unsqueeze(-1)
    if structure.log_gain is not None:
        gain = torch.where(lost(carry, times), gain, structure.log_gain)
    return (-gain).exp().unsqueeze(-1)


def lost(carry: Carry, times: int) -> Tensor:
    """Which of the last `times` times a row did not reach, (B, C) bool."""
    index = torch.arange(carry.time - times, carry.time, device=carry.diverged_at.device)
    end = carry.diverged_at.unsqueeze(-1)
    return (end >= 0) & (index >= end)


def _batch_last(values: Tensor) -> Tensor:
    return values.new_empty(values.shape[1], values.shape[2], values.shape[0])
