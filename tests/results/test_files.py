"""Files that appear complete or not at all."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from staf_torch.results import files
from staf_torch.results.files import flatten, open_after, write_metrics, write_text


def test_metrics_read_back_as_written(tmp_path: Path) -> None:
    metrics = {"error": 0.1 + 0.2, "count": 3, "missing": None, "tiny": 5e-324}
    write_metrics(tmp_path / "metrics.json", metrics)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert [entry.name for entry in tmp_path.iterdir()] == ["metrics.json"]


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf")])
def test_a_number_that_is_not_finite_is_refused_and_nothing_is_written(tmp_path: Path, number: float) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_metrics(tmp_path / "metrics.json", {"error": number})
    assert list(tmp_path.iterdir()) == []


def test_text_is_under_its_final_name_only_when_it_is_all_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, seen = tmp_path / "metrics.json", []
    sync, move = os.fsync, os.replace

    def watched_sync(descriptor: int) -> None:
        seen.append(("sync", path.exists()))
        sync(descriptor)

    def watched_move(source: Path, target: Path) -> None:
        seen.append(("move", Path(source).read_text()))
        assert Path(target) == path
        move(source, target)

    monkeypatch.setattr(files.os, "fsync", watched_sync)
    monkeypatch.setattr(files.os, "replace", watched_move)
    write_text(path, "all of it")
    assert seen == [("sync", False), ("move", "all of it")]
    assert path.read_text() == "all of it"


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "metrics.json"
    write_text(path, "old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_text(path, "new")
    assert path.read_text() == "old"


def test_nested_settings_have_dotted_keys_and_what_is_empty_stays() -> None:
    nested = {"a": {"b": {"c": 1}, "d": [2]}, "e": {}, "f": None}
    assert flatten(nested) == {"a.b.c": 1, "a.d": [2], "e": {}, "f": None}


@pytest.mark.parametrize("keep", [0, 3])
def test_a_file_is_taken_up_behind_what_is_kept(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "rows.csv"
    path.write_text("abcdef")
    with os.fdopen(open_after(path, keep), "w") as file:
        file.write("xy")
    assert path.read_text() == "abcdef"[:keep] + "xy"


@pytest.mark.parametrize("keep", [0, 3])
def test_what_is_taken_up_is_no_link_to_another_file(tmp_path: Path, keep: int) -> None:
    own, path = tmp_path / "own.txt", tmp_path / "rows.csv"
    own.write_text("abcdef")
    path.symlink_to(own)
    if keep:
        with pytest.raises(OSError, match=r"rows\.csv"):
            open_after(path, keep)
    else:
        os.close(open_after(path, keep))
        assert not path.is_symlink()
    assert own.read_text() == "abcdef"
