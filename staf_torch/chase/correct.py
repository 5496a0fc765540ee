"""The weight recursion of a piece of time: fused where it can run, else the reference."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..basis import GramStructure, StaFBasis, Target
from ..objective import Known
from ..optim.base import UpdateLaw
from ..targets import Formula
from ._pages import fresh
from .fused import History, built, evaluator, fused, fusible
from .native import NativeStructure, formula_of, native_structure
from .recursion import Carry, Recursion, recursion


class Dense(NamedTuple):
    """What the reference recursion takes of a `GramStructure`."""

    gram: Tensor  # e^{-g} K(c(x_k)), (B, C, M, M)
    log_gain: Tensor  # g(x_k), (B, C)


class Native(NamedTuple):
    """What the fused recursion finds by itself from the states; None: what it reads from tensors."""

    structure: NativeStructure | None = None
    formula: Formula | None = None


def native(
    states: Tensor, basis: StaFBasis, target: Target, law: UpdateLaw, inner_steps: int, carry: Carry
) -> Native:
    """What it finds by itself of these states (B, C, n), basis and target; nothing where it cannot run."""
    if not fusible(law, inner_steps, (states, carry.weights, carry.log_gain)):
        return Native()
    structure = native_structure(basis, states)
    if structure is None or not fusible(law, inner_steps, (states, structure.core, structure.offsets)):
        return Native()
    if built(states.dtype, basis.count, shared=True) is None:
        return Native()
    formula = formula_of(target, basis.dim)
    if formula is not None and evaluator(formula, states.dtype, basis.dim) is None:
        formula = None
    return Native(structure, formula)


def runs_fused(
    states: Tensor,
    structure: GramStructure | NativeStructure,
    values: Tensor | Formula,
    law: UpdateLaw,
    inner_steps: int,
    carry: Carry,
) -> bool:
    """Whether `fused` computes this and is at hand."""
    given = [states, carry.weights, carry.log_gain]
    given += [part for part in (*structure, values) if isinstance(part, Tensor)]
    if not fusible(law, inner_steps, given):
        return False
    core = structure.core
    return built(states.dtype, core.shape[-1], shared=core.dim() == 2) is not None


def correct(
    states: Tensor,
    structure: GramStructure,
    values: Tensor,
    own: Native,
    law: UpdateLaw,
    inner_steps: int,
    carry: Carry,
    known: Known = Known(),  # noqa: B008
    whole: Dense | None = None,
) -> Recursion:
    """Correct the weights at every time of a piece (B, C), see `recursion`.

    Args:
        states: x_k, (B, C, n).
        structure: the factors of K(c(x_k)), (B, C).
        values: V(c(x_k)), (B, C, M).
        own: what need not be read from these two.
        law: the update law.
        inner_steps: iterations a time.
        carry: from the piece before.
        known: of the objectives, what the law needs, (B, C, ...).
        whole: `dense` of the structure, where it is at hand.
    """
    factors, sampled = own.structure or structure, own.formula or values
    if runs_fused(states, factors, sampled, law, inner_steps, carry):
        batch, times, count = values.shape
        before, after = (fresh(values, times, count, batch) for _ in range(2))
        end = fused(states, factors, sampled, inner_steps, carry, History(before, after))
        return Recursion(before.permute(2, 0, 1), after.permute(2, 0, 1), end)
    whole = dense(structure, values) if whole is None else whole
    return recursion(whole.gram, values, whole.log_gain, law, inner_steps, carry, known)


def dense(structure: GramStructure, values: Tensor) -> Dense:
    """The matrices of a piece with the values (B, C, M), every time its own."""
    gram, gain = structure.scaled().expand(*values.shape, values.shape[-1]), structure.log_gain
    return Dense(gram, values.new_zeros(values.shape[:2]) if gain is None else gain)


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
