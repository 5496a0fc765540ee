"""Signals that end a program with its report, and processes that compute for a parent and end with it.

Python raises what a signal asks for between any two instructions, also inside of a finaliser or of a callback
of the garbage collector, where it is printed and lost. Whoever loops over jobs therefore asks again: `check`.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import multiprocessing
import multiprocessing.connection
import os
import pickle
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from omegaconf import DictConfig

from ..figures.style import FigurePaper, in_a_sweep, printed_on
from ..signs import SHOWN
from .hydra_compat import trusted, trusted_packages
from .job import (
    DEFERRED,
    Batch,
    Computed,
    Deferred,
    Done,
    Failed,
    LostError,
    Outcome,
    Written,
    completion,
    solve,
)

_NUMBERS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
_USUAL = (signal.SIG_DFL, signal.default_int_handler)
_arrived: list[int] = []  # since `stopped_by_signals` began
_PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>
_LOOK = 1.0  # s between two looks at a parent that is no direct one
_END = 5.0  # s that a process has to end when it is asked to


class Stopped(KeyboardInterrupt):
    """A signal of that number that asks the program to end; nothing that only handles errors catches it."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Raise `Stopped` where one of the signals arrives, once; `nohup` and other threads are left alone."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _NUMBERS}
    taken = {number: handler for number, handler in before.items() if handler in _USUAL}
    parent = threading.get_native_id()

    def stop(number: int, frame: FrameType | None) -> None:
        if threading.get_native_id() != parent:  # a child of a fork, which has its own end
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        for each in taken:  # what follows, the report, takes a second or two; Ctrl-C and SIGKILL remain
            signal.signal(each, signal.default_int_handler if each == signal.SIGINT else signal.SIG_IGN)
        _arrived.append(number)
        raise Stopped(number)

    for number in taken:
        signal.signal(number, stop)
    try:
        yield
    finally:
        _arrived.clear()
        for number, handler in taken.items():
            signal.signal(number, handler)


def check() -> None:
    """Raise `Stopped` if a signal has arrived and what it raised was lost."""
    if _arrived:
        raise Stopped(_arrived[0])


def what_ended(error: BaseException) -> BaseException:
    """Return an error, or `Stopped` where a signal has arrived: of what the signal breaks off in another
    library's settings or files an error of its own may be made, in whose place the signal stands."""
    broken_off = _arrived and not isinstance(error, KeyboardInterrupt)
    return Stopped(_arrived[0]) if broken_off else error


def name_and_code(error: KeyboardInterrupt) -> tuple[str, int]:
    """Return what ended the program, and its exit code as shells have it."""
    number = error.number if isinstance(error, Stopped) else int(signal.SIGINT)
    said = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
    return said, 128 + number


class Worker:
    """A fresh process that computes one thing after the other, by a function of a module."""

    def __init__(self, work: Callable[..., bytes]) -> None:
        context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
        self._ours, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(work, theirs, os.getpid()), daemon=True)
        self._process.start()
        theirs.close()

    @property
    def signs(self) -> list[Any]:
        """Return the handles that become ready when a result is there or the process has ended."""
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
        """Return whether the process can take more work."""
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

    ``began`` is the other's `beginning`, None that of the process that has the number now; a direct
    ``parent`` is watched by the kernel on Linux.
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


def give_memory_back() -> None:
    """Return freed memory to the system: the C library of Linux keeps that of a tensor batch, some 30 MB."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # musl has none
        if trim is not None:
            trim(0)


def pack(batch: Batch) -> tuple[bytes, list[str], list[str]]:
    """Return the arguments of `solve_elsewhere`."""
    return pickle.dumps(batch), list(sys.path), trusted_packages()


def unpack(pickled: bytes) -> Done:
    """Unpickle what `solve_elsewhere` returned."""
    done: Done = pickle.loads(pickled)
    return done


def solve_elsewhere(pickled: bytes, path: Sequence[str], packages: Sequence[str] = ()) -> bytes:
    """Compute a pickled `Batch` in a process that has only just begun, and return the pickled `Done`.

    It gets the command's `sys.path`, which may lead to a user's own modules, and the packages whose objects
    the command's settings may name.
    """
    sys.path[:] = [*path, *(entry for entry in sys.path if entry not in path)]
    start = time.monotonic()
    with trusted(packages):
        batch: Batch = pickle.loads(pickled)
        outcomes = solve(batch.settings, SHOWN)
        for i, outcome in enumerate(outcomes):
            if isinstance(outcome, Deferred):
                outcomes[i] = _run_whole(batch.settings[i], Path(batch.directories[i]))
            elif isinstance(outcome, Computed) and batch.measured:
                outcomes[i] = Written(outcome.metrics, ())
        portable = [_portable(outcome) for outcome in outcomes]
    give_memory_back()
    return pickle.dumps(Done(portable, time.monotonic() - start))


def _run_whole(cfg: DictConfig, directory: Path) -> Outcome:
    """Run an experiment that takes no part in batches, and keep its log for the parent."""
    directory.mkdir(parents=True, exist_ok=True)
    with _kept_log() as lines, in_a_sweep():
        try:
            with printed_on(FigurePaper.of(cfg.get("figures", True))):
                return Written(completion(cfg, DEFERRED)(cfg, directory, SHOWN), lines)
        except Exception as error:
            return Failed(error)


@contextlib.contextmanager
def _kept_log() -> Iterator[list[tuple[int, str]]]:
    """Collect level and text of log messages and warnings in a list."""
    lines: list[tuple[int, str]] = []
    handler, root = logging.Handler(), logging.getLogger()
    handler.emit = lambda record: lines.append((record.levelno, record.getMessage()))  # type: ignore[method-assign]
    root.setLevel(logging.INFO)
    root.addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: lines.append((logging.WARNING, str(message)))
            yield lines
    finally:
        root.removeHandler(handler)


def _portable(outcome: Outcome) -> Outcome:
    """Return the outcome; an exception that cannot be pickled is replaced by one with its words."""
    if not isinstance(outcome, Failed):
        return outcome
    try:
        pickle.loads(pickle.dumps(outcome))
    except Exception:
        return Failed(RuntimeError(f"{type(outcome.error).__name__}: {outcome.error}"))
    return outcome
