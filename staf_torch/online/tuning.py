"""Hyperparameters from a recorded stretch: all candidates are streams of one tensor batch.

Both methods begin at the best of a grid. The search draws candidates around it, twice; the gradient goes up
the likelihood by steps of Adam (Kingma and Ba, 2015) in the logarithms, from the best two of the grid.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels import GaussianKernel
from ..numerics.default_device import designed_on_cpu
from .compiled_filter import forecasts
from .filter_streams import FilterStreams, units_of
from .kalman_filter import LocalFilter
from .local_functions import LocalFunctions, OwnFunctions
from .stream_state import StreamState

_log = logging.getLogger(__name__)

WIDTHS = (0.5, 1.0, 2.0, 4.0, 8.0)  # in standard deviations of x, times sqrt(n)
NOISES = (1e-3, 1e-2, 0.1, 0.4)  # in standard deviations of y
FORGETTING = (1.0, 0.999, 0.99, 0.97)
RADII = (0.25, 0.5)  # in widths
DEFAULT = (1.0, 1e-2, 0.999)  # width, noise, forgetting of a regressor not tuned: among the candidates
ROUNDS = (0.6, 0.3)  # spread of the logarithms of the candidates around the best so far
AROUND = 48  # of these candidates a round
STARTS = 2  # of the grid, from which the gradient goes up
STEPS = 16  # that it takes
CENTERS = 15  # of which the program of a stretch is compiled in seconds
LENGTH = 0.5  # of the first of them, in logarithms; the last is a sixteenth of it
MEMORY = (0.5, 0.8)  # of Adam's means: steps are few
FADES, LEAST_NOISE = (1e-4, 0.2), 1e-5  # what is forgotten between samples, and the noise, lie beyond
SHORT = 0.35  # widths / sqrt(n), nearly what all of x covers of the widest: a coordinate with less is logged
LITTLE = 6.0  # nats, log of the number of candidates: what is worth less may be luck of the best of them
FAILS = 0.05  # share of samples that no candidate need explain
BROAD = 3.0  # standard deviations of y: width of the density that explains these
MOST = 1e100  # spreads from the center beyond which a value is none
_SHOWN = 12  # widths that a printed tuning has lines for
HARDLY = 0.02  # widths of the other coordinates: one that covers less hardly moves


class Tuning(NamedTuple):
    """Hyperparameters from a stretch, a row a stream; the kernel's width is 1 in these units of x.

    Printed it is a table of what was chosen, in units of x and y, beside the grid that was tried.
    """

    center: Tensor  # (S, n + K)
    spread: Tensor  # (S, n + K)
    ratio: Tensor  # (S,) variance of the noise in units of the process's
    forgetting: Tensor  # (S,)
    radius: Tensor  # (S,) of the centers, in widths
    likelihood: Tensor  # (S,) log of the one-step predictive density, a sample, y in standard deviations
    width: Tensor  # (S, n) in standard deviations of x; where these say nothing, that of the others
    unknown: Tensor  # (S, n) float64, 1 where the stretch says nothing about a width: it may grow
    untuned: Tensor  # (S,) likelihood by the defaults of `StaFRegressor(scaling=True)`

    @property
    def sizes(self) -> tuple[int, int, int]:
        """S, n and K, for which these hold."""
        streams, n = self.width.shape
        return streams, n, self.center.shape[1] - n

    def __repr__(self) -> str:
        """Show the median of the streams, and the least and the largest."""
        (streams, n, outputs), root = self.sizes, math.sqrt(self.width.shape[1])
        widths = f"{WIDTHS[0] * root:.3g} to {WIDTHS[-1] * root:.3g} std of x"
        noise, noises = self.ratio.sqrt(), f"{_ends(NOISES)} std of y"
        gain = f"{_spread_of(self.untuned)} untuned (`scaling=True`)"
        rows = [("", "chosen", "in standard deviations", "tried first; then around the best")]
        for k in range(min(n, _SHOWN)):
            own = _spread_of(self.spread[:, k]), f"{_spread_of(self.width[:, k])} std of x[{k}]"
            unknown = int(self.unknown[:, k].sum())
            rows.append(
                (f"width of x[{k}]", *own, widths + (f"; {unknown} not told by x" if unknown else ""))
            )
        if n > _SHOWN:
            rows.append((f"{n - _SHOWN} more widths", "in `.spread`", "in `.width`", widths))
        for k in range(outputs):
            own = _spread_of(noise * self.spread[:, n + k]), f"{_spread_of(noise)} std of y"
            rows.append((f"noise of y[{k}]" if outputs > 1 else "noise of y", *own, noises))
        rows += [
            ("forgetting", _spread_of(self.forgetting), "a unit of time", _ends(FORGETTING)),
            ("radius of centers", _spread_of(self.radius[:1]), "widths, for all streams", _ends(RADII)),
            ("log density", _spread_of(self.likelihood), "nats a sample, y in std", gain),
        ]
        a, b, c, _ = (max(map(len, column)) for column in zip(*rows, strict=True))
        head = f"Tuning of {streams} stream(s), n = {n}, {outputs} output(s), Gaussian kernel"
        head += "; medians (least to largest)" if streams > 1 else ""
        lines = (f"{name:{a}}  {own:{b}}  {std:{c}}  {tried}".rstrip() for name, own, std, tried in rows)
        return "\n".join((head, *lines))

    def keep(self, rows: Tensor) -> Tuning:
        """Keep the streams with these numbers alone; the radius stays the one that serves all."""
        return Tuning(*(part[rows] for part in self))._replace(radius=self.radius[:1].repeat(len(rows)))

    def add(self, streams: int) -> Tuning:
        """With streams that nobody has seen: typical ones, whose units are not known."""
        typical = [part.median(0).values.expand(streams, *part.shape[1:]) for part in self]
        new = Tuning(*typical)
        new = new._replace(center=new.center * torch.nan, spread=new.spread * torch.nan)
        return Tuning(*(torch.cat(pair) for pair in zip(self, new, strict=True)))


def _spread_of(values: Tensor) -> str:
    """Return the median of finite values, and the least and the largest where these differ."""
    seen = values[values.isfinite()]
    if not len(seen):
        return "learned as it goes"
    median, least, most = (f"{float(value):.4g}" for value in (seen.median(), seen.min(), seen.max()))
    return median if least == most else f"{median} ({least} to {most})"


def _ends(tried: tuple[float, ...]) -> str:
    return f"{min(tried):g} to {max(tried):g}"


class _Candidates(NamedTuple):
    width: Tensor  # (S, C, n) in standard deviations of x
    noise: Tensor  # (S, C)
    forgetting: Tensor  # (S, C)


Scores = Callable[[_Candidates], Tensor]  # likelihoods (S, C) of the later two thirds


@designed_on_cpu
def tuning(x: Tensor, y: Tensor, directions: Tensor, method: str = "search") -> Tuning:
    """Return widths a coordinate, noise, forgetting and radius a stream by the one-step predictive
    likelihood of a stretch x (T, S, n), y (T, S, K), with centers of these directions (M, n)."""
    both = torch.cat((x, y), -1).double()
    seen = torch.isfinite(both)
    learned = units_of(torch.where(seen, both, torch.nan).flatten(1))
    center, spread = (part.unflatten(0, both.shape[1:]) for part in learned)
    samples = (both - center) / spread
    samples = torch.where(samples.abs() < MOST, samples, torch.nan)
    n, streams = x.shape[-1], x.shape[1]
    widths = torch.tensor(WIDTHS, dtype=torch.float64, device="cpu") * math.sqrt(n)
    laws = (torch.tensor(each, dtype=torch.float64, device="cpu") for each in (NOISES, FORGETTING))
    rows = torch.cartesian_prod(widths, *laws)
    rows = torch.cat((rows, torch.tensor([DEFAULT], dtype=torch.float64, device="cpu")))
    first = _Candidates(*(rows[:, k].expand(streams, -1) for k in range(3)))
    first = first._replace(width=first.width.unsqueeze(-1).expand(-1, -1, n))
    found: list[tuple[Tensor, _Candidates, Tensor]] = []
    for radius in RADII:
        scored, improved = (_scores, _searched) if method == "search" else (_stretch_scores, _ascended)
        scores: Scores = functools.partial(scored, samples=samples, n=n, offsets=radius * directions)
        grid = scores(first)
        best, score = improved(first, grid, scores)
        found.append((score, best, _unknown(best, score, scores)))
    which = torch.stack([score for score, *_ in found]).argmax(0)
    one = which == 1
    (small_score, small, small_unknown), (wide_score, wide_best, wide_unknown) = found
    kept = _Candidates(*(_choose(one, b, a).squeeze(1) for a, b in zip(small, wide_best, strict=True)))
    unknown = _choose(one, wide_unknown, small_unknown)
    later = len(samples) - len(samples) // 3
    score, untuned = torch.where(one, wide_score, small_score) / later, grid[:, -1] / later
    path = torch.where(seen, both, center)[..., :n]
    extent = path.amax(0) - path.amin(0)
    width, stretch, wider = _widened(kept.width, spread[:, :n], extent, unknown)
    _warn(extent / width, width, wider)
    units = torch.cat((width, spread[:, n:]), 1)
    radii = torch.tensor(RADII, dtype=torch.float64, device="cpu")[which]
    found_ = Tuning(
        center, units, kept.noise**2, kept.forgetting, radii, score, stretch, unknown.double(), untuned
    )
    return _untold(found_, samples[..., n:])


def _untold(found: Tuning, y: Tensor) -> Tuning:
    """Give streams with an output that has one value here or none, (T, S, K), the defaults; log it."""
    apart = y.nan_to_num(nan=-torch.inf).amax(0) - y.nan_to_num(nan=torch.inf).amin(0)
    silent = ~(apart > 0).all(1)
    if not bool(silent.any()):
        return found
    _log.warning(
        "`StaFRegressor.tune(y=...)`: an output of %d of %d stream(s) (first: %d) has no two different "
        "values in this stretch: these streams keep the defaults and learn their units as they go",
        *(int(silent.sum()), len(silent), int(silent.int().argmax())),
    )
    width, noise, forgetting = DEFAULT
    lost = {"center": torch.nan, "spread": torch.nan, "ratio": noise**2}
    lost |= {"forgetting": forgetting, "width": width, "unknown": 1.0}

    def either(name: str, part: Tensor) -> Tensor:
        which = silent.reshape(-1, *[1] * (part.dim() - 1))
        return torch.where(which, lost.get(name, part), part)

    return Tuning(**{name: either(name, part) for name, part in found._asdict().items()})


def tuned_streams(
    found: Tuning,
    directions: Tensor,
    dtype: torch.dtype,
    robust: float,
    follow: float,
    periodic: tuple[int, ...],
) -> FilterStreams:
    """Streams with these hyperparameters; the radius of the first serves all."""
    n, outputs = directions.shape[1], found.center.shape[1] - directions.shape[1]
    functions = LocalFunctions.of(GaussianKernel(1.0), found.radius[0] * directions)
    law = found.ratio.clone(), found.forgetting.clone()
    filter_ = LocalFilter(functions, *law, follow * float(found.radius[0]), robust)
    state = StreamState.empty(
        torch.zeros(0, dtype=dtype, device=directions.device), len(found.ratio), n, len(directions), outputs
    )
    stretch = torch.cat((found.width, found.width.new_ones(len(found.width), outputs)), 1)
    units = torch.cat((found.center, found.spread), 1)
    return FilterStreams(filter_, state, True, units, stretch, found.unknown, periodic)


def _scores(candidates: _Candidates, samples: Tensor, n: int, offsets: Tensor) -> Tensor:
    """Log-likelihood of the later two thirds by every candidate, (S, C)."""
    streams, count, _ = candidates.width.shape
    outputs = samples.shape[-1] - n
    functions = LocalFunctions.of(GaussianKernel(1.0), offsets)
    slack = float(offsets.square().sum(-1).amax().sqrt())
    filter_ = LocalFilter(functions, candidates.noise.flatten() ** 2, candidates.forgetting.flatten(), slack)
    state = StreamState.empty(samples[:0, 0, 0], streams * count, n, len(offsets), outputs)
    lanes = FilterStreams(filter_, state, False)
    score = samples.new_zeros(streams, count)
    for k, sample in enumerate(samples):
        x = (sample[:, None, :n] / candidates.width).flatten(0, 1).contiguous()
        y = sample[:, None, n:].expand(-1, count, -1).flatten(0, 1).contiguous()
        if k > len(samples) // 3:
            mean, deviation = lanes.predict(x)
            score += _log_density(y, mean, deviation).sum(-1).unflatten(0, (streams, count))
        lanes.learn(x, y)
    return score


def _stretch_scores(candidates: _Candidates, samples: Tensor, n: int, offsets: Tensor) -> Tensor:
    """`_scores` by the program that runs the filter over a stretch, with gradients by the candidates."""
    shape, times = candidates.noise.shape, len(samples)
    x = (samples[:, :, None, :n] / candidates.width).flatten(1, 2).transpose(0, 1)
    y = samples[:, :, None, n:].expand(-1, *shape, -1).flatten(1, 2).transpose(0, 1)
    alike = OwnFunctions.of(offsets.new_ones(1), offsets.unsqueeze(0))
    functions = OwnFunctions(*(part.expand(*part.shape[:-1], len(x)) for part in alike))
    slack = float(offsets.square().sum(-1).amax().sqrt())
    law = candidates.noise.flatten() ** 2, candidates.forgetting.flatten()
    found = forecasts(LocalFilter(functions, *law, slack), x, y, x.new_ones(len(x), times))
    later = slice(times // 3 + 1, None)
    density = _log_density(y[:, later], *(part[:, later] for part in found))
    likelihood: Tensor = density.sum((1, 2)).unflatten(0, shape)
    return likelihood


def _log_density(y: Tensor, mean: Tensor, deviation: Tensor) -> Tensor:
    """log((1 - a) N(y; mean, deviation) + a b(y)) but for constants; 0 where y was not measured.

    b is a Student-t density (4 degrees of freedom, 3 standard deviations of y wide), the same for all
    candidates: a sample of a sensor that fails, which none explains, costs them alike. A density that is no
    number is a density of 0, and leaves b alone.
    """
    z = (y - mean) / deviation
    own = -0.5 * z.square() - deviation.log()
    own = torch.where(torch.isfinite(own), own, -torch.inf)
    broad = -2.5 * ((y / BROAD).square() / 4).log1p() - math.log(BROAD)
    found = torch.logaddexp(own + math.log1p(-FAILS), broad + math.log(FAILS))
    return torch.where(torch.isnan(y), 0.0, found)


def _best(candidates: _Candidates, score: Tensor) -> tuple[_Candidates, Tensor]:
    """The candidate of each stream that predicts the later two thirds best, (S, 1), and its likelihood."""
    best = score.argmax(1)
    rows = torch.arange(len(best), device="cpu")
    return _Candidates(*(part[rows, best, None] for part in candidates)), score[rows, best]


def _searched(first: _Candidates, grid: Tensor, scores: Scores) -> tuple[_Candidates, Tensor]:
    """The best of the grid and of candidates drawn around the best so far, (S, 1), and its likelihood."""
    best, score = _best(first, grid)
    draw = torch.Generator().manual_seed(0)
    for wide in ROUNDS:
        around = _around(best, wide, draw)
        again, better = _best(around, scores(around))
        gains = better > score
        best = _Candidates(*(_choose(gains, new, old) for new, old in zip(again, best, strict=True)))
        score = torch.where(gains, better, score)
    return best, score


def _ascended(first: _Candidates, grid: Tensor, scores: Scores) -> tuple[_Candidates, Tensor]:
    """The best of the grid and of what the gradient reaches from the best two, (S, 1), and its likelihood."""
    score, which = grid.topk(STARTS, 1)
    rows = torch.arange(len(which), device="cpu").unsqueeze(1)
    best = _Candidates(*(part[rows, which] for part in first))
    fades = (1 - best.forgetting).clamp(*FADES)
    at = torch.cat((best.width, best.noise.unsqueeze(-1), fades.unsqueeze(-1)), -1).log()
    mean, square = torch.zeros_like(at), torch.zeros_like(at)
    for k in range(1, STEPS + 1):
        with torch.enable_grad():
            at = at.detach().requires_grad_()
            noise = at[..., -2].exp().clamp(min=LEAST_NOISE)
            now = _Candidates(at[..., :-2].exp(), noise, 1 - at[..., -1].exp().clamp(max=FADES[1]))
            value = scores(now)
            (slope,) = torch.autograd.grad(value.sum(), at)
        gains, at = value.detach() > score, at.detach()
        score = torch.where(gains, value.detach(), score)
        best = _Candidates(*(_choose(gains, new.detach(), old) for new, old in zip(now, best, strict=True)))
        slope = slope.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
        mean, square = mean.lerp(slope, 1 - MEMORY[0]), square.lerp(slope.square(), 1 - MEMORY[1])
        size = (square / (1 - MEMORY[1] ** k)).sqrt().clamp(min=1e-12)
        at = at + LENGTH * (1 - (k - 1) / STEPS) * mean / (1 - MEMORY[0] ** k) / size
    highest = score.argmax(1, keepdim=True)
    return _Candidates(*(part[rows, highest] for part in best)), score.gather(1, highest).squeeze(1)


def _unknown(best: _Candidates, score: Tensor, scores: Scores) -> Tensor:
    """Coordinates whose widths the stretch says nothing about, (S, n): it is as likely without them.

    Coordinates that say the same are needed together, so the least needed ones are left out one after the
    other, as long as the loss of all stays below `LITTLE`.
    """
    n = best.width.shape[-1]
    alone = torch.eye(n, dtype=torch.bool, device="cpu").expand(
        len(score), -1, -1
    )  # candidate c leaves coordinate c out
    losses = score[:, None] - scores(_without(best, alone))
    rank = losses.argsort(1).argsort(1)  # 0 for the least needed
    first = (
        rank[:, None, :] <= torch.arange(n, device="cpu")[:, None]
    )  # candidate c leaves the c + 1 least needed out
    together = score[:, None] - scores(_without(best, first))
    little = (together < LITTLE).long().cumprod(1)
    return little.gather(1, rank).bool()


def _without(best: _Candidates, left_out: Tensor) -> _Candidates:
    """The best of each stream once for every choice (S, C, n) of coordinates that it does not see."""
    count = left_out.shape[1]
    width = torch.where(left_out, torch.inf, best.width)
    return _Candidates(width, best.noise.expand(-1, count), best.forgetting.expand(-1, count))


def _widened(width: Tensor, spread: Tensor, extent: Tensor, unknown: Tensor) -> tuple[Tensor, ...]:
    """Return widths in the units of x, and in standard deviations: of the others where a coordinate hardly
    moves.

    From widths in standard deviations of x, these deviations, 1 for a constant, the extent from the least x
    to the largest, and what `_unknown` says, (S, n) each. The second are those of the others wherever
    nothing is known; the third, (S, n), says which of the first are the geometric mean of the known ones
    now.
    """

    def others(values: Tensor) -> Tensor:
        """Geometric mean of the known ones, (S, 1); NaN without any."""
        return torch.where(unknown, torch.nan, values.log()).nanmean(1, keepdim=True).exp()

    own = spread * width
    typical = others(own)
    wider = unknown & (extent < HARDLY * typical)
    usual = others(width)
    stretch = torch.where(unknown & usual.isfinite(), usual, width)
    return torch.where(wider, typical, own), stretch, wider


def _warn(covered: Tensor, width: Tensor, wider: Tensor) -> None:
    """Log a line if a coordinate covers little of a width: what comes later may be beyond. ``covered`` is
    in widths, ``wider`` where the width is that of the other coordinates, (S, n) each."""
    n = covered.shape[1]
    most = SHORT / math.sqrt(n)
    if bool((covered < most).any()):
        stream, k = divmod(int(covered.argmin()), n)
        told = ", which is that of the others: it says nothing of its own" if wider[stream, k] else ""
        _log.warning(
            "`StaFRegressor.tune`: coordinate %d of stream %d covers %.2g of a width (%.3g) in this stretch%s"
            "; %d coordinate(s) in all cover less than %.2g. Either y is nearly linear in them, and there is "
            "nothing to do, or they hardly moved: tune where they move",
            *(k, stream, covered[stream, k], width[stream, k], told, int((covered < most).sum()), most),
        )


def _around(best: _Candidates, wide: float, draw: torch.Generator) -> _Candidates:
    """Candidates near the best of each stream: (S, 1, ...) -> (S, AROUND, ...)."""

    def factor(like: Tensor) -> Tensor:
        shape = (1, AROUND, *like.shape[2:])  # for all streams the same, whoever is beside them
        return (wide * torch.randn(shape, generator=draw, dtype=torch.float64, device="cpu")).exp()

    lost = (1 - best.forgetting).clamp(min=FADES[0]) * factor(best.forgetting)
    noise = (best.noise * factor(best.noise) ** 2).clamp(min=LEAST_NOISE)
    return _Candidates(best.width * factor(best.width), noise, 1 - lost.clamp(max=FADES[1]))


def _choose(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(mask.reshape(*mask.shape, *[1] * (new.dim() - mask.dim())), new, old)
