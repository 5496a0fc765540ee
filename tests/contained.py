"""Run a command for some time and leave no process behind: `python tests/contained.py SECONDS COMMAND ...`.

Daemons that the command starts leave its session and outlive it. Here they become children of this process
as soon as they are orphans, so that all of them are found and ended: when the command ends, when its time is
over, or when this process is told to end.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import FrameType

_SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER of Linux's prctl
_GRACE = 20.0  # s that the command has to tidy up by itself


class ToldToEndError(Exception):
    """A signal asked this process to end."""


def end_all() -> int:
    """Kill every child until there is none, as the children of those become ours; return how many."""
    ours, killed = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children"), set[int]()
    while left := [int(pid) for pid in ours.read_text().split()]:
        killed.update(left)
        for pid in left:
            with contextlib.suppress(ProcessLookupError, ChildProcessError):
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
    return len(killed)


def stop(number: int, frame: FrameType | None) -> None:
    raise ToldToEndError


def main(seconds: float, command: list[str]) -> int:
    """Return the exit code of the command, 124 where it was ended."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SUBREAPER, 1, 0, 0, 0)
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, stop)
    process = subprocess.Popen(command)
    code = 124
    try:
        code = process.wait(seconds)
    except (subprocess.TimeoutExpired, ToldToEndError):
        process.send_signal(signal.SIGINT)  # at which pytest leaves its fixtures
        with contextlib.suppress(subprocess.TimeoutExpired, ToldToEndError):
            process.wait(_GRACE)
    finally:
        left = end_all()
    if left:
        print(f"{left} processes that {command[0]} left behind were ended", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]), sys.argv[2:]))
