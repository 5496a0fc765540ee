"""The constants of the bank, and where its numbers stand in the table of a stream."""

from __future__ import annotations

import math
from typing import NamedTuple

from torch import Tensor

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
