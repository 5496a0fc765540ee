"""What is said about the numbers of a group of runs."""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Callable, Mapping, Sequence

_SERIES = 200  # degrees of freedom from which the expansion is more accurate than 1e-12


def mean(numbers: Sequence[float]) -> float:
    """The arithmetic mean."""
    return math.fsum(number / len(numbers) for number in numbers)


def deviation(numbers: Sequence[float]) -> float | None:
    """The standard deviation with n - 1; None for a single number."""
    if len(numbers) < 2:
        return None
    middle = mean(numbers)
    return math.hypot(*(number - middle for number in numbers)) / math.sqrt(len(numbers) - 1)


def half_width(numbers: Sequence[float]) -> float | None:
    """Half the width of the 95 % confidence interval of the mean, t s / sqrt(n); None for a single number."""
    s = deviation(numbers)
    if s is None:
        return None
    return student_quantile(len(numbers) - 1) * s / math.sqrt(len(numbers))


AGGREGATES: Mapping[str, Callable[[Sequence[float]], float | None]] = {
    "mean": mean,
    "std": deviation,
    "ci95": half_width,
    "min": min,
    "max": max,
    "median": statistics.median,
}
"""By the names of `staf-table --aggregate`; each of one or more finite numbers."""


@functools.cache
def student_quantile(freedom: int) -> float:
    """t with P(|T| <= t) = 0.95 for Student's T with that many degrees of freedom, at least 1.

    With theta = atan(t / sqrt(freedom)) the probability is a finite sum of sin(theta) cos(theta)^k, which is
    solved by bisection; for many degrees of freedom, the expansion around the normal quantile.

    Source: Abramowitz and Stegun, 26.7.3, 26.7.4 and 26.7.5.
    """
    if freedom >= _SERIES:
        return _expansion(freedom)
    low, high = 0.0, math.pi / 2
    while True:
        theta = (low + high) / 2
        if theta in (low, high):
            return math.tan(theta) * math.sqrt(freedom)
        if _probability(theta, freedom) < 0.95:
            low = theta
        else:
            high = theta


def _probability(theta: float, freedom: int) -> float:
    """P(|T| <= sqrt(freedom) tan(theta))."""
    odd = freedom % 2
    cosine = math.cos(theta)
    term = math.sin(theta) * (cosine if odd else 1.0)
    terms = []
    for k in range(1 + odd, freedom, 2):  # the next factor is k / (k + 1) cos^2
        terms.append(term)
        term *= k / (k + 1) * cosine**2
    total = math.fsum(terms)
    return 2 / math.pi * (theta + total) if odd else total


def _expansion(freedom: int) -> float:
    x = statistics.NormalDist().inv_cdf(0.975)
    terms = (
        x,
        (x**3 + x) / 4,
        (5 * x**5 + 16 * x**3 + 3 * x) / 96,
        (3 * x**7 + 19 * x**5 + 17 * x**3 - 15 * x) / 384,
        (79 * x**9 + 776 * x**7 + 1482 * x**5 - 1920 * x**3 - 945 * x) / 92160,
    )
    return math.fsum(term / freedom**k for k, term in enumerate(terms))
