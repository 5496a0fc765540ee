"""What a folder of somebody else may hold."""

from __future__ import annotations

import hashlib
import math
import os
from pathlib import Path
from typing import Any

import pytest

from staf_torch.results import untrusted
from staf_torch.results.build import digest
from staf_torch.results.settings_file import read_settings
from staf_torch.results.untrusted import (
    MOST_BYTES,
    UnreadableError,
    _plain_file,
    all_visible,
    links_in,
    open_regular,
    parse_object,
    read_bytes,
    read_lines,
    read_object,
    read_text,
    too_deep,
    visible,
)


def test_links_of_every_kind_are_found_and_files_and_folders_are_none(tmp_path: Path) -> None:
    outside, inside = tmp_path / "outside", tmp_path / "run" / "deep"
    outside.mkdir()
    inside.mkdir(parents=True)
    (outside / "own.txt").write_text("own")
    (inside / "metrics.json").write_text("{}")
    (inside / "empty").mkdir()
    assert links_in(tmp_path / "run") == []
    (inside / "to a file").symlink_to(outside / "own.txt")
    (inside / "to a folder").symlink_to(outside)
    (inside / "to nothing").symlink_to(tmp_path / "nothing")
    (inside / "hard").hardlink_to(outside / "own.txt")
    os.mkfifo(inside / "pipe")
    found = {path.name for path in links_in(tmp_path / "run")}
    assert found == {"to a file", "to a folder", "to nothing", "hard", "pipe"}
    assert links_in(tmp_path / "nothing") == []


def nested(depth: int) -> object:
    found: object = 1
    for at in range(depth):
        found = [found] if at % 2 else {"a": found, "b": 1}
    return found


@pytest.mark.parametrize("most", [1, 4])
def test_depth_is_that_of_the_deepest_branch(most: int) -> None:
    for depth in range(7):
        assert too_deep(nested(depth), most) == (depth > most)


def test_what_lies_behind_a_linked_folder_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "run" / "deep").mkdir(parents=True)
    (tmp_path / "run" / "deep" / "a").write_bytes(b"content")
    (tmp_path / "run" / "linked").symlink_to(tmp_path / "run" / "deep")
    inside, behind = tmp_path / "run" / "deep" / "a", tmp_path / "run" / "linked" / "a"
    assert digest(inside, root=tmp_path / "run") == hashlib.sha256(b"content").hexdigest()
    assert digest(behind) == digest(inside)  # without a folder to keep to, the user's own links count
    for read in (digest, open_regular):
        with pytest.raises(UnreadableError):
            read(behind, root=tmp_path / "run")


def test_a_file_that_goes_while_it_is_looked_at_is_no_link(tmp_path: Path) -> None:
    (tmp_path / "one").touch()
    with os.scandir(tmp_path) as entries:
        (entry,) = entries
    (tmp_path / "one").unlink()
    assert _plain_file(entry)


def test_a_second_name_of_a_file_is_no_plain_file(tmp_path: Path) -> None:
    (tmp_path / "one").touch()
    os.link(tmp_path / "one", tmp_path / "two")
    with os.scandir(tmp_path) as entries:
        assert not any(_plain_file(entry) for entry in entries)


def open_files() -> int:
    return len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0


def test_a_file_is_read_up_to_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, before = tmp_path / "run.json", open_files()
    path.write_bytes(b"x" * 10)
    assert read_bytes(path, 10) == b"x" * 10
    with pytest.raises(UnreadableError, match=r"run\.json has 10 bytes, and 9 are the most that is read"):
        read_bytes(path, 9)
    assert MOST_BYTES == 4 * 1024**2
    with path.open("ab") as file:
        file.truncate(MOST_BYTES)
    assert len(read_text(path)) == MOST_BYTES
    with path.open("ab") as file:
        file.truncate(MOST_BYTES + 1)
    with pytest.raises(UnreadableError, match="bytes, and 4194304 are the most"):
        read_text(path)
    with open_regular(path) as file:
        assert len(file.read()) == MOST_BYTES + 1  # any number, where none is said
    monkeypatch.setattr(untrusted, "open_regular", lambda path, most, root: path.open("rb"))
    path.write_bytes(b"x" * 11)
    with pytest.raises(UnreadableError, match=r"run\.json grows while it is read"):
        read_bytes(path, 10)
    assert read_bytes(path, 11) == b"x" * 11
    assert open_files() == before


def test_what_is_no_regular_file_is_refused_in_a_sentence_and_closed(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("own")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    (tmp_path / "linked").symlink_to(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    before = open_files()
    for path, root, why in (
        (tmp_path / "link", None, "link cannot be read: a link, which is not followed"),
        (tmp_path / "linked" / "file", tmp_path, "file cannot be read: a link, which is not followed"),
        (tmp_path / "none", None, "none cannot be read: No such file or directory"),
        (tmp_path / "file" / "none", None, "none cannot be read: Not a directory"),
        (tmp_path / "file" / "none", tmp_path, "none cannot be read: Not a directory"),
        (tmp_path / "linked" / "none", None, "none cannot be read: No such file or directory"),
        (tmp_path / "pipe", None, "pipe is not a regular file"),
        (tmp_path, None, f"{tmp_path.name} is not a regular file"),
        (tmp_path / "a\0b", None, r"'a\\x00b' is no name of a file"),
    ):
        with pytest.raises(UnreadableError, match=f"^{why}$"):
            open_regular(path, root=root)
    assert open_files() == before
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "deep" / "er" / "file").write_text("deeper")
    for root in (None, tmp_path, tmp_path / "deep", tmp_path / "deep" / "er"):
        assert read_text(tmp_path / "deep" / "er" / "file", root=root) == "deeper"
    assert read_bytes(tmp_path / "linked" / "file") == b"own"
    for read in (read_bytes, read_text):
        with pytest.raises(UnreadableError, match="a link"):
            read(tmp_path / "linked" / "file", root=tmp_path)
    (tmp_path / "deep" / "config.yaml").write_text("a: 1")
    assert read_settings(tmp_path / "deep" / "config.yaml", tmp_path).tree == {"a": 1}
    (tmp_path / "other").symlink_to(tmp_path / "deep")
    with pytest.raises(UnreadableError, match="a link"):
        read_settings(tmp_path / "other" / "config.yaml", tmp_path)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"[1]", "run.json holds no object"),
        (b"1", "run.json holds no object"),
        (b"{", "run.json is not JSON: "),
        (b"\xff{}", "run.json is not text: "),
        (b"[" * 100_000, "run.json is nested too deep"),
    ],
)
def test_what_is_no_object_is_refused_in_a_sentence(content: bytes, why: str, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_bytes(content)
    with pytest.raises(UnreadableError, match=f"^{why}"):
        read_object(tmp_path / "run.json")
    with pytest.raises(UnreadableError, match="2 are the most"):
        read_object(tmp_path / "run.json", 2) if len(content) > 2 else read_bytes(Path(__file__), 2)


def test_an_object_has_so_many_parts_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    assert untrusted._MOST_PARTS == 1_000_000
    monkeypatch.setattr(untrusted, "_MOST_PARTS", 4)
    assert parse_object(b'{"a": [[], {}]}', "it") == {"a": [[], {}]}
    with pytest.raises(UnreadableError, match="it has more than 4 lists and objects"):
        parse_object(b'{"a": [[], {}, {}]}', "it")
    with pytest.raises(UnreadableError, match="more than 4"):
        parse_object(b'{"a": [[], [], []]}', "it")


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ("12345678901234567890", 12345678901234567890),
        ("-1234567890123456789", -1234567890123456789),
        ("123456789012345678901", 123456789012345678901.0),
        ("-12345678901234567890", -12345678901234567890.0),
        ("1" + "0" * 400, math.inf),
        (r'"\u001b[2J"', "\\u001b[2J"),
        (r'"\b\f\r\n\t"', "\\u0008\\u000c\\u000d\n\t"),
        ('"\x7f"', "\\u007f"),
        ('"\u202eabc"', "\\u202eabc"),
        (r'"\ud800"', "\\ud800"),
        ('"übër \U0001f642"', "übër \U0001f642"),
        ('[{"\u200b": ["\u200b"]}]', [{"\\u200b": ["\\u200b"]}]),
        ("true", True),
        ("null", None),
    ],
)
def test_numbers_and_texts_of_a_record_are_what_can_be_shown(written: str, read: Any) -> None:
    found = parse_object(f'{{"a": {written}}}'.encode(), "it")["a"]
    assert repr(found) == repr(read)


def test_a_text_without_odd_characters_stays_as_it_is() -> None:
    for text in ("plain", "two\nlines\tand a tab", "äöü", ""):
        assert visible(text) == text
    assert visible("a\rb") == "a\\u000db"
    assert all_visible({"a\r": ["\r", 1, None, {"b": "\r"}]}) == {
        "a\\u000d": ["\\u000d", 1, None, {"b": "\\u000d"}]
    }


def test_lines_are_read_up_to_a_megabyte_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert untrusted._MOST_LINE == 2**20
    monkeypatch.setattr(untrusted, "_MOST_LINE", 5)
    path = tmp_path / "members.json"
    path.write_bytes(b"1234\n\n12\n12345")
    assert list(read_lines(path)) == [b"1234\n", b"\n", b"12\n", b"12345"]
    for long in (b"12345\n", b"1234567"):
        path.write_bytes(b"1\n" + long + b"2\n")
        found = read_lines(path)
        assert next(found) == b"1\n"
        with pytest.raises(UnreadableError, match=r"members\.json has a line of more than 5 bytes"):
            next(found)


def test_twenty_levels_are_not_too_deep_and_another_one_is() -> None:
    assert not too_deep(nested(20))
    assert too_deep(nested(21))
    assert not any(too_deep(each, 0) for each in (1, "text", None, 2.5))


def test_a_folder_that_cannot_be_listed_counts_as_a_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    (tmp_path / "b" / "link").symlink_to(tmp_path)
    scan = os.scandir

    def refused(folder: Path) -> Any:
        if folder.name == "a":
            raise PermissionError
        return scan(folder)

    monkeypatch.setattr(untrusted.os, "scandir", refused)
    assert sorted(links_in(tmp_path)) == [tmp_path / "a", tmp_path / "b" / "link"]


def test_an_entry_of_a_list_has_a_line_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("a: 1\nlist:\n - 1\n - [2, 3]\n")
    found = read_settings(tmp_path / "config.yaml", tmp_path)
    lines = [found.line(key) for key in ("list", "list.0", "list.1", "list.1.1", "list.2", "")]
    assert lines == ["2: list:", "3: - 1", "4: - [2, 3]", "4: - [2, 3]", "2: list:", "1: a: 1"]
