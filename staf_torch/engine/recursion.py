"""The sequential part of a gradient chase as a row program, in plain torch: the definition.

Inputs per time are in `Inputs`, the state is `Carry`, one step is `predict` of the predictor, then `begin`
and ``inner_steps`` times `step` of the law. All are pure functions of rows; `compiled` computes the same.
"""

from __future__ import annotations

from collections.abc import Set
from typing import NamedTuple

import torch
from torch import Tensor

from ..approximation.basis import GramStructure, StaFBasis
from ..local_basis import LocalSpace
from ..optim.base import LawState
from ..optim.objective import NativeError, Precomputed, extremes
from .predictors import PredictorInputs
from .problem import Problem


class Inputs(NamedTuple):
    """What the recursion reads at the times of a chunk; nothing of it depends on the weights."""

    gram: Tensor  # e^{-g} K(c(x_k)), (B, C, M, M)
    values: Tensor  # V(c(x_k)), (B, C, M)
    log_gain: Tensor  # g(x_k), (B, C)
    precomputed: Precomputed = Precomputed()  # what the law needs to know of the objectives, (B, C, ...)
    prediction: PredictorInputs = ()  # what the predictor prepared, (B, C, ...)

    @classmethod
    def of(cls, structure: GramStructure, values: Tensor) -> Inputs:
        """Return the matrices of a Gram structure (B, C), every time its own, with V(c) (B, C, M)."""
        gram, gain = structure.scaled().expand(*values.shape, values.shape[-1]), structure.log_gain
        return cls(gram, values, values.new_zeros(values.shape[:2]) if gain is None else gain)


class Link(NamedTuple):
    """The last time of a chunk, which the certificate of the next one continues from."""

    gram: Tensor  # (B, M, M) e^{-g} K
    log_gain: Tensor  # (B,) g
    error: Tensor  # (B, M) a - w after the correction, in units of e^{-g}


class Carry(NamedTuple):
    """What passes from one time to the next. Weights are in units of e^{-log_gain}."""

    weights: Tensor  # (B, M)
    law_state: LawState
    log_gain: Tensor  # (B,) g(x) of the last time
    time: int  # index of the next time
    diverged_at: Tensor  # (B,) int64, -1 while finite
    previous: Tensor | None = None  # (B, M) corrected weights of the time before the last; None: no predictor
    states: Tensor | None = None  # (B, 2, n) the last two states; None: no predictor
    link: Link | None = None  # None: no certificate, or the start


class Recursion(NamedTuple):
    """The weights of one chunk of time, in units of e^{-log_gain} of each time."""

    before: Tensor  # (B, C, M) as brought to x_k
    after: Tensor  # (B, C, M) as corrected at x_k
    carry: Carry


def start(problem: Problem, states: Tensor, weights: Tensor | None) -> Carry:
    """Return the carry before the first time of the states (B, C, n), from the paper's w (M,) or (B, M)."""
    first = problem.first_weights(states, weights)
    gain = problem.basis.kernel.log_gain(states[:, 0])
    zero = states.new_zeros(states.shape[0])
    never = torch.full(zero.shape, -1, dtype=torch.int64, device=states.device)
    carry = Carry(first, problem.law.init(first), zero if gain is None else gain, 0, never)
    if problem.predictor is None:
        return carry
    return carry._replace(previous=carry.weights, states=states[:, [0, 0]])


def recursion(problem: Problem, inputs: Inputs, carry: Carry) -> Recursion:
    """Correct the weights at every time of a chunk, one after the other.

    Args:
        problem: law, iterations and predictor.
        inputs: of the times of this chunk.
        carry: from the chunk before.
    """
    law, predictor = problem.law, problem.predictor
    gram, values, log_gain = inputs[:3]
    weights, state, last_gain, first, diverged_at, previous = carry[:6]
    usable = torch.isfinite(values).all(-1) & torch.isfinite(gram).all(-1).all(-1)
    before, after = [], []
    for k in range(values.shape[1]):
        unit = (log_gain[:, k] - last_gain).exp().unsqueeze(-1)
        brought, brought_state = weights * unit, law.rescale(state, unit)
        objective = NativeError(gram[:, k], values[:, k], inputs.precomputed.at(k))
        if predictor is not None and first + k > 0:
            assert previous is not None
            predicted = predictor.predict(
                tuple(part[:, k] for part in inputs.prediction), weights, previous, unit
            )
            brought = _better(objective, predicted, brought) if predictor.guarded else predicted
        new, new_state = brought, law.begin(objective, brought, brought_state)
        for _ in range(problem.inner_steps):
            new, new_state = law.step(objective, new, new_state)
        # A row that is not finite stays behind, as it was; the rows beside it never see it.
        finite = torch.isfinite(new).all(-1) & torch.isfinite(brought).all(-1)
        fine = usable[:, k] & finite & (diverged_at < 0)
        diverged_at = torch.where(fine | (diverged_at >= 0), diverged_at, first + k)
        keep = fine.unsqueeze(-1)
        before.append(torch.where(keep, brought, weights))
        if previous is not None:
            previous = torch.where(keep, (weights if first + k > 0 else new) * unit, previous)
        weights = torch.where(keep, new, weights)
        after.append(weights)
        state = tuple(
            torch.where(fine.view(-1, *[1] * (part.dim() - 1)), part, old)
            for part, old in zip(new_state, state, strict=True)
        )
        last_gain = torch.where(fine, log_gain[:, k], last_gain)
    time = first + values.shape[1]
    carry = Carry(weights, state, last_gain, time, diverged_at, previous, carry.states, carry.link)
    return Recursion(torch.stack(before, dim=1), torch.stack(after, dim=1), carry)


def _better(objective: NativeError, predicted: Tensor, held: Tensor) -> Tensor:
    """Return the prediction, or the weights held in the rows where F(predicted) > F(held): (B, M).

    Their difference from the two slopes, exact for a quadratic: F itself would lose the digits of a
    small excess.
    """
    slopes = objective.descent(predicted) + objective.descent(held)
    worse = torch.linalg.vecdot(predicted - held, slopes) < 0
    return torch.where(worse.unsqueeze(-1), held, predicted)


def precompute(
    needs: Set[str], space: LocalSpace, gram: Tensor, ideal: Tensor, row: Tensor, sampled: Tensor
) -> Precomputed:
    """Return the fields of `Precomputed` that a law names in its `needs`, the others None.

    Args:
        needs: names of fields.
        space: the local space at the states (B, C).
        gram: e^{-g} K, (B, C, M, M).
        ideal: its ideal weights, (B, C, M).
        row: e^{-g} k(x, c_i), (B, C, M) or (M,) for all states.
        sampled: V(x), (B, C).
    """
    if not needs:
        return Precomputed()
    return Precomputed(
        extremes=extremes(gram) if "extremes" in needs else None,
        ideal=ideal if "ideal" in needs else None,
        inverse=_inverse(space, gram) if "inverse" in needs else None,
        row=row.expand(ideal.shape) if "row" in needs else None,
        sampled=sampled if "sampled" in needs else None,
    )


def state_row(basis: StaFBasis, x: Tensor, space: LocalSpace) -> Tensor:
    """Return k0(0, d_i) at the states x (..., n), (..., M): e^{-g} k(x, c_i) but for the scale S."""
    return basis.kernel.core(x, x.new_zeros(1, basis.dim), space.offsets).squeeze(-2)


def _inverse(space: LocalSpace, gram: Tensor) -> Tensor:
    """Return (e^{-g} K)^-1, (..., M, M): each column a fit to a unit vector of values."""
    units = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    columns = [space.scaled_weights(space.fit(unit.expand(gram.shape[:-1]))) for unit in units]
    return torch.stack(columns, dim=-1)


def last_weights(carry: Carry) -> Tensor:
    """Return the paper's w where the recursion stands, (B, M)."""
    return carry.weights * (-carry.log_gain).exp().unsqueeze(-1)


def paper_units(structure: GramStructure, carry: Carry, times: int) -> Tensor:
    """Return e^{-g} of the last `times` times, (B, C, 1): a row that diverged keeps the last that it had.

    Args:
        carry: after the chunk.
    """
    gain = carry.log_gain.unsqueeze(-1)
    if structure.log_gain is not None:
        gain = torch.where(lost(carry, times), gain, structure.log_gain)
    return (-gain).exp().unsqueeze(-1)


def lost(carry: Carry, times: int) -> Tensor:
    """Return which of the last `times` times a row did not reach, (B, C) bool."""
    index = torch.arange(carry.time - times, carry.time, device=carry.diverged_at.device)
    end = carry.diverged_at.unsqueeze(-1)
    return (end >= 0) & (index >= end)
