"""The command `staf-table`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from .collection import Collection, collect
from .files import write_bytes
from .formats import FORMATS, PLAIN, READ, Style, parquet_bytes
from .statistics import AGGREGATES
from .tabulate import Layout, tabulate

_EXAMPLES = """\
examples:
  staf-table runs/<sweep>
  staf-table runs/<sweep> --rows kernel,centers.radius --columns centers.count --metric ball_error
  staf-table runs/* --aggregate mean,ci95 --metric ball_error,gradient_error --sort ball_error:desc
  staf-table runs/<sweep> --format tex --best bold --output table.tex
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; what a user got wrong ends as one sentence and the exit code 1."""
    options = _parser().parse_args(arguments)
    try:
        found = collect(options.path)
        for skipped in found.skipped:
            print(f"skipped {skipped.path}: {skipped.reason}", file=sys.stderr)
        for remark in found.remarks:
            print(f"note: {remark}", file=sys.stderr)
        _write(_rendered(found, options), options.output)
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
    parser.add_argument(
        "--format", choices=FORMATS, default="md", help="md (default), csv, tex, json, parquet"
    )
    lists = {
        "rows": "settings that tell rows apart (all that were swept)",
        "columns": "settings over whose values a metric is spread",
        "metric": "metrics (md, tex: the headlines; else all)",
        "aggregate": f"of {', '.join(AGGREGATES)}; n and failed, the numbers of runs, come with them",
        "sort": "columns, each maybe with :desc for the largest first",
    }
    for name, text in lists.items():
        parser.add_argument(f"--{name}", help=text, type=_names, default=(), metavar="NAME,...")
    parser.add_argument("--best", choices=("bold",), help="the best number of each column (md, tex)")
    parser.add_argument("--digits", type=int, default=3, help="significant digits of md and tex (3)")
    parser.add_argument("--output", type=Path, metavar="FILE", help="write there, not to the terminal")
    return parser


def _names(text: str) -> tuple[str, ...]:
    return tuple(name for part in text.split(",") if (name := part.strip()))


def _rendered(found: Collection, options: argparse.Namespace) -> bytes:
    kind = options.format
    layout = Layout(
        rows=options.rows,
        columns=options.columns,
        metrics=options.metric,
        aggregates=options.aggregate,
        sort=options.sort,
        every_metric=kind not in READ,
    )
    table = tabulate(found, layout)
    if kind == "parquet":
        if options.output is None:
            raise ValueError("`staf-table --format parquet` needs --output FILE.")
        return parquet_bytes(table)
    if kind in PLAIN:
        return PLAIN[kind](table).encode()
    if options.digits < 1:
        raise ValueError(f"`staf-table --digits` must be at least 1; got {options.digits}.")
    return READ[kind](table, Style(options.digits, options.best == "bold")).encode()


def _write(content: bytes, output: Path | None) -> None:
    if output is None:
        sys.stdout.write(content.decode())
    else:
        write_bytes(output, content)
