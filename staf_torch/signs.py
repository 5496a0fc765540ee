"""Signs of life: a call that takes long says what it is at, after 1.5 s and then again.

On a terminal that is a line which is redrawn and wiped, with a bar where the end is known. Elsewhere a line
every ten seconds goes to the log if that takes INFO, else to stderr (in notebooks to stdout, where nothing is
red). Nothing is shown where the log of `staf_torch` takes no warnings either, or in the processes of
`multiprocessing`, whose parent shows its own. One thread of one process shows at a time.

A thread looks four times a second at what is open, and ends when nothing is. So a sign costs a call a few
microseconds, and code that never returns to Python is shown as well. Nothing here imports torch.

`Progress` is what experiments are given for their loops, `printed` what commands print with.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import logging
import multiprocessing
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, ParamSpec, TypeVar

_P = ParamSpec("_P")
_R = TypeVar("_R")
_T = TypeVar("_T")
_log = logging.getLogger(__name__)
FIRST, EVERY = 1.5, 10.0
"""s before anything is shown, and from a line to the next."""
_LOOK = 0.25  # s
_BAR = 24  # characters
_TELLING = 0.05  # share done, from which the time left is told
_MARKS = 64  # most that a `Pace` keeps
_open: dict[int, list[Sign]] = {}  # of each thread, from the outermost call in
_lock = threading.RLock()
_mine = threading.local()
_watch: threading.Thread | None = None
_drawn = False  # whether a terminal shows a line that is to be wiped


class Pace:
    """Time left by the latter half of the steps that are done, the first of which compiles and loads.

    Example:
        >>> from staf_torch.signs import Pace
        >>> pace = Pace()
        >>> for k in range(1, 4):
        ...     pace.note(k, 10)
        >>> pace.left(10) < 1.0
        True
    """

    def __init__(self) -> None:
        self._marks: list[tuple[float, float]] = []  # (s, steps), a `_MARKS`-th of the total or more apart
        self.due = 0.0  # steps, from which there is something to note

    def note(self, done: float, total: float) -> None:
        """Note that so many steps of the total are done now."""
        if done > self.due:
            self._marks.append((time.monotonic(), done))
            self.due = done + max(total / _MARKS - 1e-9, 0.0)

    def left(self, total: float) -> float | None:
        """Return the time left (s); None as long as one step alone has been noted."""
        if len(self._marks) < 2:
            return None
        last, done = self._marks[-1]
        start, before = next((mark for mark in self._marks[-2::-1] if mark[1] <= done / 2), self._marks[0])
        late, spent = time.monotonic() - last, last - start
        if late > spent:  # the step that is going on takes long: it slows the pace
            late, spent = 0.0, spent + late
        return max(0.0, (total - done) * spent / (done - before) - late)


class Sign:
    """Context, or decorator, of what may take long.

    Example:
        >>> from staf_torch.signs import Sign
        >>> with Sign("three sums", 3, "sums") as sign:
        ...     for k in range(3):
        ...         sign.advance()

    Inside of another one of its thread a sign is a clause of that one's line:
    `near_optimal: a global value: 37 % of 20 rounds, 12 s left; compiling 3120 lines (18 s so far)`.

    Args:
        what: is going on; or a function that returns the whole clause.
        total: of the steps; 0 where nobody knows.
        unit: of them, in the plural.
        log: whether a line may go to the log; else it goes to stderr.
    """

    def __init__(
        self, what: str | Callable[[], str], total: float = 0, unit: str = "steps", *, log: bool = True
    ) -> None:
        self._what, self.total, self.unit, self._log = what, total, unit, log
        self.done, self._began, self._said, self._pace = 0.0, 0.0, -EVERY, Pace()

    def __call__(self, function: Callable[_P, _R]) -> Callable[_P, _R]:
        """Decorate a function of which each call has a sign of its own."""
        what, total, unit, log = self._what, self.total, self.unit, self._log

        @functools.wraps(function)
        def shown(*args: _P.args, **kwargs: _P.kwargs) -> _R:
            with Sign(what, total, unit, log=log):
                return function(*args, **kwargs)

        return shown

    def __enter__(self) -> Sign:
        self._began, self._stack = self._began or time.monotonic(), _signs()  # may go on after a pause
        self._stack.append(self)
        if len(self._stack) == 1 and multiprocessing.parent_process() is None:
            with _lock:
                _open[id(self._stack)] = self._stack
                _start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._stack and self._stack[-1] is self:
            self._stack.pop()
        elif self in self._stack:
            del self._stack[self._stack.index(self) :]  # with those of generators that an error has left open
        else:
            return
        if not self._stack:
            with _lock:
                if _open.pop(id(self._stack), None) is not None:
                    wipe()

    def advance(self, steps: float = 1) -> None:
        """Count steps that are done."""
        self.done += steps
        if self.done > self._pace.due and self.total:
            self._pace.note(self.done, self.total)

    @property
    def share(self) -> float:
        """Share of the steps that is done; 0 where nobody knows."""
        return min(self.done / self.total, 1.0) if self.total else 0.0

    @property
    def clause(self) -> str:
        """`what: 37 % of 100 steps, 12 s left`."""
        what, share = self._what, self.share
        if not isinstance(what, str):
            return what()
        if not 0 < share < 1:
            return what
        far, left = f"{100 * share:.0f} % of {self.total:g} {self.unit}", self._pace.left(self.total)
        if share >= _TELLING and left is not None:
            far += f", {left:.0f} s left"
        return f"{what}: {far}" if what else far


def write(line: str) -> None:
    """Write a line to stderr, above what is drawn there."""
    with _lock:
        wipe()
        sys.stderr.write(line + "\n")
        sys.stderr.flush()


def wipe() -> None:
    """Wipe what is drawn on the terminal; it is drawn again at the next look."""
    global _drawn
    if _drawn:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
        _drawn = False


def _signs() -> list[Sign]:
    if not hasattr(_mine, "signs"):
        _mine.signs = []
    found: list[Sign] = _mine.signs
    return found


def _start() -> None:
    global _watch
    if _watch is None:
        _watch = threading.Thread(target=_look, name="staf_torch.signs", daemon=True)
        _watch.start()


def _look() -> None:
    global _watch
    while True:
        time.sleep(_LOOK)
        with _lock:
            if not _open:
                _watch = None
                return
            stack = list(next(iter(_open.values())))
        if stack and time.monotonic() - stack[0]._began >= FIRST:
            with contextlib.suppress(OSError, ValueError):  # a stream that was closed
                _show(stack)


def _show(stack: list[Sign]) -> None:
    """Draw the line of the oldest call on a terminal, or write it every ten seconds."""
    first, now = stack[0], time.monotonic()
    off = first._log and not _log.isEnabledFor(logging.WARNING)
    terminal = sys.stderr is not None and sys.stderr.isatty()
    if off or sys.stderr is None or (not terminal and now - first._said < EVERY):
        return
    first._said = now
    clauses = list(dict.fromkeys(filter(None, (each.clause for each in stack))))
    line = f"{'; '.join(clauses)} ({now - first._began:.0f} s so far)"
    if terminal:
        if share := next((each.share for each in stack if each.share), 0.0):
            line = f"{100 * share:3.0f} %|{'#' * round(_BAR * share):{_BAR}}| {line}"
        _draw(line, first)
    elif first._log and _log.isEnabledFor(logging.INFO):
        _log.info("%s", line)
    else:
        stream = sys.stdout if "ipykernel" in sys.modules else sys.stderr
        stream.write(line + "\n")
        stream.flush()


def _draw(line: str, sign: Sign) -> None:
    """Draw on the terminal, if the sign is still up; what is printed next begins over it."""
    global _drawn
    with _lock:
        if sign in sign._stack:
            sys.stderr.write(f"\r{line[: shutil.get_terminal_size().columns - 1]}\x1b[K\r")
            sys.stderr.flush()
            _drawn = True
    handlers: Iterable[Any] = (*logging.getLogger().handlers, *filter(None, (logging.lastResort,)))
    for handler in handlers:
        if _wiping not in handler.filters:
            handler.addFilter(_wiping)


def _wiping(_: logging.LogRecord) -> bool:
    """Let a record of the log pass, after what is drawn is wiped."""
    with _lock:
        wipe()
    return True


def _forked() -> None:
    """Forget, in the child of a fork, what the parent shows."""
    global _lock, _watch, _drawn
    _lock, _watch, _drawn = threading.RLock(), None, False
    _open.clear()


atexit.register(_open.clear)  # a thread that writes while Python ends would abort it
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)


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

    def each(self, items: Sequence[_T], what: str) -> Iterator[_T]:
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


def printed(text: str) -> int:
    """Write a text to stdout and return the exit code 0, also to a reader with enough (`| head -1`)."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:  # what is left to write at the end of the process goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0
