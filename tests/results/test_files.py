"""Files that appear complete or not at all."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from staf_torch.results import files
from staf_torch.results.files import (
    flatten,
    open_after,
    parse_overrides,
    plain,
    write_bytes,
    write_metrics,
    write_text,
)


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


def test_metrics_are_a_line_each(tmp_path: Path) -> None:
    write_metrics(tmp_path / "metrics.json", {"error": 0.5, "missing": None})
    assert (tmp_path / "metrics.json").read_text() == '{\n  "error": 0.5,\n  "missing": null\n}\n'


def test_files_have_the_rights_that_the_user_gives_new_files(tmp_path: Path) -> None:
    before = os.umask(0o026)
    try:
        write_text(tmp_path / "one", "1")
        os.close(open_after(tmp_path / "two", 0))
    finally:
        os.umask(before)
    assert [(tmp_path / name).stat().st_mode & 0o777 for name in ("one", "two")] == [0o640, 0o640]


def test_what_a_killed_run_left_is_not_in_the_way_and_not_written_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, partial, own = tmp_path / "metrics.json", tmp_path / ".metrics.json.partial", tmp_path / "own.txt"
    own.write_text("own")
    partial.symlink_to(own)
    write_bytes(path, b"new")
    partial.write_text("half of")
    write_bytes(path, b"newer")
    assert (path.read_bytes(), own.read_text()) == (b"newer", "own")
    monkeypatch.setattr(files.os, "replace", lambda *places: int("broken"))
    with pytest.raises(ValueError, match="broken"):
        write_bytes(path, b"never")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["metrics.json", "own.txt"]
    assert path.read_bytes() == b"newer"


@pytest.mark.parametrize(
    ("value", "held"),
    [
        (float("nan"), "nan"),
        (-float("inf"), "-inf"),
        (1.5, 1.5),
        (10**400, 10**400),
        (True, True),
        (None, None),
        ("text", "text"),
        ((1, [float("inf"), None]), [1, ["inf", None]]),
        ({1: {"a": (2,)}}, {"1": {"a": [2]}}),
        (Path("a/b"), "a/b"),
    ],
)
def test_json_holds_plain_values_and_the_names_of_others(value: Any, held: Any) -> None:
    assert repr(plain(value)) == repr(held)


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("true", True),
        ("False", False),
        ("NULL", None),
        ("none", None),
        ("3", 3),
        (" 3 ", 3),
        ("-2.5e3", -2500.0),
        ("1e999", "1e999"),
        ("nan", "nan"),
        ("'3'", "3"),
        ('"a b"', "a b"),
        ("''", ""),
        ("'", "'"),
        ("'a\"", "'a\""),
        ("aba", "aba"),
        ("'a", "'a"),
        ("[1,[2.5]]", [1, [2.5]]),
        ("[1e999]", ["inf"]),
        ("[a,b]", "[a,b]"),
        ("a=b", "a=b"),
        ("", ""),
    ],
)
def test_an_override_is_read_as_what_it_is(word: str, value: Any) -> None:
    lines = [f"+key={word}", "~gone", "hydra.mode=RUN", "hydra/launcher=x", "++hydra.a=1"]
    assert repr(parse_overrides(lines)) == repr({"key": value})
