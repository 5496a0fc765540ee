"""Prints what commands say, also to a reader that stops early."""

from __future__ import annotations

import os
import sys


def printed(text: str) -> int:
    """Write a text to stdout and return the exit code 0, also to a reader with enough (`| head -1`)."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:  # what is left to write at the end of the process goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0
