"""A sweep whose jobs leave one row each, `sweep.records=table`: more jobs than run directories are good for.

`rows.json` has one line a row: number, overrides, status, reason and metrics, as the same job writes them
into a directory of its own. It has another name until it is complete. A hidden file beside it has one line a
row: the checksums of the row and of its history, and a hash of what made it. A sweep that was killed goes on
from the rows that agree with theirs.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from .. import __version__
from ..experiments.registry import check_animation
from ..lanes.compilation.compiler import compiler
from ..results import run_record as records
from ..results.build import checksums, damage, modules
from ..results.files import ROWS, UnreadableError, is_free, open_after, parse_object, partial_name, read_lines
from ..results.run_directory import RunDirectory
from ..settings.chase import make_metrics, units_of
from ..settings.plain import ManySettings
from ..signs import Progress
from . import workers
from .executors import Executor, compute
from .hydra_compat import SweepJobs
from .job import Computed, Failed, LostError, Outcome, Written, are_light, completion, reason, recorded

_log = logging.getLogger(__name__)
SUMS = f".{ROWS}.sums"
FOLDER = "rows"
_HEAD = f'{{"version": {json.dumps(__version__)}, "rows": [\n'
_DIGITS = 16  # of the hash of what made a row: enough to tell two settings apart
_PIECE = 1024  # jobs that are composed and written together: memory does not grow with their number
_AHEAD = 8  # pieces that are composed together, at most, where several workers compute them
_LIGHT = 4  # times as many jobs where they are light
_SILENT = Progress(lambda share: None)

Write = Callable[[Sequence[Mapping[str, Any]], Sequence[str]], None]


class Left(NamedTuple):
    """Rows that an earlier start of a sweep has left."""

    made: list[str]  # what made each whole row, from the first row on
    size: int = 0  # bytes of the rows' file up to the end of the last of them, without its comma
    sums: int = 0  # bytes of the checksums' file up to the end of their line


def fill(
    jobs: SweepJobs,
    overrides: Sequence[Sequence[str]],
    directory: Path,
    executor: Executor,
    *,
    most: int | None,
    ended: Callable[[int, str | None], None],
    tell: Callable[[float], None],
) -> None:
    """Compute the jobs that have no row yet, write their rows, and at last `rows.json` as a whole.

    Args:
        jobs: compose the settings.
        overrides: of every job.
        directory: of the sweep.
        executor: computes tensor batches, of ``most`` jobs at most.
        ended: is told the number of every job that has a row, and why it failed, None where it did not.
        tell: is told how many jobs are computed.

    Raises:
        ValueError, hydra.errors.HydraException: if settings name what is not there, or rows that are left
            were made otherwise. What is wrong with one job alone fails it alone.
        LostError: if rows lost their workers twice; `sweep.resume` computes them.
    """
    record = records.RunRecord(jobs.base, jobs.choices, jobs.typed, compiler())
    record.covers(ROWS, f"{FOLDER}/**/*")
    before = _before(directory, record, jobs.master)
    if before is None:
        _log.info("completed before: %s", os.path.relpath(directory))
        for row in _rows(directory / ROWS, len(overrides)):
            ended(row["num"], row["reason"])
        return
    work = _RowsToFill(
        overrides, directory, executor, _Pieces(jobs, overrides, executor, most), most, ended, tell
    )
    done = len(before.made)
    for begin in range(0, done, work.pieces.size):
        _, flat = work.pieces.composed(begin)
        _refuse_others(overrides, begin, flat, before.made[begin : begin + work.pieces.size])
        del flat
    with (
        _saying_how_to_resume(directory, len(overrides)) as completed,
        recorded(record, directory, 0.0),
        _writer(directory, record.made_by, len(overrides), before) as write,
    ):
        check_animation(jobs.base)
        record.declare([metric.info for metric in make_metrics(jobs.base.get("metric"))])
        record.measured_in(units_of(jobs.base))
        for row in _rows(directory / partial_name(ROWS), done):
            ended(row["num"], row["reason"])
        begins = range(done // work.pieces.size * work.pieces.size, len(overrides), work.pieces.size)
        lost = sum(work.compute(begin, done, write, completed) for begin in begins)
        if lost:
            raise LostError(f"{lost} of {len(overrides)} rows lost their workers; sweep.resume computes them")


class _Pieces:
    """Composes the jobs of a table in pieces of ``size`` jobs: memory does not grow with their number.

    The first is composed at once: most wrong names are refused before anything is written.
    """

    def __init__(
        self, jobs: SweepJobs, overrides: Sequence[Sequence[str]], executor: Executor, most: int | None
    ) -> None:
        self.fixed = jobs.fixed  # settings that all jobs share
        self.keep = "history" in self.fixed and jobs.base.history is True  # files of every job
        self.size = max(_PIECE, most or 0) * min(_AHEAD, executor.workers)
        self._jobs, self._overrides = jobs, overrides
        self._own = ("figures=false", f"history={str(self.keep).lower()}")
        self._last: dict[int, tuple[ManySettings, list[Mapping[str, Any]]]] = {}  # by its first job
        _, flat = self.composed(0)
        if self.size < len(overrides) and most is None and not self.keep and are_light(flat):
            self.size *= _LIGHT
            self._last.clear()
            self.composed(0)

    def composed(self, begin: int) -> tuple[ManySettings, list[Mapping[str, Any]]]:
        """Settings of the jobs of a piece, and the same by dotted keys; kept until another is composed."""
        if begin not in self._last:
            self._last.clear()
            jobs = self._overrides[begin : begin + self.size]
            self._last[begin] = self._jobs.many([[*job, *self._own] for job in jobs])
        return self._last[begin]

    def taken(self, begin: int) -> tuple[ManySettings, list[Mapping[str, Any]]]:
        """Settings of the jobs of a piece, which are kept no longer."""
        self.composed(begin)
        return self._last.pop(begin)


class _RowsToFill(NamedTuple):
    """Jobs of a table, what computes them, and who is told; as `fill` takes them."""

    overrides: Sequence[Sequence[str]]
    directory: Path
    executor: Executor
    pieces: _Pieces
    most: int | None
    ended: Callable[[int, str | None], None]
    tell: Callable[[float], None]

    def compute(self, begin: int, done: int, write: Write, completed: list[int]) -> int:
        """Compute the jobs of a piece, from number ``begin`` on, and write the rows from ``done`` on; return
        how many were lost. ``completed`` takes the number of rows after each."""
        cfgs, flat = self.pieces.taken(begin)
        rows, lost = _InOrder(write, [made_by(one) for one in flat], max(0, done - begin)), 0

        def place(index: int) -> Path:
            return self.directory / FOLDER / str(begin + index)

        outcomes = compute(
            *(cfgs, flat, place, self.executor),
            finished=range(rows.written),
            most=self.most,
            measured=not self.pieces.keep,
            tell=lambda count: self.tell(begin + count),
        )
        del flat
        for index, outcome, _ in outcomes:
            workers.check()
            given = self.overrides[begin + index]
            own = [line for line in given if line.partition("=")[0] not in self.pieces.fixed]
            row: dict[str, Any] = {"num": begin + index, "overrides": own}
            row |= _result(cfgs, index, outcome, place(index), self.pieces.keep)
            gone = isinstance(outcome, Failed) and isinstance(outcome.error, LostError)
            lost += gone
            rows.add(index, row, gone)
            completed[0] = begin + rows.written
            self.ended(begin + index, row["reason"])
        return lost


class _InOrder:
    """Writes the rows of a piece in their order, a thousand at a time; batches may end in another one.

    It gets what made each row of the piece, and how many are written already.
    """

    def __init__(self, write: Write, made: list[str], written: int) -> None:
        self._write, self._made, self.written = write, made, written
        self._rows: dict[int, Mapping[str, Any]] = {}  # of batches that ended before others
        self._next: list[Mapping[str, Any]] = []

    def add(self, index: int, row: Mapping[str, Any], lost: bool) -> None:
        """Take in a row; one that ``lost`` its worker is marked, so that it is computed when resumed."""
        self._rows[index] = row
        if lost:
            self._made[index] = ""
        while self.written + len(self._next) in self._rows:
            self._next.append(self._rows.pop(self.written + len(self._next)))
        end = self.written + len(self._next)
        if len(self._next) >= _PIECE or end == len(self._made):
            self._write(self._next, self._made[self.written : end])
            self.written, self._next = end, []


def _before(directory: Path, record: records.RunRecord, master: Any) -> Left | None:
    """Return the rows that an earlier start of the sweep has left; None: all of them, and it is complete.

    Raises:
        ValueError: if they were made otherwise.
    """
    if not records.resumed(master):
        return Left([])
    if record.finished_before(directory) is not None:
        return None
    anyway, found = records.resumed_anyway(master), left(directory, record.made_by)
    if found is None and not anyway:
        record.refuse_rows(directory)
    if found is None:
        _log.warning("%s: existing rows were made with other settings or source; recomputing all", directory)
    found = found or Left([])
    if found.made:
        _log.info("%d jobs were completed before", len(found.made))
    return found


@contextlib.contextmanager
def _saying_how_to_resume(directory: Path, total: int) -> Iterator[list[int]]:
    """Yield a list of the number of rows; add it and the line that resumes to a Ctrl-C or another signal."""
    done = [0]
    try:
        yield done
    except KeyboardInterrupt as error:
        place = os.path.relpath(directory)
        error.add_note(
            f"{done[0]} of {total} jobs have a row, {total - done[0]} are to do. "
            f"Resume with:\n  staf -m sweep.resume={place}"
        )
        raise


def _refuse_others(
    jobs: Sequence[Sequence[str]], first: int, now: Sequence[Mapping[str, Any]], then: Sequence[str]
) -> None:
    """Raise ValueError if a row that is left was made by other settings than it would be now."""
    for index, (settings, was) in enumerate(zip(now, then, strict=False)):
        if made_by(settings) != was:
            own = " ".join(records.own(jobs[first + index]))
            raise ValueError(
                f"job {first + index} ({own}) would be made otherwise now: its settings or the modules "
                "that they name have changed. Run the sweep in another directory."
            )


def _result(cfgs: ManySettings, index: int, outcome: Outcome, directory: Path, keep: bool) -> dict[str, Any]:
    """Return what a row says of the end of a job; its files are written where they are kept."""
    try:
        if isinstance(outcome, Written) or (isinstance(outcome, Computed) and not keep):
            metrics = outcome.metrics
        else:
            if not isinstance(outcome, Failed):
                directory.mkdir(parents=True, exist_ok=True)
            metrics = completion(cfgs[index], outcome)(cfgs[index], directory, _SILENT)
    except Exception as error:
        return {"status": "failed", "reason": reason(error), "metrics": {}}
    return {"status": "completed", "reason": None, "metrics": metrics}


def made_by(settings: Mapping[str, Any]) -> str:
    """Return a hash of the settings of a job, by dotted keys, and of the user's modules that they name."""
    decisive = {key: value for key, value in settings.items() if not is_free(key)}
    text = json.dumps([decisive, modules(settings)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]


def left(directory: Path, run: str) -> Left | None:
    """Return the rows that an earlier start has left, up to the first that is not whole or lost its worker;
    None where something else made them than the hash ``run`` says."""
    partial, found = directory / partial_name(ROWS), Left([])
    if not os.path.lexists(directory / SUMS) or not os.path.lexists(partial):
        return found
    try:
        sums, rows = read_lines(directory / SUMS), read_lines(partial)
        head = next(sums, b"")
        if parse_object(head, SUMS).get("run") != run:
            return None
        if next(rows, b"") != _HEAD.encode():
            return found
        size, found = len(_HEAD), Left([], len(_HEAD), len(head))
        for line, row in zip(sums, rows, strict=False):
            about, text = parse_object(line, SUMS), row.removesuffix(b"\n").removesuffix(b",")
            wrong = _damage(directory / FOLDER / str(len(found.made)), about, text)
            if wrong is not None:
                raise UnreadableError(wrong)
            found.made.append(about["made"])
            found = Left(found.made, size + len(text), found.sums + len(line))
            size += len(row)
    except UnreadableError as error:
        _log.warning("%s; job %d and those after it run again", error, len(found.made))
    return found


def _damage(directory: Path, about: Mapping[str, Any], row: bytes) -> str | None:
    """Return what is wrong with a row or with its history in a directory."""
    if about.get("sha256") != hashlib.sha256(row).hexdigest() or not isinstance(about.get("made"), str):
        return f"a row of {ROWS} is damaged or cut off"
    if not about["made"]:
        return f"a row of {ROWS} lost its worker"
    files = about.get("files")
    return damage(directory, files, thorough=True) if isinstance(files, dict) else None


def _rows(path: Path, count: int) -> Iterator[dict[str, Any]]:
    """Yield the first rows of a file of rows, complete or not."""
    lines = read_lines(path) if count else iter(())
    next(lines, None)
    for _, row in zip(range(count), lines, strict=False):
        yield parse_object(row.removesuffix(b"\n").removesuffix(b","), ROWS)


@contextlib.contextmanager
def _writer(directory: Path, run: str, total: int, before: Left) -> Iterator[Write]:
    """Yield a function that appends rows to `rows.json`, with what made each of them.

    ``run`` is the hash of what makes the rows, ``total`` their number in the end; what the files have after
    the rows ``before`` is cut off.
    """
    done = len(before.made)

    def ending(number: int) -> str:
        return ",\n" if number < total else "\n]}\n"

    with (
        os.fdopen(open_after(directory / SUMS, before.sums), "wb") as sums,
        RunDirectory(directory).lines(ROWS, keep=before.size) as write,
    ):

        def note(lines: Sequence[Mapping[str, Any]]) -> None:
            sums.write("".join(json.dumps(line) + "\n" for line in lines).encode())
            sums.flush()
            os.fsync(sums.fileno())

        if before.size == 0:
            note([{"run": run}])
            write(_HEAD)
        elif done:
            write(ending(done))

        def add(rows: Sequence[Mapping[str, Any]], made: Sequence[str]) -> None:
            nonlocal done
            about, text = [], []
            for row, by in zip(rows, made, strict=True):
                line, done = json.dumps(row, allow_nan=False), done + 1
                text.append(line + ending(done))  # one job a line
                line_sum = hashlib.sha256(line.encode()).hexdigest()
                files = checksums(directory / FOLDER / str(row["num"]))
                about.append({"made": by, "sha256": line_sum} | ({"files": files} if files else {}))
            write("".join(text))
            note(about)

        yield add
    (directory / SUMS).unlink()
