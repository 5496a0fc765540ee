"""Calls that are each too short to be compiled: one line of the log once they have taken long together.

`auto` decides by a call alone, so that equal calls have equal bits: the hundredth is plain torch as the first
was. What that has cost by then, and what to write, is all that is said.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Hashable

_log = logging.getLogger(__name__)
_TOGETHER = 3.0  # s, in which most loops are compiled twice
_spent: dict[Hashable, tuple[int, float]] = {}  # calls of a kind, and s that they took; inf once it was said


class ShortCall:
    """Context of a call that `auto` leaves in plain torch as it is short.

    Args:
        name: of what is called, in the log.
        kind: tells calls apart that other programs would serve.
        remedy: what compiles it.
    """

    def __init__(self, name: str, kind: Hashable, remedy: str = "") -> None:
        self._name, self._kind, self._remedy = name, (name, kind), remedy
        self._began = 0.0

    def __enter__(self) -> None:
        self._began = time.perf_counter()

    def __exit__(self, error: object, *_: object) -> None:
        if error is None:
            self.count(time.perf_counter() - self._began)

    def count(self, seconds: float, calls: int = 1) -> None:
        """Count calls and what they took, and log the sum once it is large."""
        before, spent = _spent.get(self._kind, (0, 0.0))
        calls, spent = before + calls, spent + seconds
        late = _TOGETHER <= spent < math.inf and calls > 1
        _spent[self._kind] = calls, math.inf if late else spent
        if late:
            _log.warning(
                "%s: %d calls took %.1f s in plain torch, %.0f ms each: each is too short to be compiled, "
                'and equal calls keep equal bits. %s`with lanes.compiling("always"):` around them compiles '
                "them, once, in about two seconds; the numbers then differ by some 1e-12. Said once.",
                *(self._name, calls, spent, 1e3 * spent / calls, self._remedy and f"{self._remedy} or "),
            )
