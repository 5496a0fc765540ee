"""What a run directory takes, and in which order."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from staf_torch.results import run_directory
from staf_torch.results.run_directory import History, RunDirectory
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


def test_lines_are_on_the_disk_one_by_one_and_get_their_name_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    partial, synced = tmp_path / ".rows.csv.partial", []
    monkeypatch.setattr(run_directory.os, "fsync", lambda number: synced.append(partial.read_text()))
    partial.write_text("left by an earlier run")
    with RunDirectory(tmp_path).lines("rows.csv") as write:
        write("one\n")
        write("two\n")
        assert not (tmp_path / "rows.csv").exists()
    assert synced == ["one\n", "one\ntwo\n"]
    assert [path.name for path in tmp_path.iterdir()] == ["rows.csv"]
    partial.write_text("one\nhal")
    with RunDirectory(tmp_path).lines("rows.csv", keep=4) as write:
        write("2\n")
    assert (tmp_path / "rows.csv").read_text() == "one\n2\n"


def test_several_figures_share_a_folder(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    run.figure("one", {"png": b"1"})
    run.figure("two", {"png": b"2"})
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"one.png", "two.png"}


def test_a_history_is_written_beside_itself_and_leaves_no_file_open(tmp_path: Path) -> None:
    open_before = len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else None
    with RunDirectory(tmp_path).history(2, 3) as history:
        (scratch,) = tmp_path.iterdir()
        assert scratch.name.startswith(".history-")
        for begin, end in ((0, 1), (1, 3)):
            whole = np.arange(2 * 3 * 4.0).reshape(2, 3, 2, 2)
            empty = np.zeros((2, 3, 0))
            history.add({"a": whole[:, begin:end], "b": whole[:, begin:end, 0, 0], "c": empty[:, begin:end]})
        history.close(time=np.arange(3))
        shutil.rmtree(scratch)  # by somebody else: it would have gone now
    if open_before is not None:
        assert len(os.listdir("/proc/self/fd")) == open_before
    found = History(tmp_path / "history.npz")
    assert list(found) == ["time", "a", "b", "c"]
    assert (len(found), repr(found)) == (4, "<History time, a, b, c>")
    np.testing.assert_array_equal(found["a"], whole)
    np.testing.assert_array_equal(found["b"], whole[:, :, 0, 0])
    assert found["c"].shape == (2, 3, 0)
    assert found["a"] is found["a"]
    assert [path.name for path in tmp_path.iterdir()] == ["history.npz"]
