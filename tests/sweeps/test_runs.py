"""Runs in Python, read from folders that nobody ran: their order, choice, tables and what is shown."""

from __future__ import annotations

import base64
import dataclasses
import operator
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sweep_runs import write_run

from staf_torch.results.reader import collect
from staf_torch.sweeps.python_api import Run, Runs

FIGURE: Any = object()
notebook = operator.methodcaller("_repr_html_")
"""What a notebook shows of a run or of runs."""
GRID = [  # kernel, count, error, fraction that is regulated
    ("gaussian", 6, 0.5, 0.25),
    ("matern", 3, 0.125, 1.0),
    ("gaussian", 3, 2.0, None),
    ("matern", 6, None, 0.5),
]


@pytest.fixture
def runs(tmp_path: Path) -> Runs:
    for num, (kernel, count, error, fraction) in enumerate(GRID):
        overrides = {"kernel": kernel, "centers.count": count, "initial_state": [1.0, float(num % 2)]}
        write_run(tmp_path / str(num), overrides, {"ball_error": error, "regulated_fraction": fraction})
    return Runs(collect(tmp_path), lambda run: {run.directory.name: FIGURE})


def names(runs: Any) -> str:
    return "".join(run.directory.name for run in runs)


def test_runs_are_a_sequence(runs: Runs) -> None:
    assert len(runs) == 4
    assert names(runs) == "0123"
    assert isinstance(runs[0], Run)
    assert runs[-1].directory.name == "3"
    assert isinstance(runs[1:3], Runs)
    assert names(runs[1:3]) == "12"
    assert runs[2].figures() == {"2": FIGURE}
    assert runs[1:3][1].figures() == {"2": FIGURE}
    assert repr(runs) == "<Runs 4 completed, over kernel, centers.count, initial_state>"
    assert repr(runs[:0]) == "<Runs none, over nothing>"
    with pytest.raises(IndexError):
        runs[4]


@pytest.mark.parametrize(
    ("by", "order"),
    [
        (["ball_error"], "1023"),
        (["ball_error:desc"], "2013"),
        (["regulated_fraction"], "1302"),  # the larger the better
        (["regulated_fraction:asc"], "0312"),
        (["centers.count", "kernel"], "2103"),
        (["kernel:desc", "ball_error"], "1302"),
        ([], "0123"),
    ],
)
def test_runs_are_sorted_by_metrics_and_settings_with_what_is_missing_last(
    by: list[str], order: str, runs: Runs
) -> None:
    assert names(runs.sort(*by)) == order


def test_the_best_run_is_that_of_the_best_number(runs: Runs) -> None:
    assert runs.best("ball_error").directory.name == "1"
    assert runs.best("regulated_fraction").directory.name == "1"
    assert runs[2:].best("regulated_fraction").directory.name == "3"
    with pytest.raises(ValueError, match=r"`Runs.best\(metric=...\)` has no number: .*; got 'ball_error'"):
        runs[3:].best("ball_error")
    with pytest.raises(ValueError, match=r"`Runs.best\(metric=...\)` must be one of 'ball_error'"):
        runs.best("kernel")
    with pytest.raises(ValueError, match=r"`Runs\(name=...\)` must be one of 'ball_error'.*; got 'speed'"):
        runs.sort("speed")


def test_runs_are_chosen_as_settings_are_typed_or_by_a_function(runs: Runs) -> None:
    assert names(runs.filter("kernel=matern")) == "13"
    assert names(runs.filter("+kernel=matern", "centers.count=6")) == "3"
    assert names(runs.filter("initial_state=[1.0,1.0]")) == "13"
    assert names(runs.filter("ball_error=0.5")) == "0"
    assert names(runs.filter("ball_error=null")) == "3"
    assert names(runs.filter(lambda run: (run.metrics["ball_error"] or 0) > 0.3, "kernel=gaussian")) == "02"
    assert names(runs.filter()) == "0123"
    assert isinstance(runs.filter("kernel=matern"), Runs)
    with pytest.raises(ValueError, match=r"`Runs\(name=...\)` must be one of .*; got 'kernle'"):
        runs.filter("kernle=matern")


def test_a_table_has_the_best_in_bold_unless_somebody_says_otherwise(runs: Runs) -> None:
    assert "**0.125**" in runs.table().markdown()
    assert "**" not in runs.table(style=dataclasses.replace(runs.table().style, bold=False)).markdown()
    assert "condition_number" not in runs.table().markdown()
    assert [row.cells["ball_error"] for row in runs.table(sort=("ball_error",)).rows] == [
        0.125,
        0.5,
        2.0,
        None,
    ]
    shown = notebook(runs)
    assert shown.startswith(
        "<p><code>&lt;Runs 4 completed, over kernel, centers.count, initial_state&gt;</code></p>"
    )
    assert "<b>0.125</b>" in shown


def test_a_history_is_read_where_one_was_kept(runs: Runs) -> None:
    with pytest.raises(
        ValueError, match=r"`Run\(history=...\)` cannot be read: the run kept none; got .*npz"
    ):
        _ = runs[0].history
    np.savez(runs[1].directory / "history.npz", time=np.arange(3.0))
    assert list(runs[1].history["time"]) == [0.0, 1.0, 2.0]


def test_a_notebook_shows_metrics_and_the_pictures_of_the_run(runs: Runs, tmp_path: Path) -> None:
    place = runs[0].directory / "figures"
    place.mkdir()
    for name, content in (("b<", b"two"), ("a", b"one")):
        (place / f"{name}.png").write_bytes(content)
    (place / "else.svg").write_bytes(b"three")
    (tmp_path / "elsewhere.png").write_bytes(b"four")
    (place / "link.png").symlink_to(tmp_path / "elsewhere.png")
    shown = notebook(runs[0])
    pictures = re.findall(r'alt="([^"]*)" src="data:image/png;base64,([^"]*)"', shown)
    assert [(name, base64.b64decode(text)) for name, text in pictures] == [("a", b"one"), ("b&lt;", b"two")]
    assert "<tr><th>ball_error</th><td>0.5</td></tr>" in shown
    assert shown.startswith("<p><code>&lt;Run completed: ")
    assert "<td>-</td>" in notebook(runs[3])
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "a.png").write_bytes(b"one")
    (runs[1].directory / "figures").symlink_to(tmp_path / "theirs")
    assert "<img" not in notebook(runs[1])


# pandas


def test_a_frame_has_a_row_a_run_and_all_metrics(runs: Runs) -> None:
    pytest.importorskip("pandas")
    frame = runs.to_pandas()
    assert list(frame["ball_error"].astype(float).fillna(-1.0)) == [0.5, 0.125, 2.0, -1.0]
    assert "regulated_fraction" in frame
    write_run(runs[0].directory.parent / "9", {"kernel": "own"}, {"condition_number": 1.0})
    assert "condition_number" in Runs(collect(runs[0].directory.parent), lambda run: {}).to_pandas()


def test_a_pivot_is_of_the_runs_that_share_a_cell(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    cells = [("a", 3, 1.0), ("a", 3, 2.0), ("a", 3, 6.0), ("b", 3, 4.0), ("b", 6, None), ("b", 6, 5.0)]
    for num, (kernel, count, error) in enumerate(cells):
        overrides = {"kernel": kernel, "centers.count": count, "seed": num, "initial_state": [1.0, num % 2]}
        write_run(tmp_path / str(num), overrides, {"ball_error": error})
    runs = Runs(collect(tmp_path), lambda run: {})
    for aggregate, value in (("mean", 3.0), ("median", 2.0), ("min", 1.0), ("max", 6.0), ("std", 7**0.5)):
        frame = runs.pivot("kernel", "centers.count", "ball_error", aggregate)
        assert frame.loc["a", 3] == pytest.approx(value)
        assert pandas.isna(frame.loc["b", 6])  # one of the two has none
        assert pandas.isna(frame.loc["a", 6])
    assert runs.pivot("kernel", "centers.count", "ball_error").loc["a", 3] == 3.0
    both = runs.pivot(["kernel", "centers.count"], ["initial_state"], "ball_error")
    assert both.loc[("a", 3), "[1.0, 0]"] == 3.5
    with pytest.raises(ValueError, match=r"aggregate=...\)` must be one of 'mean', 'median'"):
        runs.pivot("kernel", "centers.count", "ball_error", "sum")


def test_polars_reads_the_table_of_the_runs(runs: Runs) -> None:
    for extra in ("pandas", "pyarrow", "polars"):
        pytest.importorskip(extra)
    import polars

    frame = polars.DataFrame(runs)
    assert frame["ball_error"].to_list() == [0.5, 0.125, 2.0, None]
    assert "__index_level_0__" not in frame.columns
