"""Workers and signals without processes: what is asked of the system, and how long anybody waits."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from staf_torch.sweeps import signals, workers
from staf_torch.sweeps.signals import Stopped, name_and_code, stopped_by_signals
from staf_torch.sweeps.workers import LostError, Worker, beginning, end_with, end_with_file


class Ended(BaseException):  # ends the program, as `os._exit` does
    """This process would have ended."""


@pytest.fixture(autouse=True)
def _ends(monkeypatch: pytest.MonkeyPatch) -> None:
    def end(code: int) -> None:
        raise Ended(code)

    monkeypatch.setattr(os, "_exit", end)


class Threads:
    """Stands for `threading`: what is begun runs at once, here."""

    def __init__(self) -> None:
        self.daemons: list[bool] = []

    def Thread(self, *, target: Any, daemon: bool = False) -> Any:  # noqa: N802
        self.daemons.append(daemon)
        return SimpleNamespace(start=target)


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> Threads:
    made = Threads()
    monkeypatch.setattr(workers, "threading", made)
    return made


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """How long was slept, each time; the clock goes on meanwhile."""
    spans: list[float] = []
    fake = SimpleNamespace(sleep=spans.append, monotonic=lambda: 50.0 + sum(spans))
    monkeypatch.setattr(workers, "time", fake)
    return spans


# Who is watched


def test_a_process_is_looked_at_every_second_until_it_has_gone(
    threads: Threads, slept: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def kill(pid: int, number: int) -> None:
        asked.append((pid, number))
        if len(asked) == 4:
            raise ProcessLookupError
        if len(asked) == 3:
            raise PermissionError  # it is there, and somebody else's

    monkeypatch.setattr(os, "kill", kill)
    with pytest.raises(Ended):
        end_with(os.getpid())
    assert asked == [(os.getpid(), 0)] * 4
    assert slept == [1.0] * 3
    assert threads.daemons == [True]


def test_a_process_lives_where_somebody_may_signal_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert workers._lives(os.getpid())
    assert not workers._lives(2**22 + 1)  # more than there can be

    def kill(pid: int, number: int) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "kill", kill)
    assert workers._lives(7)


def test_a_process_of_another_beginning_is_another(threads: Threads, slept: list[float]) -> None:
    with pytest.raises(Ended):
        end_with(os.getpid(), "never")
    assert slept == []


def test_a_process_is_watched_as_that_which_began_when_it_is_said(
    threads: Threads, slept: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = iter(["then", "then", "now", "now", "now", "then"])
    monkeypatch.setattr(workers, "beginning", lambda pid: next(seen))
    with pytest.raises(Ended):
        end_with(os.getpid(), "then")
    assert slept == [1.0] * 2
    with pytest.raises(Ended):
        end_with(os.getpid())
    assert slept == [1.0] * 3


@pytest.mark.parametrize(("platform", "parent"), [("linux", True), ("linux", False), ("darwin", True)])
def test_the_kernel_of_linux_watches_a_parent(
    platform: str, parent: bool, threads: Threads, slept: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[int, int]] = []
    library = SimpleNamespace(prctl=lambda *given: asked.append(given))
    monkeypatch.setattr(ctypes, "CDLL", lambda name: library)
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(workers, "_lives", lambda pid: False)
    if platform == "linux" and parent:
        end_with(os.getppid(), parent=True)
        assert asked == [(1, signal.SIGKILL)]  # PR_SET_PDEATHSIG
        with pytest.raises(Ended):
            end_with(os.getpid(), parent=True)  # another one: ours ended before
        assert threads.daemons == []
    else:
        with pytest.raises(Ended):
            end_with(os.getppid(), parent=parent)
        assert asked == []
        assert threads.daemons == [True]


def test_a_beginning_is_that_of_the_process(tmp_path: Path) -> None:
    began = Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]  # field 22 of proc(5)
    assert beginning(os.getpid()) == began
    assert began.isdigit()
    assert beginning(2**22 + 1) == ""  # more than there can be


def test_a_file_is_watched_while_it_is_there_and_touched(
    tmp_path: Path, threads: Threads, slept: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "lock"
    with pytest.raises(Ended):
        end_with_file(path)
    assert slept == []
    path.write_text("")
    with pytest.raises(Ended):
        end_with_file(path)  # which nobody touches
    assert slept == [1.0] * 300
    slept.clear()
    with pytest.raises(Ended):
        end_with_file(path, 4.0)
    assert slept == [0.4] * 10
    slept.clear()
    assert threads.daemons == [True] * 3

    def touched(span: float) -> None:
        slept.append(span)
        if len(slept) in (5, 12):
            os.utime(path, (len(slept), len(slept)))
        if len(slept) == 17:
            path.unlink()

    monkeypatch.setattr(workers.time, "sleep", touched)
    with pytest.raises(Ended):
        end_with_file(path, 4.0)
    assert len(slept) == 17


def test_a_file_of_the_year_1970_counts_as_seen_once(
    tmp_path: Path, threads: Threads, slept: list[float]
) -> None:
    path = tmp_path / "lock"
    path.write_text("")
    os.utime(path, ns=(1, 1))
    with pytest.raises(Ended):
        end_with_file(path, 40.0)
    assert slept == [1.0] * 40


# A worker and its process


class Pipe:
    """One end of a pipe that gives what a test puts into it."""

    def __init__(self, *given: Any) -> None:
        self.given, self.sent, self.closed = list(given), [], False

    def recv(self) -> Any:
        found = self.given.pop(0)
        if isinstance(found, BaseException):
            raise found
        return found

    def send(self, what: Any) -> None:
        if self.closed:
            raise OSError("closed")
        self.sent.append(what)

    def close(self) -> None:
        self.closed = True


class Process:
    """A process that ends when it is told, or not."""

    exitcode, sentinel = -9, 17

    def __init__(self, **given: Any) -> None:
        self.given, self.notes, self.deaf = given, [], False

    def start(self) -> None:
        self.notes.append("start")

    def terminate(self) -> None:
        self.notes.append("terminate")

    def kill(self) -> None:
        self.notes.append("kill")

    def join(self, seconds: float | None = None) -> None:
        self.notes.append(seconds)

    def is_alive(self) -> bool:
        return self.deaf


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> tuple[Pipe, Pipe]:
    """Both ends of the pipe of a worker that is made."""
    made = Pipe(), Pipe()
    context = SimpleNamespace(Pipe=lambda: made, Process=Process)
    monkeypatch.setattr(multiprocessing, "get_context", lambda kind: context if kind == "spawn" else None)
    return made


def double(number: int) -> bytes:
    """Work."""
    if number == 3:
        raise KeyError("three")
    return str(2 * number).encode()


def test_a_worker_is_a_process_that_serves_and_ends_with_this_one(ends: tuple[Pipe, Pipe]) -> None:
    ours, theirs = ends
    worker: Any = Worker(double)
    process = worker._process
    assert process.given == {"target": workers._serve, "args": (double, theirs, os.getpid()), "daemon": True}
    assert process.notes == ["start"]
    assert (ours.closed, theirs.closed) == (False, True)
    assert worker.signs == [ours, 17]
    worker.begin(3, 4)
    assert ours.sent == [(3, 4)]
    assert not worker.alive()
    process.deaf = True
    assert worker.alive()


def test_a_result_is_waited_for_and_a_lost_process_for_five_seconds(ends: tuple[Pipe, Pipe]) -> None:
    worker: Any = Worker(double)
    ends[0].given = [(True, b"six"), (False, "KeyError: why"), EOFError(), OSError()]
    assert worker.result() == b"six"
    with pytest.raises(LostError, match=r"^KeyError: why$"):
        worker.result()
    assert worker._process.notes == ["start"]
    for _ in range(2):
        with pytest.raises(LostError, match="it was ended by SIGKILL"):
            worker.result()
    assert worker._process.notes == ["start", 5.0, 5.0]


@pytest.mark.parametrize("deaf", [False, True])
def test_a_worker_is_asked_to_end_and_then_killed(deaf: bool, ends: tuple[Pipe, Pipe]) -> None:
    worker: Any = Worker(double)
    worker._process.deaf = deaf
    worker.end()
    assert ends[0].closed
    assert worker._process.notes == ["start", "terminate", 5.0, *(["kill", None] if deaf else [])]
    worker.begin(1)  # found by `result`


def test_a_process_serves_until_its_pipe_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    set_to: list[Any] = []
    monkeypatch.setattr(signal, "signal", lambda *given: set_to.append(given))
    monkeypatch.setattr(workers, "end_with", lambda *given, **more: set_to.append((*given, more)))
    for closed in (EOFError(), OSError()):
        pipe = Pipe((1,), (3,), (2,), closed)
        workers._serve(double, pipe, 77)  # type: ignore[arg-type]
        assert pipe.sent == [(True, b"2"), (False, "KeyError: 'three'"), (True, b"4")]
    assert set_to[:3] == [
        (signal.SIGINT, signal.SIG_IGN),
        (signal.SIGHUP, signal.SIG_IGN),
        (77, {"parent": True}),
    ]


# Signals

NUMBERS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)


@pytest.fixture
def usual() -> Iterator[None]:
    """The handlers of a program that has only just begun."""
    before = {number: signal.getsignal(number) for number in NUMBERS}
    for number in NUMBERS:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("usual")
@pytest.mark.parametrize("number", NUMBERS)
def test_a_signal_stops_once_and_what_follows_is_let_be(number: signal.Signals) -> None:
    before = [signal.getsignal(each) for each in NUMBERS]
    with stopped_by_signals():
        assert all(
            signal.getsignal(each) not in (signal.SIG_DFL, signal.default_int_handler) for each in NUMBERS
        )
        with pytest.raises(Stopped) as stopped:
            signal.raise_signal(number)
        assert (stopped.value.number, stopped.value.args) == (number, (number,))
        assert [signal.getsignal(each) for each in NUMBERS] == [
            *(signal.SIG_IGN, signal.SIG_IGN, signal.default_int_handler)
        ]
        with pytest.raises(Stopped, match=str(int(number))):
            signals.check()
    signals.check()  # nothing is left of it
    assert [signal.getsignal(each) for each in NUMBERS] == before


@pytest.mark.usefixtures("usual")
def test_signals_that_somebody_handles_or_ignores_are_left_alone() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as `nohup` does
    signal.signal(signal.SIGTERM, print)  # type: ignore[arg-type]
    with stopped_by_signals():
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is print
        assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


@pytest.mark.usefixtures("usual")
def test_another_thread_leaves_signals_alone() -> None:
    before, seen = [signal.getsignal(each) for each in NUMBERS], []

    def work() -> None:
        with stopped_by_signals():
            seen.append([signal.getsignal(each) for each in NUMBERS])

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]


@pytest.mark.usefixtures("usual")
def test_a_child_of_a_fork_ends_by_the_signal_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    raised: list[Any] = []
    with stopped_by_signals():
        stop: Any = signal.getsignal(signal.SIGTERM)
        with monkeypatch.context() as patch:
            patch.setattr(threading, "get_native_id", lambda: -1)
            patch.setattr(
                signal, "raise_signal", lambda number: raised.append((number, signal.getsignal(number)))
            )
            with pytest.raises(Stopped):
                stop(signal.SIGTERM, None)
    assert raised == [(signal.SIGTERM, signal.SIG_DFL)]


@pytest.mark.usefixtures("usual")
def test_no_signal_is_raised_again_where_nobody_forked(monkeypatch: pytest.MonkeyPatch) -> None:
    with stopped_by_signals():
        stop: Any = signal.getsignal(signal.SIGTERM)
        monkeypatch.setattr(signal, "raise_signal", pytest.fail)
        with pytest.raises(Stopped):
            stop(signal.SIGTERM, None)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (KeyboardInterrupt(), ("interrupted", 130)),
        (Stopped(signal.SIGINT), ("interrupted", 130)),
        (Stopped(signal.SIGTERM), ("ended by SIGTERM", 143)),
        (Stopped(signal.SIGHUP), ("ended by SIGHUP", 129)),
    ],
)
def test_a_signal_has_a_name_and_the_code_of_shells(error: KeyboardInterrupt, said: tuple[str, int]) -> None:
    assert name_and_code(error) == said
