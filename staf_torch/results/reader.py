"""Runs as they are read back: of one run directory, of a sweep, or of a folder of both.

A run may go on, be killed or be damaged; it has a row with the reason. Nothing here needs torch.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import sys
from collections import ChainMap, Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..numerics import fail
from ..signs import Sign
from .build import damage, damaged, short
from .files import (
    COMPLETED,
    FAILED,
    FIGURES,
    HYDRA,
    METRICS,
    ROWS,
    RUN,
    RUNNING,
    SWEEP,
    UNFINISHED,
    UnreadableError,
    is_free,
    is_number,
    parse_object,
    parse_overrides,
    partial_name,
    plain,
    read_lines,
    read_object,
    visible,
)
from .files import Value as Value
from .run import ABOUT as ABOUT
from .run import Collection as Collection
from .run import RecordedRun as RecordedRun
from .run import Skipped as Skipped
from .run import identity as identity
from .run import mixed, read_infos, versions

_LISTED = 8  # jobs that have not started, by their numbers
_UNSAID = {RUNNING: "has not ended: it goes on, or was killed", FAILED: "no reason was left", COMPLETED: None}
"""Statuses, and what is said of one without a reason."""


@Sign("reading runs", log=False)
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
    rows: list[RecordedRun] = []
    skipped: list[Skipped] = []
    others: list[Path] = []
    for start in paths:
        if not start.is_dir():
            raise fail("collect", "path", "must be a directory that exists", str(start))
        for directory in _directories(start, skipped):
            if not _is_run(directory):
                others.append(directory)
                continue
            try:
                rows += read_run(directory)
            except UnreadableError as error:
                skipped.append(Skipped(directory, str(error)))
            except Exception as error:  # one bad run never costs the others
                skipped.append(Skipped(directory, f"cannot be read ({type(error).__name__}: {error})"))
    for directory in others:
        skipped += _not_started(directory, rows)
    skipped = [Skipped(one.path, visible(one.reason)) for one in skipped]
    if not rows and not skipped:
        raise fail("collect", "path", "must hold a run or a sweep of runs", [str(p) for p in paths])
    collection = Collection(tuple(rows), tuple(skipped))
    remarks = tuple(map(visible, (*versions(rows), *mixed(collection))))
    return dataclasses.replace(collection, remarks=remarks)


def _directories(start: Path, skipped: list[Skipped]) -> Iterator[Path]:
    """The folders at and under a path, numbers in their names in order; none below a run directory.

    Those that cannot be looked at are added to ``skipped``.
    """
    waiting = [start]
    while waiting:
        folder = waiting.pop()
        yield folder
        try:
            if _is_run(folder):
                continue
            with os.scandir(folder) as entries:
                names = [entry.name for entry in entries if entry.is_dir(follow_symlinks=False)]
        except OSError as error:
            skipped.append(Skipped(folder, f"cannot be listed: {error.strerror}"))
            continue
        inner = [name for name in sorted(names, key=_natural) if not name.startswith(".") and name != FIGURES]
        waiting += [folder / name for name in reversed(inner)]


def _is_run(directory: Path) -> bool:
    files = (RUN, ROWS, METRICS, f"{HYDRA}/overrides.yaml")
    return any(os.path.lexists(directory / name) for name in files)


def _natural(name: str) -> list[tuple[bool, int, str]]:
    parts = re.split(r"([0-9]{1,18})", name)
    return [(bool(n % 2), int(part) if n % 2 else 0, part) for n, part in enumerate(parts)]


def _not_started(directory: Path, rows: Sequence[RecordedRun]) -> Iterator[Skipped]:
    """The jobs that a sweep has announced and of which there is no run."""
    if not os.path.lexists(directory / SWEEP):
        return
    try:
        jobs = read_object(directory / SWEEP).get("jobs")
    except UnreadableError as error:
        yield Skipped(directory, str(error))
        return
    if not isinstance(jobs, list) or not all(isinstance(job, dict) for job in jobs):
        yield Skipped(directory, f"{SWEEP} has no list of jobs")
        return
    own = [run for run in rows if directory in run.directory.parents]
    begun = {_identity(run.overrides) for run in own}
    waiting = [job.get("num") for job in jobs if _identity(parse_overrides(_lines(job))) not in begun]
    if waiting:
        listed = ", ".join(map(str, waiting[:_LISTED])) + (", ..." if len(waiting) > _LISTED else "")
        counts = Counter(run.status for run in own)
        ended = "".join(f"; {counts[status]} {status}" for status in counts)
        goes_on = f"`staf -m sweep.resume={directory}` runs what is missing, unless the sweep still goes on"
        told = f"{len(waiting)} of {len(jobs)} jobs have not started: {listed}{ended}. {goes_on}"
        yield Skipped(directory, told)


def _identity(overrides: Mapping[str, Value]) -> tuple[tuple[str, str], ...]:
    """Return what tells a job from the others of its sweep."""
    return tuple(sorted((key, identity(value)) for key, value in overrides.items() if not is_free(key)))


def read_run(directory: Path) -> list[RecordedRun]:
    """Return the runs of a run directory: one, or one a row of a table.

    Raises:
        UnreadableError: if its record cannot be read.
    """
    record = read_object(directory / RUN)
    run = _of_record(directory, record)
    wrong = damaged(directory, record, thorough=False)
    if wrong is not None:
        return [dataclasses.replace(run, status=UNFINISHED, reason=wrong, metrics={})]
    if os.path.lexists(directory / ROWS):
        return _rows(run, ROWS)
    begun = run.status != COMPLETED and os.path.lexists(directory / partial_name(ROWS))
    return [*_rows(run, partial_name(ROWS)), run] if begun else [run]


def read_record(directory: Path) -> RecordedRun:
    """Return the run of a run directory as its `run.json` has it, also where there are rows of a table.

    Raises:
        UnreadableError: if it cannot be read.
    """
    return _of_record(directory, read_object(directory / RUN))


def _of_record(directory: Path, record: Mapping[str, Any]) -> RecordedRun:
    status, reason = _status(record)
    metrics, lost, unread = _measured(directory, record) if status == COMPLETED else ({}, {}, None)
    if unread is not None:
        status, reason = UNFINISHED, unread
    made_by = record.get("build")
    return RecordedRun(
        directory=directory,
        overrides=parse_overrides(_lines(record)),
        settings=_settings(record),
        metrics=metrics,
        status=status,
        reason=reason,
        version=_text(record.get("version")),
        task=_text(record.get("task")),
        seconds=_number(record.get("seconds")),
        declared=read_infos(record.get("metrics")),
        lost=lost,
        build=short(made_by) if isinstance(made_by, dict) else None,
        modules={name: one for name, one in _table(_table(made_by).get("modules")).items() if _text(one)},
        **{name: _text(record.get(name)) for name in ("began", "machine", "python")},  # type: ignore[arg-type]
        units={str(key): str(text) for key, text in _table(record.get("units")).items()},
    )


def _table(value: Any) -> dict[Any, Any]:
    return value if isinstance(value, dict) else {}


def _status(record: Mapping[str, Any]) -> tuple[str, str | None]:
    status, reason = record.get("status"), _text(record.get("reason"))
    if not isinstance(status, str) or status not in _UNSAID:
        by = f", written by staf_torch {record.get('version', 'of an unknown version')}"
        raise UnreadableError(f"{RUN}{by}: its status {status!r} is none that this version writes")
    return status, reason or _UNSAID[status]


def _rows(run: RecordedRun, name: str) -> list[RecordedRun]:
    """Return one run a row of a table of that name; its overrides come on top of the sweep's."""
    return [_row(run, number, row) for number, row in enumerate(read_rows(run.directory, name))]


def read_rows(directory: Path, name: str = ROWS) -> Iterator[Mapping[str, Any]]:
    """Yield the rows of `rows.json`, one after the other: one line each, as the library writes them.

    In a file that is not complete, which has another ``name``, the last line may be cut off.

    Raises:
        UnreadableError: if it has another form.
    """
    lines = read_lines(directory / name)
    if name != ROWS:
        yield from (parse_object(line[:-2], name) for line in lines if line.endswith(b"},\n"))
        return
    if not re.fullmatch(rb'\{"version": "[^"]*", "rows": \[\n', next(lines, b"")):
        raise UnreadableError(f"{ROWS} does not begin as a table of rows")
    for line in lines:
        if line == b"]}\n":
            return
        yield parse_object(line.removesuffix(b"\n").removesuffix(b","), ROWS)
    raise UnreadableError(f"{ROWS} ends before its last row")


def _row(run: RecordedRun, number: int, row: Mapping[str, Any]) -> RecordedRun:
    status, reason = _status(row)
    own = parse_overrides(_lines(row))
    metrics, lost = _metrics(row.get("metrics")) if status == COMPLETED else ({}, {})
    place = row.get("num")
    return dataclasses.replace(
        run,
        overrides={**run.overrides, **own},
        settings=_settings(row) or ChainMap(own, run.settings),  # type: ignore[arg-type]
        metrics=metrics,
        status=status,
        reason=reason,
        row=place if isinstance(place, int) and not isinstance(place, bool) else number,
        seconds=None,
        lost=lost,
    )


def _measured(
    directory: Path, record: Mapping[str, Any]
) -> tuple[dict[str, float | None], dict[str, str], str | None]:
    """`_metrics` of a run, and why they cannot be read or believed."""
    files = found if isinstance(found := record.get("files"), dict) else {}
    numbers = {name: about for name, about in files.items() if name in (METRICS, ROWS)}
    wrong = damage(directory, numbers, thorough=True)
    if wrong is not None or ROWS in files:
        return {}, {}, wrong
    try:
        return *_metrics(read_object(directory / METRICS)), None
    except UnreadableError as error:
        return {}, {}, str(error)


def _metrics(found: object) -> tuple[dict[str, float | None], dict[str, str]]:
    """The numbers, and what stood in the place of one; nested or other values are no metrics."""
    metrics: dict[str, float | None] = {}
    lost: dict[str, str] = {}
    for name, value in found.items() if isinstance(found, dict) else ():
        if is_number(value) and not math.isfinite(value):
            metrics[sys.intern(name)], lost[name] = None, repr(value)
        elif value is None or is_number(value):
            metrics[sys.intern(name)] = value
    return metrics, lost


def _lines(record: Mapping[str, Any]) -> list[str]:
    lines = record.get("overrides")
    return [line for line in lines if isinstance(line, str)] if isinstance(lines, list) else []


def _settings(record: Mapping[str, Any]) -> dict[str, Value]:
    found = record.get("settings")
    if not isinstance(found, dict):
        return {}
    # One object for equal names and words: the settings of a thousand runs take a third of the memory.
    return {sys.intern(key): _setting(value) for key, value in found.items()}


def _setting(value: Any) -> Value:
    known: Value = json.dumps(value) if isinstance(value, dict) else plain(value)
    return sys.intern(known) if isinstance(known, str) else known


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None


def _number(value: object) -> float | None:
    return value if is_number(value) and math.isfinite(value) else None
