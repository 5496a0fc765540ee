"""Processes of this machine that compute for a parent, and end with it, however the parent ends."""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

_PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>
_LOOK = 1.0  # s between two looks at a parent that is no direct one
_END = 5.0  # s that a process has to end when it is asked to


class LostError(Exception):
    """A worker that ended without a result; the message says how."""


class Worker:
    """A fresh process that computes one thing after the other.

    Args:
        work: a function of a module, called in the process.
    """

    def __init__(self, work: Callable[..., bytes]) -> None:
        context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
        self._ours, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(work, theirs, os.getpid()), daemon=True)
        self._process.start()
        theirs.close()

    @property
    def signs(self) -> list[Any]:
        """What becomes ready when a result is there or the process has ended."""
        return [self._ours, self._process.sentinel]

    def begin(self, *arguments: Any) -> None:
        """Compute ``work(*arguments)``; a process that has ended by then is found by `result`."""
        with contextlib.suppress(OSError):
            self._ours.send(arguments)

    def result(self) -> bytes:
        """Wait for what was computed last and return it.

        Raises:
            LostError: if the process ended first.
        """
        try:
            good, found = self._ours.recv()
        except (EOFError, OSError) as error:
            self._process.join(_END)
            raise LostError(_end_of(self._process.exitcode)) from error
        if not good:
            raise LostError(found)
        return bytes(found)

    def alive(self) -> bool:
        """Whether the process can take more work."""
        return self._process.is_alive()

    def end(self) -> None:
        """End the process now."""
        self._ours.close()
        self._process.terminate()
        self._process.join(_END)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _end_of(code: int | None) -> str:
    if code is not None and code < 0:
        name = signal.Signals(-code).name
        likely = ", as the kernel does where memory runs out" if name == "SIGKILL" else ""
        return f"it was ended by {name}{likely}"
    return f"it ended with exit code {code}"


def _serve(work: Callable[..., bytes], theirs: multiprocessing.connection.Connection, parent: int) -> None:
    """Compute what comes through the pipe until it closes, in the process of a `Worker` of that parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    end_with(parent, parent=True)  # which may have ended while this process began
    while True:
        try:
            arguments = theirs.recv()
        except (EOFError, OSError):
            return
        try:
            answer: tuple[bool, Any] = (True, work(*arguments))
        except Exception as error:
            answer = (False, f"{type(error).__name__}: {error}")
        theirs.send(answer)


def beginning(pid: int) -> str:
    """Return when a process of this machine began: its number may be used again."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""


def end_with(pid: int, began: str | None = None, *, parent: bool = False) -> None:
    """Let this process be killed when another one of this machine ends.

    Args:
        pid: of the other.
        began: its `beginning`; None: that of the process that has the number now.
        parent: whether it is the direct parent, which the kernel can watch on Linux.
    """
    if parent and sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != pid:  # it ended before we asked
            os._exit(1)
        return
    known = beginning(pid) if began is None else began

    def watch() -> None:
        while _lives(pid) and beginning(pid) == known:
            time.sleep(_LOOK)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def ready(workers: Mapping[int, Worker]) -> list[int]:
    """Block until a worker has a result or has ended; return the keys of all such."""
    found = set(multiprocessing.connection.wait([sign for each in workers.values() for sign in each.signs]))
    return [key for key, each in workers.items() if found.intersection(each.signs)]
