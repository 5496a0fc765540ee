"""The command `staf-table`."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from ..results.files import RUNNING, UNFINISHED, visible, write_bytes
from ..results.reader import Collection, collect
from ..signs import Sign, printed
from ..tables import Layout, Print, Style, Table, json_text, latex_text, parquet_bytes, tabulate
from ..tables.aggregate import AGGREGATES
from ..tables.latex import parts
from ..tables.model import escaped


def markdown_text(table: Table, about: Print) -> str:
    """Return the table in Markdown, or one for each value of a setting with a line above."""
    texts = [(value, part.markdown()) for value, part in parts(table, about.split)]
    return "\n".join(f"{escaped(value)}\n\n{text}" if value else text for value, text in texts)


_READ: dict[str, Callable[[Table, Print], str]] = {"md": markdown_text, "tex": latex_text}
"""For people: few digits, mean and deviation in one column."""
_PLAIN: dict[str, Callable[[Table], str]] = {"csv": Table.csv, "json": json_text}
"""For programs: all columns and every digit."""

_EXAMPLES = """\
examples:
  staf-table runs/<sweep>
  staf-table runs/<sweep> --rows kernel,centers.radius --columns centers.count --metric ball_error
  staf-table runs/* --aggregate mean,ci95 --metric ball_error,gradient_error --sort ball_error:desc
  staf-table runs/<sweep> --format tex --best bold --output table.tex
  staf-table runs/<sweep> --format tex --split kernel --caption "Errors." --label tab:errors
columns: --rows chooses settings, --metric numbers. All names, and a table that fits a column of a page:
  staf-table runs/<sweep> --format csv | head -1
  staf-table runs/<sweep> --format tex --rows kernel,centers.radius --metric ball_error,cost_ratio
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; what a user got wrong ends as one sentence and the exit code 1."""
    options = _parser().parse_args(arguments)
    if options.watch is None:
        return _once(options)
    with contextlib.suppress(KeyboardInterrupt):
        while _going_on(options.path):
            sys.stdout.write("\x1b[H\x1b[2J" if sys.stdout.isatty() else "")
            _once(options)
            sys.stdout.flush()
            time.sleep(options.watch)
    return _once(options)


def _going_on(paths: Sequence[Path]) -> bool:
    """Return whether a run has not ended, or a job of a sweep has not begun."""
    try:
        found = collect(paths)
    except ValueError:  # nothing is there so far
        return any(path.is_dir() for path in paths)
    waiting = any("have not started" in skipped.reason for skipped in found.skipped)
    return waiting or any(run.status in (RUNNING, UNFINISHED) for run in found.rows)


@Sign("staf-table", log=False)
def _once(options: argparse.Namespace) -> int:
    try:
        found = collect(options.path)
        for skipped in found.skipped:
            print(f"skipped {visible(str(skipped.path))}: {skipped.reason}", file=sys.stderr)
        for remark in found.remarks:
            print(f"note: {remark}", file=sys.stderr)
        content = _rendered(found, options)
        if options.output is None:
            printed(content.decode())
        else:
            write_bytes(options.output, content)
    except (ValueError, OSError) as error:
        print(f"staf-table: {error}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="staf-table",
        description="The runs of sweeps as a table: one row a run, or aggregated over what is neither in "
        "--rows nor in --columns, such as the seed.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("path", nargs="+", type=Path, help="a run, a sweep, or a folder of such")
    kinds = (*_READ, *_PLAIN, "parquet")
    parser.add_argument("--format", choices=kinds, default="md", help="md (default), csv, tex, json, parquet")
    lists = {
        "rows": "settings with a column of their own, a row for each combination (all that were swept)",
        "columns": "settings whose values become columns of each metric",
        "metric": "metrics (md, tex: the headlines; else all)",
        "aggregate": f"any of {', '.join(AGGREGATES)}, over the runs of a row; n and failed count them",
        "sort": "columns to sort by, smallest first; NAME:desc for the largest first",
    }
    for name, text in lists.items():
        parser.add_argument(f"--{name}", help=text, type=_names, default=(), metavar="NAME,...")
    parser.add_argument(
        "--best", choices=("bold",), help="print the best number of each column in bold (md, tex)"
    )
    parser.add_argument("--split", metavar="SETTING", help="a table for each value of this setting (md, tex)")
    parser.add_argument(
        "--caption",
        metavar="TEXT",
        help="put a `table` environment with this caption around it; meanings of the columns follow (tex)",
    )
    parser.add_argument("--label", metavar="TEXT", help="label for \\ref; needs --caption (tex)")
    parser.add_argument(
        "--wide", action="store_true", help="`table*`, over both columns of a page; needs --caption (tex)"
    )
    parser.add_argument(
        "--rename",
        type=_pairs,
        default={},
        metavar="NAME=TEXT,...",
        help="names of settings, metrics or texts of cells in the printed table; TEXT is LaTeX (tex)",
    )
    parser.add_argument("--digits", type=int, default=3, help="significant digits of md and tex (3)")
    parser.add_argument(
        "--watch",
        type=float,
        nargs="?",
        const=2.0,
        metavar="SECONDS",
        help="print again every SECONDS (2) until the sweep has ended",
    )
    parser.add_argument("--output", type=Path, metavar="FILE", help="file to write in place of the terminal")
    return parser


def _names(text: str) -> tuple[str, ...]:
    return tuple(name for part in text.split(",") if (name := part.strip()))


def _pairs(text: str) -> dict[str, str]:
    pairs = [part.partition("=") for part in _names(text)]
    for name, equals, _ in pairs:
        if not equals:
            raise argparse.ArgumentTypeError(f"must be NAME=TEXT,...; got {name!r}")
    return {name.strip(): written.strip() for name, _, written in pairs}


def _rendered(found: Collection, options: argparse.Namespace) -> bytes:
    kind = options.format
    if options.digits < 1:
        raise ValueError(f"`staf-table --digits` must be at least 1; got {options.digits}.")
    layout = Layout(
        rows=options.rows,
        columns=options.columns,
        metrics=options.metric,
        aggregates=options.aggregate,
        sort=options.sort,
        every_metric=kind not in _READ,
        style=Style(options.digits, options.best == "bold"),
    )
    table = tabulate(found, layout)
    about = Print(options.caption, options.label, options.rename, options.split, options.wide)
    if kind in _READ:
        return _READ[kind](table, about).encode()
    if kind == "json":  # a list of rows has no place for them
        for note in table.notes:
            print(f"note: {visible(note)}", file=sys.stderr)
    if kind in _PLAIN:
        return _PLAIN[kind](table).encode()
    if options.output is None:
        raise ValueError("`staf-table --format parquet` needs --output FILE.")
    return parquet_bytes(table)
