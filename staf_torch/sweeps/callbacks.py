"""The Hydra callbacks of `conf/config.yaml`: the sweep's directory, its report, and trackers."""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import logging
import os
import shutil
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from ..figures.style import FigurePaper, draws, printed_on
from ..numerics import COMMAND_LINE, fail
from ..results import run_record as records
from ..results.files import COMPLETED, FAILED, PAGE, ROWS, links_in, visible
from ..results.reader import RecordedRun, collect
from . import lock
from .hydra_compat import as_typed, end_sweep, parse_override, sweep_size
from .job import PRINTS, sentence
from .report import write_report

_log = logging.getLogger(__name__)

_FOLDER = "tensorboard"
MOST_JOBS = 10**6  # of a sweep: their lists are memory


class Tracker(ABC):
    """Takes finished runs elsewhere: to event files, a server, a notebook.

    Example:
        >>> class Lines(Tracker):
        ...     def record(self, run):
        ...         with open("results.txt", "a") as file:
        ...             print(run.settings["kernel"], run.metrics["ball_error"], file=file)

        In `mine.py`, it is used by `staf tracker=custom tracker.path=mine.Lines`.

    One is made before the first run, so that the constructor can refuse by a ValueError, and one for each job
    that ended. An error of `record` is a warning in the log: the results are on the disk all the same.
    """

    @abstractmethod
    def record(self, run: RecordedRun) -> None:
        """Take in a completed run, once: of a table each row, when all are there."""


class TensorBoardTracker(Tracker):
    """The metrics as scalars and the settings as hyperparameters, in `tensorboard/` of the run directory.

    Raises:
        ValueError: without TensorBoard.
    """

    def __init__(self) -> None:
        if importlib.util.find_spec("tensorboard") is None:
            raise ValueError(
                "`tracker=tensorboard` needs TensorBoard: install the extra, "
                "pip install 'staf_torch[tensorboard]'."
            )

    def record(self, run: RecordedRun) -> None:
        """Write an event file; a metric without a number is left out."""
        from torch.utils.tensorboard import SummaryWriter
        from torch.utils.tensorboard.summary import hparams

        folder = run.directory / _FOLDER
        numbers = {name: float(value) for name, value in run.metrics.items() if value is not None}
        known = {
            key: value if isinstance(value, bool | int | float | str) else str(value)
            for key, value in (run.settings or run.overrides).items()
            if value is not None
        }
        with SummaryWriter(str(folder if run.row is None else folder / str(run.row))) as writer:
            for summary in hparams(known, numbers):
                writer._get_file_writer().add_summary(summary)
            for name, number in numbers.items():
                writer.add_scalar(name, number)


class SweepDirectory(Callback):
    """Takes a directory for a sweep that begins and notes there what was typed."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Make the directory, lock it, and write `sweep.json`; a sweep that is resumed has both.

        Raises:
            SystemExit: if the directory cannot be written, or belongs to another sweep: Hydra turns other
                exceptions of callbacks into warnings.
        """
        try:
            if records.resumed(config):
                lock.hold(_directory(config))
                _refuse_links(_directory(config))
                return
            claim(config)
            typed = config.hydra.overrides
            records.begin_sweep(_directory(config), as_typed(typed.task), as_typed(typed.hydra))
        except (ValueError, OSError) as error:
            lock.give_back(_directory(config))
            raise SystemExit(f"staf: {sentence(error)}") from error

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Give the directory back: the report has been written, or no job has begun."""
        if _in_vain(config):
            _remove(_directory(config))
        lock.give_back(_directory(config))

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Make the directory of a run and lock it.

        Raises:
            SystemExit: if something in it leads elsewhere, it is below a file, or it belongs to another run.
        """
        directory = Path(str(config.hydra.run.dir))
        try:
            _refuse_links(directory)
            directory.mkdir(parents=True, exist_ok=True)
            lock.hold(directory, "run")
            _refuse_finished(directory, as_typed(config.hydra.overrides.task))
        except (ValueError, OSError) as error:
            raise SystemExit(f"staf: {sentence(error)}") from error


class SweepReport(Callback):
    """Prints and saves the table of a sweep, draws its figures (None: as the runs do), and writes
    `report.html`, when it ends."""

    def __init__(self, figures: bool | None = None) -> None:
        self._figures = figures

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Write the report; nothing that goes wrong here may look like a sweep gone wrong."""
        directory = _directory(config)
        chosen = OmegaConf.select(config, "figures")
        if not directory.is_dir() or _in_vain(config):
            return
        try:
            chosen = True if chosen is None else chosen
            figures = draws(chosen) if self._figures is None else self._figures
            with printed_on(FigurePaper.of(chosen)):
                text = write_report(directory, figures=figures)
        except OSError as error:  # a full disk, a directory that has gone
            raise SystemExit(f"staf: no report of the sweep: {sentence(error)}") from error
        except Exception as error:
            _log.warning("no report of the sweep: %s", error)
            return
        if PRINTS.get():
            with contextlib.suppress(OSError):  # the terminal may be gone
                sys.stdout.write(f"\n{text}\n  report: {directory / PAGE}\n")
                sys.stdout.flush()


class TrackRuns(Callback):
    """Hands completed runs to the tracker of the settings, which is made before and can refuse."""

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Make the tracker of a run or sweep that begins, and end the program where the tracker refuses."""
        try:
            tracker(config)
        except Exception as error:  # Hydra turns other exceptions of callbacks into warnings
            raise SystemExit(f"staf: {error}") from error

    on_multirun_start = on_run_start

    def idle(self, settings: DictConfig) -> bool:
        """Return whether no job of these settings is tracked."""
        return OmegaConf.select(settings, "tracker._target_") is None

    def on_job_end(self, config: DictConfig, job_return: Any, **_: Any) -> None:
        """Hand over a run, or a job of a sweep, that has ended."""
        _track(config, "hydra.runtime.output_dir")

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Hand over the rows of a sweep that has a table of them."""
        if (_directory(config) / ROWS).exists():
            _track(config, "hydra.sweep.dir")


def _track(config: DictConfig, directory: str) -> None:
    """Hand the completed runs of the directory with that key to the tracker of the settings."""
    try:
        found = tracker(config)
        if found is not None:
            for run in collect(str(OmegaConf.select(config, directory))).rows:
                if run.status == COMPLETED:
                    found.record(run)
    except Exception as error:  # the results are on the disk
        _log.warning("not tracked: %s: %s", type(error).__name__, error)


def tracker(config: DictConfig) -> Tracker | None:
    """Return the tracker that the settings name; None for `tracker=none`.

    Raises:
        ValueError: if it is no tracker, or something that it needs is not installed.
    """
    settings = OmegaConf.select(config, "tracker")
    if settings is None or settings.get("_target_") is None:
        return None
    try:
        found = instantiate(settings, _convert_="all")
    except Exception as error:
        if isinstance(error.__cause__, ValueError):  # Hydra wraps what a constructor raises
            raise error.__cause__ from error
        raise
    if not isinstance(found, Tracker):
        raise fail(COMMAND_LINE, "tracker", "must be a staf_torch.sweeps.callbacks.Tracker", found)
    return found


def claim(config: DictConfig) -> None:
    """Make the sweep's directory and lock it; where another sweep has it, take the next name: `<name>-2`, ...

    A directory that was asked for on the command line is taken, or refused.

    Raises:
        ValueError: if there are more than a million jobs, or a directory that was asked for holds a sweep,
            belongs to one that goes on, or leads elsewhere.
        OSError: if it cannot be made.
    """
    wanted = str(config.hydra.sweep.dir)
    refuse_many(wanted, as_typed(config.hydra.overrides.task))
    if any(line.startswith("hydra.sweep.dir=") for line in as_typed(config.hydra.overrides.hydra)):
        place = Path(wanted)
        place.mkdir(parents=True, exist_ok=True)
        lock.hold(place)
        if (place / records.RUN).exists():
            raise ValueError(
                f"{wanted} holds a run, and a table would mix it with the sweep's. Choose another "
                "`hydra.sweep.dir`."
            )
        if (place / records.SWEEP).exists() or next(place.glob(f"*/{records.RUN}"), None) is not None:
            raise ValueError(
                f"{wanted} holds a sweep already, and a table of both would mix them. Resume that one with "
                f"`staf -m sweep.resume={wanted}`, or choose another `hydra.sweep.dir`."
            )
        _refuse_links(place)
        return
    directory, attempt = Path(wanted), 1
    while True:
        try:
            directory.mkdir(parents=True)
        except FileExistsError:
            attempt += 1
            directory = Path(f"{wanted}-{attempt}")
        else:
            break
    lock.hold(directory)
    if attempt > 1:  # also for the jobs, whose settings are composed anew
        config.hydra.sweep.dir = str(directory)
        config.hydra.overrides.hydra.append(f"hydra.sweep.dir={records.quoted(str(directory))}")


def refuse_many(directory: str | Path, typed: Sequence[str]) -> None:
    """Raise ValueError for a sweep of more jobs than memory has room for, before anybody lists them."""
    with contextlib.suppress(HydraException):  # whoever composes the jobs says so
        size = sweep_size([parse_override(line) for line in typed])
        if size > MOST_JOBS:
            raise ValueError(f"{directory} has a sweep of {size:g} jobs, and {MOST_JOBS} are the most.")


def _refuse_links(directory: Path) -> None:
    """Raise ValueError where something in a directory leads elsewhere: nothing is written through it."""
    blocking = next((p for p in (directory, *directory.parents) if p.exists() and not p.is_dir()), None)
    if blocking is not None:
        raise NotADirectoryError(errno.ENOTDIR, "Not a directory", str(blocking))
    found = sorted(path for path in links_in(directory) if ".submitit" not in path.parts)
    if found:
        more = f" and {len(found) - 1} more" if len(found) > 1 else ""
        raise ValueError(
            f"{visible(str(found[0]))}{more} is a link (or has another name, as hard links have), a pipe or "
            "the like, which no run writes: what goes there would end elsewhere. Remove it, or choose "
            "another directory."
        )


def _refuse_finished(directory: Path, typed: Sequence[str]) -> None:
    """Raise ValueError where a directory holds a sweep, or a completed run of another command line."""
    before = records.completed(directory)
    other = before is not None and sorted(before) != sorted(records.own(typed))
    if other or (directory / records.SWEEP).exists():
        holds = f"the run {' '.join(before or ())!r}" if other else "a sweep"
        raise ValueError(
            f"{directory} holds {visible(holds)}, which this run would replace. Choose another "
            "`hydra.run.dir`, or remove what is there."
        )


def close(config: DictConfig) -> None:
    """End a sweep that an exception broke: with its report, or without a trace where no job has begun."""
    directory = _directory(config)
    own = lock.held(directory)
    if own is not None and not own.lost():  # else it is another sweep's, which refused us, or has gone
        end_sweep(config)
    lock.give_back(directory)


def _in_vain(config: DictConfig) -> bool:
    """Return whether the sweep that ends now is ours, and was broken before its first job."""
    own = lock.held(_directory(config))
    ours = own is not None and not own.lost() and not records.resumed(config)
    return ours and not any(_directory(config).glob(f"**/{records.RUN}"))


def _remove(directory: Path) -> None:
    """Take away what a sweep without jobs leaves."""
    for name in (records.SWEEP, "multirun.yaml", lock.NAME):
        (directory / name).unlink(missing_ok=True)
    shutil.rmtree(directory / ".submitit", ignore_errors=True)
    with contextlib.suppress(OSError):  # not empty: it was there before
        directory.rmdir()


def farewell(config: DictConfig | None, error: KeyboardInterrupt, said: str) -> str:
    """Return what to say after the signal ``said``: how far the sweep was, and how to resume it.

    The error has what a run has noted there; ``config`` is None for a single run, or where nothing had begun.
    """
    notes = getattr(error, "__notes__", ())
    if config is None or notes:
        return "; ".join([f"staf: {said}", *notes])
    ended = [records.read(path) or {} for path in _directory(config).glob(f"*/{records.RUN}")]
    if not ended:
        return f"staf: {said}"
    complete = sum(run.get("status") == COMPLETED for run in ended)
    failed = sum(run.get("status") == FAILED and run.get("reason") != "interrupted" for run in ended)
    jobs = max(len((records.read(_directory(config) / records.SWEEP) or {}).get("jobs", ())), len(ended))
    told = f"{complete} of {jobs} jobs are complete, {failed} failed, {jobs - complete - failed} are to do"
    place = os.path.relpath(_directory(config))
    return f"staf: {said}; {told}. Resume with:\n  staf -m sweep.resume={place}"


def _directory(config: DictConfig) -> Path:
    return Path(str(config.hydra.sweep.dir))
