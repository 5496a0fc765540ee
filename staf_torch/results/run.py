"""A run as it is read back, and a collection of runs: plain values, whoever wrote them."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections import ChainMap
from collections.abc import Collection as Collection_
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from .._version import __version__
from .build import shortened
from .files import Value, is_free, is_number, visible

ABOUT = ("task", "status", "reason", "seconds", "version", "build", "directory", "row")
"""What can be a column of a table beside settings and metrics."""
_SHOWN = 1  # headlines in the short form of a run
_NAMED = 3  # values of a setting that a remark names


@dataclasses.dataclass(frozen=True, repr=False)
class RecordedRun:
    """A run, or a row of a sweep's table: what it was, how it ended, what it measured.

    Example:
        >>> done = sweep("centers.radius=0.1,0.2", "duration=0.1", "settle_time=0", "figures=false")
        >>> done[0].status, done[0].setting("centers.radius")
        ('completed', 0.1)

        Shown by `staf-table runs`.
    """

    directory: Path
    overrides: Mapping[str, Value]  # key -> value, as typed
    settings: Mapping[str, Value]  # all of them, with dotted keys; the option of a group under its name
    metrics: Mapping[str, float | None]  # None: nothing to report, or not finite
    status: str
    reason: str | None = None  # why there is no result, or something else that a reader should know
    row: int | None = None  # its number in the table of a sweep
    version: str | None = None  # of the staf_torch that wrote it
    task: str | None = None
    seconds: float | None = None
    declared: Mapping[str, MetricInfo] = dataclasses.field(default_factory=dict)  # of the user's own metrics
    lost: Mapping[str, str] = dataclasses.field(default_factory=dict)  # metric -> what stood there instead
    build: str | None = None  # what else made the numbers: source, torch, compiler
    modules: Mapping[str, str] = dataclasses.field(default_factory=dict)  # the user's own -> hash
    began: str | None = None  # date and time, ISO 8601, UTC
    machine: str | None = None
    python: str | None = None  # its version
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)  # of the plant: state, input

    def __repr__(self) -> str:
        """`<Run completed: kernel=gaussian, ball_error=0.0762>`: overrides and the first headlines."""
        words = (f"{key}={_typed(value)}" for key, value in self.overrides.items())
        typed = " ".join(words) or "no overrides"
        shown = [name for name in HEADLINES if self.metrics.get(name) is not None][:_SHOWN]
        return f"<Run {self.status}: {', '.join([typed, *(f'{n}={self.metrics[n]:.3g}' for n in shown)])}>"

    def setting(self, key: str) -> Value:
        """Return the setting of that key, as composed where that is known, else as typed."""
        return self.settings[key] if key in self.settings else self.overrides.get(key)

    def value(self, key: str) -> Value:
        """Return anything about the run that has a name: a metric, one of `ABOUT`, or a setting."""
        if key in self.metrics:
            return self.metrics[key]
        if key == "build" and self.modules:
            return f"{self.build} modules {shortened(dict(self.modules))}"
        if key in ABOUT:
            found = getattr(self, key)
            return visible(str(found)) if isinstance(found, Path) else found
        return self.setting(key)

    def absence(self, metric: str) -> str:
        """Say why there is no number under that metric."""
        if metric in self.lost:
            return f"was {self.lost[metric]}, which is not a number"
        if self.reason is not None:
            return self.reason
        if metric in self.metrics:
            return "not finite, or nothing to report"
        return "this run has no such metric"


@dataclasses.dataclass(frozen=True)
class Skipped:
    """Something without a row, or with a row that is not as it should be."""

    path: Path
    reason: str


@dataclasses.dataclass(frozen=True)
class Collection:
    """The runs that `collect` found.

    Example:
        >>> done = sweep("centers.radius=0.1,0.2", "duration=0.1", "settle_time=0", "figures=false")
        >>> found = collect([run.directory for run in done])
        >>> len(found.rows), found.skipped
        (2, ())

        Shown by `staf-table runs`.
    """

    rows: tuple[RecordedRun, ...]  # in the order of the sweep
    skipped: tuple[Skipped, ...]  # what has no row, and why
    remarks: tuple[str, ...] = ()  # what a reader of the rows should know

    @functools.cached_property
    def metrics(self) -> tuple[str, ...]:
        """The names of all metrics, in the order in which runs wrote them."""
        return tuple(dict.fromkeys(name for run in self.rows for name in run.metrics))

    @functools.cached_property
    def infos(self) -> dict[str, MetricInfo]:
        """Return what the library, or the runs for metrics of the user's own, declare of each metric."""
        known = {info.name: info for info in OWN}
        for declared in {id(run.declared): run.declared for run in self.rows}.values():
            known |= declared
        return {name: known.get(name, MetricInfo(name)) for name in self.metrics}

    @functools.cached_property
    def keys(self) -> tuple[str, ...]:
        """The names of everything but metrics that can be a column."""
        settings = dict.fromkeys(key for settings in self._settings for key in settings)
        return (*(self._overridden | settings), *ABOUT)

    @functools.cached_property
    def _overridden(self) -> dict[str, None]:
        return dict.fromkeys(key for run in self.rows for key in run.overrides)

    @functools.cached_property
    def swept(self) -> tuple[str, ...]:
        """The overridden settings that differ between runs; of a single run, those that were overridden.

        Those that change no number, such as `figures`, are none.
        """
        typed = [key for key in self._overridden if not is_free(key)]
        if len(self.rows) == 1:
            return tuple(typed)
        found = [k for k in typed if len({identity(run.setting(k)) for run in self.rows}) > 1]
        return (*found, *self.unswept)

    @functools.cached_property
    def unswept(self) -> tuple[str, ...]:
        """Settings that differ between runs although nobody overrode them, and `build` where that differs.

        Somebody edited a file between two of the runs. What an interpolation takes from an override is none,
        nor are the user's modules that only some runs need: the option that names them is a setting.
        """
        overridden = self._overridden
        words = [key for key in overridden if any(isinstance(run.setting(key), str) for run in self.rows)]
        first: dict[tuple[str, ...], RecordedRun] = {}
        seen: set[int] = set()
        found: dict[str, None] = {}
        for run in self.rows:
            base = layers(run.settings)[-1]
            if id(base) in seen or not base:  # rows of a table share theirs
                continue
            seen.add(id(base))
            other = first.setdefault(tuple(identity(run.setting(key)) for key in words), run)
            if other is not run:
                found |= dict.fromkeys(_differ(run, other))
        builds = {run.build for run in self.rows}
        hashes = {module for run in self.rows for module in run.modules.items()}
        differ = len(builds) > 1 or len(hashes) > len({name for name, _ in hashes})
        told = (key for key in found if not is_free(key) and not _explained(key, overridden))
        return (*told, *["build"] * differ)

    @functools.cached_property
    def _settings(self) -> list[Mapping[str, Value]]:
        """The settings of all runs, those that rows of a table share once."""
        return list({id(part): part for run in self.rows for part in layers(run.settings)}.values())


def _differ(run: RecordedRun, other: RecordedRun) -> Iterator[str]:
    """The settings in which two runs differ, where neither takes its value from an override of its own."""
    one, two = layers(run.settings)[-1], layers(other.settings)[-1]
    for key in {**one, **two}:
        if one.get(key) != two.get(key):
            ours, theirs = (v if isinstance(v, list) else [v] for v in (one.get(key), two.get(key)))
            mine, others = (list(each.overrides.values()) for each in (run, other))
            if len(ours) != len(theirs) or any(
                a != b and a not in mine and b not in others for a, b in zip(ours, theirs, strict=True)
            ):
                yield key


def _explained(key: str, overridden: Collection_[str]) -> bool:
    """Return whether a key is overridden, or is above or below one that is."""
    return any(key == o or key.startswith((f"{o}.", f"{o}/")) or o.startswith(f"{key}.") for o in overridden)


def layers(settings: Mapping[str, Value]) -> Sequence[Mapping[str, Value]]:
    """Return the settings of a row apart from those of its sweep, which all rows share."""
    return settings.maps if isinstance(settings, ChainMap) else [settings]


def identity(value: Value) -> str:
    """Return equal texts for values that are the same in a table: 1 and 1.0 are, 1 and "1" are not."""
    return repr(float(value)) if is_number(value) else f"{type(value).__name__} {value!r}"


def as_text(value: Value) -> str:
    """Return a value as it would be typed."""
    return value if isinstance(value, str) else json.dumps(value)


CLASS_PATH = ".path"
"""End of the keys of settings that name a class of a user's own by its dotted path."""


def class_name(path: str) -> str:
    """Return the name of a class that its dotted path names: `mine.Cauchy` -> `Cauchy`."""
    return path.rpartition(".")[2]


def _typed(value: Value) -> str:
    """Return a value as the command line has it: false, not False."""
    return str(value).lower() if isinstance(value, bool) else "null" if value is None else str(value)


def versions(rows: Sequence[RecordedRun]) -> Iterator[str]:
    """Yield a remark for each other version of which there are runs."""
    others = dict.fromkeys(run.version for run in rows if run.version not in (None, __version__))
    for version in others:
        those = [run for run in rows if run.version == version]
        yield (
            f"{len(those)} of {len(rows)} runs were written by staf_torch {version}, and this is "
            f"{__version__}: their numbers may mean something else (the first is {those[0].directory})"
        )


def mixed(found: Collection) -> Iterator[str]:
    """Yield a remark for each setting that differs although nobody swept it, and for different builds."""
    for key in found.unswept:
        values: dict[str, list[RecordedRun]] = {}
        for run in found.rows:
            values.setdefault(as_text(run.value(key)), []).append(run)
        counts = [f"{value} in {len(runs)} (as {runs[0].directory})" for value, runs in values.items()]
        more = f" and {len(counts) - _NAMED} others" if len(counts) > _NAMED else ""
        yield f"`{key}` differs between runs although nobody swept it: {', '.join(counts[:_NAMED])}{more}"


class MetricInfo(NamedTuple):
    """A metric, as tables know it.

    Example:
        >>> MetricInfo("digits", unit="digits", larger_is_better=True).unit
        'digits'

        Shown by `staf-table runs --sort ball_error`.
    """

    name: str
    unit: str = ""  # empty: that of V, or of what it is made of
    larger_is_better: bool = False
    headline: bool = False  # whether a table shows it where no metric is named

    def record(self) -> dict[str, Any]:
        """For `run.json`: everything but the name."""
        return {key: value for key, value in self._asdict().items() if key != "name"}


OWN = (
    *map(MetricInfo, ("ultimate_error", "ultimate_error_before", "floor_error")),
    *map(MetricInfo, ("ultimate_excess", "ultimate_excess_before")),
    MetricInfo("ball_error", headline=True),
    MetricInfo("ball_floor_error", headline=True),
    MetricInfo("rounding_floor"),
    MetricInfo("gradient_error", headline=True),
    MetricInfo("condition_number", unit="1"),
    MetricInfo("settling_time", unit="s"),
    MetricInfo("contraction_violations", unit="times"),
    MetricInfo("certificate_violations", unit="times"),
    MetricInfo("products_per_second", unit="1/s"),
    MetricInfo("cost", headline=True),
    MetricInfo("optimal_cost"),
    MetricInfo("cost_ratio", unit="1", headline=True),
    MetricInfo("cost_ratio_mean", unit="1"),
    MetricInfo("cost_ratio_max", unit="1"),
    *map(MetricInfo, ("final_state_norm", "final_error", "parameter_error", "control_error", "value_error")),
    MetricInfo("regulated_fraction", unit="1", larger_is_better=True, headline=True),
    MetricInfo("diverged_fraction", unit="1"),
    MetricInfo("history_bytes", unit="B"),
)
"""The library's own metrics, headlines in the order in which a table shows them."""
MEANINGS = {
    "ultimate_error": "largest |V - V^| at the state, after settling",
    "ultimate_error_before": "largest |V - V^| at the state before the correction, after settling",
    "floor_error": "largest |V - V^| at the state with the ideal weights, after settling",
    "ultimate_excess": "largest (a - w)'K(a - w) of the weights a, after settling",
    "ultimate_excess_before": "largest (a - w)'K(a - w) before the correction, after settling",
    "ball_error": "largest |V - V^| over the closed ball of the centers' radius, after settling",
    "ball_floor_error": "ball_error of the ideal weights: the best that kernel, radius and layout allow",
    "rounding_floor": "machine epsilon times the largest |V|: no error below it means anything",
    "gradient_error": "largest |grad V - grad V^| at the state, centers frozen",
    "condition_number": "largest condition number of the Gram matrix, at least 1",
    "settling_time": "time from which on the excess stays at most ultimate_excess",
    "contraction_violations": "steps whose excess shrank by less than the law's rate promises",
    "certificate_violations": "steps that break the one-step bound",
    "products_per_second": "products of an M x M matrix with a vector, a second of the trajectory",
    "cost": "median cost of the closed loop",
    "optimal_cost": "median least cost from the same states",
    "cost_ratio": "cost over the least cost, median; 1 is optimal",
    "cost_ratio_mean": "cost over the least cost, mean; 1 is optimal",
    "cost_ratio_max": "cost over the least cost, largest; 1 is optimal",
    "final_state_norm": "largest |x| at the end",
    "final_error": "largest |x - path| at the end",
    "parameter_error": "largest error of an identified parameter at the end",
    "control_error": "largest |u - u*| over the second half of the time",
    "value_error": "largest |V* - V^| over the second half of the time",
    "regulated_fraction": "share of trajectories with |x| < 1e-3 at the end, 0 to 1; larger is better",
    "diverged_fraction": "share of trajectories that became non-finite, 0 to 1",
    "history_bytes": "bytes of a run's histories, as a dry run (device=meta) counts them",
}
"""What a reader of a table needs to know of each of the library's own metrics."""
HEADLINES = tuple(info.name for info in OWN if info.headline)


def read_infos(recorded: object) -> dict[str, MetricInfo]:
    """Return the metrics that a record of a run declares, by name; anything malformed is passed over."""
    if not isinstance(recorded, Mapping):
        return {}
    found = {str(name): about for name, about in recorded.items() if isinstance(about, Mapping)}
    flags = "larger_is_better", "headline"
    return {
        name: MetricInfo(name, str(about.get("unit", "")), *(about.get(flag) is True for flag in flags))
        for name, about in found.items()
    }
