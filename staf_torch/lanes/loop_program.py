"""Loops that begin in plain torch: compiled where that repays; a sign, and advice, where they take long."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

from ..signs import Sign
from .calls.choice import PlainTime, RepaysError, ShortCall
from .compiled_methods import methods_of
from .program import Program
from .row_numbers import one_by_one
from .trace.row_independence import generators
from .tree import Tree

_log = logging.getLogger(__name__)
_FEW = 16  # steps of a loop that are not worth the count of one
_SAID, _LONG = 1.5, 3.0  # s after which a loop says that it takes long, and that are then left of it at least


class LoopProgram:
    """Program of a loop that begins in plain torch, and is compiled from its start where that repays.

    The first step is counted as it runs (`PlainTime`). Where all of them take twice as long as a compiler,
    it is undone, random numbers too, and the compiled program runs the loop. Else plain torch goes on, and
    says in the log after 1.5 s how long the rest takes, if more than 3 s.

    Args:
        plain: the program in plain torch.
        compiled: makes the compiled one; None where there is none.
        times: of the loop, all calls together.
        remedy: what makes it faster, for the log.
        parts: of the loop; while a method of one will soon be compiled by itself, nobody knows the rest.
    """

    def __init__(
        self,
        plain: Program,
        compiled: Callable[[], Program] | None,
        times: int,
        *,
        remedy: str = "",
        parts: Sequence[Any] = (),
    ) -> None:
        self._step, self._make, self._times, self._remedy = plain.step, compiled, times, remedy
        self._plain = Program(self._timed, name=plain.name, compile=False)
        self._compiled: Program | None = None
        self._sign = Sign(f"{plain.name} in plain torch", times)
        self._done, self._spent, self._fastest, self._said = 0, 0.0, math.inf, False
        self._parts, self._waited = parts, False
        self._counted = 0  # rows, one after the other, of which a step was counted
        self._short = ShortCall(plain.name, tuple(map(type, parts)), "`compile=True`" if remedy else "")

    def __call__(
        self, carry: Tree, now: Tree = (), row: Tree = (), *, steps: int | None = None, every: int = 1
    ) -> tuple[Tree, Tree]:
        """The carry after the last step, and the outputs, as of a `Program`."""
        if self._compiled is None:
            put_back = generators()
            try:
                return self._in_plain_torch(carry, now, row, steps=steps, every=every)
            except RepaysError:
                assert self._make is not None
                put_back()
                self._compiled = self._make()
        return self._compiled(carry, now, row, steps=steps, every=every)

    def _in_plain_torch(self, *given: Tree, steps: int | None, every: int) -> tuple[Tree, Tree]:
        calls, before = int(not self._done), self._spent
        with self._sign:
            found = self._plain(*given, steps=steps, every=every)
        if self._make is not None and not self._said:
            self._short.count(self._spent - before, calls)
        return found

    def _timed(self, carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
        start = time.perf_counter()
        rows = one_by_one()
        if self._make is not None and rows > self._counted and self._times * rows >= _FEW:
            self._counted = rows
            with PlainTime(self._times * rows) as plain:
                found = self._step(carry, now, row)
            plain.refuse()
        else:
            found = self._step(carry, now, row)
        self._look(time.perf_counter() - start)
        return found

    def _look(self, seconds: float) -> None:
        """Log once, if a loop takes long, how long the rest of it takes by the fastest step so far."""
        self._done, self._spent = self._done + 1, self._spent + seconds
        self._sign.advance()
        self._fastest = min(self._fastest, seconds)
        if self._said or self._done < 2 or self._spent < _SAID:
            return
        methods = [method for part in self._parts for method in methods_of(part)]
        waited, self._waited = self._waited, any(method.compiles_soon for method in methods)
        if waited or self._waited:  # or in the step after the last one was compiled
            self._fastest = math.inf
            return
        rest = self._fastest * (self._times * one_by_one() - self._done)
        if rest < _LONG:
            return
        self._said = True
        _log.warning(
            "%s: %d of %d steps took %.1f s in plain torch, the rest takes some %.0f s%s",
            *(self._plain.name, self._done, self._times * one_by_one(), self._spent, rest, self._remedy),
        )
