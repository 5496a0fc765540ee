"""SLURM's controller, which may be busy, away for a while or gone for good."""

from __future__ import annotations

import concurrent.futures
import contextlib
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from tqdm.auto import tqdm

from ..signals import check

_log = logging.getLogger(__name__)
_ASK = 10.0  # s between two questions
_ANSWER = 20.0  # s that an answer may take: a busy controller needs some, and a signal ends the wait anyway
_SILENT, _AGAIN = 60.0, 300.0  # s without an answer until that is told, and until it is told again
_END = 4.0  # s that cancelling jobs, or a submission that a signal breaks off, may take
_LOOK = 0.5  # s between two looks at a submission
_MANY, _SHOWN = 1000, 20  # jobs that a command line takes, and that a message shows


class Controller:
    """The commands of SLURM that ask or tell the controller something, each in bounded time.

    Where there is no answer for about a minute, whoever watches the sweep is told so, and what to do.
    """

    def __init__(self) -> None:
        self._asked = -_ASK
        self._since: float | None = None  # when we first asked without an answer
        self._told: float | None = None  # when somebody was told so

    def states(self) -> dict[str, str] | None:
        """Ask how our jobs are, now and then: accounting is not needed for that.

        Returns:
            A state a job that the controller still knows; None where it was not asked or does not answer.
        """
        check()  # nobody else does as long as no job ends
        if time.monotonic() - self._asked < _ASK:
            return None
        began = time.monotonic()
        line = ["squeue", "--noheader", "--me", "--states=all", "--format=%i %T"]
        try:
            found = subprocess.run(line, capture_output=True, text=True, timeout=_ANSWER, check=True).stdout
        except (OSError, subprocess.SubprocessError) as error:
            self._silence(_words(error), began)
            return None
        finally:
            self._asked = time.monotonic()
        self._answer()
        return dict(line.split() for line in found.splitlines() if len(line.split()) == 2)

    def submit(self, begin: Callable[[], None]) -> None:
        """Call a function that runs `sbatch`, in a thread, so that a signal ends the wait for it at once.

        `sbatch` tries for a while where the controller is away, and `subprocess` waits for its end whatever
        comes. Where a signal breaks the wait off, the submission has some seconds to come through.

        Args:
            begin: submits a job, and keeps it where `cancel` will find it.

        Raises:
            Exception: what the function raises.
        """
        ended: concurrent.futures.Future[None] = concurrent.futures.Future()

        def run() -> None:
            try:
                begin()
            except BaseException as error:
                ended.set_exception(error)
            else:
                ended.set_result(None)

        thread = threading.Thread(target=run, daemon=True)
        began = time.monotonic()
        try:
            thread.start()
            while not concurrent.futures.wait([ended], _LOOK).done:
                self._silence("sbatch has not ended", began)
        except BaseException:
            if not concurrent.futures.wait([ended], _END).done:
                _end_children(thread)
                concurrent.futures.wait([ended], _LOOK)
            raise
        ended.result()
        self._answer()

    def cancel(self, jobs: Sequence[str]) -> None:
        """Take jobs back in bounded time, and say which ones SLURM did not confirm."""
        until = time.monotonic() + _END
        for first in range(0, len(jobs), _MANY):
            line = ["scancel", "--quiet", *jobs[first : first + _MANY]]
            try:
                left = max(0.0, until - time.monotonic())
                ended = subprocess.run(line, capture_output=True, text=True, timeout=left, check=False)
                why = ended.stderr.strip()
            except (OSError, subprocess.SubprocessError) as error:
                why = _words(error)
            if why:
                names = [*jobs[first : first + _SHOWN], *["..."] * (len(jobs) - first > _SHOWN)]
                _tell(
                    f"SLURM did not confirm that it cancels {len(jobs) - first} jobs ({_short(why)}). They "
                    "end by themselves where they see the sweep's directory. When SLURM answers again: "
                    f"scancel {' '.join(names)}"
                )
                return

    def _answer(self) -> None:
        if self._told is not None and self._since is not None:
            _tell(f"SLURM answers again, after {_minutes(time.monotonic() - self._since)}.")
        self._since = self._told = None

    def _silence(self, why: str, began: float) -> None:
        """Note that there is no answer; tell it when it has lasted, and now and then from there on.

        Args:
            why: what the command said instead.
            began: when it began.
        """
        now = time.monotonic()
        self._since = began if self._since is None else self._since
        if now - self._since < _SILENT or (self._told is not None and now - self._told < _AGAIN):
            return
        self._told = now
        _tell(
            f"SLURM has not answered for {_minutes(now - self._since)} ({_short(why)}). The sweep waits, and "
            "takes the results that its jobs still write. If SLURM does not come back, end the sweep "
            "(Ctrl-C) and resume it elsewhere: by the line that it then says, with "
            "hydra.launcher.executor=process"
        )


def _tell(line: str) -> None:
    """Write a line above the bar of a sweep: the log goes to files alone there."""
    _log.warning("%s", line)
    tqdm.write(f"staf: {line}", file=sys.stderr)


def _words(error: Exception) -> str:
    """What a command said, or why it said nothing."""
    if isinstance(error, subprocess.CalledProcessError) and str(error.stderr).strip():
        return str(error.stderr)
    if isinstance(error, subprocess.TimeoutExpired):
        return f"{error.cmd[0]} did not end in time"
    return str(error)


def _short(why: str) -> str:
    """The last line of what a command said, which is its reason, in at most 200 characters."""
    return (why.strip().splitlines() or ["no reason"])[-1][:200]


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} minutes"


def _end_children(thread: threading.Thread) -> None:
    """End the processes that a thread of ours has started, where the kernel tells which ones they are."""
    with contextlib.suppress(OSError):
        found = Path(f"/proc/self/task/{thread.native_id}/children").read_text(encoding="ascii")
        for pid in found.split():
            os.kill(int(pid), signal.SIGKILL)
