"""Tables of one sweep in every format, and the page of it, recorded word for word."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from recorded import Record
from sweep_runs import write_sweep

from staf_torch.results.reader import Collection, collect
from staf_torch.sweeps.report import page
from staf_torch.tables import Layout, Style, html_text, json_text, latex_text, tabulate
from staf_torch.tables.aggregate import AGGREGATES

LAYOUTS = {
    "runs": Layout(),
    "every metric": Layout(every_metric=True, sort=("ball_error",)),
    "pivot": Layout(
        rows=("kernel",), columns=("centers.count",), metrics=("ball_error",), style=Style(bold=True)
    ),
    "aggregates": Layout(
        rows=("kernel", "centers.count"),
        metrics=("ball_error", "settling_time"),
        aggregates=tuple(AGGREGATES),
        style=Style(digits=5),
        sort=("centers.count",),
    ),
}


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Collection:
    return collect(write_sweep(tmp_path_factory.mktemp("recorded") / "runs", radii=(0.1,), seeds=(0, 1)))


def lines(text: str, folder: Path | None) -> list[str]:
    """Without where it was written, when, and by which build."""
    text = re.sub(r"(/[\w.-]+)+/runs", "RUNS", text)
    return re.sub(r"\b\d+\.\d+\.\d+\S* source \w+[^<\n\"]*", "BUILD", text).splitlines()


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("form", [html_text, json_text, latex_text], ids=["html", "json", "latex"])
def test_a_table_is_the_recorded(name: str, form: object, found: Collection, record: Record) -> None:
    table = tabulate(found, LAYOUTS[name])
    assert callable(form)
    record(lines(form(table), None), rtol=1e-9)


def test_the_page_of_a_sweep_is_the_recorded(found: Collection, record: Record) -> None:
    text = page(found, tabulate(found), {"errors.png": b"png"}, "A sweep")
    record(lines(text.partition("<body")[2], None))
