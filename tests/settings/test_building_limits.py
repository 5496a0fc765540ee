"""What building from settings of unknown origin may take: what is asked of the system, without taking it."""

from __future__ import annotations

import re
import resource
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from staf_torch.settings import trust
from staf_torch.settings.trust import limited

QUARTER = 2**28  # bytes


@pytest.fixture
def limits(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Limits of the process that a test says, and what they are set to."""
    found = SimpleNamespace(soft=-1, hard=-1, used=1000, set=[])
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (found.soft, found.hard))
    monkeypatch.setattr(resource, "setrlimit", lambda kind, pair: found.set.append((kind, pair)))
    monkeypatch.setattr(trust, "_data_bytes", lambda: found.used)
    return found


@pytest.mark.parametrize(
    ("hard", "used", "wanted"),
    [
        (-1, 1000, QUARTER + 1000),
        (QUARTER + 999, 1000, QUARTER + 999),  # no more than there may be
        (QUARTER + 1001, 1000, QUARTER + 1000),
        (-1, 1, QUARTER + 1),
        (-1, 0, None),  # nobody knows what the process has
    ],
)
def test_memory_is_limited_to_a_quarter_of_a_gigabyte_more_and_given_back(
    hard: int, used: int, wanted: int | None, limits: SimpleNamespace
) -> None:
    limits.soft, limits.hard, limits.used = 7, hard, used
    with limited("this"):
        inside = list(limits.set)
    assert inside == ([] if wanted is None else [(resource.RLIMIT_DATA, (wanted, hard))])
    assert limits.set == [*inside, (resource.RLIMIT_DATA, (7, hard))]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "this takes more memory to build than 268435456 bytes: add --trust."),
        (RuntimeError("not enough memory: you tried"), "this takes more memory to build than"),
        (trust._TooLongError(), "this takes more than 4 s to build: add --trust to wait."),
    ],
)
def test_what_was_too_much_is_said(error: Exception, said: str, limits: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match=re.escape(said)), limited("this"):
        raise error
    assert limits.set[-1] == (resource.RLIMIT_DATA, (-1, -1))


@pytest.mark.parametrize("error", [RuntimeError("shapes differ"), KeyError("memory"), ValueError("no")])
def test_other_errors_are_their_own(error: Exception, limits: SimpleNamespace) -> None:
    with pytest.raises(type(error)) as raised, limited("this"):
        raise error
    assert raised.value is error
    assert limits.set[-1] == (resource.RLIMIT_DATA, (-1, -1))


def test_the_time_is_four_seconds_and_the_signal_is_given_back(
    limits: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_to: list[Any] = []
    monkeypatch.setattr(signal, "setitimer", lambda *given: set_to.append(given))
    before = signal.getsignal(signal.SIGPROF)
    with limited("this"):
        stop = signal.getsignal(signal.SIGPROF)
        assert stop is not before
        with pytest.raises(trust._TooLongError):
            stop(signal.SIGPROF, None)  # type: ignore[operator, misc, arg-type]
    assert signal.getsignal(signal.SIGPROF) is before
    assert set_to == [(signal.ITIMER_PROF, 4.0), (signal.ITIMER_PROF, 0)]


@pytest.fixture
def watchers(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    """What watches a thread that builds: run by a test, at a time that it says."""
    found = SimpleNamespace(made=[], now=50.0, raised=[], waits=[])

    class Ended:
        """An event that notes how long it is waited for."""

        def __init__(self) -> None:
            self.over, self.looks = False, 0

        def wait(self, seconds: float) -> bool:
            found.waits.append(seconds)
            self.looks += 1
            return self.over or self.looks > 5

        def is_set(self) -> bool:
            return self.over

        def set(self) -> None:
            self.over = True

    def thread(target: Any, daemon: bool = False) -> SimpleNamespace:
        found.made.append((target, daemon))
        return SimpleNamespace(start=lambda: None)

    own = SimpleNamespace(
        **{name: getattr(threading, name) for name in ("current_thread", "main_thread", "get_ident", "Lock")},
        Event=Ended,
        Thread=thread,
    )
    monkeypatch.setattr(trust, "threading", own)
    monkeypatch.setattr(
        trust,
        "time",
        SimpleNamespace(pthread_getcpuclockid=time.pthread_getcpuclockid, clock_gettime=lambda _: found.now),
    )
    asked = SimpleNamespace(PyThreadState_SetAsyncExc=lambda ident, error: found.raised.append(ident.value))
    monkeypatch.setattr(trust.ctypes, "pythonapi", asked)
    return found


def test_a_thread_that_builds_is_looked_at_twenty_times_a_second(
    limits: SimpleNamespace, watchers: SimpleNamespace
) -> None:
    def build() -> int:
        with limited("this"):
            ((watch, daemon),) = watchers.made
            assert daemon
            watchers.now = 54.0
            watch()  # five looks, and it is not over
            assert watchers.raised == []
            assert watchers.waits == [0.05] * 6
            watchers.waits.clear()
        watchers.now = 99.0
        watch()
        assert watchers.raised == []  # it has ended
        return threading.get_ident()

    with ThreadPoolExecutor(1) as pool:
        pool.submit(build).result(60)


def test_a_thread_that_takes_longer_is_told_once(limits: SimpleNamespace, watchers: SimpleNamespace) -> None:
    def build() -> int:
        with limited("this"):
            ((watch, _),) = watchers.made
            watchers.now = 54.5
            watch()
        return threading.get_ident()

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(build).result(60) == watchers.raised[0]
    assert len(watchers.raised) == 1
    assert watchers.waits == [0.05]


def test_the_memory_of_this_process_is_what_the_kernel_says() -> None:
    status = Path("/proc/self/status")
    if not status.exists():
        assert trust._data_bytes() == 0
        return
    (kilobytes,) = re.findall(r"^VmData:\s+(\d+) kB$", status.read_text(), re.MULTILINE)
    assert trust._data_bytes() == pytest.approx(1024 * int(kilobytes), rel=0.1)
