"""Constants of the bank, where its numbers stand, and its rules of mixing and judging: the definition."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..kalman_filter import NOVEL, SURPRISE
from ..stream_state import rows_of

LOCAL, CARRIED, QUADRATIC, TRACKERS = 24, 8, 8, 8
MEMBERS = LOCAL + CARRIED + QUADRATIC + TRACKERS + 2  # ... and the linear model, the last value
CLOCKS, BLENDS = 3, 4
KNOTS = 33  # of the map of the mean
GROUPS = 11  # of members whose predictions correct the mixture: see `group`
MOST_FEATURES = 120  # of a quadratic model: beyond, squares without products, or the coordinates alone
TRACKED = 96  # places for the samples of a tracker
SEARCHED = 128  # samples by whose likelihood hyperparameters of trackers are learned
TURNED, PLAIN, FADING, TURNED_FADING = 0, 1, 4, 5  # these trackers
RECENT = 64  # samples that are always kept
CARRIED_WIDTH, CARRIED_RADIUS = 8.0, 0.1  # of the filters: in sqrt(n), in widths


def group(member: int) -> int:
    """Return the number of a member's group: processes alike but for fading, latest, ..., trackers, linear.

    -1 for the last value, which has no say in the correction.
    """
    if member < 18:
        return member % 6
    if member >= MEMBERS - 2:
        return 10 if member == MEMBERS - 2 else -1
    return 6 + (member - 18) // 6 if member < LOCAL else 7 + (member - LOCAL) // 8


class BankShape(NamedTuple):
    """Sizes of a bank."""

    dim: int  # n
    outputs: int  # K
    capacity: int  # C, samples kept
    neighbours: int  # k, samples of a local process

    @property
    def features(self) -> int:
        """Coefficients of a quadratic model."""
        n = self.dim
        return next((d for d in ((n + 1) * (n + 2) // 2, 2 * n + 1) if d <= MOST_FEATURES), n + 1)


class Rules(NamedTuple):
    """Constants of a bank, in the order of `Rules` in _bank.hpp; chosen on public streams."""

    width_rates: tuple[float, ...]  # 1 / (2 width^2) of the local processes' three widths
    tracker_rate: tuple[float, ...]  # 1 / (2 width^2)
    scaling: bool
    carried_slack: float  # distance at which the filters' centers follow
    fade_rates: tuple[float, ...] = (1e-4, 1e-6)  # by age
    noise: tuple[float, ...] = (0.09, 1e-8, 9e-4, 1e-12, 0.09, 1e-8) * 4  # in units of a process's amplitude
    discounts: tuple[float, ...] = (0.9, 0.97, 0.995)  # of the scores in the three mixtures
    discount: float = 0.98  # of the scores of the mixtures
    share: float = 0.001  # of the weights that is equal
    doubts: tuple[float, ...] = (1.0, 0.5, 0.25)  # powers of a doubted variance that weights fall with
    doubt: float = 0.5  # ... by squared errors
    drop: float = 0.02  # members below this part of the largest weight are left out
    heavy: float = 8.0  # degrees of freedom
    likelihood: float = 0.6  # its part of a score
    members_rate: float = 0.03  # of the members' running scales
    error_rate: float = 0.02  # of the mixture's
    linear_forgetting: float = 0.999
    linear_prior: float = 100.0  # variance of the coefficients
    recent: float = RECENT
    floor: float = 0.05  # of the variance, in running squared errors
    uncalibrated: float = 3.0  # samples before the errors have a say in the size of the variance
    margin: float = 0.1  # how far beyond the range of y a member may go
    far: float = 1e3  # spreads from the center beyond which a sample is not believed
    doubtful: float = 30.0  # deviations beyond which a sample waits for another one such to be believed
    doubtful_outside: float = 8.0  # the same for an error of more than ``outside`` spreads of y
    outside: float = 12.0
    rare: float = 0.05  # share of samples that are doubted: beyond, none waits
    doubted_rate: float = 0.01  # of this running share
    settled: float = 10.0  # samples before which none waits
    outlying: float = 30.0  # median deviations beyond which a value has no say in the units
    learned_at: tuple[int, ...] = (2, 5, 10, 20, 40, 80, 160, 320)  # samples after which units are learned
    carried_forgetting: tuple[float, ...] = (0.9, 0.95, 0.97, 0.98, 0.99, 0.995, 0.999, 1.0)  # of the filters
    carried_ratio: float = 1e-6  # variance of their noise
    quadratic_forgetting: tuple[float, ...] = (0.9999, 0.9999, 0.9999, 0.9999, 0.998, 0.99, 0.99, 0.97)
    quadratic_prior: tuple[float, ...] = (1e8, 1e4, 1e2, 1.0, 1e4, 1e4, 10.0, 1e2)  # of their coefficients
    pace: float = 0.1  # of the error that the correction and the quadratics are measured by
    correction_prior: float = 0.1  # variance of the correction's coefficients
    correction_forgetting: float = 0.999
    correction_most: float = 4.0  # running errors that a group may be away from the mixture
    correction_discount: float = 0.995  # of the scores of the four mixtures
    correction_share: float = 0.01  # of their weights that is equal
    squares_discount: float = 0.999  # of the members' squared errors in the mixture by squares
    squares_rate: float = 0.1  # of their running mean that a squared error counts
    squares_share: float = 0.001
    own_rate: float = 0.05  # of the running squared error of the prediction
    best_rate: float = 0.005  # of the least one of the four mixtures
    largest: float = 400.0  # running squares that a square counts at most there
    searched_at: float = 40.0  # samples from which hyperparameters of trackers are learned with the units
    map_step: float = 0.25  # between knots, in units of y
    map_prior: float = 10.0  # samples that say that the map is the identity
    map_forgetting: float = 0.995
    tracker_noise: tuple[float, ...] = (0.1, 1e-4, 1e-2, 0.1, 1e-4, 1e-4, 1e-4, 1e-2)  # variances
    tracker_forgetting: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0, 0.999, 0.999, 0.99, 0.99)
    tracker_jitter: float = 1e-6
    tracker_wrong: float = 0.1  # of an entry of 1, that rounding may add up to
    least: float = 1e-16  # of a member's running scale

    @classmethod
    def of(cls, dim: int, scaling: bool, doubtful: float | None = None) -> Rules:
        """Return the rules for inputs (n,); widths in units of sqrt(n)."""
        local, trackers = (0.5, 1.5, 15.0), (0.5, 2.0, 2.0, 4.0, 1.0, 8.0, 4.0, 1.0)
        rates, tracker_rates = (tuple(1 / (2 * w**2 * dim) for w in widths) for widths in (local, trackers))
        found = cls(rates, tracker_rates, scaling, CARRIED_RADIUS * CARRIED_WIDTH * math.sqrt(dim))
        return found if doubtful is None else found._replace(doubtful=doubtful, doubtful_outside=doubtful)

    def numbers(self) -> list[float]:
        """Return all constants, one after the other."""
        return [float(x) for field in self for x in (field if isinstance(field, tuple) else (field,))]


def layout(shape: BankShape) -> list[tuple[str, tuple[int, ...]]]:
    """Return names and shapes of a stream's numbers, in the order of `Stream` in _bank.hpp."""
    n, k, c, d = shape.dim, shape.outputs, shape.capacity, shape.features
    filters = rows_of(n, n + 1, k) + 1
    return [
        *((name, ()) for name in ("clock", "count", "far", "skipped", "learned", "time")),
        *(("last_x", (n,)), ("last_y", (k,))),
        *((name, ()) for name in ("waiting", "trust", "doubted", "waiting_time", "waiting_lapse")),
        *(("waiting_x", (n,)), ("waiting_y", (k,))),  # an unexpected sample, until the next one tells
        *(("center", (n + k,)), ("spread", (n + k,))),
        *(("covariance", (n + 1, n + 1)), ("linear", (k, n + 1))),
        ("filters", (filters, CARRIED)),  # the rows of a `StreamState`, and the samples since it began
        ("factor", (d * (d + 1) // 2, QUADRATIC)),  # of covariances U D U': columns of U, D last
        *(("quadratic", (k, d, QUADRATIC)), ("quadratic_error", (k, QUADRATIC))),  # coefficients
        ("tracked", (TRACKED, n, TRACKERS)),  # this and the next four: parts of `TrackerModels`
        ("tracker_weights", (k, TRACKED, TRACKERS)),
        *((f"tracker_{name}", (TRACKED * (TRACKED + 1) // 2, TRACKERS)) for name in ("known", "inverse")),
        ("tracker_counts", (3, TRACKERS)),
        *((f"tracker_{name}", (TRACKERS,)) for name in ("rate", "noise", "forgetting")),
        ("metric", (n, n)),  # A: two trackers see A'x
        *(("weights", (k, CLOCKS, MEMBERS)), ("clock_weights", (k, CLOCKS))),  # logarithms
        *(("excess", (k, MEMBERS)), ("usual", (k, MEMBERS))),  # running scales; logarithms of variances
        ("squares", (k, MEMBERS)),  # logarithms of the weights by squared errors
        *((name, (k,)) for name in ("error", "pace", "own", "best", "low", "high", "calibration")),
        *(
            (name, (k,)) for name in ("level", "wide", "leaps", "told")
        ),  # mean and spread of y: see `spread_with`
        ("surprises", (k,)),  # in a row
        ("usual_unknown", ()),  # running share of the variance of a local process that is unknown
        *(("correction_covariance", (k, GROUPS, GROUPS)), ("correction", (k, GROUPS))),  # coefficients
        ("corrected", (k, BLENDS)),  # logarithms of the weights of the four mixtures
        ("map", (k, 2, KNOTS)),  # corrections, and what is known of them
        *(("x", (c, n)), ("y", (c, k)), *((name, (c,)) for name in ("when", "order", "gap"))),
        ("unlearned", ()),  # time that has passed in samples that were skipped
    ]


def answer_layout(shape: BankShape) -> list[tuple[str, tuple[int, ...]]]:
    """Return names and shapes of a stream's answer to one question, in the order of `Answer` in _bank.hpp."""
    n, k = shape.dim, shape.outputs
    return [
        *(("asked", (n,)), ("answered", ())),  # where, and whether the stream is still as it was then
        ("unknown", ()),  # share of the variance of a local process
        ("weight", (k,)),  # of the variance, what the errors say
        ("away", (k, GROUPS)),  # of the groups from the mixture, in running errors
        *((name, (k, MEMBERS)) for name in ("means", "variances")),
        *((name, (k, CLOCKS)) for name in ("mixed", "mixed_variance")),
        ("blend", (k, BLENDS)),  # the mixture, the corrected one, that by squares, what the map makes of them
        *(("straight", (k,)), ("mean", (k,)), ("variance", (k,))),  # straight: the mean without the map
    ]


def parts(fields: list[tuple[str, tuple[int, ...]]], table: Tensor) -> dict[str, Tensor]:
    """Return views of the numbers of streams (..., size) by name, (..., *dims)."""
    split = table.split([math.prod(dims) for _, dims in fields], dim=-1)
    return {
        name: part.unflatten(-1, dims) if dims else part.squeeze(-1)
        for (name, dims), part in zip(fields, split, strict=True)
    }


def size(fields: list[tuple[str, tuple[int, ...]]]) -> int:
    """Return the count of numbers a stream."""
    return sum(math.prod(dims) for _, dims in fields)


def refuse_unwritten(shape: BankShape, table: Tensor) -> None:
    """Refuse a saved table (S, size) with numbers that no bank writes and that compiled code goes by: a
    number of samples or a place out of range, a sample that is not finite."""
    named = parts(layout(shape), table)
    count, turns = named["count"], named["tracker_counts"][:, -1]
    rules = {
        f"a number of samples from 0 to {shape.capacity}": (count >= 0) & (count <= shape.capacity),
        f"a place from 0 to {TRACKED}": (turns >= 0) & (turns <= TRACKED),
        "samples that are finite": named["x"].isfinite().all() & named["y"].isfinite().all(),
    }
    for rule, holds in rules.items():
        if not bool(holds.all()):
            raise ValueError(f"`load_state_dict(state=...)` must have {rule}; 'table' has another.")


_LEAST = 1e-30  # of a variance
_STILL = 1e-4  # variance, in units, of what has been constant so far
_GROUP = torch.tensor([group(member) for member in range(MEMBERS)], dtype=torch.int64, device="cpu")


def constant(s: dict[str, Tensor]) -> Tensor:
    """Outputs that have been constant so far, (K,)."""
    return ~(s["wide"] > 1e-15 * s["level"].abs())


def _let_go(s: dict[str, Tensor], level: Tensor, wide: Tensor) -> None:
    """Away from the samples the band goes over to the spread of y around its mean, (K,), in units."""
    usual, still = s["usual_unknown"], constant(s)
    most = torch.minimum(NOVEL * usual, 1 - (1 - usual) / 4)
    away = ((s["unknown"] - most) / (1 - most).clamp(min=1e-9)).clamp(0.0, 1.0)
    far = torch.where(still, 1.0, wide.square()) + (s["mean"] - level).square()
    near = torch.where(still, s["variance"].clamp(min=_STILL), s["variance"])
    s["variance"].copy_(near + away * (far - near))
    s["weight"].copy_(torch.where(near < far, (1 - away) * near / s["variance"], 1.0))


def mix(r: Rules, s: dict[str, Tensor], low: Tensor, high: Tensor, level: Tensor, wide: Tensor) -> None:
    """The mixture of what the members say, and its variance: a mixture of four.

    A member that is less certain than it usually is has less weight, as far as another one is more certain
    than it. First, three mixtures by scores that fade at three rates are mixed by their own scores; the
    faster they fade, the more counts how certain a member is. Second, to that is added
    sum_g beta_g (m_g - first), m_g the mean of a group by the scores that fade most slowly, beta by least
    squares. Third, the members by their squared errors over a long time, which rare large errors decide. The
    three are weighed by how they predict, and one far behind the best has no weight. Fourth, what usually
    follows where these three say what they say, which is another value where a function saturates or a target
    has few values; it is weighed alike.
    """
    means = s["means"]
    claims = s["variances"].clamp(min=_LEAST).log()
    behind = claims + s["excess"].log()
    surplus = torch.minimum(claims - s["usual"], behind - behind.amin(-1, keepdim=True)).clamp(min=0.0)
    logs = (
        s["weights"] - torch.tensor(r.doubts, dtype=torch.float64, device="cpu")[:, None] * surplus[:, None]
    )
    weights = (logs - logs.amax(-1, keepdim=True)).exp()
    weights = torch.where(weights < r.drop, 0.0, weights)
    weights = weights / weights.sum(-1, keepdim=True)  # (K, clocks, members)
    middle = (weights * means[:, None]).sum(-1)
    own = (s["variances"] * s["excess"])[:, None] + (means[:, None] - middle[..., None]).square()
    s["mixed"].copy_(middle)
    s["mixed_variance"].copy_((weights * own).sum(-1))
    clocks = s["clock_weights"].softmax(-1)
    blend = (clocks * middle).sum(-1)
    variance = (clocks * (s["mixed_variance"] + (middle - blend[:, None]).square())).sum(-1)
    unit = s["pace"].clamp(min=_LEAST).sqrt()
    for g in range(GROUPS):
        inside = torch.eq(_GROUP, g)
        share = logs[:, -1, inside].softmax(-1)
        s["away"][:, g] = ((share * means[:, inside]).sum(-1) - blend) / unit
    s["away"].clamp_(-r.correction_most, r.correction_most)
    stacked = blend + unit * (s["correction"] * s["away"]).sum(-1)
    squared = ((s["squares"] - r.doubt * surplus).softmax(-1) * means).sum(-1)
    straight = torch.stack((blend, torch.maximum(torch.minimum(stacked, high), low), squared), -1)
    s["straight"].copy_(_weighed(r, s["corrected"][:, : BLENDS - 1], straight))
    knots, parts = _knots(r, s["straight"])
    mapped = s["straight"] + (parts * s["map"][:, 0].gather(1, knots)).sum(-1)
    mapped = torch.maximum(torch.minimum(mapped, high), low)
    s["blend"].copy_(torch.cat((straight, mapped[:, None]), -1))
    s["mean"].copy_(_weighed(r, s["corrected"], s["blend"]))
    variance = variance + (s["mean"] - blend).square()
    s["variance"].copy_(torch.maximum(variance, r.floor * s["pace"]) * s["calibration"])
    _let_go(s, level, wide)


def _weighed(r: Rules, logs: Tensor, values: Tensor) -> Tensor:
    """Means of values (K, B) by the logarithms of weights, of which small ones are dropped: (K,)."""
    parts = (logs - logs.amax(-1, keepdim=True)).exp()
    parts = torch.where(parts < r.drop, 0.0, parts)
    return (parts * values).sum(-1) / parts.sum(-1)


def _knots(r: Rules, mean: Tensor) -> tuple[Tensor, Tensor]:
    """The two knots of the map around a mean (K,), and the parts that they have in it: (K, 2), (K, 2)."""
    place = (mean / r.map_step + KNOTS // 2).clamp(0, KNOTS - 1)
    knot = place.long().clamp(max=KNOTS - 2)
    part = place - knot
    return torch.stack((knot, knot + 1), -1), torch.stack((1 - part, part), -1)


def _learn_map(r: Rules, s: dict[str, Tensor], value: Tensor, told: Tensor) -> None:
    """The map of the mean learns by least squares, each of two knots as if it stood alone."""
    knots, parts = _knots(r, s["straight"])
    for o in told.nonzero().flatten().tolist():
        at, part, (correction, known) = knots[o], parts[o], s["map"][o]
        error = value[o] - s["straight"][o] - (part * correction[at]).sum()
        known[at] = known[at] * (1 - (1 - r.map_forgetting) * part) + part.square()
        correction[at] += part * error / (known[at] + r.map_prior)


def judge(r: Rules, s: dict[str, Tensor], value: Tensor, told: Tensor, t: float) -> None:
    """Judge the members and their mixtures by their prediction of value (K,), where it was told (K,)
    bool; t samples were learned so far."""

    def put(name: str, new: Tensor) -> None:
        s[name].copy_(torch.where(told.view(-1, *[1] * (new.dim() - 1)), new, s[name]))

    error, blended = value - s["mean"], value - s["blend"][:, 0]
    _learn_correction(r, s, blended, told)
    _learn_map(r, s, value, told)
    old, since = s["calibration"], t - r.uncalibrated
    z2 = error.square() / s["variance"].clamp(min=1e-300)
    row = SURPRISE ** s["surprises"]  # each in a row may be so many times larger
    rate = max(r.error_rate, 1 / (since + 5)) if since > 0 else 0.0
    surprised = torch.minimum((s["weight"] * (z2 - 1)).clamp(min=-1.0), SURPRISE * row - 1)
    put("calibration", (old + rate * surprised * old).clamp(1e-6, 1e2))
    of_blends = (value[:, None] - s["blend"]).square()
    scores = _student(r, of_blends.sqrt(), s["own"].clamp(min=_LEAST)[:, None])
    corrected = _reweighed(r.correction_share, r.correction_discount * s["corrected"] + scores)
    costs = ((value[:, None] - s["means"]).square() / s["best"].clamp(min=_LEAST)[:, None]).clamp(max=1e9)
    squares = _reweighed(r.squares_share, r.squares_discount * s["squares"] - r.squares_rate * costs)
    for name, found, rate, most in (
        ("error", blended.square(), r.error_rate, SURPRISE),
        ("pace", blended.square(), r.pace, SURPRISE),
        ("own", error.square(), r.own_rate, r.largest),
        ("best", of_blends.amin(-1), r.best_rate, r.largest),
    ):
        old = s[name]
        step = max(rate, 1 / (t + 1)) * (torch.minimum(found, most * row * old) - old)
        put(name, (old + step).clamp(min=_LEAST))
    away, v = value[:, None] - s["means"], s["variances"]
    score = _scores(r, away, v * s["excess"], s["error"][:, None])
    over = _scores(r, value[:, None] - s["mixed"], s["mixed_variance"], s["error"][:, None])
    old, rate = s["excess"], max(r.members_rate, 1 / (t + 3))
    ratio, logs = away.square() / v.clamp(min=_LEAST), v.clamp(min=_LEAST).log()
    larger = SURPRISE * row[:, None]
    put("excess", (old + rate * (torch.minimum(ratio, larger * old) - old)).clamp(r.least, 1e8))
    put("usual", s["usual"] + max(r.members_rate, 1 / (t + 1)) * (logs - s["usual"]))
    of = slice(LOCAL + CARRIED, LOCAL + CARRIED + QUADRATIC)
    factor = 1 + max(r.pace, 1 / (t + 2)) * (torch.minimum(ratio[:, of], larger) - 1)
    put("quadratic_error", (s["quadratic_error"] * factor).clamp(min=1e-26))
    discounts = torch.tensor(r.discounts, dtype=torch.float64, device="cpu")[:, None]
    put("weights", _reweighed(r.share, discounts * s["weights"] + score[:, None]))
    put("clock_weights", _reweighed(r.share, r.discount * s["clock_weights"] + over))
    put("surprises", torch.where(z2 > SURPRISE, (s["surprises"] + 1).clamp(max=40.0), 0.0))
    put("corrected", corrected)
    put("squares", squares)


def _learn_correction(r: Rules, s: dict[str, Tensor], blended: Tensor, told: Tensor) -> None:
    """Least squares of the mixture's error on the groups' distance from it, both in running errors."""
    most = r.correction_most
    unit = s["pace"].clamp(min=_LEAST).sqrt()
    for o in told.nonzero().flatten().tolist():
        away, covariance = s["away"][o], s["correction_covariance"][o]
        target = (blended[o] / unit[o]).clamp(-most, most)
        gain = covariance @ away
        total = r.correction_forgetting + away @ gain
        s["correction"][o] += gain * ((target - s["correction"][o] @ away) / total)
        covariance -= gain[:, None] * gain / total
        if float(covariance.diagonal().max()) < r.correction_prior:
            covariance /= r.correction_forgetting


def _student(r: Rules, error: Tensor, variance: Tensor) -> Tensor:
    return -0.5 * (r.heavy + 1) * (error.square() / (r.heavy * variance)).log1p()


def _scores(r: Rules, error: Tensor, variance: Tensor, common: Tensor) -> Tensor:
    """Part Student-t likelihood with a member's variance, part with the common squared error."""
    variance, common = variance.clamp(min=_LEAST), common.clamp(min=_LEAST)
    own = _student(r, error, variance) - 0.5 * variance.log()
    return r.likelihood * own + (1 - r.likelihood) * _student(r, error, common)


def _reweighed(share: float, logs: Tensor) -> Tensor:
    """Logarithms of the normalised weights, a share of them equal."""
    return ((1 - share) * logs.softmax(-1) + share / logs.shape[-1]).log()
