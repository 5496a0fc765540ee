"""The Kalman filter of a local Gaussian process, many streams side by side."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from .frame import LocalFrame


@dataclasses.dataclass
class StreamState:
    """What is kept of every stream, in place; streams are the last dimension.

    u is the mean of the weights, I - D their covariance: D, 0 <= D <= I, is what has been learned.
    """

    anchor: Tensor  # the state that the centers surround, (n, S)
    mean: Tensor  # u, (M, S)
    learned: Tensor  # D, (M, M, S)
    samples: Tensor  # learned from, (S,) int64
    skipped: Tensor  # not learned from, (S,) int64

    @classmethod
    def at(cls, x: Tensor, count: int) -> StreamState:
        """Nothing learned, at the states x (n, S); zero stands in for a state that is not finite."""
        none = torch.zeros(x.shape[1], dtype=torch.int64, device=x.device)
        mean, learned = x.new_zeros(count, x.shape[1]), x.new_zeros(count, count, x.shape[1])
        return cls(torch.where(_finite(x), x, 0.0), mean, learned, none, none.clone())


class LocalFilter:
    """y_k = V_k(x_k) + e_k, e ~ N(0, rho), with V a Gaussian process of unit amplitude around the state.

    A sample: P <- I - lambda D (what was learned fades towards the prior), then the Kalman update. When the
    state has left the anchor the frame moves there, u <- T u and D <- T D T', |T| <= 1: D can only shrink, so
    that no covariance winds up in directions that the stream does not visit.

    Args:
        frame: the local functions.
        ratio: rho, variance of the noise in units of the process's.
        forgetting: lambda, in (0, 1].
        slack: distance from the anchor at which the frame follows.
    """

    def __init__(self, frame: LocalFrame, ratio: float, forgetting: float, slack: float) -> None:
        self.frame, self.ratio, self.forgetting, self.slack = frame, ratio, forgetting, slack

    def learn(self, state: StreamState, x: Tensor, y: Tensor) -> None:
        """One sample a stream: (n, S), (S,). A stream whose sample is not finite stays as it was."""
        fine = _finite(x) & torch.isfinite(y)
        z = torch.where(fine, x - state.anchor, 0.0)
        away = _dot(z, z) > self.slack**2
        far = away.nonzero().squeeze(-1)
        if len(far):  # a cost that only the streams which moved on pay; each is computed alone
            self._follow(state, far, z.index_select(1, far))
            z = torch.where(away, 0.0, z)
        psi, noise = self.frame.functions(state.anchor, z), torch.full_like(y, self.ratio)
        log_factor = self.frame.log_factor(state.anchor, z)
        if log_factor is not None:
            shrink = (-log_factor).exp()
            y, noise = y * shrink, noise * shrink.square()
        seen = _apply(state.learned, psi).mul_(self.forgetting)  # lambda D psi
        spread = self.frame.variance(state.anchor, z) - _dot(psi, seen) + noise
        fine = fine & (spread > 0)
        inverse = torch.where(fine, 1 / spread, 0.0)
        error = torch.where(fine, y - _dot(psi, state.mean), 0.0)
        gain = psi - seen
        weighted = gain * inverse
        state.mean.addcmul_(weighted, error)
        if self.forgetting < 1:
            state.learned.mul_(torch.where(fine, self.forgetting, 1.0).to(gain))
        state.learned.addcmul_(gain.unsqueeze(1), weighted.unsqueeze(0))
        state.samples.add_(fine)
        state.skipped.add_(~fine)

    def mean(self, state: StreamState, x: Tensor) -> Tensor:
        """The expected V at x (n, S), in units of the process: (S,)."""
        z = x - state.anchor
        mean = _dot(self.frame.functions(state.anchor, z), state.mean)
        log_factor = self.frame.log_factor(state.anchor, z)
        return mean if log_factor is None else mean * log_factor.exp()

    def variance(self, state: StreamState, x: Tensor) -> Tensor:
        """The variance of V at x (n, S), in units of the process's: (S,)."""
        z = x - state.anchor
        psi = self.frame.functions(state.anchor, z)
        variance = self.frame.variance(state.anchor, z) - _dot(psi, _apply(state.learned, psi))
        log_factor = self.frame.log_factor(state.anchor, z)
        return variance if log_factor is None else variance * (2 * log_factor).exp()

    def _follow(self, state: StreamState, rows: Tensor, step: Tensor) -> None:
        """Move the frame of the streams ``rows`` by (n, R)."""
        anchor = state.anchor.index_select(1, rows)
        transfer, factor = self.frame.transfer(anchor, step)
        columns = transfer.transpose(0, 1)
        mean = _apply(columns, state.mean.index_select(1, rows))
        half = _product(columns, state.learned.index_select(2, rows))  # T D
        state.anchor.index_copy_(1, rows, anchor + step)
        state.mean.index_copy_(1, rows, mean if factor is None else mean * factor)
        state.learned.index_copy_(2, rows, _product(columns, half.transpose(0, 1)))


def _apply(columns: Tensor, vector: Tensor) -> Tensor:
    """A v with the batch last, from A': (M, M, S), (M, S) -> (M, S)."""
    total = columns[0] * vector[0]
    for k in range(1, len(vector)):
        total.addcmul_(columns[k], vector[k])
    return total


def _product(columns: Tensor, matrix: Tensor) -> Tensor:
    """A B with the batch last, from A': (M, M, S), (M, M, S) -> (M, M, S)."""
    total = columns[0].unsqueeze(1) * matrix[0]
    for k in range(1, len(columns)):
        total.addcmul_(columns[k].unsqueeze(1), matrix[k])
    return total


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """(M, S), (M, S) -> (S,), term by term."""
    total = a[0] * b[0]
    for k in range(1, len(a)):
        total.addcmul_(a[k], b[k])
    return total


def _finite(x: Tensor) -> Tensor:
    total: Tensor = _dot(x, torch.zeros_like(x))  # 0 unless something is not finite
    return total == 0
