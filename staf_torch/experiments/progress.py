"""How far a long run is: a bar on a terminal, now and then a line in the log otherwise."""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar

_log = logging.getLogger(__name__)
_QUIET = 2.0  # seconds before anything is shown: short runs need none
_BAR_EVERY = 0.2
_LINE_EVERY = 10.0

_listener: ContextVar[Callable[[float], None] | None] = ContextVar("listener", default=None)


@contextlib.contextmanager
def listening(listener: Callable[[float], None]) -> Iterator[None]:
    """Progress inside is told to ``listener``, the share that is done, and not shown."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


class Progress:
    """Progress over a known number of steps.

    Args:
        total: steps.
        what: what is counted, for the message.
    """

    def __init__(self, total: int, what: str) -> None:
        self._total, self._what = total, what
        self._terminal = sys.stderr.isatty()
        self._start = time.monotonic()
        self._shown = self._start + _QUIET - (_BAR_EVERY if self._terminal else _LINE_EVERY)
        self._drawn = False
        self._done = 0

    def advance(self, steps: int) -> None:
        """``steps`` more are done."""
        self._done += steps
        listener = _listener.get()
        if listener is not None:
            listener(self._done / self._total)
            return
        now = time.monotonic()
        if now - self._start < _QUIET or now - self._shown < self._interval:
            return
        self._shown = now
        share = self._done / self._total
        left = (now - self._start) * (1 - share) / share
        if self._terminal:
            filled = round(30 * share)
            bar = "#" * filled + "." * (30 - filled)
            sys.stderr.write(f"\r[{bar}] {share:4.0%} of {self._total} {self._what}, {left:.0f} s left ")
            sys.stderr.flush()
            self._drawn = True
        else:
            _log.info("%.0f %% of %d %s, %.0f s left", 100 * share, self._total, self._what, left)

    def close(self) -> None:
        """Wipe the bar, if one was drawn."""
        if self._drawn:
            sys.stderr.write("\r" + " " * 79 + "\r")
            sys.stderr.flush()

    @property
    def _interval(self) -> float:
        return _BAR_EVERY if self._terminal else _LINE_EVERY
