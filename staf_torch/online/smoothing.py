"""The Kalman filter of a local Gaussian process back again over a record."""

from __future__ import annotations

import torch
from torch import Tensor

from .kalman_filter import LocalFilter
from .stream_state import StreamState


def smooth_record(
    filter_: LocalFilter, state: StreamState, x: Tensor, y: Tensor, lapse: Tensor
) -> tuple[Tensor, Tensor]:
    """Estimate V at the recorded states from all samples, before and after: Rauch, Tung and Striebel (1965).

    Forwards the filter stores u, I - D and what it expected before each sample: u' = T u with the covariance
    P' = I - lambda T D T'. Backwards u_k <- u_k + G (u_k+1 - u'_k+1) with the gain G = P_k T' P'_k+1^-1, and
    the covariances alike.

    Args:
        filter_: the definition.
        state: of the streams at the beginning, updated to the end.
        x: (T, S, n).
        y: (T, S, K).
        lapse: (T, S).

    Returns:
        Mean (T, S, K) and standard deviation (T, S, 1) of V, without noise, in the units of y.
    """
    eye = torch.eye(state.count, dtype=torch.float64, device=x.device)
    means, covariances, expected, predicted, transfers, anchors = [], [], [], [], [], []
    for k in range(len(x)):
        before, old = state.counts.clone(), state.parts(state.table.double().clone())
        filter_.learn(state, x[k], y[k], lapse[k])
        new = state.parts(state.table.double().clone())
        known = ~torch.isnan(old.anchor).any(0)
        step = torch.where(known, new.anchor - old.anchor, 0.0)
        transfer, factor = filter_.functions.transfer(torch.where(known, old.anchor, 0.0), step)
        transfer = torch.where(step.abs().sum(0) > 0, transfer, eye.unsqueeze(-1))
        # a stream that starts afresh says nothing about what was before
        afresh = (before[3] > 0) & (state.counts[3] == 1) & (state.counts[0] > before[0])
        transfer = torch.where(afresh, 0.0, transfer).permute(2, 0, 1)
        scaled = transfer if factor is None else transfer * factor[:, None, None]
        learned = old.learned.permute(2, 0, 1)
        share = (filter_.forgetting ** lapse[k])[:, None, None]
        means.append(new.mean[:-1].permute(2, 1, 0))
        covariances.append(eye - new.learned.permute(2, 0, 1))
        expected.append(scaled @ old.mean[:-1].permute(2, 1, 0))
        predicted.append(eye - share * transfer @ learned @ transfer.mT)
        transfers.append(scaled)
        anchors.append(new.anchor)
    around = list(_held(torch.stack(anchors).mT).mT)  # before the first sample: where that will be
    record = means, covariances, expected, predicted, transfers, around
    mean, variance = _backwards(filter_, record, _held(x.double()))
    size = torch.as_tensor(filter_.base, dtype=torch.float64, device=mean.device).sqrt()
    return mean, variance.clamp(min=0.0).sqrt() * size.unsqueeze(-1)


def _held(x: Tensor) -> Tensor:
    """Fill NaN of (T, ...) forward in time, leading NaN backward."""
    found = x.clone()
    for k in range(1, len(x)):
        found[k] = torch.where(torch.isnan(found[k]), found[k - 1], found[k])
    for k in reversed(range(len(x) - 1)):
        found[k] = torch.where(torch.isnan(found[k]), found[k + 1], found[k])
    return found


def _backwards(filter_: LocalFilter, record: tuple[list[Tensor], ...], x: Tensor) -> tuple[Tensor, Tensor]:
    means, covariances, expected, predicted, transfers, anchors = record
    u, p = means[-1], covariances[-1]
    found = []
    for k in reversed(range(len(x))):
        if k < len(x) - 1:
            gain = torch.linalg.solve(predicted[k + 1], transfers[k + 1] @ covariances[k]).mT
            u = means[k] + gain @ (u - expected[k + 1])
            p = covariances[k] + gain @ (p - predicted[k + 1]) @ gain.mT
        z = x[k].mT - anchors[k]
        functions, log_factor = filter_.functions.local(anchors[k], z)
        psi = functions.mT.unsqueeze(-1)  # (S, M, 1)
        factor = torch.ones_like(z[0]) if log_factor is None else log_factor.exp()
        prior = torch.zeros_like(z[0]) + filter_.functions.prior(anchors[k], z)
        rest = prior - psi.square().sum((1, 2))
        variance = (rest + (psi.mT @ p @ psi).squeeze(-1).squeeze(-1)) * factor.square()
        found.append(((psi.mT @ u).squeeze(1) * factor[:, None], variance.unsqueeze(-1)))
    mean, variances = zip(*reversed(found), strict=True)
    return torch.stack(mean), torch.stack(variances)
