"""Progress of an experiment's loops: signs of life, or for a listener that shows several together."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from ..signs import Sign

T = TypeVar("T")


class Progress:
    """Report how far long loops of an experiment are.

    Args:
        listener: is told the share of the loop that is done, and nothing is shown; None: `signs`.

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
        if self._listener is None:
            with Sign("", total, what) as sign:
                yield sign.advance
            return
        tell, done = self._listener, 0

        def advance(steps: int) -> None:
            nonlocal done
            done += steps
            tell(done / total)

        yield advance


SHOWN = Progress()
"""Signs of life: what a program that asks for nothing else gets."""
