"""The Kalman filter of a local Gaussian process, many streams side by side."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..numerics.linalg import length, root
from .local_functions import LocalFunctions, OwnFunctions
from .stream_state import Counts, StateParts, StreamState

SURPRISE = 25.0  # squared errors count at most so many times their running mean, each in a row so many more
ERROR_RATE = 0.05  # at which that mean follows: the latest twenty samples or so
SPREAD_RATE = 1e-3  # at which the mean and the spread of y follow
LEAST = 1e-3  # of the spread of y: the amplitude of V that the errors say is no less
NOVEL = 4.0  # times its running mean, a share that is unknown says that x is away from the stream
STREAK = 8  # samples in a row that are out of all proportion before a stream starts afresh


class _Outlook(NamedTuple):
    """The expected next y."""

    mean: Tensor  # (K, S)
    deviation: Tensor  # (K, S)
    weight: Tensor  # of its square, what the amplitude makes that the errors say, (K, S)
    unknown: Tensor  # share of the variance of V, (S,)


class _NewSample(NamedTuple):
    """A sample of every stream, judged."""

    z: Tensor  # from the anchor, (n, S)
    y: Tensor  # (K, S), 0 where it was not measured
    seen: Tensor  # whether it was, (K, S)
    lapse: Tensor  # (S,)
    fine: Tensor  # whether the stream learns, (S,)
    stays: Tensor  # whether x is what it was, (S,)
    before: _Outlook  # before the centers moved
    most: float  # the largest number of the table


@dataclasses.dataclass(frozen=True, eq=False)
class LocalFilter:
    """y_k = m + V_k(x_k) + e_k, e ~ N(0, rho), V a Gaussian process of unit amplitude around the state.

    A sample: P <- I - lambda D (what was learned fades towards the prior), then the Kalman update; a
    prediction is of a sample one unit of time after the latest, with lambda D. When the state has left the
    anchor the centers move there, u <- T u and D <- T D T', |T| <= 1: D can only shrink, so that no
    covariance winds up in directions that the stream does not visit. K outputs share D.

    m is the running mean of y. As the filter is linear, a second mean u1, of an output that is always 1,
    makes it exact whatever m becomes: the prediction is psi'u + m (1 - psi'u1).

    The noise and the prior have scales of their own. On the stream the variance r + rho of a prediction, r
    the share of V's that is unknown, is multiplied by c^2, the running mean of the squared errors in these
    units. Where r is beyond some times its running mean, the variance goes over to that of y as r goes to 1,
    and c learns by the share of the variance that it makes (the expectation step of Dempster, Laird and
    Rubin, 1977). Until y takes a second value its size is ``base``.

    A coordinate that is NaN was not measured and is held; a target that is NaN is not learned. A sample whose
    |y| is 1/sqrt(eps) times the largest so far, or whose local functions overflow, is skipped; a stream that
    meets `STREAK` of those in a row, or as many values sqrt(eps) times smaller than the largest, starts
    afresh.

    Args:
        functions: the local functions.
        ratio: rho, variance of the noise in units of the process's, (S,).
        forgetting: lambda, in (0, 1], for a step of time 1, (S,).
        slack: distance from the anchor at which the centers follow; this and the next may be (S,).
        robust: standard deviations beyond which an error counts no more than there (Huber); inf for none.
        base: variance of the process in the units of y, before there are errors to tell.
    """

    functions: LocalFunctions | OwnFunctions
    ratio: Tensor
    forgetting: Tensor
    slack: float | Tensor
    robust: float | Tensor = math.inf
    base: float | Tensor = 1.0

    def with_law(self, ratio: Tensor, forgetting: Tensor) -> LocalFilter:
        """The filter for other streams, with these rho and lambda (S,)."""
        return dataclasses.replace(self, ratio=ratio, forgetting=forgetting)

    def of_rows(self, rows: Tensor) -> LocalFilter:
        """The filter of the streams with these numbers."""
        own = {name: getattr(self, name) for name in ("ratio", "forgetting", "slack", "robust", "base")}
        some = {name: part[rows] for name, part in own.items() if isinstance(part, Tensor)}
        return dataclasses.replace(self, functions=self.functions.of_rows(rows), **some)

    def predict(self, state: StreamState, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the next y at x (S, n): (S, K), (S, K)."""
        mean, deviation = self.expected(state.parts(state.table.double()), x.mT, self.forgetting)
        return mean.mT.to(state.blocks), deviation.mT.to(state.blocks)

    def expected(self, old: StateParts, x: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (K, S) of y at x (n, S) when a share (S,) of D is left."""
        fresh = torch.isnan(old.anchor).any(0)  # nothing is known before the first sample
        x = torch.where(torch.isnan(x), old.last, x.double())
        found = self._outlook(old, _known(old.anchor, x), torch.where(fresh, 0.0, x - old.anchor), share)
        mean = torch.where(fresh, 0.0, found.mean)
        return mean, torch.where(fresh, ((1 + self.ratio) * self.base).sqrt(), found.deviation)

    def _outlook(self, old: StateParts, here: Tensor, z: Tensor, share: Tensor) -> _Outlook:
        """Return the expected y at z (n, S) from an anchor, and the share of D that is left when it comes."""
        psi, log_factor = self.functions.local(here, z)
        prior = torch.zeros_like(share) + self.functions.prior(here, z)
        factor = torch.ones_like(share) if log_factor is None else log_factor.exp()
        *means, one = ((psi * old.mean).sum(-2) * factor).unbind()
        mean = torch.stack(means) + old.level * (1 - one)
        known = (psi * _apply(old.learned, psi)).sum(0)  # psi'D psi
        some = prior > 0  # an anchored kernel knows the origin
        unknown = torch.where(some, 1 - share * known / torch.where(some, prior, 1.0), 0.0).clamp(0.0, 1.0)
        usual = torch.minimum(NOVEL * old.usual[0], 1 - (1 - old.usual[0]) / 4)
        away = ((unknown - usual) / (1 - usual).clamp(min=1e-9)).clamp(0.0, 1.0)
        near = self._amplitude(old) * (torch.minimum(unknown, usual) * prior * factor**2 + self.ratio).sqrt()
        far = torch.maximum(self._spread(old), near)
        square = (near / far).square()
        whole = away + (1 - away) * square
        weight = torch.where(square < 1, (1 - away) * square / whole, 1.0)
        return _Outlook(mean, far * whole.sqrt(), weight, unknown)

    def learn(self, state: StreamState, x: Tensor, y: Tensor, lapse: Tensor | None = None) -> None:
        """Learn one sample a stream, x (S, n), y (S, K), in place, computed in float64; ``lapse`` (S,) is
        the time since the sample before, by default 1: what was learned fades by lambda^lapse."""
        lapse = torch.ones_like(self.ratio) if lapse is None else lapse
        counts = Counts(*state.counts.unbind())
        parts, counts = self.learned(
            state.parts(state.table.double()), counts, x.mT, y.mT, lapse, torch.finfo(state.dtype)
        )
        state.put(state.whole(parts))
        state.counts.copy_(torch.stack(counts))

    def learned(
        self, old: StateParts, counts: Counts, x: Tensor, y: Tensor, lapse: Tensor, numbers: torch.finfo
    ) -> tuple[StateParts, Counts]:
        """Return the state after one sample a stream, x (n, S), y (K, S), lapse (S,); ``numbers`` are the
        limits of the table's dtype."""
        samples, skipped, streak, since = counts
        measured = ~torch.isnan(x).all(0)
        x = torch.where(torch.isnan(x), old.last, x.double())
        seen = ~torch.isnan(y)
        y = torch.where(seen, y.double(), 0.0)
        size, largest = y.abs().amax(0), old.largest[0]
        tiny = numbers.eps**0.5
        sound = measured & seen.any(0) & torch.isfinite(x).all(0) & torch.isfinite(y).all(0)
        huge = (since > 0) & (largest > 0) & (size * tiny > largest)
        small = (size > 0) & (size < largest * tiny)
        streak = torch.where(sound, torch.where(huge | small, streak + 1, streak * (size == 0)), streak)
        afresh = sound & ((streak >= STREAK) | torch.isnan(old.anchor).any(0))
        fine = sound & (~huge | afresh)
        y = torch.where(torch.isfinite(y), y, 0.0)

        z = torch.where(fine & ~afresh, x - old.anchor, 0.0)
        stays = torch.eq(x, old.last).all(0)
        moves = fine & (afresh | ((z * z).sum(0) > self.slack**2))
        share = self.forgetting**lapse
        here = _known(old.anchor, x)
        before = self._outlook(old, here, z, share)
        anchor = torch.where(moves, x, old.anchor)
        left = torch.where(afresh, x, here)
        transfer, factor = self.functions.transfer(left, torch.where(moves, z, 0.0))
        mean = torch.where(moves, _apply(transfer, old.mean) * (1.0 if factor is None else factor), old.mean)
        half = _apply(transfer, old.learned.transpose(0, 1))  # rows of D T'
        learned = torch.where(moves, _apply(transfer, half.transpose(0, 1)), old.learned)
        z = torch.where(moves, 0.0, z)
        since = torch.where(afresh, 0, since)
        held = torch.where(torch.isfinite(x), x, old.last)
        kept = old._replace(mean=mean, learned=learned)
        moved = StateParts(anchor, held, *(torch.where(afresh, 0.0, part) for part in kept[2:]))
        sample = _NewSample(z, y, seen, lapse, fine, stays, before, numbers.max)
        found, good = self._update(moved, since, sample)
        faded = moved._replace(learned=moved.learned * share)  # time passes in any case
        both = [torch.where(good, new, old_) for new, old_ in zip(found, faded, strict=True)]
        streak = torch.where(afresh & good, 0, streak)
        return StateParts(*both), Counts(samples + good, skipped + ~good, streak, since + good)

    def _update(self, old: StateParts, since: Tensor, sample: _NewSample) -> tuple[StateParts, Tensor]:
        """The Kalman update at z from the anchor; and the streams whose result is finite."""
        z, y, seen, lapse, fine, stays, before, most = sample
        here = _known(old.anchor, old.last)
        (psi, log_factor), noise = self.functions.local(here, z), self.ratio
        largest = torch.maximum(old.largest, y.abs().amax(0))
        prior = torch.zeros_like(lapse) + self.functions.prior(here, z)
        shrink = torch.ones_like(lapse) if log_factor is None else (-log_factor).exp()
        noise = noise * shrink.square()
        share = self.forgetting**lapse
        known = _apply(old.learned, psi) * share
        spread = prior + noise - (psi * known).sum(0)
        gain = psi - known
        left = torch.cat((y * shrink, shrink[None])) - (psi * old.mean).sum(-2)
        of_level = old.level * left[-1]
        # nothing was expected of the first value, nor where a kernel overflows
        expects = (old.told > 0) & torch.isfinite(before.mean) & torch.isfinite(before.deviation)
        expected = (torch.where(expects, part, 1.0) for part in (before.mean, before.deviation))
        away = torch.where(expects, (y - next(expected)).abs() / next(expected), 0.0).clamp(max=1e150)
        beyond = away > self.robust
        kept = torch.where(beyond, self.robust / torch.where(beyond, away, 1.0), 1.0)
        counts = torch.where(kept < 1, kept * (left[:-1] - of_level) + of_level, left[:-1])
        change = torch.cat((torch.where(seen, counts, 0.0), left[-1:])) / spread
        mean = old.mean + gain * change.unsqueeze(-2)
        first = seen & (old.told == 0)  # as if it had always been so
        told = torch.where(first.unsqueeze(1), y.unsqueeze(1) * mean[-1], mean[:-1])
        mean = torch.cat((told, mean[-1:]))
        learned = old.learned * share + gain.unsqueeze(1) * (gain / spread)
        errors, surprises = self._errors(old, away, before.weight.nan_to_num(0.0))
        level, deviation, leaps, told = spread_with(
            y, old.level, old.spread, self._spread(old), old.leaps, old.told, since
        )
        # a sample that repeats the last one says nothing of errors, unless all have been alike
        says = seen & ~(stays & torch.eq(y, old.value) & (old.told >= 2))
        own = [
            torch.where(says, new.clamp(-most, most), old_)
            for new, old_ in zip((errors, surprises, told, level, deviation, leaps), old[4:10], strict=True)
        ]
        own.append(torch.where(seen, y, old.value))
        rate = (1 / since.clamp(min=1).double()).clamp(min=ERROR_RATE)
        moved = old.usual + rate * (before.unknown.nan_to_num(1.0) - old.usual)
        usual = torch.where(says.any(0), torch.where(since > 0, moved, 0.0), old.usual)
        good = fine & (spread > 0) & (mean.abs().amax((0, 1)) <= most) & torch.isfinite(learned.sum((0, 1)))
        parts = (old.anchor, old.last, mean, learned, *own, usual, largest)
        return StateParts._make(parts), good

    def _errors(self, old: StateParts, away: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Errors and surprises after an error of so many deviations."""
        inside = (1 + weight * (away.square() - 1)).clamp(min=0.0)
        counted = (self._amplitude(old) * root(inside)).clamp(max=1e300)
        limited, surprises = _limited(
            counted, torch.maximum(old.errors, LEAST * self._spread(old)), old.surprises, old.told
        )
        rate = (1 / (old.told - 1).clamp(min=1.0)).clamp(min=ERROR_RATE)
        errors = length((1 - rate).sqrt() * old.errors, rate.sqrt() * limited)
        return torch.where(old.told >= 2, errors, 0.0), surprises

    def _amplitude(self, old: StateParts) -> Tensor:
        """c: the prior's amplitude at first, then what errors say."""
        trust = (old.told - 2).clamp(0.0, 20.0) / 20.0
        found = length(old.errors * trust.sqrt(), root(self.base * (1 - trust)))
        return torch.maximum(found, LEAST * self._spread(old))

    def _spread(self, old: StateParts) -> Tensor:
        """Deviation of y, that of the prior where it has been constant."""
        return torch.where(old.spread > 1e-15 * old.level.abs(), old.spread, self.base**0.5)


def spread_with(
    y: Tensor, level: Tensor, spread: Tensor, size: Tensor, leaps: Tensor, told: Tensor, age: Tensor
) -> tuple[Tensor, ...]:
    """Return the running mean and deviation of y with another value: the next level, spread, leaps and told.

    The first values may be outliers, and fade sooner. As long as y is constant it counts as one value.
    ``size`` is that deviation, or another one where y has been constant, ``leaps`` counts values in a row
    that were far away, ``told`` values so far, ``age`` samples so far: of some, a first other value may be
    an outlier.
    """
    rate = torch.minimum(3 / (told + 3), 1 / (told - 40).clamp(min=1.0)).clamp(min=SPREAD_RATE)
    step, leaps = _limited((y - level).abs(), size, leaps, torch.where(told > 0, age, 0.0))
    wide = (1 - rate).sqrt() * length(spread, rate.sqrt() * step)
    counts = (wide > 0) | (told == 0)
    told = torch.where(counts, (told + 1).clamp(max=2 / SPREAD_RATE), told)
    return level + rate * torch.where(y < level, -step, step), wide, leaps, told


def _known(anchor: Tensor, x: Tensor) -> Tensor:
    """Return the anchors, x of streams that have none: a NaN would reach the gradients of all others."""
    return torch.where(torch.isnan(anchor), torch.where(torch.isfinite(x), x, 1.0), anchor)


def _limited(value: Tensor, running: Tensor, row: Tensor, told: Tensor) -> tuple[Tensor, Tensor]:
    """A value, at most so many times its running size, each in a row so many more; how many are in a row."""
    step = math.sqrt(SURPRISE)
    large = (told >= STREAK + 2) & (value > step * running)
    most = step ** (1 + row) * running
    return torch.where(large, torch.minimum(value, most), value), torch.where(
        large, (row + 1).clamp(max=100.0), 0.0
    )


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

    Returns the mean (T, S, K) and standard deviation (T, S, 1) of V, without noise, in the units of y, for x
    (T, S, n), y (T, S, K), lapse (T, S); ``state``, that at the beginning, is updated to the end.
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
