"""Mix and judge the members of a bank, in plain torch: the definition."""

from __future__ import annotations

import torch
from torch import Tensor

from ..kalman_filter import NOVEL, SURPRISE
from .rules import BLENDS, CARRIED, GROUPS, KNOTS, LOCAL, MEMBERS, QUADRATIC, Rules, group

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

    Args:
        r: the constants.
        s: parts of a stream; ``means`` and ``variances`` are what the members say.
        low: of the range in which a prediction must be, (K,).
        high: (K,).
        level: mean of y, (K,).
        wide: its spread, (K,).
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
