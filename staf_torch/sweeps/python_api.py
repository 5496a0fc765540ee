"""`staf_torch.run`, `staf_torch.sweep` and `staf_torch.read_runs`: the command `staf` as Python functions."""

from __future__ import annotations

import contextlib
import functools
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from ..figures.style import keep_figures
from ..results import run_record as records
from ..results.files import FAILED, FIGURES, RUN
from ..results.reader import collect, read_record
from . import callbacks
from .batching import sentence
from .hydra_compat import application, broken_sweep
from .job import PRINTS, Refused, execute, silence_terminal
from .resume import command_line
from .runs import Run, Runs

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def run(*overrides: str, directory: str | Path | None = None) -> Run:
    """Run one experiment, as `staf` does with the same overrides.

    Settings, run directory and numbers are those of the command. Nothing of Hydra, `sys.argv`, logging or the
    environment is left changed, so that this may be called anywhere, in another Hydra application too.

    Example:
        >>> run("kernel=gaussian", "duration=6.0", "figures=false", directory="runs/gaussian")
        <Run completed: kernel=gaussian duration=6.0 figures=false, ball_error=...>

        Shown by `tests/examples/notebooks/chasing.py`.

    Args:
        overrides: as on the command line, without the shell's quotes: `"initial_state=[1.0,0.0]"`.
        directory: of the run; None: `runs/<date and time>` in the working directory.

    Raises:
        ValueError: if a setting breaks its rule, or the settings ask for a sweep.
        Exception: that of the experiment.
        KeyboardInterrupt: after Ctrl-C; the run directory says `interrupted`.
    """
    place = [] if directory is None else [f"hydra.run.dir={records.quoted(str(directory))}"]
    with _quietly(), keep_figures() as drawn, _plain_errors(), application([*overrides, *place]) as app:
        if app.is_sweep():
            raise ValueError(
                f"`staf_torch.run(...)` must be one run; got {' '.join(overrides)!r}, which is a sweep: "
                "call `staf_torch.sweep`."
            )
        path = app.run(_execute_silently)
    figures = {
        png.stem: figure
        for png in sorted((path / FIGURES).glob("*.png"))
        for figure, content in drawn
        if content == png.read_bytes()
    }
    return Run.of(read_record(path), functools.partial(_kept, figures))


def sweep(*overrides: str, directory: str | Path | None = None) -> Runs:
    """Run a sweep, as `staf -m` does with the same overrides: in tensor batches, a directory for each job.

    With `"sweep.records=table"` there is one file of rows in place of directories.

    A job that fails has a row with its reason, and the others go on. `"sweep.resume=runs/<sweep>"` takes up a
    sweep that was interrupted.

    Example:
        >>> runs = sweep("kernel=gaussian,matern", "centers.radius=0.1,0.2", "duration=6.0", "figures=false")
        >>> runs
        <Runs 4 completed, over kernel, centers.radius>
        >>> runs.best("ball_error").setting("centers.radius")
        0.1

        Shown by `tests/examples/notebooks/sweep_and_table.py`.

    Args:
        overrides: as on the command line, without the shell's quotes.
        directory: of the sweep; None: `runs/<date and time>_sweep` in the working directory.

    Raises:
        ValueError: if the sweep cannot begin.
        KeyboardInterrupt: after Ctrl-C, with the number of jobs that are complete and how to resume.
    """
    place = [] if directory is None else [f"hydra.sweep.dir={records.quoted(str(directory))}"]
    with (
        _quietly(),
        _plain_errors(),
        application(command_line(["--multirun", *overrides, *place])) as app,
    ):
        try:
            path = app.sweep(execute)
        except BaseException as error:
            path = _ended_early(error)
    return read_runs(path)


def read_runs(path: str | Path | Sequence[str | Path]) -> Runs:
    """Return the runs at or under a directory, or several, whoever made them.

    Example:
        >>> sweep("centers.radius=0.1,0.2", "duration=6.0", "figures=false", directory="runs/radii")
        <Runs 2 completed, over centers.radius>
        >>> read_runs("runs/radii")
        <Runs 2 completed, over centers.radius>

        Shown by `tests/examples/notebooks/sweep_and_table.py`.

    Raises:
        ValueError: if a path does not exist or no run is found.
    """
    return Runs(collect(path), _draw_again)


def _execute_silently(cfg: DictConfig) -> Any:
    silence_terminal()
    return execute(cfg)


def _kept(figures: Mapping[str, Figure], run: Run) -> Mapping[str, Figure]:
    """Return the figures that were drawn while the run went on."""
    return figures


def _draw_again(done: Run) -> Mapping[str, Figure]:
    """Compute a run once more, in a directory that is then removed, for its figures."""
    record = records.read(done.directory / RUN)
    if record is None or done.row is not None:
        raise ValueError(f"`Run.figures()` needs a run with its own {RUN}; got {done.directory}.")
    with tempfile.TemporaryDirectory() as folder:
        again = run(*record["overrides"], "figures=true", "history=false", "tracker=none", directory=folder)
        return again.figures()


def _ended_early(error: BaseException) -> Path:
    """End a broken sweep with its report; return its directory if nothing but jobs failed.

    Raises:
        KeyboardInterrupt: after Ctrl-C, with what to say.
        BaseException: ``error``, where it is not that of a job.
    """
    broken = broken_sweep(error)
    if broken is not None:
        callbacks.close(broken)
    if isinstance(error, KeyboardInterrupt):
        raise KeyboardInterrupt(callbacks.farewell(broken, error, "interrupted")) from None
    if broken is not None and isinstance(error, Exception):
        directory = Path(str(broken.config.hydra.sweep.dir)).absolute()
        begun = any(directory.glob(f"**/{RUN}"))
        if begun and any(row.status == FAILED for row in collect(directory).rows):
            return directory
    raise error


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Keep tables and log lines off the terminal: the caller gets objects."""
    token = PRINTS.set(False)
    try:
        yield
    finally:
        PRINTS.reset(token)


@contextlib.contextmanager
def _plain_errors() -> Iterator[None]:
    """Raise the errors of a user as `ValueError` in the command's words, and never `SystemExit`."""
    try:
        yield
    except Refused as refused:
        raise _as_value_error(refused.__cause__ or refused) from refused.__cause__
    except SystemExit as ended:
        raise ValueError(str(ended.code).removeprefix("staf: ")) from ended.__cause__
    except (HydraException, OmegaConfBaseException) as error:
        raise _as_value_error(error) from error


def _as_value_error(error: BaseException) -> BaseException:
    ours = not isinstance(error, HydraException | OmegaConfBaseException)
    return error if ours else ValueError(sentence(error))
