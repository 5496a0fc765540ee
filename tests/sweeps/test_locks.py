"""The lock of a directory: whose it is, how it is told, and what is left of it."""

from __future__ import annotations

import errno
import json
import os
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from staf_torch.sweeps.lock import NAME, DirectoryLock, TakenError, give_back, held, hold, returned


@pytest.fixture(autouse=True)
def _nothing_stays_locked(tmp_path: Path) -> Iterator[None]:
    yield
    give_back(tmp_path)


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def test_a_lock_says_whose_it_is_and_leaves_nothing(tmp_path: Path) -> None:
    before = open_files()
    (tmp_path / NAME).write_text("x" * 500)  # of an owner that was killed
    taken = DirectoryLock(tmp_path)
    about = json.loads((tmp_path / NAME).read_text())
    assert (about["host"], about["pid"]) == (socket.gethostname(), os.getpid())
    assert set(about) == {"kind", "host", "pid", "since"}
    assert not taken.lost()
    taken.release()
    assert list(tmp_path.iterdir()) == []
    taken.release()  # once is enough
    (tmp_path / NAME).mkdir()
    with pytest.raises(OSError, match="Is a directory"):
        DirectoryLock(tmp_path)
    assert open_files() == before


def test_a_second_owner_is_told_of_the_first_in_this_process_or_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    first = hold(Path("."))
    assert held(tmp_path) is first  # by any name
    with pytest.raises(TakenError, match=rf"^{tmp_path} belongs to a sweep that goes on in this process\.$"):
        hold(tmp_path)
    told = rf"^{tmp_path} belongs to a sweep that goes on: process {os.getpid()} on .*`hydra.sweep.dir`"
    with pytest.raises(TakenError, match=told):
        DirectoryLock(tmp_path)  # the kernel tells two files of one process apart, too
    with ThreadPoolExecutor(1) as pool:  # a thread that is refused frees nobody else's directory
        assert isinstance(pool.submit(refused, tmp_path).exception(), TakenError)
    assert held(tmp_path) is first
    assert (tmp_path / NAME).exists()
    for _ in range(2):
        give_back(tmp_path / "x" / "..")
    assert held(Path(".")) is None
    assert not (tmp_path / NAME).exists()


def refused(place: Path) -> None:
    with returned():
        hold(place)


@pytest.mark.parametrize(
    ("owner", "waits"),
    [
        ({"host": "elsewhere", "pid": 7, "since": "then"}, True),
        ({"host": socket.gethostname(), "pid": 7}, False),
    ],
)
def test_an_owner_elsewhere_is_dead_where_its_file_was_not_touched_for_minutes(
    owner: dict[str, object], waits: bool, tmp_path: Path
) -> None:
    for age in (0, 200, 400):
        (tmp_path / NAME).write_text(json.dumps(owner))
        os.utime(tmp_path / NAME, (time.time() - age,) * 2)
        if waits and age < 300:
            with pytest.raises(TakenError, match="process 7 on elsewhere, since then"):
                DirectoryLock(tmp_path)
        else:
            DirectoryLock(tmp_path).release()


def test_what_the_file_of_a_lock_may_not_be(tmp_path: Path) -> None:
    before = open_files()
    (tmp_path / "other").write_text("mine")
    (tmp_path / NAME).hardlink_to(tmp_path / "other")
    with pytest.raises(OSError, match="it is a hard link") as told:
        DirectoryLock(tmp_path)
    assert (told.value.errno, told.value.filename) == (errno.EMLINK, str(tmp_path / NAME))
    (tmp_path / NAME).unlink()
    (tmp_path / NAME).symlink_to("other")
    with pytest.raises(OSError, match="symbolic links"):
        DirectoryLock(tmp_path)
    assert (tmp_path / "other").read_text() == "mine"
    assert open_files() == before
