"""SIGTERM and SIGHUP end a program as Ctrl-C does: with its report and the line that resumes.

Python raises what a signal asks for between any two instructions, also inside of a finaliser or of a callback
of the garbage collector, where it is printed and lost. Whoever loops over jobs therefore asks again: `check`.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

_NUMBERS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
_USUAL = (signal.SIG_DFL, signal.default_int_handler)
_arrived: list[int] = []  # since `stopped_by_signals` began


class Stopped(KeyboardInterrupt):
    """A signal that asks the program to end; nothing that only handles errors catches it.

    Args:
        number: of the signal.
    """

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
