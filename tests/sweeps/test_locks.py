"""The lock of a directory: whose it is, how it is told, and what is left of it."""

from __future__ import annotations

import errno
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import environment

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


def test_a_second_owner_is_told_of_the_first_in_this_process_or_another(tmp_path: Path) -> None:
    first = hold(tmp_path)
    assert held(tmp_path) is first
    with pytest.raises(TakenError, match=rf"^{tmp_path} belongs to a sweep that goes on in this process\.$"):
        hold(tmp_path)
    before = open_files()
    told = rf"^{tmp_path} belongs to a sweep that goes on: process {os.getpid()} on .*`hydra.sweep.dir`"
    with pytest.raises(TakenError, match=told):
        DirectoryLock(tmp_path)  # the kernel tells two files of one process apart, too
    assert open_files() == before
    give_back(tmp_path)
    give_back(tmp_path)
    assert held(tmp_path) is None
    assert not (tmp_path / NAME).exists()
    hold(tmp_path)


def test_a_thread_that_is_refused_frees_nobody_elses_directory(tmp_path: Path) -> None:
    first, met = hold(tmp_path), []

    def second() -> None:
        with pytest.raises(TakenError), returned():
            hold(tmp_path)
        give_back(tmp_path)
        met.append(held(tmp_path))

    thread = threading.Thread(target=second)
    thread.start()
    thread.join()
    assert met == [None]
    assert held(tmp_path) is first
    assert (tmp_path / NAME).exists()


def test_a_directory_is_the_same_by_any_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    taken = hold(Path("."))
    assert held(tmp_path) is taken
    with pytest.raises(TakenError):
        hold(tmp_path)
    give_back(tmp_path / "x" / "..")
    assert held(Path(".")) is None


def test_a_directory_that_was_replaced_is_lost(tmp_path: Path) -> None:
    place = tmp_path / "sweep"
    place.mkdir()
    taken = DirectoryLock(place)
    os.rename(place, tmp_path / "moved")
    assert taken.lost()
    place.mkdir()
    assert taken.lost()
    place.rmdir()
    os.rename(tmp_path / "moved", place)
    assert not taken.lost()
    taken.release()


@pytest.mark.parametrize(
    ("owner", "waits"),
    [
        ({"host": "elsewhere", "pid": 7, "since": "then"}, True),
        ({"host": "elsewhere"}, True),
        ({"host": socket.gethostname(), "pid": 7}, False),
        ({"pid": 7}, False),
    ],
)
def test_an_owner_elsewhere_is_dead_where_its_file_was_not_touched_for_minutes(
    owner: dict[str, object], waits: bool, tmp_path: Path
) -> None:
    for age in (0, 200, 400):
        (tmp_path / NAME).write_text(json.dumps(owner))
        os.utime(tmp_path / NAME, (time.time() - age,) * 2)
        if waits and age < 300:
            pid, since = owner.get("pid", r"\?"), owner.get("since", r"\?")
            with pytest.raises(TakenError, match=f"process {pid} on elsewhere, since {since}"):
                DirectoryLock(tmp_path)
        else:
            DirectoryLock(tmp_path).release()


def test_an_owner_that_is_killed_leaves_a_lock_that_is_taken(tmp_path: Path) -> None:
    program = "import fcntl, os, sys, time; f = os.open(sys.argv[1], os.O_RDWR | os.O_CREAT);"
    program += (
        "fcntl.flock(f, fcntl.LOCK_EX); os.write(f, b'{\"pid\": 5}'); print(1, flush=True); time.sleep(60)"
    )
    line = [sys.executable, "-c", program, str(tmp_path / NAME)]
    with subprocess.Popen(line, env=environment(), stdout=subprocess.PIPE) as owner:
        assert owner.stdout is not None
        owner.stdout.readline()
        with pytest.raises(TakenError, match="process 5 on"):
            DirectoryLock(tmp_path)
        owner.kill()
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
