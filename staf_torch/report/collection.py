"""Every run under a path: of one run directory, of a sweep, or of a folder of both."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from .._version import __version__
from .._wording import fail
from .overrides import Value, parse_overrides
from .reading import SWEEP, UnreadableError, is_run, read_object, read_run
from .run import ABOUT, Run

_PASSED_BY = ("figures",)  # folders in which no run can be


@dataclasses.dataclass(frozen=True)
class Skipped:
    """Something that is not, or not as it should be, in the rows."""

    path: Path
    reason: str


@dataclasses.dataclass(frozen=True)
class Collection:
    """What `collect` found."""

    rows: tuple[Run, ...]  # in the order of the sweep
    skipped: tuple[Skipped, ...]  # what has no row, and why
    remarks: tuple[str, ...] = ()  # what a reader of the rows should know

    @property
    def metrics(self) -> tuple[str, ...]:
        """The names of all metrics, in the order in which runs wrote them."""
        return tuple(dict.fromkeys(name for run in self.rows for name in run.metrics))

    @property
    def keys(self) -> tuple[str, ...]:
        """Everything but metrics that can be a column."""
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
    """Equal for values that are the same in a table: 1 and 1.0 are, 1 and "1" are not."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return repr(float(value))
    return f"{type(value).__name__} {value!r}"


def collect(path: str | Path | Sequence[str | Path]) -> Collection:
    """Read every run directory at or under a path: also those of a sweep that goes on, or was killed.

    Example:
        >>> for run in collect("runs/2026-11-21_18-40-59-589684_sweep").rows:
        ...     print(run.overrides, run.status, run.metrics.get("ball_error"))

    Args:
        path: a run directory, a sweep's directory, a folder of such, or several of them.

    Raises:
        ValueError: if a path does not exist or no run is found.
    """
    paths = [Path(p) for p in ([path] if isinstance(path, str | Path) else path)]
    rows: list[Run] = []
    skipped: list[Skipped] = []
    sweeps: list[Path] = []
    for start in paths:
        if not start.is_dir():
            raise fail("collect", "path", "must be a directory that exists", str(start))
        for directory in _directories(start):
            if is_run(directory):
                try:
                    rows += read_run(directory)
                except UnreadableError as error:
                    skipped.append(Skipped(directory, str(error)))
            else:
                sweeps.append(directory)
    for directory in sweeps:
        skipped += _not_started(directory, rows)
    if not rows and not skipped:
        raise fail("collect", "path", "must hold a run or a sweep of runs", [str(p) for p in paths])
    return Collection(tuple(rows), tuple(skipped), tuple(_versions(rows)))


def _directories(start: Path) -> Iterator[Path]:
    """The folders at and under a path, numbers in their names in order; none below a run directory."""
    yield start
    if is_run(start):
        return
    with os.scandir(start) as entries:
        names = [entry.name for entry in entries if entry.is_dir(follow_symlinks=False)]
    for name in sorted(names, key=_natural):
        if not name.startswith(".") and name not in _PASSED_BY:
            yield from _directories(start / name)


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
        listed = ", ".join(str(number) for number in waiting[:8]) + (", ..." if len(waiting) > 8 else "")
        yield Skipped(directory, f"{len(waiting)} of {len(jobs)} jobs have not started: {listed}")


def _versions(rows: Sequence[Run]) -> Iterator[str]:
    """One remark for each other version of which there are runs."""
    others = dict.fromkeys(run.version for run in rows if run.version not in (None, __version__))
    for version in others:
        count = sum(run.version == version for run in rows)
        first = next(run.directory for run in rows if run.version == version)
        yield (
            f"{count} of {len(rows)} runs were written by staf_torch {version}, and this is {__version__}: "
            f"their numbers may mean something else (the first is {first})"
        )
