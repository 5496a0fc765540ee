"""`staf_torch.run`, `staf_torch.sweep` and `staf_torch.read_runs`: the command `staf` as Python functions.

They return a `Run` or `Runs`.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import functools
import html
import operator
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from ..figures.style import keep_figures
from ..numerics.checks import choice, fail
from ..results import reader
from ..results import run_record as records
from ..results.files import FAILED, FIGURES, HISTORY, RUN, UnreadableError, parse_overrides, read_bytes
from ..results.reader import Collection, Value, collect, identity, read_record
from ..results.run_directory import History
from ..signs import Sign
from ..tables import Layout, Style, Table, html_text, tabulate
from ..tables.aggregate import in_order, lost_share
from ..tables.model import data_frame, require, significant
from . import callbacks
from .command import command_line
from .hydra_compat import application
from .job import PRINTS, Refused, execute, sentence, silence_terminal

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    DataFrame = Any

Draw = Callable[["Run"], Mapping[str, "Figure"]]


@Sign("staf_torch.run", log=False)
def run(*overrides: str, directory: str | Path | None = None) -> Run:
    """Run one experiment, as `staf` does with the same overrides.

    Settings, run directory and numbers are those of the command. Nothing of Hydra, `sys.argv`, logging or the
    environment is left changed, so that this may be called anywhere, in another Hydra application too.

    Example:
        >>> run("kernel=gaussian", "duration=6.0", "figures=false", directory="runs/gaussian")
        <Run completed: kernel=gaussian duration=6.0 figures=false, ball_error=...>

        Shown by `staf_torch/sweeps/README.md`.

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
        path = Path(str(app.run(_execute_silently).hydra_cfg.hydra.runtime.output_dir))
    figures = {
        png.stem: figure
        for png in sorted((path / FIGURES).glob("*.png"))
        for figure, content in drawn
        if content == png.read_bytes()
    }
    return Run.of(read_record(path), functools.partial(_kept, figures))


@Sign("staf_torch.sweep", log=False)
def sweep(*overrides: str, directory: str | Path | None = None) -> Runs:
    """Run a sweep, as `staf -m` does with the same overrides: in tensor batches, a directory for each job.

    With `"sweep.records=table"` there is one file of rows in place of directories.

    A job that fails has a row with its reason, and the others go on. `"sweep.resume=runs/<sweep>"` takes up a
    sweep that was interrupted.

    Example:
        >>> runs = sweep("kernel=gaussian,matern", "centers.radius=0.1,0.2", "duration=5.5", "figures=false")
        >>> runs
        <Runs 4 completed, over kernel, centers.radius>
        >>> runs.best("ball_error").setting("centers.radius")
        0.1

        Shown by `staf_torch/sweeps/README.md`.

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
            app.sweep(execute)
            path = _directory(app.begun)
        except BaseException as error:
            path = _ended_early(error, app.begun)
    return read_runs(path)


def read_runs(path: str | Path | Sequence[str | Path]) -> Runs:
    """Return the runs at or under a directory, or several, whoever made them.

    Example:
        >>> sweep("centers.radius=0.1,0.2", "duration=6.0", "figures=false", directory="runs/radii")
        <Runs 2 completed, over centers.radius>
        >>> read_runs("runs/radii")
        <Runs 2 completed, over centers.radius>

        Shown by `staf_torch/sweeps/README.md`.

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
        typed = (line for line in record["overrides"] if not line.startswith("figures="))
        again = run(*typed, "figures.draw=true", "history=false", "tracker=none", directory=folder)
        return again.figures()


def _ended_early(error: BaseException, broken: DictConfig | None) -> Path:
    """End a broken sweep with its report; return its directory if nothing but jobs failed.

    Raises:
        KeyboardInterrupt: after Ctrl-C, with what to say.
        BaseException: ``error``, where it is not that of a job.
    """
    if broken is not None:
        callbacks.close(broken)
    if isinstance(error, KeyboardInterrupt):
        raise KeyboardInterrupt(callbacks.farewell(broken, error, "interrupted")) from None
    if broken is not None and isinstance(error, Exception):
        directory = _directory(broken)
        begun = any(directory.glob(f"**/{RUN}"))
        if begun and any(row.status == FAILED for row in collect(directory).rows):
            return directory
    raise error


def _directory(sweep: DictConfig | None) -> Path:
    assert sweep is not None
    return Path(str(sweep.hydra.sweep.dir)).absolute()


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


@dataclasses.dataclass(frozen=True, repr=False)
class Run(reader.RecordedRun):
    """A run in its directory: settings, metrics, history and figures.

    Example:
        >>> found = run("centers.radius=0.2", "duration=6.0", directory="runs/one")
        >>> found.metrics["ball_error"] < 1
        True
        >>> found.history["state"].shape
        (1, 601, 2)
        >>> sorted(found.figures())
        ['gradient_chase']
    """

    draw: Draw = dataclasses.field(kw_only=True, compare=False)

    @classmethod
    def of(cls, record: reader.RecordedRun, draw: Draw) -> Run:
        """Return what was read from a run directory, with a function that draws its figures."""
        return cls(
            **{f.name: getattr(record, f.name) for f in dataclasses.fields(reader.RecordedRun)}, draw=draw
        )

    @functools.cached_property
    def history(self) -> History:
        """Name -> array, each read from `history.npz` when it is first asked for.

        Raises:
            ValueError: if the run kept no history (`history=false`).
        """
        path = self.directory / HISTORY
        if not path.exists():
            raise fail("Run", "history", "cannot be read: the run kept none", str(path))
        return History(path)

    def figures(self) -> dict[str, Figure]:
        """Return the figures by their names, as matplotlib objects.

        A run of `staf_torch.run` has them already. Those of other runs are drawn anew, for which the run is
        computed once more.
        """
        return dict(self.draw(self))

    def _repr_html_(self) -> str:
        shown = "".join(
            f'<img style="max-width:100%" alt="{html.escape(name)}" '
            f'src="data:image/png;base64,{base64.b64encode(picture).decode()}">'
            for name, picture in self._pictures()
        )
        rows = "".join(
            f"<tr><th>{html.escape(name)}</th><td>{html.escape(significant(value, 4))}</td></tr>"
            for name, value in self.metrics.items()
        )
        return f"<p><code>{html.escape(repr(self))}</code></p>{shown}<table>{rows}</table>"

    def _pictures(self) -> Iterator[tuple[str, bytes]]:
        """Yield name and content of every picture in this folder; a link may lead to anything."""
        folder = self.directory / FIGURES
        for path in () if folder.is_symlink() else sorted(folder.glob("*.png")):
            with contextlib.suppress(UnreadableError):
                yield path.stem, read_bytes(path)


@dataclasses.dataclass(frozen=True, repr=False)
class Runs:
    """The runs of a sweep, in order.

    No `Sequence` by name: polars would take one for rows, and not ask for the Arrow stream.

    Example:
        >>> found = sweep("kernel=gaussian,matern", "centers.radius=0.1,0.2", "duration=6.0", "figures=false")
        >>> found
        <Runs 4 completed, over kernel, centers.radius>
        >>> found.best("ball_error").setting("centers.radius")
        0.1
        >>> len(found.filter("kernel=matern"))
        2
    """

    found: Collection
    draw: Draw

    @overload
    def __getitem__(self, index: int) -> Run: ...
    @overload
    def __getitem__(self, index: slice) -> Runs: ...
    def __getitem__(self, index: int | slice) -> Run | Runs:
        """Return a run, or the runs of a slice."""
        if isinstance(index, slice):
            return self._with(self.found.rows[index])
        return Run.of(self.found.rows[index], self.draw)

    def __iter__(self) -> Iterator[Run]:
        """Yield the runs."""
        return (self[i] for i in range(len(self)))

    def __len__(self) -> int:
        """Return the number of runs."""
        return len(self.found.rows)

    def __repr__(self) -> str:
        """Return how many runs there are, how they ended, and what was swept."""
        statuses = [run.status for run in self.found.rows]
        counts = ", ".join(f"{statuses.count(each)} {each}" for each in dict.fromkeys(statuses))
        return f"<Runs {counts or 'none'}, over {', '.join(self.found.swept) or 'nothing'}>"

    def _repr_html_(self) -> str:
        return f"<p><code>{html.escape(repr(self))}</code></p>{html_text(self.table())}"

    def table(self, **layout: Any) -> Table:
        """Return the table of `staf-table`; the arguments are those of `tables.Layout`."""
        return tabulate(self.found, Layout(**{"style": Style(bold=True)} | layout))

    def sort(self, *names: str) -> Runs:
        """Return the runs in order of metrics or settings, the first name counts most.

        The best number of a metric comes first; `name:asc` and `name:desc` say otherwise. What is missing is
        last.
        """
        rows = list(self.found.rows)
        for name in reversed(names):
            key, _, direction = name.partition(":")
            self._known(key)
            larger = key in self.found.infos and self.found.infos[key].larger_is_better
            descending = direction == "desc" or (larger and direction != "asc")
            rows = in_order(rows, operator.methodcaller("value", key), descending=descending)
        return self._with(rows)

    def filter(self, *conditions: str | Callable[[Run], bool]) -> Runs:
        """Return the runs for which all conditions hold: settings as typed, `"kernel=gaussian"`, or functions
        of a run."""
        kept: Iterable[Run] = self
        for condition in conditions:
            if callable(condition):
                kept = [run for run in kept if condition(run)]
                continue
            for key, wanted in parse_overrides([condition]).items():
                self._known(key)
                kept = [run for run in kept if identity(run.value(key)) == identity(wanted)]
        return self._with(kept)

    def best(self, metric: str) -> Run:
        """Return the run with the best number of a metric: the smallest, unless larger is better.

        Metrics are of the trajectories that did not diverge: only runs that lost the least of them count.

        Raises:
            ValueError: if no run has a number of that name.
        """
        choice("Runs.best", "metric", metric, self.found.metrics)
        ordered = self.sort(metric)
        if ordered[0].metrics.get(metric) is None:
            raise fail("Runs.best", "metric", f"has no number: {ordered[0].absence(metric)}", metric)
        return min(ordered, key=lambda run: lost_share(run, metric))  # the first of equals

    def to_pandas(self) -> DataFrame:
        """Return a pandas `DataFrame` with a row a run: swept settings, all metrics, status and directory.

        Raises:
            ValueError: without pandas (extra `tables`).
        """
        return data_frame(self.table(every_metric=True))

    def pivot(
        self, rows: str | Sequence[str], columns: str | Sequence[str], metric: str, aggregate: str = "mean"
    ) -> DataFrame:
        """Return a pandas `DataFrame` of one metric over settings.

        Args:
            rows: settings down the side.
            columns: settings along the top.
            metric: what the cells hold.
            aggregate: of the runs that share a cell: mean, median, min, max or std. NaN where one of them has
                no number.

        Raises:
            ValueError: for a name that there is not, or without pandas (extra `tables`).
        """
        choice("Runs.pivot", "metric", metric, self.found.metrics)
        choice("Runs.pivot", "aggregate", aggregate, ("mean", "median", "min", "max", "std"))
        down, along = ([each] if isinstance(each, str) else list(each) for each in (rows, columns))
        for key in (*down, *along):
            self._known(key)
        pandas = require("pandas", "a DataFrame")
        cells = {key: [_hashable(run.value(key)) for run in self.found.rows] for key in (*down, *along)}
        frame = pandas.DataFrame(cells | {metric: [run.metrics.get(metric) for run in self.found.rows]})
        frame[metric] = frame[metric].astype(float)
        grouped = frame.groupby([*down, *along], dropna=False)[metric]
        return grouped.agg(lambda numbers: getattr(numbers, aggregate)(skipna=False)).unstack(along)

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """Hand the table of `to_pandas` to polars, duckdb and others through Arrow's C interface.

        Raises:
            ValueError: without pyarrow (extra `tables`).
        """
        arrow = require("pyarrow", "an Arrow stream")
        table = arrow.Table.from_pandas(self.to_pandas(), preserve_index=False)
        return table.__arrow_c_stream__(requested_schema)

    def _with(self, rows: Iterable[reader.RecordedRun]) -> Runs:
        return dataclasses.replace(self, found=dataclasses.replace(self.found, rows=tuple(rows)))

    def _known(self, key: str) -> None:
        choice("Runs", "name", key, (*self.found.metrics, *self.found.keys))


def _hashable(value: Value) -> Value:
    return repr(value) if isinstance(value, list) else value
