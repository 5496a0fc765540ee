"""Tests of a tree in a fork of a process that has torch: for `mutation_map.py` and `mutation_judge.py`."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

PATIENCE = 10  # seconds by the clock for one of the processor, on a machine that is shared

_place = Path()


def begin(tree: Path, compiled: Path) -> None:
    """Make a copy of a tree, which this process alone changes.

    Args:
        tree: the right one.
        compiled: folder of the programs that are compiled already; what a mutant compiles goes elsewhere.
    """
    global _place
    _place = tree.parent / f"tree-{os.getpid()}"
    shutil.copytree(tree, _place, ignore=shutil.ignore_patterns(".assets"))
    programs = tree.parent / f"cache-{os.getpid()}"
    (programs / "staf_torch").mkdir(parents=True)
    for library in compiled.glob("*.so"):
        shutil.copy2(library, programs / "staf_torch")
    os.environ |= {"PYTHONPATH": str(_place), "XDG_CACHE_HOME": str(programs)}
    os.environ |= {"OMP_NUM_THREADS": "1", "MPLBACKEND": "agg", "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}


def place() -> Path:
    """The copy of this process."""
    return _place


def in_fork(files: Sequence[str], plugin: object, limit: float, *, stop: bool) -> int | None:
    """Run files of tests in a child.

    Args:
        files: paths in the tree.
        plugin: of pytest; what it finds out, it must write where the parent reads.
        limit: seconds of the processor.
        stop: at the first failure.

    Returns:
        The exit code of pytest, or None where the child was ended or ended itself.
    """
    heard, told = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.write(told, bytes([_tested(files, plugin, int(limit), stop=stop)]))
        finally:
            os._exit(0)
    os.close(told)
    end = time.monotonic() + PATIENCE * limit
    while os.waitpid(child, os.WNOHANG)[0] == 0:
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            break
        time.sleep(0.02)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what the tests started and left
    code = os.read(heard, 1)
    os.close(heard)
    return code[0] if code else None


def _tested(files: Sequence[str], plugin: object, limit: int, *, stop: bool) -> int:
    os.setsid()
    multiprocessing.current_process().daemon = False  # a worker of a pool may start no processes, tests may
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores these in the background
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    os.chdir(_place)
    sys.path[:0] = [str(_place)]
    line = ["-q", "-p", "no:cacheprovider", "--assert=plain", "--tb=no", *(["-x"] if stop else []), *files]
    return int(pytest.main(line, plugins=[plugin]))
