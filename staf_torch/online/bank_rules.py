"""The constants of the bank, and where its numbers stand in the table of a stream."""

from __future__ import annotations

import math
from typing import NamedTuple

LOCAL, CARRIED = 24, 8
MEMBERS = LOCAL + CARRIED + 2  # local processes and filters; the linear model and the last value
CLOCKS = 3
RECENT = 64  # samples that are always kept
CARRIED_WIDTH, CARRIED_RADIUS = 8.0, 0.1  # of the filters: in sqrt(n), in widths


class BankShape(NamedTuple):
    """Sizes of a bank."""

    dim: int  # n
    outputs: int  # K
    capacity: int  # C, samples kept
    neighbours: int  # k, samples of a local process


class Rules(NamedTuple):
    """What decides in a bank; chosen on public streams, those of the benchmark among them."""

    width_rates: tuple[float, ...]  # 1 / (2 width^2) of the local processes' three widths
    scaling: bool
    carried_slack: float  # distance at which the filters' centers follow
    fade_rates: tuple[float, ...] = (1e-4, 1e-6)  # by age
    noise: tuple[float, ...] = (0.09, 1e-8, 9e-4, 1e-12, 0.09, 1e-8) * 4  # a local process each
    discounts: tuple[float, ...] = (0.9, 0.97, 0.995)  # of the scores in the three mixtures
    discount: float = 0.98  # of the scores of the mixtures
    share: float = 0.01  # of the weights that is equal
    drop: float = 0.02  # members below this part of the largest weight are left out
    heavy: float = 8.0  # degrees of freedom
    likelihood: float = 0.6  # its part of a score
    members_rate: float = 0.03  # of the members' running scales
    error_rate: float = 0.02  # of the mixture's
    linear_forgetting: float = 0.999
    linear_prior: float = 100.0  # variance of the coefficients
    recent: float = RECENT
    floor: float = 1e-3  # of the variance, in running squared errors
    margin: float = 0.1  # how far beyond the range of y a member may go
    far: float = 1e3  # spreads from the center beyond which a sample is not believed
    outlying: float = 30.0  # median deviations beyond which a value has no say in the units
    learned_at: tuple[int, ...] = (2, 5, 10, 20, 40)  # samples after which the units are learned
    forgetting: tuple[float, ...] = (0.9, 0.95, 0.97, 0.98, 0.99, 0.995, 0.999, 1.0)  # of the filters
    carried_ratio: float = 1e-6  # variance of their noise

    @classmethod
    def of(cls, dim: int, scaling: bool) -> Rules:
        """The rules for inputs (n,); widths in units of sqrt(n)."""
        rates = tuple(1 / (2 * width**2 * dim) for width in (0.5, 1.5, 15.0))
        return cls(rates, scaling, CARRIED_RADIUS * CARRIED_WIDTH * math.sqrt(dim))

    def numbers(self) -> list[float]:
        """In the order of `Rules` in _bank.cpp."""
        members = [(select, pair) for select in range(4) for pair in range(6)]
        found = [*self.width_rates, *self.width_rates, *self.fade_rates, *self.noise]
        found += [pair // 2 + (3 if select == 3 else 0) for select, pair in members]
        found += [(-1, 6, 7, -1)[select] for select, _ in members]
        found += [*self.discounts, self.discount, self.share, self.drop, self.heavy, self.likelihood]
        found += [self.members_rate, self.error_rate, self.linear_forgetting, self.linear_prior, self.recent]
        found += [self.floor, self.margin, self.far, self.outlying, *self.learned_at, -1, float(self.scaling)]
        return [*found, *self.forgetting, self.carried_ratio, self.carried_slack**2]


def layout(shape: BankShape) -> list[tuple[str, tuple[int, ...]]]:
    """Names and shapes of a stream's numbers, in the order of `Stream` in _bank.cpp."""
    n, k, c, _ = shape
    filters = 2 * n + k * (n + 1) + (n + 1) ** 2 + k + 2
    return [
        *((name, ()) for name in ("clock", "count", "far", "skipped", "learned", "time")),
        ("last_x", (n,)),
        ("last_y", (k,)),
        ("asked", (n,)),
        ("answered", ()),
        ("center", (n + k,)),
        ("spread", (n + k,)),
        ("covariance", (n + 1, n + 1)),
        ("linear", (k, n + 1)),
        ("filters", (filters, CARRIED)),  # the rows of a `StreamState`, and the samples since it began
        ("weights", (k, CLOCKS, MEMBERS)),  # logarithms
        ("clock_weights", (k, CLOCKS)),
        ("excess", (k, MEMBERS)),
        *((name, (k,)) for name in ("error", "low", "high", "calibration")),
        ("means", (k, MEMBERS)),
        ("variances", (k, MEMBERS)),
        ("mixed", (k, CLOCKS)),
        ("mixed_variance", (k, CLOCKS)),
        ("mean", (k,)),
        ("variance", (k,)),
        ("x", (c, n)),
        ("y", (c, k)),
        *((name, (c,)) for name in ("when", "order", "gap")),
    ]


def size(shape: BankShape) -> int:
    """Numbers a stream."""
    return sum(math.prod(dims) for _, dims in layout(shape))
