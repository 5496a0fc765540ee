"""A run as it is read back, and a collection of runs: plain values, whoever wrote them."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections import ChainMap
from collections.abc import Collection as Collection_
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from .._version import __version__
from .build import shortened
from .files import Value, is_free, is_number
from .metric_info import HEADLINES, OWN, MetricInfo
from .untrusted import visible

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
