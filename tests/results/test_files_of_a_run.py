"""The files of a run directory: complete or not there, read back as written, never through a link."""

from __future__ import annotations

import contextlib
import json
import os
import resource
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some

from staf_torch.results.files import (
    flatten,
    open_after,
    parse_overrides,
    write_metrics,
    write_text,
)
from staf_torch.results.run_directory import History, HistoryWriter, RunDirectory
from staf_torch.tables import Table


@contextlib.contextmanager
def full_disk() -> Iterator[None]:
    """No file of this process may grow beyond 100 bytes: nothing else may write meanwhile."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_metrics_read_back_to_the_last_bit(tmp_path: Path) -> None:
    metrics = {"error": 0.1 + 0.2, "count": 3, "missing": None, "tiny": 5e-324}
    write_metrics(tmp_path / "metrics.json", metrics)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert [entry.name for entry in tmp_path.iterdir()] == ["metrics.json"]


@pytest.mark.parametrize("number", [float("nan"), -float("inf")])
def test_a_metric_that_is_not_finite_is_refused_and_nothing_is_written(tmp_path: Path, number: float) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_metrics(tmp_path / "metrics.json", {"error": number})
    assert list(tmp_path.iterdir()) == []


def test_a_write_to_a_full_disk_leaves_the_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    write_text(path, "old")
    with pytest.raises(OSError, match="File too large"), full_disk():
        write_text(path, "new" * 1000)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_run_left_is_not_in_the_way_and_not_written_through(tmp_path: Path) -> None:
    path, partial, own = tmp_path / "metrics.json", tmp_path / ".metrics.json.partial", tmp_path / "own.txt"
    own.write_text("own")
    partial.symlink_to(own)
    write_text(path, "new")
    partial.write_text("half of")
    write_text(path, "newer")
    assert (path.read_text(), own.read_text()) == ("newer", "own")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["metrics.json", "own.txt"]


def test_new_files_have_the_permissions_of_the_users_mask(tmp_path: Path) -> None:
    before = os.umask(0o026)
    try:
        write_text(tmp_path / "one", "1")
        os.close(open_after(tmp_path / "two", 0))
    finally:
        os.umask(before)
    assert [(tmp_path / name).stat().st_mode & 0o777 for name in ("one", "two")] == [0o640, 0o640]


def test_lines_stay_when_the_run_is_killed_and_get_their_name_at_the_end(tmp_path: Path) -> None:
    partial = tmp_path / ".rows.csv.partial"
    partial.write_text("left by an earlier run")
    with RunDirectory(tmp_path).lines("rows.csv") as write:
        write("one\n")
        assert partial.read_text() == "one\n"
        write("two\n")
        assert not (tmp_path / "rows.csv").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["rows.csv"]
    partial.write_text("one\nhal")
    with RunDirectory(tmp_path).lines("rows.csv", keep=4) as write:
        write("2\n")
    assert (tmp_path / "rows.csv").read_text() == "one\n2\n"


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


LATE: dict[str, Callable[[RunDirectory], Any]] = {
    "history": lambda run: run.history(1, 1),
    "table": lambda run: run.table("late", Table.of([{"a": 1}])),
    "figure": lambda run: run.figure("late", {"png": b""}),
    "text": lambda run: run.text("late.txt", ""),
    "metrics": lambda run: run.metrics({}),
}


@pytest.mark.parametrize("late", LATE)
def test_the_metrics_are_the_last_file_of_a_run(late: str, tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    with pytest.raises(ValueError, match="not JSON compliant"):
        run.metrics({"error": float("nan")})  # which leaves the directory open
    run.metrics({"error": 1.0})
    with pytest.raises(AssertionError, match="comes after the metrics"):
        LATE[late](run)
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]


# Histories


def arrays(batch: int, times: int, dtype: str = "float64") -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "state": rng.normal(size=(batch, times, 3)).astype(dtype),
        "value": rng.normal(size=(batch, times)).astype(dtype)[:, ::-1],  # not contiguous
        "weights": rng.normal(size=(batch, times, 2, 4)).astype(dtype),
        "none": np.zeros((batch, times, 0), dtype),
    }


@given(
    batch=some.integers(1, 4),
    times=some.integers(1, 12),
    data=some.data(),
    dtype=some.sampled_from(["f4", "f8"]),
)
def test_a_history_written_in_pieces_reads_back_as_the_whole_arrays(
    tmp_path_factory: pytest.TempPathFactory, batch: int, times: int, data: some.DataObject, dtype: str
) -> None:
    cuts = sorted(data.draw(some.lists(some.integers(0, times), max_size=4)))
    rows = sorted(data.draw(some.sets(some.integers(1, batch), max_size=2)) - {batch})
    expected = arrays(batch, times, dtype)
    path = tmp_path_factory.mktemp("history") / "history.npz"
    with HistoryWriter(path, batch, times) as writer:
        for low, high in zip([0, *rows], [*rows, batch], strict=True):
            for start, stop in zip([0, *cuts], [*cuts, times], strict=True):
                if stop > start:
                    writer.add({n: array[low:high, start:stop] for n, array in expected.items()}, low)
        assert not path.exists()
        writer.close(time=np.arange(times) * 0.1)
    found = History(path)
    assert list(found) == ["time", *expected]
    for name, array in ({"time": np.arange(times) * 0.1} | expected).items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)
    assert [entry.name for entry in path.parent.iterdir()] == ["history.npz"]


def test_a_history_that_is_too_long_to_be_held_reads_back_as_its_arrays(tmp_path: Path) -> None:
    arrays = {"long": np.arange(6_000_000.0).reshape(2, -1), "ones": np.ones((2, 3_000_000), "f4")}
    with HistoryWriter(tmp_path / "history.npz", 2, 3_000_000) as writer:
        for start, stop in ((0, 1_000_000), (1_000_000, 3_000_000)):
            writer.add({name: array[:, start:stop] for name, array in arrays.items()})
        writer.close(time=np.arange(3))
    found = History(tmp_path / "history.npz")
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)


def cut_short(path: Path) -> None:
    with HistoryWriter(path, 2, 5) as writer:
        writer.add({name: array[:, :4] for name, array in arrays(2, 5).items()})
        writer.close()


def not_closed(path: Path) -> None:
    with HistoryWriter(path, 2, 5) as writer:
        writer.add(arrays(2, 5))
        raise AssertionError


@pytest.mark.parametrize("broken", [cut_short, not_closed])
def test_a_history_that_was_not_completed_does_not_appear(
    broken: Callable[[Path], None], tmp_path: Path
) -> None:
    with pytest.raises(AssertionError):
        broken(tmp_path / "history.npz")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OSError, match="nowhere"):
        HistoryWriter(tmp_path / "nowhere" / "history.npz", 1, 1)


def test_a_history_leaves_no_file_open_and_names_its_arrays(tmp_path: Path) -> None:
    def open_files() -> int:
        return len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0

    before = open_files()
    np.savez(tmp_path / "history.npz", first=np.arange(6.0), last=np.arange(9.0))
    found = History(tmp_path / "history.npz")
    assert found["last"] is found["last"]
    assert open_files() == before
    assert repr(found) == "<History first, last>"
    with pytest.raises(KeyError, match=r"'middle' is not in .*; there are first, last"):
        found["middle"]


# Plain values


def test_nested_settings_have_dotted_keys_and_what_is_empty_stays() -> None:
    nested = {"a": {"b": {"c": 1}, "d": [2]}, "e": {}, "f": None}
    assert flatten(nested) == {"a.b.c": 1, "a.d": [2], "e": {}, "f": None}


@pytest.mark.parametrize(
    ("word", "value"),
    [
        *(("true", True), ("False", False), ("NULL", None), ("none", None), ("3", 3), (" 3 ", 3)),
        *(("-2.5e3", -2500.0), ("1e999", "1e999"), ("nan", "nan"), ("'3'", "3"), ('"a b"', "a b")),
        *(("''", ""), ("'", "'"), ("'a\"", "'a\""), ("[1,[2.5]]", [1, [2.5]]), ("[1e999]", ["inf"])),
        *(("[a,b]", "[a,b]"), ("a=b", "a=b"), ("", "")),
    ],
)
def test_an_override_is_read_as_hydra_reads_it(word: str, value: Any) -> None:
    lines = [f"+key={word}", "~gone", "hydra.mode=RUN", "hydra/launcher=x", "++hydra.a=1"]
    assert repr(parse_overrides(lines)) == repr({"key": value})
