"""Runs as they are read back: of one run directory, of a sweep, or of a folder of both.

A run may go on, be killed or be damaged; it has a row with the reason. Nothing here needs torch.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from .._version import __version__
from ..numerics import fail
from .files import (
    COMPLETED,
    FAILED,
    FIGURES,
    HYDRA,
    MEMBERS,
    METRICS,
    RUN,
    RUNNING,
    SWEEP,
    UNFINISHED,
    UnreadableError,
    flatten,
    parse_overrides,
    read_object,
    read_text,
)
from .files import Value as Value
from .metric_info import HEADLINES, OWN, MetricInfo, read_infos

ABOUT = ("task", "status", "reason", "seconds", "version", "directory", "member")
"""What can be a column of a table beside settings and metrics."""
_OVERRIDES = "overrides.yaml"
_SHOWN = 1  # headlines in the short form of a run
_LISTED = 8  # jobs that have not started, by their numbers


@dataclasses.dataclass(frozen=True, repr=False)
class Run:
    """A run, or a member of a run of many: what it was, how it ended, what it measured.

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
    member: int | None = None  # its number among the members of a run of many
    version: str | None = None  # of the staf_torch that wrote it
    task: str | None = None
    seconds: float | None = None
    declared: Mapping[str, MetricInfo] = dataclasses.field(default_factory=dict)  # of the user's own metrics
    lost: Mapping[str, str] = dataclasses.field(default_factory=dict)  # metric -> what stood there instead

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
        if key in ABOUT:
            found = getattr(self, key)
            return str(found) if isinstance(found, Path) else found
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


def _typed(value: Value) -> str:
    """Return a value as the command line has it: false, not False."""
    return str(value).lower() if isinstance(value, bool) else "null" if value is None else str(value)


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

    rows: tuple[Run, ...]  # in the order of the sweep
    skipped: tuple[Skipped, ...]  # what has no row, and why
    remarks: tuple[str, ...] = ()  # what a reader of the rows should know

    @property
    def metrics(self) -> tuple[str, ...]:
        """The names of all metrics, in the order in which runs wrote them."""
        return tuple(dict.fromkeys(name for run in self.rows for name in run.metrics))

    @property
    def infos(self) -> dict[str, MetricInfo]:
        """What is declared of each metric: by the library, or by the runs for metrics of the user's own."""
        known = {info.name: info for info in OWN}
        for run in self.rows:
            known |= run.declared
        return {name: known.get(name, MetricInfo(name)) for name in self.metrics}

    @property
    def keys(self) -> tuple[str, ...]:
        """The names of everything but metrics that can be a column."""
        named = (key for run in self.rows for key in (*run.overrides, *run.settings))
        return (*dict.fromkeys(named), *ABOUT)

    @property
    def swept(self) -> tuple[str, ...]:
        """The overridden settings that differ between runs; of a single run, those that were overridden."""
        overridden = dict.fromkeys(key for run in self.rows for key in run.overrides)
        if len(self.rows) == 1:
            return tuple(overridden)
        return tuple(key for key in overridden if len({identity(run.setting(key)) for run in self.rows}) > 1)


def identity(value: Value) -> str:
    """Return equal texts for values that are the same in a table: 1 and 1.0 are, 1 and "1" are not."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return repr(float(value))
    return f"{type(value).__name__} {value!r}"


def collect(path: str | Path | Sequence[str | Path]) -> Collection:
    """Read every run directory at or under a path: also those of a sweep that goes on, or was killed.

    Example:
        >>> lines = ("centers.radius=0.1,0.2", "duration=0.1", "settle_time=0", "figures=false")
        >>> done = sweep(*lines, directory="runs/radii")
        >>> for run in collect("runs/radii").rows:
        ...     print(run.overrides["centers.radius"], run.status)
        0.1 completed
        0.2 completed

        Shown by `staf-table runs`.

    Args:
        path: a run directory, a sweep's directory, a folder of such, or several of them.

    Raises:
        ValueError: if a path does not exist or no run is found.
    """
    paths = [Path(p) for p in ([path] if isinstance(path, str | Path) else path)]
    rows: list[Run] = []
    skipped: list[Skipped] = []
    others: list[Path] = []
    for start in paths:
        if not start.is_dir():
            raise fail("collect", "path", "must be a directory that exists", str(start))
        for directory in _directories(start):
            if not _is_run(directory):
                others.append(directory)
                continue
            try:
                rows += read_run(directory)
            except UnreadableError as error:
                skipped.append(Skipped(directory, str(error)))
    for directory in others:
        skipped += _not_started(directory, rows)
    if not rows and not skipped:
        raise fail("collect", "path", "must hold a run or a sweep of runs", [str(p) for p in paths])
    return Collection(tuple(rows), tuple(skipped), tuple(_versions(rows)))


def _directories(start: Path) -> Iterator[Path]:
    """The folders at and under a path, numbers in their names in order; none below a run directory."""
    yield start
    if _is_run(start):
        return
    with os.scandir(start) as entries:
        names = [entry.name for entry in entries if entry.is_dir(follow_symlinks=False)]
    for name in sorted(names, key=_natural):
        if not name.startswith(".") and name != FIGURES:
            yield from _directories(start / name)


def _is_run(directory: Path) -> bool:
    files = (RUN, MEMBERS, METRICS, f"{HYDRA}/{_OVERRIDES}")
    return any((directory / name).exists() for name in files)


def _natural(name: str) -> list[tuple[bool, int, str]]:
    parts = re.split(r"(\d+)", name)
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts]


def _not_started(directory: Path, rows: Sequence[Run]) -> Iterator[Skipped]:
    """The jobs that a sweep has announced and of which there is no run."""
    if not (directory / SWEEP).exists():
        return
    try:
        jobs = read_object(directory / SWEEP).get("jobs")
    except UnreadableError as error:
        yield Skipped(directory, str(error))
        return
    if not isinstance(jobs, list) or not all(isinstance(job, dict) for job in jobs):
        yield Skipped(directory, f"{SWEEP} has no list of jobs")
        return
    begun = [dict(run.overrides) for run in rows if directory in run.directory.parents]
    waiting = [job.get("num") for job in jobs if parse_overrides(job.get("overrides") or ()) not in begun]
    if waiting:
        listed = ", ".join(map(str, waiting[:_LISTED])) + (", ..." if len(waiting) > _LISTED else "")
        yield Skipped(directory, f"{len(waiting)} of {len(jobs)} jobs have not started: {listed}")


def _versions(rows: Sequence[Run]) -> Iterator[str]:
    """One remark for each other version of which there are runs."""
    others = dict.fromkeys(run.version for run in rows if run.version not in (None, __version__))
    for version in others:
        those = [run for run in rows if run.version == version]
        yield (
            f"{len(those)} of {len(rows)} runs were written by staf_torch {version}, and this is "
            f"{__version__}: their numbers may mean something else (the first is {those[0].directory})"
        )


def read_run(directory: Path) -> list[Run]:
    """Return the runs of a run directory: one, or one a member.

    Raises:
        UnreadableError: if not even the settings can be read.
    """
    if not (directory / RUN).exists():
        return [_without_record(directory, None)]
    try:
        run = _of_record(directory, read_object(directory / RUN))
    except UnreadableError as error:
        return [_without_record(directory, str(error))]
    return _members(run) if (directory / MEMBERS).exists() else [run]


def read_record(directory: Path) -> Run:
    """Return the run of a run directory as its `run.json` has it, also where there are members.

    Raises:
        UnreadableError: if it cannot be read.
    """
    return _of_record(directory, read_object(directory / RUN))


def _of_record(directory: Path, record: Mapping[str, Any]) -> Run:
    status, reason = _status(record)
    metrics, lost, unread = _measured(directory) if status == COMPLETED else ({}, {}, None)
    return Run(
        directory=directory,
        overrides=parse_overrides(_lines(record)),
        settings=_settings(record),
        metrics=metrics,
        status=status,
        reason=reason if unread is None else unread,
        version=_text(record.get("version")),
        task=_text(record.get("task")),
        seconds=_number(record.get("seconds")),
        declared=read_infos(record.get("metrics")),
        lost=lost,
    )


def _status(record: Mapping[str, Any]) -> tuple[str, str | None]:
    status, reason = record.get("status"), _text(record.get("reason"))
    if status == RUNNING:
        return RUNNING, reason or "has not ended: it goes on, or was killed"
    if status == FAILED:
        return FAILED, reason or "no reason was left"
    if status != COMPLETED:
        by = f", written by staf_torch {record.get('version', 'of an unknown version')}"
        raise UnreadableError(f"{RUN}{by}: the status {status!r} is not known here")
    return COMPLETED, reason


def _members(run: Run) -> list[Run]:
    """One a member; its overrides come on top of the run's."""
    listed = read_object(run.directory / MEMBERS).get("members")
    if not isinstance(listed, list) or not all(isinstance(member, dict) for member in listed):
        raise UnreadableError(f"{MEMBERS} has no list of members")
    return [_member(run, number, member) for number, member in enumerate(listed)]


def _member(run: Run, number: int, member: Mapping[str, Any]) -> Run:
    status, reason = _status(member)
    own = parse_overrides(_lines(member))
    metrics, lost = _metrics(member.get("metrics") or {}) if status == COMPLETED else ({}, {})
    stated = _settings(member) or {**run.settings, **own}
    return dataclasses.replace(
        run,
        overrides={key: value for key, value in run.overrides.items() if not _of_axis(key)} | own,
        settings={key: value for key, value in stated.items() if not _of_axis(key)},
        metrics=metrics,
        status=status,
        reason=reason,
        member=int(_number(member.get("num")) or number),
        seconds=None,
        lost=lost,
    )


def _of_axis(key: str) -> bool:
    """Whether a setting lists the members themselves."""
    return key == "members" or key.startswith("members.")


def _without_record(directory: Path, why: str | None) -> Run:
    """What Hydra's own files and the metrics say: a run of a version without `run.json`, or a damaged one."""
    try:
        overrides, settings = _of_hydra(directory / HYDRA)
    except UnreadableError as error:
        raise UnreadableError("; ".join(filter(None, (why, str(error))))) from error
    metrics, lost, unread = _measured(directory)
    if unread is not None and not (directory / METRICS).exists():
        unread = f"has no {METRICS}: it goes on, failed or was killed"
    reason = "; ".join(filter(None, (why, unread))) or None
    status = COMPLETED if unread is None else UNFINISHED
    task = _text(settings.get("task"))
    return Run(directory, overrides, settings, metrics, status, reason, task=task, lost=lost)


def _of_hydra(folder: Path) -> tuple[dict[str, Value], dict[str, Value]]:
    import yaml  # Hydra brings it; only runs without `run.json` need it

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

    def load(name: str) -> Any:
        try:
            return yaml.load(read_text(folder / name), loader)
        except UnreadableError as error:
            raise UnreadableError(f"{HYDRA}/{error}") from error
        except yaml.YAMLError as error:
            raise UnreadableError(f"{HYDRA}/{name} is not YAML: {error}") from error

    lines = load(_OVERRIDES)
    if not isinstance(lines, list):
        raise UnreadableError(f"{HYDRA}/{_OVERRIDES} holds no list")
    try:
        composed, choices = load("config.yaml"), load("hydra.yaml")["hydra"]["runtime"]["choices"]
        options = {group: option for group, option in choices.items() if not group.startswith("hydra/")}
        settings = flatten(composed) | options
    except (UnreadableError, KeyError, TypeError, AttributeError):
        settings = {}  # the overrides tell runs apart without them
    return parse_overrides(str(line) for line in lines), settings


def _measured(directory: Path) -> tuple[dict[str, float | None], dict[str, str], str | None]:
    """`_metrics` of a run, and why they cannot be read."""
    try:
        return *_metrics(read_object(directory / METRICS)), None
    except UnreadableError as error:
        return {}, {}, str(error)


def _metrics(found: Mapping[str, Any]) -> tuple[dict[str, float | None], dict[str, str]]:
    """The numbers, and what stood in the place of one; nested or other values are no metrics."""
    metrics: dict[str, float | None] = {}
    lost: dict[str, str] = {}
    for name, value in found.items():
        if value is None or (isinstance(value, int) and not isinstance(value, bool)):
            metrics[name] = value
        elif isinstance(value, float):
            metrics[name] = value if math.isfinite(value) else None
            if not math.isfinite(value):
                lost[name] = repr(value)
    return metrics, lost


def _lines(record: Mapping[str, Any]) -> list[str]:
    return list(map(str, lines)) if isinstance(lines := record.get("overrides"), list) else []


def _settings(record: Mapping[str, Any]) -> dict[str, Value]:
    return dict(found) if isinstance(found := record.get("settings"), dict) else {}


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None


def _number(value: object) -> float | None:
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None
