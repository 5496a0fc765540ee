"""The Kalman filter of a local Gaussian process, many streams side by side."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import torch
from torch import Tensor

from .frame import Local, LocalFrame

_FADED = 1e-6  # the table's D is as large as 1 / fading


@dataclasses.dataclass
class StreamState:
    """What is kept of every stream, in place; streams are the last dimension.

    u is the mean of the weights, I - D their covariance: D, 0 <= D <= I, is what has been learned. One table,
    so that the streams that move on are taken out and put back in one pass each.
    """

    table: Tensor  # anchor, u, D / fading, row by row, (n + M + M M, S)
    dim: int  # n
    count: int  # M
    samples: Tensor  # learned from, (S,) int64
    skipped: Tensor  # not learned from, (S,) int64
    fading: float = 1.0  # the powers of lambda that the table's D lacks: to scale it costs a pass

    @classmethod
    def at(cls, x: Tensor, count: int) -> StreamState:
        """Nothing learned, at the states x (n, S); zero stands in for a state that is not finite."""
        dim, streams = x.shape
        none = torch.zeros(streams, dtype=torch.int64, device=x.device)
        table = x.new_zeros(dim + count + count * count, streams)
        table[:dim] = torch.where(_finite(x), x, 0.0)
        return cls(table, dim, count, none, none.clone())

    def parts(self, table: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Views of a table's rows: (n, S), (M, S), (M, M, S)."""
        end = self.dim + self.count
        return table[: self.dim], table[self.dim : end], table[end:].unflatten(0, (self.count, -1))

    @property
    def anchor(self) -> Tensor:
        """The state that the centers surround, (n, S)."""
        return self.table[: self.dim]

    @property
    def mean(self) -> Tensor:
        """u, (M, S)."""
        return self.parts(self.table)[1]

    @property
    def learned(self) -> Tensor:
        """D, (M, M, S)."""
        return self.parts(self.table)[2] * self.fading


class Ahead(NamedTuple):
    """A prediction before its sample: what learning the sample needs of it, while the state is the same."""

    x: Tensor  # (n, S)
    z: Tensor  # x from the anchor, (n, S)
    local: Local  # the local functions at x
    mean: Tensor  # their value psi'u, (S,)


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

    def learn(self, state: StreamState, x: Tensor, y: Tensor, ahead: Ahead | None = None) -> None:
        """One sample a stream: (n, S), (S,). A stream whose sample is not finite stays as it was.

        The branches here spare work that would change nothing: no stream's values depend on which is taken.

        Args:
            state: of the streams, updated in place.
            x: (n, S).
            y: (S,).
            ahead: of the same state at the same x, where there is one.
        """
        fine = None
        if not math.isfinite(float(x.sum() + y.sum())):
            fine, ahead = _finite(x) & torch.isfinite(y), None
        z = ahead.z if ahead is not None else x - state.anchor
        if fine is not None:
            z = torch.where(fine, z, 0.0)
        far = (_dot(z, z) > self.slack**2).nonzero().squeeze(-1)
        if len(far):  # a cost that only the streams which moved on pay; each is computed alone
            ahead = self._follow(state, far, z, ahead)
            z.index_fill_(1, far, 0.0)
        self._update(state, y, fine, ahead or self._ahead(state, x, z))

    def _update(self, state: StreamState, y: Tensor, fine: Tensor | None, ahead: Ahead) -> None:
        """The Kalman update of the streams that are fine, None for all."""
        anchor, mean, learned = state.parts(state.table)
        psi, log_factor = ahead.local
        variance: Tensor | float = self.frame.prior(anchor, ahead.z)
        noise: Tensor | float = self.ratio
        if log_factor is not None:
            shrink = (-log_factor).exp()
            y, noise = y * shrink, noise * shrink.square()
        share = self.forgetting * state.fading
        seen = _apply(learned, psi)  # D psi, to be multiplied by the share
        spread = _dot(psi, seen).mul_(-share).add_(variance + noise)
        inverse, error = 1 / spread, y - ahead.mean
        if fine is not None or not bool(spread.min() > 0):
            fine = spread > 0 if fine is None else fine & (spread > 0)
            inverse, error = torch.where(fine, inverse, 0.0), torch.where(fine, error, 0.0)
        gain = torch.sub(psi, seen, alpha=share)
        weighted = gain * inverse
        mean.addcmul_(weighted, error)
        self._fade(state, learned, fine)
        learned.addcmul_(gain.unsqueeze(1), weighted.unsqueeze(0), value=1 / state.fading)
        state.samples.add_(1 if fine is None else fine)
        if fine is not None:
            state.skipped.add_(~fine)

    def _fade(self, state: StreamState, learned: Tensor, fine: Tensor | None) -> None:
        """D <- lambda D for the streams that are fine: by a number for all, where it can."""
        if fine is None:
            state.fading *= self.forgetting
        if fine is not None or state.fading < _FADED:
            learned.mul_(state.fading)
            state.fading = 1.0
        if fine is not None and self.forgetting < 1:
            kept = learned.new_tensor(self.forgetting)  # a number would be rounded to the default dtype
            learned.mul_(torch.where(fine, kept, 1.0))

    def ahead(self, state: StreamState, x: Tensor) -> Ahead:
        """What is expected at x (n, S)."""
        return self._ahead(state, x, x - state.anchor)

    def _ahead(self, state: StreamState, x: Tensor, z: Tensor) -> Ahead:
        local = self.frame.local(state.anchor, z)
        return Ahead(x, z, local, _dot(local.psi, state.mean))

    def mean(self, ahead: Ahead) -> Tensor:
        """The expected V, in units of the process: (S,)."""
        log_factor = ahead.local.log_factor
        return ahead.mean if log_factor is None else ahead.mean * log_factor.exp()

    def variance(self, state: StreamState, ahead: Ahead) -> Tensor:
        """The variance of V, in units of the process's: (S,)."""
        psi, log_factor = ahead.local
        variance = self.frame.prior(state.anchor, ahead.z) - _dot(psi, _apply(state.learned, psi))
        return variance if log_factor is None else variance * (2 * log_factor).exp()

    def _follow(self, state: StreamState, rows: Tensor, z: Tensor, ahead: Ahead | None) -> Ahead | None:
        """Move the frame of the streams ``rows`` (R,) by their z, of (n, S); what is ahead of it there."""
        step = _take(z, rows)
        old = _take(state.table, rows)
        new = torch.empty_like(old)
        (anchor, mean, learned), (there, moved, fewer) = state.parts(old), state.parts(new)
        transfer, factor = self.frame.transfer(anchor, step)
        columns = transfer.transpose(0, 1)
        torch.add(anchor, step, out=there)
        _apply(columns, mean, out=moved)
        if factor is not None:
            moved.mul_(factor)
        half = _product(columns, learned)  # T D
        _product(columns, half.transpose(0, 1), out=fewer)
        _put(state.table, rows, new)
        if ahead is None:
            return None
        local = self.frame.local(there, torch.zeros_like(step))
        _put(ahead.local.psi, rows, local.psi)
        _put(ahead.mean.unsqueeze(0), rows, _dot(local.psi, moved).unsqueeze(0))
        if ahead.local.log_factor is not None and local.log_factor is not None:
            _put(ahead.local.log_factor.unsqueeze(0), rows, local.log_factor.unsqueeze(0))
        return ahead


def _take(table: Tensor, rows: Tensor) -> Tensor:
    """The streams ``rows`` (R,) of a table: (K, S) -> (K, R). Twice as fast as index_select."""
    return table.gather(1, rows.expand(len(table), -1))


def _put(table: Tensor, rows: Tensor, source: Tensor) -> None:
    """The inverse of `_take`, in place."""
    table.scatter_(1, rows.expand(len(table), -1), source)


def _apply(columns: Tensor, vector: Tensor, out: Tensor | None = None) -> Tensor:
    """A v with the batch last, from A': (M, M, S), (M, S) -> (M, S)."""
    total = torch.mul(columns[0], vector[0], out=out)
    for k in range(1, len(vector)):
        total.addcmul_(columns[k], vector[k])
    return total


def _product(columns: Tensor, matrix: Tensor, out: Tensor | None = None) -> Tensor:
    """A B with the batch last, from A': (M, M, S), (M, M, S) -> (M, M, S)."""
    total = torch.mul(columns[0].unsqueeze(1), matrix[0], out=out)
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
