"""The lock of a directory: whose it is, how it is told, and what is left of it."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from staf_torch.sweeps import lock
from staf_torch.sweeps.lock import NAME, DirectoryLock, TakenError, give_back, held, hold


@pytest.fixture(autouse=True)
def _nothing_stays_locked() -> Iterator[None]:
    before = dict(lock._held)
    yield
    for key in set(lock._held) - set(before):
        give_back(Path(key))


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def test_a_lock_says_whose_it_is_and_leaves_nothing(tmp_path: Path) -> None:
    before = open_files()
    (tmp_path / NAME).write_text("x" * 500)  # of an owner that was killed
    taken = DirectoryLock(tmp_path)
    about = json.loads((tmp_path / NAME).read_text())
    assert (about["host"], about["pid"]) == (socket.gethostname(), os.getpid())
    assert set(about) == {"host", "pid", "since"}
    assert open_files() == before + 1
    assert not taken.lost()
    taken.release()
    assert list(tmp_path.iterdir()) == []
    assert open_files() == before
    taken.release()  # once is enough
    assert open_files() == before


def test_a_file_of_a_lock_can_be_read_by_all(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        taken = DirectoryLock(tmp_path)
    finally:
        os.umask(before)
    assert (tmp_path / NAME).stat().st_mode & 0o777 == 0o644
    taken.release()


def test_a_lock_that_is_taken_away_is_given_back_all_the_same(tmp_path: Path) -> None:
    taken = DirectoryLock(tmp_path)
    (tmp_path / NAME).unlink()
    taken.release()
    assert list(tmp_path.iterdir()) == []


def test_a_second_owner_is_told_of_the_first_in_this_process_or_another(tmp_path: Path) -> None:
    first = hold(tmp_path)
    assert held(tmp_path) is first
    for what in ("sweep", "run"):
        with pytest.raises(
            TakenError, match=rf"^{tmp_path} belongs to a {what} that goes on in this process\.$"
        ):
            hold(tmp_path, what)
        before = open_files()
        told = rf"^{tmp_path} belongs to a {what} that goes on: process {os.getpid()} on .*`hydra.{what}.dir`"
        with pytest.raises(TakenError, match=told):
            DirectoryLock(tmp_path, what)
        assert open_files() == before
    give_back(tmp_path)
    assert held(tmp_path) is None
    assert not (tmp_path / NAME).exists()
    give_back(tmp_path)
    hold(tmp_path, "run")
    assert held(tmp_path) is not None


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


def test_an_owner_elsewhere_is_dead_behind_five_minutes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr(
        lock, "time", SimpleNamespace(time=lambda: now[0], strftime=lambda layout: f"today {layout[:2]}")
    )
    for owner, waits in (
        ({"host": "elsewhere", "pid": 7, "since": "then"}, True),
        ({"host": socket.gethostname(), "pid": 7}, False),
        ({"pid": 7}, False),
    ):
        for seconds in (-9.0, 0.0, 299.5, 300.0, 301.0):
            (tmp_path / NAME).write_text(json.dumps(owner))
            os.utime(tmp_path / NAME, (1000, 1000))
            now[0] = 1000 + seconds
            if waits and seconds < 300:
                with pytest.raises(TakenError, match="process 7 on elsewhere, since then"):
                    DirectoryLock(tmp_path)
            else:
                DirectoryLock(tmp_path).release()
    (tmp_path / NAME).write_text('{"host": "elsewhere"}')
    os.utime(tmp_path / NAME, (1000, 1000))
    now[0] = 1000.0
    with pytest.raises(TakenError, match=r"process \? on elsewhere, since \?"):
        DirectoryLock(tmp_path)


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


@pytest.mark.parametrize(
    "number", ["EWOULDBLOCK", "EACCES", "ENOLCK", "EOPNOTSUPP", "ENOSYS", "EIO", "EBADF"]
)
def test_a_disk_without_locks_is_used_and_one_that_fails_is_told(
    number: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def flock(file: int, how: int) -> None:
        asked.append(how)
        raise OSError(getattr(errno, number), "no")

    monkeypatch.setattr(fcntl, "flock", flock)
    if number in ("ENOLCK", "EOPNOTSUPP", "ENOSYS"):
        DirectoryLock(tmp_path).release()
    elif number in ("EWOULDBLOCK", "EACCES"):
        with pytest.raises(TakenError, match="belongs to a sweep that goes on"):
            DirectoryLock(tmp_path)
    else:
        with pytest.raises(OSError, match="no") as told:
            DirectoryLock(tmp_path)
        assert not isinstance(told.value, TakenError)
    assert asked == [fcntl.LOCK_EX | fcntl.LOCK_NB]


@pytest.mark.parametrize("becomes", ["nothing", "another", "a link to it"])
def test_a_file_that_its_owner_gives_back_meanwhile_is_opened_anew(
    becomes: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, opened = open_files(), []
    write = os.pwrite

    def harm(file: int, text: bytes, at: int) -> int:
        opened.append(file)
        if len(opened) == 1:
            os.rename(tmp_path / NAME, tmp_path / "old")
            if becomes == "another":
                (tmp_path / NAME).write_text("")
            if becomes == "a link to it":
                (tmp_path / NAME).symlink_to("old")
        elif becomes == "a link to it":
            pytest.fail("what is behind a link is no lock")
        return write(file, text, at)

    monkeypatch.setattr(os, "pwrite", harm)
    if becomes == "a link to it":
        with pytest.raises(OSError, match="symbolic links"):
            DirectoryLock(tmp_path)
        assert open_files() == before
        return
    taken = DirectoryLock(tmp_path)
    assert len(opened) == 2
    assert open_files() == before + 1
    assert json.loads((tmp_path / NAME).read_text())["pid"] == os.getpid()
    taken.release()


def test_who_has_a_directory_touches_its_file_twice_a_minute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[dict[str, object]] = []

    class Thread:
        def __init__(self, **given: object) -> None:
            begun.append(given)

        def start(self) -> None:
            begun.append({})

    monkeypatch.setattr(threading, "Thread", Thread)
    taken = DirectoryLock(tmp_path)
    assert begun == [{"target": taken._beat, "daemon": True}, {}]
    waited: list[float] = []

    class Ended(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            waited.append(timeout or 0.0)
            if len(waited) == 3:
                self.set()
            return self.is_set()

    taken._ended = Ended()
    os.utime(tmp_path / NAME, (1000, 1000))
    taken._beat()
    assert waited == [30.0] * 3
    assert (tmp_path / NAME).stat().st_mtime > 1000
    os.close(taken._file)
