"""The sequential part of a gradient chase, in plain torch. This defines what a faster one computes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..objective import Known, NativeError
from ..optim.base import LawState, UpdateLaw
from .certificate import Link
from .predictors import Predictor
from .predictors.base import Parts


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
    """The weights of one piece of time, in units of e^{-log_gain} of each time."""

    before: Tensor  # (B, C, M) as brought to x_k
    after: Tensor  # (B, C, M) as corrected at x_k
    carry: Carry


def recursion(
    gram: Tensor,
    values: Tensor,
    log_gain: Tensor,
    law: UpdateLaw,
    inner_steps: int,
    carry: Carry,
    known: Known = Known(),  # noqa: B008
    predictor: Predictor | None = None,
    parts: Parts = (),
) -> Recursion:
    """Correct the weights at every time of a piece, one after the other.

    Args:
        gram: e^{-g} K(c(x_k)), (B, C, M, M).
        values: V(c(x_k)), (B, C, M).
        log_gain: g(x_k), (B, C).
        law: the update law.
        inner_steps: iterations a time.
        carry: from the piece before.
        known: of the objectives, what the law needs, (B, C, ...).
        predictor: moves the weights to the next time; None keeps them.
        parts: what the predictor prepared for the times of this piece.
    """
    weights, state, last_gain, start, diverged_at, previous = carry[:6]
    usable = torch.isfinite(values).all(-1) & torch.isfinite(gram).all(-1).all(-1)
    before, after = [], []
    for k in range(values.shape[1]):
        unit = (log_gain[:, k] - last_gain).exp().unsqueeze(-1)
        brought, brought_state = weights * unit, law.rescale(state, unit)
        objective = NativeError(gram[:, k], values[:, k], known.at(k))
        if predictor is not None and start + k > 0:
            assert previous is not None
            predicted = predictor.predict(tuple(part[:, k] for part in parts), weights, previous, unit)
            brought = _better(objective, predicted, brought) if predictor.guarded else predicted
        new, new_state = brought, law.begin(objective, brought, brought_state)
        for _ in range(inner_steps):
            new, new_state = law.step(objective, new, new_state)
        # A row that is not finite stays behind, as it was; the rows beside it never see it.
        finite = torch.isfinite(new).all(-1) & torch.isfinite(brought).all(-1)
        fine = usable[:, k] & finite & (diverged_at < 0)
        diverged_at = torch.where(fine | (diverged_at >= 0), diverged_at, start + k)
        keep = fine.unsqueeze(-1)
        before.append(torch.where(keep, brought, weights))
        if previous is not None:
            previous = torch.where(keep, (weights if start + k > 0 else new) * unit, previous)
        weights = torch.where(keep, new, weights)
        after.append(weights)
        state = tuple(
            torch.where(fine.view(-1, *[1] * (part.dim() - 1)), part, old)
            for part, old in zip(new_state, state, strict=True)
        )
        last_gain = torch.where(fine, log_gain[:, k], last_gain)
    time = start + values.shape[1]
    carry = Carry(weights, state, last_gain, time, diverged_at, previous, carry.states, carry.link)
    return Recursion(torch.stack(before, dim=1), torch.stack(after, dim=1), carry)


def _better(objective: NativeError, predicted: Tensor, held: Tensor) -> Tensor:
    """The prediction, or the weights held in the rows where F(predicted) > F(held): (B, M).

    Their difference from the two slopes, exact for a quadratic: F itself would lose the digits of a
    small excess.
    """
    slopes = objective.descent(predicted) + objective.descent(held)
    worse = torch.linalg.vecdot(predicted - held, slopes) < 0
    return torch.where(worse.unsqueeze(-1), held, predicted)
