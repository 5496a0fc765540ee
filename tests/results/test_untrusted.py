"""What a folder of somebody else may hold."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from staf_torch.results.build import digest
from staf_torch.results.untrusted import UnreadableError, _plain_file, links_in, open_regular, too_deep


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
