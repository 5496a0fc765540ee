"""A directory belongs to one run or sweep at a time: a lock that says whose, and ends with its owner."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from ..results.files import UnreadableError, read_object

NAME = ".lock"
_BEAT, _STALE = 30.0, 300.0  # s: how often the owner touches the file, and when another host counts it dead


class TakenError(ValueError):
    """Another run or sweep has the directory; the message says whose it is."""


class DirectoryLock:
    """The lock of a directory of a run or sweep, which exists, held until `release`, or until this process
    ends anyhow.

    On one machine the kernel knows whether the owner lives. Between machines that share the disk without
    sharing locks, the owner touches the file every half a minute. Raises TakenError if another one has it,
    OSError if the directory cannot be written.
    """

    def __init__(self, directory: Path, kind: str = "sweep") -> None:
        self._path, self.kind, self.thread = directory / NAME, kind, threading.get_ident()
        self._directory = directory.absolute()
        self._file = self._taken()
        self._inode = os.stat(self._directory)
        self._ended = threading.Event()
        threading.Thread(target=self._beat, daemon=True).start()

    def lost(self) -> bool:
        """Return whether the directory was removed or replaced since it was taken."""
        try:
            now = os.stat(self._directory)
        except OSError:
            return True
        return (now.st_dev, now.st_ino) != (self._inode.st_dev, self._inode.st_ino)

    def release(self) -> None:
        """Give the directory back."""
        if self._ended.is_set():
            return
        self._ended.set()
        with contextlib.suppress(OSError):
            self._path.unlink()
        os.close(self._file)

    def _taken(self) -> int:
        while True:
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK
            file = os.open(self._path, flags, 0o644)
            try:
                if os.fstat(file).st_nlink > 1:  # what we write there would be in the other file too
                    raise OSError(errno.EMLINK, "it is a hard link", str(self._path))
                self._hold(file)
                if os.fstat(file).st_ino == os.stat(self._path, follow_symlinks=False).st_ino:
                    return file
            except FileNotFoundError:
                pass  # its owner has just given it back: once more
            except BaseException:
                os.close(file)
                raise
            os.close(file)

    def _hold(self, file: int) -> None:
        """Lock an open file and write our name into it."""
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                raise self._refused() from error
            if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
                raise
        host = self._owner().get("host")
        # Where locks are not shared between machines, ours says nothing about an owner elsewhere.
        if host not in (None, socket.gethostname()) and time.time() - os.fstat(file).st_mtime < _STALE:
            raise self._refused()
        about = {
            "kind": self.kind,
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "since": time.strftime("%Y-%m-%d %H:%M:%S"),
        }
        os.ftruncate(file, 0)
        os.pwrite(file, json.dumps(about).encode(), 0)

    def _owner(self) -> dict[str, object]:
        try:
            return read_object(self._path)
        except UnreadableError:
            return {}

    def _refused(self) -> TakenError:
        owner = self._owner()
        return TakenError(
            f"{self._path.parent} belongs to a {'run' if owner.get('kind') == 'run' else 'sweep'} that goes "
            f"on: process {owner.get('pid', '?')} on {owner.get('host', '?')}, since "
            f"{owner.get('since', '?')}. Wait for its end, or choose another `hydra.{self.kind}.dir`."
        )

    def _beat(self) -> None:
        while not self._ended.wait(_BEAT):
            with contextlib.suppress(OSError):
                os.utime(self._file)


_held: dict[str, DirectoryLock] = {}
"""The locks of this process, by the absolute paths of the directories."""
_holding = threading.Lock()


def hold(directory: Path, kind: str = "sweep") -> DirectoryLock:
    """Take the lock of a directory for this process; arguments and errors as of `DirectoryLock`."""
    key = os.path.abspath(directory)
    with _holding:
        if key in _held:
            raise TakenError(f"{directory} belongs to a {_held[key].kind} that goes on in this process.")
        found = _held[key] = DirectoryLock(directory, kind)
    return found


def held(directory: Path) -> DirectoryLock | None:
    """Return the lock of a directory where this thread has it."""
    found = _held.get(os.path.abspath(directory))
    return found if found is not None and found.thread == threading.get_ident() else None


def give_back(directory: Path) -> None:
    """Release the lock of a directory where this thread took it: one that was refused frees nobody else's."""
    lock = held(directory)
    if lock is not None:
        del _held[os.path.abspath(directory)]
        lock.release()


@contextlib.contextmanager
def returned() -> Iterator[None]:
    """Context: a directory that this thread locks in it is given back in the end, and removed if empty."""
    before, thread = set(_held), threading.get_ident()
    try:
        yield
    finally:
        mine = {directory for directory, lock in list(_held.items()) if lock.thread == thread}
        for directory in mine - before:
            give_back(Path(directory))
            with contextlib.suppress(OSError):  # something is in it
                os.rmdir(directory)
