"""The Kalman filter of a local Gaussian process, many streams side by side, and back again over a record."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import torch
from torch import Tensor

from .local_functions import LocalFunctions

SURPRISE = 25.0  # standardised squared errors count at most so many times their running mean
LANES = 8  # streams whose numbers stand together: the double precision numbers of a vector register
ERROR_RATE = 0.05  # at which that mean follows: the latest twenty samples or so
STREAK = 8  # samples in a row that are out of all proportion before a stream starts afresh


@dataclasses.dataclass
class StreamState:
    """State of every stream, changed in place; streams are the last dimension.

    u is the mean of the weights, I - D their covariance: D, 0 <= D <= I, is what has been learned. The rows
    of the table: the anchor, x as last measured, u output by output, D's lower triangle row by row, and for
    every output the running mean of its squared standardised errors; then the largest |y| learned. In memory
    the numbers of `LANES` streams stand together, so that machine code reads them one after the other.
    """

    blocks: Tensor  # (ceil(S / LANES), 2 n + K M + M (M + 1) / 2 + K + 1, LANES)
    counts: Tensor  # learned, skipped, out of proportion in a row, learned since it began: (4, S) int64
    dim: int  # n
    count: int  # M
    outputs: int  # K

    @classmethod
    def empty(cls, like: Tensor, streams: int, dim: int, count: int, outputs: int) -> StreamState:
        """Nothing learned, at NaN: a stream's first sample puts it somewhere."""
        rows = 2 * dim + outputs * count + count * (count + 1) // 2 + outputs + 1
        table = like.new_zeros(rows, streams)
        table[: 2 * dim] = torch.nan
        counts = torch.zeros(4, streams, dtype=torch.int64, device=like.device)
        return cls(_blocks(table), counts, dim, count, outputs)

    def with_table(self, table: Tensor, counts: Tensor) -> StreamState:
        """Other streams of these sizes."""
        return dataclasses.replace(self, blocks=_blocks(table), counts=counts.contiguous())

    @property
    def streams(self) -> int:
        """S."""
        return self.counts.shape[1]

    @property
    def dtype(self) -> torch.dtype:
        """Return the dtype of the table."""
        return self.blocks.dtype

    @property
    def table(self) -> Tensor:
        """A copy of the table, (rows, S)."""
        return self.blocks.transpose(0, 1).flatten(1)[:, : self.streams]

    def put(self, table: Tensor) -> None:
        """Take these numbers, (rows, S)."""
        self.blocks.copy_(_blocks(table.to(self.blocks)))

    @property
    def sizes(self) -> tuple[int, int, int]:
        """n, M and K."""
        return self.dim, self.count, self.outputs

    def replace(self, rows: Tensor, other: StreamState) -> None:
        """Take the numbers of another state for the streams with these numbers."""
        table = self.table
        table[:, rows], self.counts[:, rows] = other.table, other.counts
        self.put(table)

    def parts(self, table: Tensor) -> StateParts:
        """The rows of a table (..., S) by name: views, but for D."""
        n, m, k = self.dim, self.count, self.outputs
        anchor, last, mean, lower, errors, largest = table.split([n, n, k * m, m * (m + 1) // 2, k, 1])
        row, column = torch.tril_indices(m, m, device=table.device)
        learned = table.new_empty(m, m, *table.shape[1:])
        learned[row, column] = learned[column, row] = lower
        return StateParts(anchor, last, mean.unflatten(0, (k, m)), learned, errors, largest)

    def whole(self, parts: StateParts) -> Tensor:
        """The table with these rows."""
        row, column = torch.tril_indices(self.count, self.count, device=parts.learned.device)
        lower = parts._replace(learned=parts.learned[row, column])
        return torch.cat([part.reshape(-1, part.shape[-1]) for part in lower])

    @property
    def anchor(self) -> Tensor:
        """The state that the centers surround, (n, S)."""
        return self.parts(self.table).anchor

    @property
    def mean(self) -> Tensor:
        """u, (K, M, S)."""
        return self.parts(self.table).mean

    @property
    def learned(self) -> Tensor:
        """D, (M, M, S)."""
        return self.parts(self.table).learned


class StateParts(NamedTuple):
    """The rows of a `StreamState`."""

    anchor: Tensor  # (n, S)
    last: Tensor  # (n, S)
    mean: Tensor  # (K, M, S)
    learned: Tensor  # (M, M, S)
    errors: Tensor  # (K, S)
    largest: Tensor  # (1, S)


class _NewSample(NamedTuple):
    """A sample of every stream, judged."""

    z: Tensor  # from the anchor, (n, S)
    y: Tensor  # (K, S), 0 where it was not measured
    seen: Tensor  # whether it was, (K, S)
    lapse: Tensor  # (S,)
    fine: Tensor  # whether the stream learns, (S,)
    moved: Tensor  # whether its centers have moved to x, and what follows is a number, (K, S)
    before: Tensor  # squared errors in units of the variance predicted before they did, (K, S)
    most: float  # the largest number of the table


@dataclasses.dataclass(frozen=True, eq=False)
class LocalFilter:
    """y_k = V_k(x_k) + e_k, e ~ N(0, rho), with V a Gaussian process of unit amplitude around the state.

    A sample: P <- I - lambda D (what was learned fades towards the prior), then the Kalman update; a
    prediction is of a sample one unit of time after the latest, with lambda D. Variances are multiplied by
    the running mean of squared errors in units of the variance that was predicted for them. When the
    state has left the anchor the centers move there, u <- T u and D <- T D T', |T| <= 1: D can only shrink,
    so that no covariance winds up in directions that the stream does not visit. K outputs share D.

    A coordinate that is NaN was not measured and is held; a target that is NaN is not learned. A sample whose
    |y| is 1/sqrt(eps) times the largest so far, or whose local functions overflow, is skipped; a stream that
    meets `STREAK` of those in a row, or as many values sqrt(eps) times smaller than the largest, starts
    afresh.

    Args:
        functions: the local functions.
        ratio: rho, variance of the noise in units of the process's, (S,).
        forgetting: lambda, in (0, 1], for a step of time 1, (S,).
        slack: distance from the anchor at which the centers follow.
        robust: standard deviations beyond which an error counts no more than there (Huber); inf for none.
        base: variance of the process in the units of y, before there are errors to tell.
    """

    functions: LocalFunctions
    ratio: Tensor
    forgetting: Tensor
    slack: float
    robust: float = math.inf
    base: float = 1.0

    def with_law(self, ratio: Tensor, forgetting: Tensor) -> LocalFilter:
        """The filter for other streams, with these rho and lambda (S,)."""
        return dataclasses.replace(self, ratio=ratio, forgetting=forgetting)

    def predict(self, state: StreamState, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the next y at x (S, n): (S, K), (S, K)."""
        mean, variance = self.moments(state, x)
        return mean, variance.sqrt()

    def moments(self, state: StreamState, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the y at x (S, n) one unit of time later: (S, K), (S, K)."""
        old = state.parts(state.table.double())
        x = torch.where(torch.isnan(x.mT), old.last, x.mT.double())
        mean, variance = self._moments(old, x - old.anchor, self.forgetting)
        scale = self._scale(old.errors, state.counts[3])
        fresh = torch.isnan(old.anchor).any(0)  # nothing is known before the first sample
        mean, variance = torch.where(fresh, 0.0, mean), variance * scale
        variance = torch.where(fresh, (1 + self.ratio) * self.base, variance)
        return mean.mT.to(state.blocks), variance.mT.to(state.blocks)

    def _moments(self, old: StateParts, z: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (K, S) and variance (S,) of the next y at z (n, S) from the anchor, before errors scale it;
        when it comes, this share of D is left."""
        psi, log_factor = self.functions.local(old.anchor, z)
        prior = self.functions.prior(old.anchor, z)
        factor: Tensor | float = 1.0 if log_factor is None else log_factor.exp()
        mean = (psi * old.mean).sum(-2) * factor
        known = (psi * _apply(old.learned, psi)).sum(0)  # psi'D psi
        return mean, (prior - share * known) * factor**2 + self.ratio

    def learn(self, state: StreamState, x: Tensor, y: Tensor, lapse: Tensor | None = None) -> None:
        """Learn one sample a stream, in place, computed in float64.

        Args:
            state: of the streams.
            x: (S, n).
            y: (S, K).
            lapse: time since the sample before, (S,), ones by default: what was learned fades by
            lambda^lapse.
        """
        x, y = x.mT, y.mT
        lapse = torch.ones_like(self.ratio) if lapse is None else lapse
        table, (samples, skipped, streak, since) = state.table.double(), state.counts.unbind()
        old = state.parts(table)
        measured = ~torch.isnan(x).all(0)
        x = torch.where(torch.isnan(x), old.last, x.double())
        seen = ~torch.isnan(y)
        y = torch.where(seen, y.double(), 0.0)
        size, largest = y.abs().amax(0), old.largest[0]
        tiny = torch.finfo(state.dtype).eps ** 0.5
        sound = measured & seen.any(0) & torch.isfinite(x).all(0) & torch.isfinite(y).all(0)
        huge = (since > 0) & (largest > 0) & (size * tiny > largest)
        small = (size > 0) & (size < largest * tiny)
        streak = torch.where(sound, torch.where(huge | small, streak + 1, streak * (size == 0)), streak)
        afresh = sound & ((streak >= STREAK) | torch.isnan(old.anchor).any(0))
        fine = sound & (~huge | afresh)

        z = torch.where(fine & ~afresh, x - old.anchor, 0.0)
        moves = fine & (afresh | ((z * z).sum(0) > self.slack**2))
        expected, variance = self._moments(old, z, self.forgetting**lapse)
        before = (y - expected).square() / variance  # no number where a kernel overflows so far away
        jumped = moves & ~afresh & torch.isfinite(before)
        anchor = torch.where(moves, x, old.anchor)
        start = torch.where(afresh, 0.0, 1.0).double()
        left = torch.where(afresh, x, old.anchor)
        transfer, factor = self.functions.transfer(left, torch.where(moves, z, 0.0))
        mean = torch.where(moves, _apply(transfer, old.mean) * (1.0 if factor is None else factor), old.mean)
        half = _apply(transfer, old.learned.transpose(0, 1))  # rows of D T'
        learned = torch.where(moves, _apply(transfer, half.transpose(0, 1)), old.learned)
        z = torch.where(moves, 0.0, z)
        since = torch.where(afresh, 0, since)
        held = torch.where(torch.isfinite(x), x, old.last)
        largest = torch.where(afresh, 0.0, largest)[None]
        moved = StateParts(anchor, held, mean * start, learned * start, old.errors * start, largest)
        most = torch.finfo(state.dtype).max
        found, good = self._update(moved, since, _NewSample(z, y, seen, lapse, fine, jumped, before, most))
        faded = moved._replace(learned=moved.learned * self.forgetting**lapse)  # time passes in any case
        kept = [torch.where(good, new, old_) for new, old_ in zip(found, faded, strict=True)]
        state.put(state.whole(StateParts(*kept)))
        streak = torch.where(afresh & good, 0, streak)
        state.counts.copy_(torch.stack((samples + good, skipped + ~good, streak, since + good)))

    def _update(self, old: StateParts, samples: Tensor, sample: _NewSample) -> tuple[StateParts, Tensor]:
        """The Kalman update at z from the anchor; and the streams whose result is finite."""
        z, y, seen, lapse, fine, moved, before, most = sample
        (psi, log_factor), noise = self.functions.local(old.anchor, z), self.ratio
        largest = torch.maximum(old.largest, y.abs().amax(0))
        prior = torch.zeros_like(lapse) + self.functions.prior(old.anchor, z)
        if log_factor is not None:
            shrink = (-log_factor).exp()
            y, noise = y * shrink, noise * shrink.square()
        share = self.forgetting**lapse
        known = _apply(old.learned, psi) * share
        spread = prior + noise - (psi * known).sum(0)
        error = y - (psi * old.mean).sum(-2)
        gain = psi - known
        square = torch.where(moved, before, error * error / spread).clamp(max=most)
        limited = square.clamp(max=most**0.75)
        scale = self._scale(old.errors, samples)
        kept = (self.robust * (scale / square).sqrt()).clamp(max=1.0) if math.isfinite(self.robust) else 1.0
        change = torch.where(seen, kept * error / spread, 0.0)
        mean = old.mean + gain * change.unsqueeze(-2)
        learned = old.learned * share + gain.unsqueeze(1) * (gain / spread)
        rate = (1 / (samples.double() + 1.0)).clamp(min=ERROR_RATE)
        counted = torch.where(samples < STREAK, limited, torch.minimum(limited, SURPRISE * old.errors))
        errors = torch.where(seen, old.errors + rate * (counted - old.errors), old.errors)
        good = fine & (spread > 0) & (mean.abs().amax((0, 1)) <= most) & torch.isfinite(learned.sum((0, 1)))
        return StateParts(old.anchor, old.last, mean, learned, errors, largest), good

    def _scale(self, errors: Tensor, samples: Tensor) -> Tensor:
        """Running residual variance in units of the predicted: the prior's at first, then what errors say."""
        trust = samples.double().clamp(max=20) / 20.0
        return (errors * trust + self.base * (1 - trust)).clamp(min=1e-6 * self.base)


def _blocks(table: Tensor) -> Tensor:
    """(rows, S) -> (ceil(S / LANES), rows, LANES), zeros behind the last stream."""
    short = -table.shape[1] % LANES
    padded = torch.nn.functional.pad(table, (0, short))
    blocks: Tensor = padded.unflatten(1, (-1, LANES)).transpose(0, 1).contiguous()
    return blocks


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """A v with the batch last, term by term: (M, M, S), (..., M, S) -> (..., M, S)."""
    total = matrix[:, 0] * vector[..., :1, :]
    for k in range(1, len(matrix)):
        total = total + matrix[:, k] * vector[..., k : k + 1, :]
    return total


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
    eye = torch.eye(state.count, dtype=torch.float64)
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
        means.append(new.mean.permute(2, 1, 0))
        covariances.append(eye - new.learned.permute(2, 0, 1))
        expected.append(scaled @ old.mean.permute(2, 1, 0))
        predicted.append(eye - share * transfer @ learned @ transfer.mT)
        transfers.append(scaled)
        anchors.append(new.anchor)
    around = list(_held(torch.stack(anchors).mT).mT)  # before the first sample: where that will be
    record = means, covariances, expected, predicted, transfers, around
    mean, variance = _backwards(filter_, record, _held(x.double()))
    return mean, variance.clamp(min=0.0).sqrt() * filter_.base**0.5


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
