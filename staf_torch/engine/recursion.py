"""The sequential part of a gradient chase as a row program, in plain torch: the definition.

Inputs per time are in `Inputs`, the state is `Carry`, one step is `predict` of the predictor, then `begin`
and ``inner_steps`` iterations of the law. All are pure functions of rows; `row_program` computes the same.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..approximation.basis import GramStructure
from ..optim.base import LawState
from ..optim.objective import NativeError, Objective, Precomputed
from .predictors import PredictorInputs
from .problem import Problem


class Moment(NamedTuple):
    """Inputs of the recursion at one time, beside the objective."""

    log_gain: Tensor  # g(x), (B,)
    usable: Tensor  # (B,) bool: whether V(c) and K are finite
    prediction: PredictorInputs = ()  # what the predictor prepared, (B, ...)


class Inputs(NamedTuple):
    """Inputs of the recursion at the times of a chunk; none depends on the weights."""

    gram: Tensor  # e^{-g} K(c(x_k)), (B, C, M, M)
    values: Tensor  # V(c(x_k)), (B, C, M)
    log_gain: Tensor  # g(x_k), (B, C)
    usable: Tensor  # (B, C) bool
    precomputed: Precomputed = Precomputed()  # what the law needs to know of the objectives, (B, C, ...)
    prediction: PredictorInputs = ()  # what the predictor prepared, (B, C, ...)

    @classmethod
    def of(cls, structure: GramStructure, values: Tensor) -> Inputs:
        """Return the matrices of a Gram structure (B, C), every time its own, with V(c) (B, C, M)."""
        gram, gain = structure.scaled().expand(*values.shape, values.shape[-1]), structure.log_gain
        usable = torch.isfinite(values).all(-1) & torch.isfinite(gram).all(-1).all(-1)
        return cls(gram, values, values.new_zeros(values.shape[:-1]) if gain is None else gain, usable)

    def objective(self, k: int) -> NativeError:
        """Return F at time k of the chunk."""
        return NativeError(self.gram[:, k], self.values[:, k], self.precomputed.at(k))

    def at(self, k: int) -> Moment:
        """Return what else is known of time k of the chunk."""
        return Moment(self.log_gain[:, k], self.usable[:, k], tuple(part[:, k] for part in self.prediction))


class Link(NamedTuple):
    """Quantities of the previous time that the certificate reads."""

    gram: Tensor  # (..., M, M) e^{-g} K
    log_gain: Tensor  # (...) g
    error: Tensor  # (..., M) a - w after the correction, in units of e^{-g}


class Carry(NamedTuple):
    """Carry of the recursion from one time to the next. Weights are in units of e^{-log_gain}."""

    weights: Tensor  # (B, M)
    law_state: LawState
    log_gain: Tensor  # (B,) g(x) of the last time
    time: int | Tensor  # index of the next time; (B,) within a row program
    diverged_at: Tensor  # (B,) int64, -1 while finite
    previous: Tensor | None = None  # (B, M) corrected weights of the time before the last; None: no predictor
    states: Tensor | None = None  # (B, 2, n) the last two states; None: no predictor
    link: Link | None = None  # None: no certificate, or the start


class Corrected(NamedTuple):
    """The weights of some times, in units of e^{-log_gain} of each, and what they were corrected for."""

    before: Tensor  # (..., M) as brought to x_k
    after: Tensor  # (..., M) as corrected at x_k
    values: Tensor  # V(c(x_k)), (..., M)
    log_gain: Tensor  # g(x_k), (...)


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
    carry = Carry(first, problem.first_state(first), zero if gain is None else gain, 0, never)
    if problem.predictor is None:
        return carry
    return carry._replace(previous=carry.weights, states=states[:, [0, 0]])


def recursion(problem: Problem, inputs: Inputs, carry: Carry) -> Recursion:
    """Correct the weights at every time of a chunk, one after the other."""
    before, after = [], []
    for k in range(inputs.values.shape[1]):
        held, carry = correct(problem, inputs.objective(k), inputs.at(k), carry)
        before.append(held)
        after.append(carry.weights)
    return Recursion(torch.stack(before, dim=1), torch.stack(after, dim=1), carry)


def correct(problem: Problem, objective: Objective, at: Moment, carry: Carry) -> tuple[Tensor, Carry]:
    """Return the weights as brought to one time, (B, M), and the carry after their correction there."""
    law, weights, previous, time = problem.law, carry.weights, carry.previous, carry.time
    unit = (at.log_gain - carry.log_gain).exp().unsqueeze(-1)
    brought, state = weights * unit, law.rescale(carry.law_state, unit)
    new = brought
    if problem.predictor is not None and previous is not None:
        new = problem.predictor.predict(at.prediction, weights, previous, unit)
        new = _better(objective, new, brought) if problem.predictor.guarded else new
        new = brought = _chosen(time, new, brought)
    new_state = law.begin(objective, brought, state)
    new, new_state = law.iterate(objective, new, new_state, problem.inner_steps)
    problem.check_step(new, new_state, carry.law_state)
    # A row that is not finite stays behind, as it was; the rows beside it never see it.
    finite = all_finite(new) & all_finite(brought)
    fine = at.usable & finite & (carry.diverged_at < 0)
    keep = fine.unsqueeze(-1)
    if previous is not None:
        previous = torch.where(keep, _chosen(time, weights, new) * unit, previous)
    states = zip(new_state, carry.law_state, strict=True)
    return torch.where(keep, brought, weights), carry._replace(
        weights=torch.where(keep, new, weights),
        law_state=tuple(torch.where(fine.view(-1, *[1] * (n.dim() - 1)), n, old) for n, old in states),
        log_gain=torch.where(fine, at.log_gain, carry.log_gain),
        time=time + 1,
        diverged_at=torch.where(fine | (carry.diverged_at >= 0), carry.diverged_at, time),
        previous=previous,
    )


def all_finite(vector: Tensor) -> Tensor:
    """Return whether all entries are finite: (..., M) -> (...). 0 x is 0 then, and NaN else."""
    return (vector * 0).sum(-1) == 0


def _chosen(time: int | Tensor, later: Tensor, first: Tensor) -> Tensor:
    """Return one (B, M) at the first time of all and the other from then on."""
    if isinstance(time, int):
        return later if time > 0 else first
    return torch.where((time > 0).unsqueeze(-1), later, first)


def _better(objective: Objective, predicted: Tensor, held: Tensor) -> Tensor:
    """Return the prediction, or the weights held in the rows where F(predicted) > F(held): (B, M).

    Their difference from the two slopes, exact for a quadratic: F itself would lose the digits of a
    small excess.
    """
    slopes = objective.descent(predicted) + objective.descent(held)
    worse = torch.linalg.vecdot(predicted - held, slopes) < 0
    return torch.where(worse.unsqueeze(-1), held, predicted)


def last_weights(carry: Carry) -> Tensor:
    """Return the paper's w where the recursion stands, (B, M)."""
    return carry.weights * (-carry.log_gain).exp().unsqueeze(-1)


def kept_gain(log_gain: Tensor, carry: Carry) -> Tensor:
    """Return g in whose units the weights of the last times stand, (B, C): of a lost row, its last."""
    return torch.where(lost(carry, log_gain.shape[1]), carry.log_gain.unsqueeze(-1), log_gain)


def lost(carry: Carry, times: int) -> Tensor:
    """Return which of the last `times` times a row did not reach, (B, C) bool."""
    assert isinstance(carry.time, int)
    index = torch.arange(carry.time - times, carry.time, device=carry.diverged_at.device)
    end = carry.diverged_at.unsqueeze(-1)
    return (end >= 0) & (index >= end)
