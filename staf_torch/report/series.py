"""From runs to the curves of a sweep's figures: those that the swept settings allow, and their points."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from .collection import Collection, identity
from .cost import products_per_second
from .run import Run
from .statistics import half_width, mean
from .tabulate import as_text, rank

KERNEL, RADIUS, COUNT, SEED = "kernel", "centers.radius", "centers.count", "seed"
METRIC, FLOOR, ROUNDING = "ball_error", "ball_floor_error", "rounding_floor"
_OF_COST = ("optimizer", "predictor", "optimizer.inner_steps", "dt", COUNT, SEED)
_NAMES = {"gaussian": "Gaussian", "matern": "Matérn", "inverse_multiquadric": "inverse multiquadric"}
_MOST_PANELS = 12


class Point(NamedTuple):
    """The errors of the runs that differ by their seed: on a logarithmic axis, so of their logarithms."""

    x: float
    middle: float  # geometric mean
    low: float  # of the 95 % confidence interval; the mean for a single run
    high: float


class Curve(NamedTuple):
    """One line of a panel."""

    label: str
    points: tuple[Point, ...]
    floor: tuple[Point, ...] = ()  # with the ideal weights


class Panel(NamedTuple):
    """One panel of a figure."""

    title: str
    curves: tuple[Curve, ...]


class HeatMap(NamedTuple):
    """The errors of one panel, radius by count."""

    title: str
    radii: tuple[float, ...]
    counts: tuple[int, ...]
    errors: tuple[tuple[float | None, ...], ...]  # a row a count


class TooManyError(Exception):
    """More panels than can be read."""


def error_against_radius(found: Collection) -> list[Panel]:
    """A panel for each kernel (and for each other swept setting), a line for each count; empty: not swept."""
    runs = _usable(found, METRIC)
    if not _several(runs, RADIUS):
        return []
    panels = []
    for title, group in _panels(found, runs, (RADIUS, COUNT, SEED)):
        curves = []
        for _, line in _split(group, lambda run: run.setting(COUNT)):
            count = line[0].setting(COUNT)
            label = f"{count} centers" if isinstance(count, int) else "all centers"
            curves.append(Curve(label, _points(line, RADIUS, METRIC), _points(line, RADIUS, FLOOR)))
        panels.append(Panel(title, tuple(curves)))
    return panels


def rounding_floor(found: Collection) -> float | None:
    """The largest error that rounding of V alone explains in any of the runs."""
    floors = [run.metrics.get(ROUNDING) for run in found.rows]
    return max((floor for floor in floors if floor is not None), default=None)


def heat_maps(found: Collection) -> list[HeatMap]:
    """The error over radius and count, one map for each kernel; empty: they were not both swept."""
    runs = _usable(found, METRIC)
    if not _several(runs, RADIUS) or not _several(runs, COUNT):
        return []
    radii = tuple(
        sorted({float(r) for run in found.rows if isinstance(r := run.setting(RADIUS), int | float)})
    )
    counts = tuple(sorted({c for run in found.rows if isinstance(c := run.setting(COUNT), int)}))
    maps = []
    for title, group in _panels(found, runs, (RADIUS, COUNT, SEED)):
        cells = []
        for count in counts:
            row = _points([run for run in group if run.setting(COUNT) == count], RADIUS, METRIC)
            at = {point.x: point.middle for point in row}
            cells.append(tuple(at.get(radius) for radius in radii))
        maps.append(HeatMap(title, radii, counts, tuple(cells)))
    return maps


def cost_against_accuracy(found: Collection) -> list[Panel]:
    """Products with K a second of trajectory against the error, a line for each law and predictor."""
    runs = [run for run in _usable(found, METRIC) if products_per_second(run) is not None]
    if len({products_per_second(run) for run in runs}) < 2:
        return []
    panels = []
    for title, group in _panels(found, runs, _OF_COST):
        lines = _split(group, lambda run: f"{run.setting('optimizer')}|{run.setting('predictor')}")
        curves = [Curve(_law(line[0]), _costs(line)) for _, line in lines]
        panels.append(Panel(title, tuple(curves)))
    return panels


def _law(run: Run) -> str:
    law, predictor = (str(run.setting(key)).replace("_", " ") for key in ("optimizer", "predictor"))
    return law if predictor in ("none", "None") else f"{law}, {predictor} predictor"


def _usable(found: Collection, metric: str) -> list[Run]:
    """The runs with a number that a logarithmic axis can show."""
    return [run for run in found.rows if (run.metrics.get(metric) or 0) > 0]


def _several(runs: Sequence[Run], key: str) -> bool:
    numbers = {run.setting(key) for run in runs if isinstance(run.setting(key), int | float)}
    return len(numbers) > 1


def _panels(found: Collection, runs: Sequence[Run], inside: Sequence[str]) -> list[tuple[str, list[Run]]]:
    """The runs by all that was swept but what a panel shows, with a title each."""
    outside = [key for key in found.swept if key not in inside]
    groups = _split(runs, lambda run: json_key(run, outside))
    if len(groups) > _MOST_PANELS:
        raise TooManyError(f"{len(groups)} panels, by {', '.join(outside)}: too many to read")
    return [(_title(group[0], outside), group) for _, group in groups]


def json_key(run: Run, keys: Sequence[str]) -> str:
    """The same for runs that agree in those settings."""
    return "|".join(identity(run.setting(key)) for key in keys)


def _title(run: Run, keys: Sequence[str]) -> str:
    kernel = as_text(run.setting(KERNEL))
    if not keys:
        return f"{_NAMES.get(kernel, kernel)} kernel" if run.setting(KERNEL) else ""
    named = [key for key in keys if key != KERNEL]
    parts = [f"{_NAMES.get(kernel, kernel)} kernel"] if KERNEL in keys else []
    return ", ".join(parts + [f"{key} = {as_text(run.setting(key))}" for key in named])


def _split(runs: Sequence[Run], key: Callable[[Run], object]) -> list[tuple[object, list[Run]]]:
    """By a key: numbers in order, then the others as they came."""
    groups: dict[object, list[Run]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    return sorted(groups.items(), key=lambda item: rank(item[0]))  # type: ignore[arg-type]


def _points(runs: Sequence[Run], key: str, metric: str) -> tuple[Point, ...]:
    at: dict[float, list[float]] = {}
    for run in runs:
        x, error = run.setting(key), run.metrics.get(metric)
        if isinstance(x, int | float) and error is not None and error > 0:
            at.setdefault(float(x), []).append(error)
    return tuple(_point(x, errors) for x, errors in sorted(at.items()))


def _costs(runs: Sequence[Run]) -> tuple[Point, ...]:
    groups: Mapping[str, list[Run]] = dict(_split(runs, lambda run: json_key(run, _OF_COST[:-1])))  # type: ignore[arg-type]
    points = []
    for group in groups.values():
        cost = products_per_second(group[0])
        assert cost is not None
        points.append(_point(cost, [error for run in group if (error := run.metrics[METRIC]) is not None]))
    return tuple(sorted(points))


def _point(x: float, errors: Sequence[float]) -> Point:
    if len(set(errors)) == 1:  # one seed says nothing about the spread, and equal errors have none
        return Point(x, errors[0], errors[0], errors[0])
    logs = [math.log(error) for error in errors]
    middle, width = mean(logs), half_width(logs)
    assert width is not None
    return Point(x, math.exp(middle), math.exp(middle - width), math.exp(middle + width))
