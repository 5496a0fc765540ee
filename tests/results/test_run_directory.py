"""What a run directory takes, and in which order."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from staf_torch.results.run_directory import RunDirectory
from staf_torch.tables import Table


def test_a_directory_holds_what_was_given_under_the_names_of_all_runs(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    with run.history(1, 2) as history:
        history.add({"value": np.ones((1, 2))})
        history.close()
    run.figure("laws", {"png": b"one", "pdf": b"two"})
    text = run.table("laws", Table.of([{"law": "exact", "error": 1 / 3}]))
    assert run.metrics({"error": 1 / 3}) == {"error": 1 / 3}
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")} == {
        *("history.npz", "laws.md", "laws.csv", "metrics.json", "figures/laws.png", "figures/laws.pdf")
    }
    assert (tmp_path / "laws.md").read_text() == text
    assert (tmp_path / "laws.csv").read_text() == f"law,error\nexact,{1 / 3!r}\n"
    assert (tmp_path / "figures" / "laws.pdf").read_bytes() == b"two"
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"error": 1 / 3}


def test_people_may_be_shown_other_tables_than_programs(tmp_path: Path) -> None:
    every, one, two = (Table.of([{key: 1}]) for key in "abc")
    text = RunDirectory(tmp_path).table("found", every, shown=[one, two])
    assert text == f"{one.markdown()}\n{two.markdown()}"
    assert RunDirectory(tmp_path).table("found", every, shown=one) == one.markdown()
    assert (tmp_path / "found.csv").read_text() == "a\n1\n"


@pytest.mark.parametrize("late", ["history", "table", "figure", "text", "metrics"])
def test_nothing_comes_after_the_metrics(late: str, tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    run.metrics({"error": 1.0})
    calls = {
        "history": lambda: run.history(1, 1),
        "table": lambda: run.table("late", Table.of([{"a": 1}])),
        "figure": lambda: run.figure("late", {"png": b""}),
        "text": lambda: run.text("late.txt", ""),
        "metrics": lambda: run.metrics({}),
    }
    with pytest.raises(AssertionError, match="comes after the metrics"):
        calls[late]()
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]


def test_metrics_that_are_refused_leave_the_directory_open(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    with pytest.raises(ValueError, match="not JSON compliant"):
        run.metrics({"error": float("nan")})
    run.metrics({"error": None})
    assert (tmp_path / "metrics.json").exists()


def test_figures_are_not_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "run" / "figures").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="it is a link, which is not written through"):
        RunDirectory(tmp_path / "run").figure("one", {"png": b"1"})
    assert list((tmp_path / "elsewhere").iterdir()) == []
