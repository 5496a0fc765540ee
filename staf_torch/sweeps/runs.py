"""Results in Python: `Run` and `Runs`, as `staf_torch.run` and `staf_torch.sweep` return them."""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import html
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, overload

from ..numerics.checks import choice, fail
from ..results import reader
from ..results.files import FIGURES, HISTORY, parse_overrides
from ..results.reader import Collection, Value, identity
from ..results.run_directory import History
from ..results.untrusted import UnreadableError, read_bytes
from ..tables import Layout, Style, Table, html_text, tabulate
from ..tables.columns import significant
from ..tables.model import data_frame, require

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    DataFrame = Any

Draw = Callable[["Run"], Mapping[str, "Figure"]]


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

    @cached_property
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
            there = [run for run in rows if run.value(key) is not None]
            there.sort(
                key=lambda run: _order(run.value(key)),
                reverse=direction == "desc" or (larger and direction != "asc"),
            )
            rows = there + [run for run in rows if run.value(key) is None]
        return self._with(rows)

    def filter(self, *conditions: str | Callable[[Run], bool]) -> Runs:
        """Return the runs for which all conditions hold.

        Args:
            conditions: settings as they are typed, `"kernel=gaussian"`, or functions of a run.
        """
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

        Raises:
            ValueError: if no run has a number of that name.
        """
        choice("Runs.best", "metric", metric, self.found.metrics)
        first = self.sort(metric)[0]
        if first.metrics.get(metric) is None:
            raise fail("Runs.best", "metric", f"has no number: {first.absence(metric)}", metric)
        return first

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


def _order(value: Value) -> tuple[bool, float, str]:
    number = isinstance(value, int | float)
    return (False, float(value), "") if number else (True, 0.0, str(value))  # type: ignore[arg-type]


def _hashable(value: Value) -> Value:
    return repr(value) if isinstance(value, list) else value
