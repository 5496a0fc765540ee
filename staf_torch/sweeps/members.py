"""The setting `members`: a sweep inside one job, for more members than run directories are good for.

The members are the product of the lists, as `staf -m` would take it; they run in tensor batches and leave one
row each in `members.json`, the row that the same job of a sweep leaves in its own directory.
"""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from ..experiments.registry import Metrics
from ..numerics.checks import COMMAND_LINE, fail, flag
from ..results import run_record as records
from ..results.progress import Progress
from ..results.reader import Value
from ..results.run_directory import RunDirectory
from ..settings.plain import ManySettings
from ..tables import Table
from . import lock
from .batching import Computed, Failed, Outcome, completion, reason
from .executors import Inline, compute
from .hydra_compat import (
    Composer,
    ConfigLoader,
    config_loader,
    parse_override,
    product,
    sweep_size,
)
from .member_rows import FOLDER, Left, left, made_by, rows_left, writer

_log = logging.getLogger(__name__)
_PIECE = 1024  # members that are composed and written together: memory does not grow with their number
MOST_JOBS = 10**6  # of a sweep, or members of a job: their lists are memory
_LISTED = 20  # members that the log shows one by one
_SHOWN = ("ultimate_error", "floor_error", "ball_error", "ultimate_excess", "diverged_fraction")


class Start(NamedTuple):
    """What a job of members begins with."""

    run: str  # hash of what makes the run
    left: Left  # rows of an earlier start


def run(
    cfg: DictConfig,
    directory: Path,
    overrides: Sequence[str],
    config_name: str | None,
    start: Start,
    progress: Progress,
) -> Metrics:
    """Run all members and write `members.json` and `metrics.json`: how many there are, failed and diverged.

    Args:
        cfg: the settings; `members` is not null.
        directory: the run directory.
        overrides: that led to ``cfg``.
        config_name: of the primary configuration that led to ``cfg``.
        start: what makes the run, and the rows that an earlier start of it has left.
        progress: shows how many members are done.

    Raises:
        ValueError, hydra.errors.HydraException: if `members` is no list of overrides, or names what is not
            there, or a row that is left had other settings. What is wrong with one member alone fails it
            alone.
    """
    base = [line for line in overrides if line.lstrip("+~").partition("=")[0] != "members"]
    keep = flag(COMMAND_LINE, "history", cfg.history) and "history=true" in base
    loader = config_loader()
    jobs = member_overrides(cfg.members, loader)
    fixed = ("figures=false", f"history={str(keep).lower()}")
    composer = Composer(loader, config_name)
    out, before = RunDirectory(directory), start.left
    done = len(before.made)

    def composed(begin: int) -> ManySettings:
        return composer.many([[*base, *job, *fixed] for job in jobs[begin : begin + _PIECE]])

    cfgs = composed(0)  # before anything is written: most wrong names are refused here
    for begin in range(0, done, _PIECE):
        made = [made_by(one) for one in (composed(begin) if begin else cfgs).flat]
        _refuse_others(jobs, begin, made, before.made[begin : begin + _PIECE])
    with contextlib.closing(_Tally(directory)) as tally:
        for row in rows_left(directory, done) if done else ():
            tally.add([row])
        if done:
            _log.info("%d of %d members were completed before", done, len(jobs))
        with (
            _saying_how_to_resume(directory, tally, len(jobs)),
            progress.over(len(jobs), "members") as advance,
            writer(directory, start.run, len(jobs), before) as write,
        ):
            advance(done)
            for begin in range(done // _PIECE * _PIECE, len(jobs), _PIECE):
                part = jobs[begin : begin + _PIECE]
                cfgs = composed(begin) if begin else cfgs
                places = [directory / FOLDER / str(begin + index) for index in range(len(part))]
                rows: list[dict[str, Any]] = [{} for _ in part]
                completed = range(max(0, min(done - begin, len(part))))
                for index, outcome, _ in compute(
                    cfgs, places, Inline(), finished=completed, flat=cfgs.flat, tell=lambda jobs: None
                ):
                    row = {"num": begin + index, "overrides": part[index]}
                    rows[index] = row | _result(cfgs, index, outcome, places[index], keep, progress)
                    advance(1)
                write(rows[len(completed) :], [made_by(one) for one in cfgs.flat[len(completed) :]])
                tally.add(rows[len(completed) :])
        tally.report()
        return out.metrics(tally.counts())


@contextlib.contextmanager
def start_of(
    cfg: DictConfig, directory: Path, record: records.RunRecord, *, again: bool = False
) -> Iterator[Start]:
    """Hold the directory of a job of members, and yield what an earlier start has left where that is resumed.

    Args:
        cfg: the settings; `members` is not null.
        directory: of the run.
        record: of the run that begins.
        again: whether what is there was left by an earlier try of this run.

    Raises:
        ValueError: if another process has the directory, or the rows that are left were made otherwise.
    """
    lock.hold(directory, "run")
    try:
        found: Left | None = Left([])
        if again or records.resumed(cfg):
            found = left(directory, record.made_by)
        if found is None and not records.resumed_anyway(cfg):
            record.refuse_rows(directory)
        if found is None:
            _log.warning("the members that %s has were made otherwise: all run again", directory)
        yield Start(record.made_by, found or Left([]))
    finally:
        lock.give_back(directory)


@contextlib.contextmanager
def _saying_how_to_resume(directory: Path, tally: _Tally, total: int) -> Iterator[None]:
    """Add to a Ctrl-C, or another signal, how many members are complete and the line that resumes."""
    try:
        yield
    except KeyboardInterrupt as error:
        done, place = tally.counts()["members"], os.path.relpath(directory)
        error.add_note(f"{done} of {total} members are complete. Resume with:\n  staf sweep.resume={place}")
        raise


def _refuse_others(
    jobs: Sequence[Sequence[str]], first: int, now: Sequence[str], then: Sequence[str]
) -> None:
    """Raise ValueError if a member that is left was made by other settings than it would be now."""
    for index, (is_now, was) in enumerate(zip(now, then, strict=False)):
        if is_now != was:
            raise ValueError(
                f"member {first + index} ({' '.join(jobs[first + index])}) was not made as it would be now: "
                "its settings or the modules that they name have changed. Run the job in another directory."
            )


def member_overrides(setting: Any, loader: ConfigLoader) -> Sequence[list[str]]:
    """Return the overrides of every member, in the order of Hydra's own sweeper.

    Raises:
        ValueError: if the setting is not a list of overrides in Hydra's grammar, or they make too many.
    """
    lines = OmegaConf.to_container(setting) if OmegaConf.is_config(setting) else setting
    lines = [lines] if isinstance(lines, str) else lines
    if not isinstance(lines, list) or not lines or not all(isinstance(line, str) for line in lines):
        raise fail(COMMAND_LINE, "members", "must be a list of overrides, like 'seed=range(100)'", lines)
    overrides = []
    for line in lines:
        try:
            override = parse_override(line, loader)
        except HydraException as error:
            rule = f"must be overrides in Hydra's grammar ({str(error).splitlines()[0]})"
            raise fail(COMMAND_LINE, "members", rule, line) from error
        overrides.append(override)
        if override.is_hydra_override() or override.key_or_group == "members":
            raise fail(COMMAND_LINE, "members", "must be about the experiment alone", line)
    if sweep_size(overrides) > MOST_JOBS:
        raise fail(COMMAND_LINE, "members", f"must be {MOST_JOBS} at most, in several jobs if need be", lines)
    return product(overrides)


def _result(
    cfgs: ManySettings, index: int, outcome: Outcome, directory: Path, keep: bool, progress: Progress
) -> dict[str, Any]:
    """Return what a row says of the end of a member; its files are written where they are kept."""
    try:
        if isinstance(outcome, Computed) and not keep:
            metrics = outcome.metrics
        else:
            if not isinstance(outcome, Failed):
                directory.mkdir(parents=True, exist_ok=True)
            metrics = completion(cfgs[index], outcome)(cfgs[index], directory, progress)
    except Exception as error:
        return {"status": "failed", "reason": reason(error), "metrics": {}}
    return {"status": "completed", "reason": None, "metrics": metrics}


class _Tally:
    """What the log says of all members in the end, and their counts.

    Many rows are not kept, and the numbers of a metric lie in a file without a name: memory does not grow
    with the members.

    Args:
        directory: of the run.
    """

    def __init__(self, directory: Path) -> None:
        self._directory, self._files = directory, contextlib.ExitStack()
        self._count = self._failed = self._diverged = 0
        self._rows: list[dict[str, Any]] = []  # while they are few
        self._bad: list[dict[str, Any]] = []
        self._numbers: dict[str, IO[bytes]] = {}

    def add(self, rows: Sequence[dict[str, Any]]) -> None:
        """Count further rows."""
        for row in rows:
            self._count += 1
            self._diverged += bool(row["metrics"].get("diverged_fraction"))
            if row["status"] == "failed":
                self._failed += 1
                self._bad += [row] * (len(self._bad) < _LISTED)
            self._rows += [row] * (len(self._rows) <= _LISTED)
        for name in dict.fromkeys(name for row in rows for name in row["metrics"]):
            if name not in self._numbers:
                made = tempfile.TemporaryFile(dir=self._directory)  # noqa: SIM115  # closed with the others
                self._numbers[name] = self._files.enter_context(made)
            values = (row["metrics"].get(name) for row in rows)
            array("d", (value for value in values if value is not None)).tofile(self._numbers[name])

    def close(self) -> None:
        """Give the files back."""
        self._files.close()

    def counts(self) -> Metrics:
        """What `metrics.json` holds."""
        return {"members": self._count, "failed": self._failed, "diverged": self._diverged}

    def report(self) -> None:
        """Log a short table: the members themselves where they are few, else the spread of each metric."""
        for row in self._bad:
            _log.error("member %d (%s): %s", row["num"], " ".join(row["overrides"]), row["reason"])
        if self._count <= _LISTED:
            shown = [name for name in _SHOWN if any(name in row["metrics"] for row in self._rows)]
            cells: list[dict[str, Value]] = [
                {"member": " ".join(row["overrides"]), **row["metrics"]} for row in self._rows
            ]
            names: tuple[str, ...] = ("member", *shown)
        else:
            cells, names = [], ("metric", "least", "median", "most", "members")
            for name, file in self._numbers.items():
                file.seek(0)
                if len(found := np.fromfile(file)):
                    least, median, most = (float(of(found)) for of in (np.min, np.median, np.max))
                    numbers = (name, least, median, most, len(found))
                    cells.append(dict(zip(names, numbers, strict=True)))
        for line in Table.of(cells, {name: name for name in names}).markdown().splitlines():
            _log.info("%s", line)
