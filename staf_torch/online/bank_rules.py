"""The constants of the bank, and where its numbers stand in the table of a stream."""

from __future__ import annotations

import math
from typing import NamedTuple

from torch import Tensor

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
    """Local processes alike but for fading, latest, filters, quadratics, trackers, linear: a member's group.

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
    """What decides in a bank; chosen on public streams, those of the benchmark among them."""

    width_rates: tuple[float, ...]  # 1 / (2 width^2) of the local processes' three widths
    scaling: bool
    carried_slack: float  # distance at which the filters' centers follow
    fade_rates: tuple[float, ...] = (1e-4, 1e-6)  # by age
    noise: tuple[float, ...] = (0.09, 1e-8, 9e-4, 1e-12, 0.09, 1e-8) * 4  # a local process each
    discounts: tuple[float, ...] = (0.9, 0.97, 0.995)  # of the scores in the three mixtures
    discount: float = 0.98  # of the scores of the mixtures
    share: float = 0.001  # of the weights that is equal
    doubts: tuple[float, ...] = (
        1.0,
        0.5,
        0.25,
    )  # powers of a doubted variance that weights fall with, a mixture each
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
    learned_at: tuple[int, ...] = (
        2,
        5,
        10,
        20,
        40,
        80,
        160,
        320,
    )  # samples after which units are learned: all are kept
    forgetting: tuple[float, ...] = (0.9, 0.95, 0.97, 0.98, 0.99, 0.995, 0.999, 1.0)  # of the filters
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
    tracker_width: tuple[float, ...] = (0.5, 2.0, 2.0, 4.0, 1.0, 8.0, 4.0, 1.0)  # in sqrt(n)
    tracker_noise: tuple[float, ...] = (0.1, 1e-4, 1e-2, 0.1, 1e-4, 1e-4, 1e-4, 1e-2)  # variances
    tracker_forgetting: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0, 0.999, 0.999, 0.99, 0.99)
    tracker_rate: tuple[float, ...] = ()  # 1 / (2 width^2)
    tracker_jitter: float = 1e-6
    tracker_wrong: float = 0.1  # of an entry of 1, that rounding may add up to
    least: float = 1e-16  # of a member's running scale

    @classmethod
    def of(cls, dim: int, scaling: bool, doubtful: float | None = None) -> Rules:
        """The rules for inputs (n,); widths in units of sqrt(n)."""
        rates = tuple(1 / (2 * width**2 * dim) for width in (0.5, 1.5, 15.0))
        slack = CARRIED_RADIUS * CARRIED_WIDTH * math.sqrt(dim)
        tracker_rates = tuple(1 / (2 * width**2 * dim) for width in cls._field_defaults["tracker_width"])
        found = cls(rates, scaling, slack, tracker_rate=tracker_rates)
        return found if doubtful is None else found._replace(doubtful=doubtful, doubtful_outside=doubtful)

    def numbers(self) -> list[float]:
        """In the order of `Rules` in _bank.cpp."""
        members = [(select, pair) for select in range(4) for pair in range(6)]
        found = [*self.width_rates, *self.width_rates, *self.fade_rates, *self.noise]
        found += [pair // 2 + (3 if select == 3 else 0) for select, pair in members]
        found += [(-1, 6, 7, -1)[select] for select, _ in members]
        found += [*self.discounts, self.discount, self.share, self.drop, self.heavy, self.likelihood]
        found += [self.members_rate, self.error_rate, self.linear_forgetting, self.linear_prior, self.recent]
        found += [self.floor, self.margin, self.far, self.outlying, *self.learned_at, -1, float(self.scaling)]
        found += [*self.forgetting, self.carried_ratio, self.carried_slack**2]
        found += [*self.quadratic_forgetting, *self.quadratic_prior, self.pace, self.correction_prior]
        found += [self.correction_forgetting, self.correction_most, self.correction_discount]
        found += [
            self.correction_share,
            self.least,
            *self.doubts,
            self.doubt,
            self.doubtful,
            self.doubtful_outside,
        ]
        found += [self.outside, self.rare, self.doubted_rate, self.settled]
        found += [self.squares_discount, self.squares_rate, self.squares_share, self.own_rate]
        found += [self.best_rate, self.largest, self.uncalibrated, self.searched_at]
        found += [self.map_step, self.map_prior, self.map_forgetting]
        found += [*self.tracker_rate, *self.tracker_noise]
        return [*found, *self.tracker_forgetting, self.tracker_jitter, self.tracker_wrong]


def layout(shape: BankShape) -> list[tuple[str, tuple[int, ...]]]:
    """Names and shapes of a stream's numbers, in the order of `Stream` in _bank.cpp."""
    n, k, c, d = shape.dim, shape.outputs, shape.capacity, shape.features
    filters = 2 * n + k * (n + 1) + (n + 1) * (n + 2) // 2 + k + 2
    return [
        *((name, ()) for name in ("clock", "count", "far", "skipped", "learned", "time")),
        ("last_x", (n,)),
        ("last_y", (k,)),
        ("asked", (n,)),
        ("answered", ()),
        *((name, ()) for name in ("waiting", "trust", "doubted", "waiting_time", "waiting_lapse")),
        ("waiting_x", (n,)),  # a sample that nobody expected, until the next one tells
        ("waiting_y", (k,)),
        ("center", (n + k,)),
        ("spread", (n + k,)),
        ("covariance", (n + 1, n + 1)),
        ("linear", (k, n + 1)),
        ("filters", (filters, CARRIED)),  # the rows of a `StreamState`, and the samples since it began
        (
            "factor",
            (d * (d + 1) // 2, QUADRATIC),
        ),  # of the quadratics' covariances U D U': columns of U, D last
        ("quadratic", (k, d, QUADRATIC)),  # coefficients
        ("quadratic_error", (k, QUADRATIC)),
        ("tracked", (TRACKED, n, TRACKERS)),  # the parts of `TrackerModels`
        ("tracker_weights", (k, TRACKED, TRACKERS)),
        *((f"tracker_{name}", (TRACKED * (TRACKED + 1) // 2, TRACKERS)) for name in ("known", "inverse")),
        ("tracker_counts", (3, TRACKERS)),
        *((f"tracker_{name}", (TRACKERS,)) for name in ("rate", "noise", "forgetting")),
        ("metric", (n, n)),  # A: two trackers see A'x
        ("weights", (k, CLOCKS, MEMBERS)),  # logarithms
        ("clock_weights", (k, CLOCKS)),
        ("excess", (k, MEMBERS)),
        ("usual", (k, MEMBERS)),  # running logarithms of the members' variances
        ("squares", (k, MEMBERS)),  # logarithms of the weights by squared errors
        *((name, (k,)) for name in ("error", "pace", "own", "best", "low", "high", "calibration")),
        ("correction_covariance", (k, GROUPS, GROUPS)),
        ("correction", (k, GROUPS)),  # coefficients
        ("away", (k, GROUPS)),  # of the groups from the mixture, in running errors
        ("corrected", (k, BLENDS)),  # logarithms of the weights of the four mixtures
        ("map", (k, 2, KNOTS)),  # corrections, and what is known of them
        ("means", (k, MEMBERS)),
        ("variances", (k, MEMBERS)),
        ("mixed", (k, CLOCKS)),
        ("mixed_variance", (k, CLOCKS)),
        ("blend", (k, BLENDS)),  # the mixture, the corrected one, that by squares, what the map makes of them
        ("straight", (k,)),  # the mean without the map
        ("mean", (k,)),
        ("variance", (k,)),
        ("x", (c, n)),
        ("y", (c, k)),
        *((name, (c,)) for name in ("when", "order", "gap")),
        ("unlearned", ()),  # time that has passed in samples that were skipped
    ]


def size(shape: BankShape) -> int:
    """Numbers a stream."""
    return sum(math.prod(dims) for _, dims in layout(shape))


def refuse_unwritten(shape: BankShape, table: Tensor) -> None:
    """Refuse a saved table (S, size) with numbers that no bank writes and that compiled code goes by.

    Raises:
        ValueError: where a number of samples or a place is out of range, or a sample is not finite.
    """
    sizes = [math.prod(dims) for _, dims in layout(shape)]
    parts = dict(zip((name for name, _ in layout(shape)), table.split(sizes, dim=1), strict=True))
    turns = parts["tracker_counts"][:, -TRACKERS:]
    rules = {
        f"a number of samples from 0 to {shape.capacity}": (parts["count"] >= 0)
        & (parts["count"] <= shape.capacity),
        f"a place from 0 to {TRACKED}": (turns >= 0) & (turns <= TRACKED),
        "samples that are finite": (parts["x"].isfinite().all(1) & parts["y"].isfinite().all(1))[:, None],
    }
    for rule, holds in rules.items():
        if not bool(holds.all()):
            raise ValueError(
                f"`StaFRegressor.load_state_dict(state=...)` must have {rule}; 'table' has another."
            )
