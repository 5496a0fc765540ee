"""Progress of long loops: a bar on a terminal, now and then a line in the log otherwise."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from tqdm.auto import tqdm

T = TypeVar("T")
_log = logging.getLogger(__name__)
_QUIET = 2.0  # seconds before anything is shown: short loops need none
_LINE_EVERY = 10.0  # s


class Progress:
    """Report how far long loops of an experiment are.

    Args:
        listener: is told the share of the loop that is done, and nothing is shown; None: a bar or log lines.

    Example:
        >>> for radius in Progress().each([0.1, 0.2], "radii"):
        ...     pass
    """

    def __init__(self, listener: Callable[[float], None] | None = None) -> None:
        self._listener = listener

    def each(self, items: Sequence[T], what: str) -> Iterator[T]:
        """Yield the items; each counts as done when the next one is asked for."""
        with self.over(len(items), what) as advance:
            for item in items:
                yield item
                advance(1)

    @contextlib.contextmanager
    def over(self, total: int, what: str) -> Iterator[Callable[[int], None]]:
        """Yield a function to be told of every few steps that are done.

        Args:
            total: number of steps.
            what: what is counted, for the message.
        """
        tell = self._listener or _log_lines(total, what)
        done = 0
        hidden = None if self._listener is None else True  # None: shown where stderr is a terminal
        with tqdm(total=total, unit=f" {what}", delay=_QUIET, leave=False, disable=hidden) as bar:

            def advance(steps: int) -> None:
                nonlocal done
                done += steps
                bar.update(steps)
                if bar.disable:
                    tell(done / total)

            yield advance


SHOWN = Progress()
"""Bars and log lines: what a program that asks for nothing else gets."""


def _log_lines(total: int, what: str) -> Callable[[float], None]:
    """Return a function that logs the share that is done, a line every ten seconds, the first after two."""
    start = time.monotonic()
    said = start + _QUIET - _LINE_EVERY

    def tell(share: float) -> None:
        nonlocal said
        now = time.monotonic()
        if now - said >= _LINE_EVERY:
            said, left = now, (now - start) * (1 - share) / share
            _log.info("%.0f %% of %d %s, %.0f s left", 100 * share, total, what, left)

    return tell
