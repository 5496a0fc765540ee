"""One line for a whole sweep: a bar on a terminal, now and then a line of its own otherwise."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

_BAR_EVERY, _LINE_EVERY = 0.2, 10.0  # s
_WIDTH = 30


class SweepProgress:
    """Jobs that are done and that failed, and the time left.

    Args:
        total: jobs.
        done: of them, from before.
    """

    def __init__(self, total: int, done: int = 0) -> None:
        self._total, self._before, self._done, self._failed = total, done, done, 0
        self._sizes: dict[int, int] = {}
        self._solved, self._part = 0, 0.0
        self._terminal = sys.stderr.isatty()
        self._start = self._shown = time.monotonic()
        self._width = 0

    def expect(self, sizes: Sequence[int]) -> None:
        """So many jobs in each tensor batch."""
        self._sizes = dict(enumerate(sizes))

    def part(self, share: float) -> None:
        """That share of the first tensor batch that is not computed is."""
        self._part = share * next(iter(self._sizes.values()), 0)
        self._show()

    def solved(self, number: int) -> None:
        """The tensor batch of that number is computed."""
        self._solved, self._part = self._solved + self._sizes.pop(number), 0.0
        self._show()

    def ended(self, name: str, failure: str | None) -> None:
        """One more job has its run directory; ``failure`` says why it has no result."""
        self._done += 1
        if failure is not None:
            self._failed += 1
            self.say(f"{name} failed: {failure}")
        self._show()

    def say(self, message: str) -> None:
        """A message of its own, above the line."""
        self._wipe()
        self._write(message + "\n")

    def close(self) -> None:
        """Wipe the line."""
        self._wipe()

    @property
    def line(self) -> str:
        """`37 of 100 jobs done, 1 failed, 12 s left`."""
        failed = f", {self._failed} failed" if self._failed else ""
        share = self._share
        spent = time.monotonic() - self._start
        left = f", {spent * (1 - share) / share:.0f} s left" if 0 < share < 1 else ""
        return f"{self._done} of {self._total} jobs done{failed}{left}"

    @property
    def _share(self) -> float:
        """Of the jobs that were left to do."""
        computed = max(self._solved + self._part, self._done - self._before)
        return min(1.0, computed / max(1, self._total - self._before))

    def _show(self) -> None:
        now = time.monotonic()
        if now - self._shown < (_BAR_EVERY if self._terminal else _LINE_EVERY):
            return
        self._shown = now
        if not self._terminal:
            self._write(self.line + "\n")
            return
        filled = round(_WIDTH * self._share)
        text = f"[{'#' * filled}{'.' * (_WIDTH - filled)}] {self.line}"
        self._write("\r" + text.ljust(self._width))
        self._width = len(text)

    @staticmethod
    def _write(text: str) -> None:
        sys.stderr.write(text)  # and not the log: while a job is replayed, that is the job's own
        sys.stderr.flush()

    def _wipe(self) -> None:
        if self._width:
            self._write("\r" + " " * self._width + "\r")
            self._width = 0
