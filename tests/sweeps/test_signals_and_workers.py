"""Signals end a sweep once, and workers end with whom they work for; tests/trust kills real processes."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from staf_torch.sweeps.workers import (
    Stopped,
    beginning,
    check,
    name_and_code,
    stopped_by_signals,
    what_ended,
)

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


def handlers() -> list[object]:
    return [signal.getsignal(each) for each in NUMBERS]


@pytest.mark.usefixtures("usual")
@pytest.mark.parametrize("number", NUMBERS)
def test_a_signal_stops_once_and_what_follows_is_let_be(number: signal.Signals) -> None:
    before = handlers()
    with stopped_by_signals():
        with pytest.raises(Stopped) as stopped:
            signal.raise_signal(number)
        assert stopped.value.number == number
        assert handlers() == [signal.SIG_IGN, signal.SIG_IGN, signal.default_int_handler]
        with pytest.raises(Stopped, match=str(int(number))):  # whoever loops asks again
            check()
        assert isinstance(what_ended(AttributeError("left behind in a library")), Stopped)
    check()  # nothing is left of it
    assert handlers() == before


@pytest.mark.usefixtures("usual")
def test_signals_that_somebody_handles_or_ignores_are_left_alone_and_so_are_other_threads() -> None:
    seen: list[object] = []

    def work() -> None:
        with stopped_by_signals():
            seen.extend(handlers())

    before = handlers()
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == before
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as `nohup` does
    signal.signal(signal.SIGTERM, print)  # type: ignore[arg-type]
    with stopped_by_signals():
        assert handlers()[:2] == [print, signal.SIG_IGN]
        assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


@pytest.mark.usefixtures("usual")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_child_of_a_fork_ends_by_the_signal_itself() -> None:
    with stopped_by_signals():
        child = os.fork()
        if not child:
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGKILL)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGTERM


def test_a_signal_has_a_name_and_the_code_of_shells() -> None:
    assert name_and_code(KeyboardInterrupt()) == ("interrupted", 130)
    assert name_and_code(Stopped(signal.SIGINT)) == ("interrupted", 130)
    assert name_and_code(Stopped(signal.SIGTERM)) == ("ended by SIGTERM", 143)


def test_a_beginning_tells_a_process_from_a_later_one_of_its_number() -> None:
    began = Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]  # field 22 of proc(5)
    assert beginning(os.getpid()) == began
    assert beginning(2**22 + 1) == ""  # more than there can be
