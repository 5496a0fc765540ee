"""The Kalman filter of a local Gaussian process, many streams side by side."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from .frame import Features, LocalFrame


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
        (far,) = (z.square().sum(0) > self.slack**2).nonzero(as_tuple=True)
        if len(far):  # a cost that only the streams which moved on pay; each is computed alone
            self._follow(state, far, z[:, far])
            z[:, far] = 0.0
        psi, variance = _scaled(self.frame.features(state.anchor, z))
        seen = (state.learned * psi).sum(1)  # D psi
        spread = variance - self.forgetting * torch.linalg.vecdot(psi, seen, dim=0) + self.ratio
        fine = fine & (spread > 0)
        inverse = torch.where(fine, 1 / spread, 0.0)
        error = torch.where(fine, y - torch.linalg.vecdot(psi, state.mean, dim=0), 0.0)
        gain = psi - self.forgetting * seen
        state.mean.addcmul_(gain, error * inverse)
        if self.forgetting < 1:
            state.learned.mul_(torch.where(fine, self.forgetting, 1.0).to(gain))
        state.learned.addcmul_(gain.unsqueeze(1), (gain * inverse).unsqueeze(0))
        state.samples.add_(fine)
        state.skipped.add_(~fine)

    def estimate(self, state: StreamState, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of V at x (n, S), in units of the process: (S,), (S,)."""
        psi, variance = _scaled(self.frame.features(state.anchor, x - state.anchor))
        seen = (state.learned * psi).sum(1)
        mean = torch.linalg.vecdot(psi, state.mean, dim=0)
        return mean, variance - torch.linalg.vecdot(psi, seen, dim=0)

    def _follow(self, state: StreamState, rows: Tensor, step: Tensor) -> None:
        """Move the frame of the streams ``rows`` by (n, R)."""
        anchor = state.anchor[:, rows]
        transfer, factor = self.frame.transfer(anchor, step)
        mean = (transfer * state.mean[:, rows]).sum(1)
        half = _product(transfer, state.learned[..., rows])  # T D
        state.anchor[:, rows] = anchor + step
        state.mean[:, rows] = mean if factor is None else mean * factor
        state.learned[..., rows] = _product(half, transfer.transpose(0, 1))


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Matrix products with the batch last: (M, M, S), (M, M, S) -> (M, M, S)."""
    total = a[:, 0].unsqueeze(1) * b[0]
    for k in range(1, a.shape[1]):
        total.addcmul_(a[:, k].unsqueeze(1), b[k])
    return total


def _scaled(found: Features) -> tuple[Tensor, Tensor]:
    """psi and the variance at the point in units of V."""
    if found.log_factor is None:
        return found.functions, found.variance
    factor = found.log_factor.exp()
    return found.functions * factor, found.variance * factor.square()


def _finite(x: Tensor) -> Tensor:
    finite: Tensor = torch.isfinite(x).all(0)
    return finite
