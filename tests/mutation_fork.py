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
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from _pytest.config import _prepareconfig

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


def collected(files: Sequence[str]) -> pytest.Session:
    """Read files of tests in this process, which runs none of them: its children do, in `run_items`."""
    _enter()
    line = ["-q", "-p", "no:cacheprovider", "--assert=plain", "--tb=no", *files]
    config = _prepareconfig(line, [])
    config._do_configure()
    session = pytest.Session.from_config(config)
    config.hook.pytest_sessionstart(session=session)
    config.hook.pytest_collection(session=session)
    return session


def run_items(items: Sequence[pytest.Item], plugin: object, *, stop: Callable[[], bool]) -> int:
    """Run tests that were collected, one after another, until one says that it is enough; 0."""
    for item, following in zip(items, [*items[1:], None], strict=True):
        if not item.config.pluginmanager.is_registered(plugin):
            item.config.pluginmanager.register(plugin)
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if stop():
            break
    return 0


def in_fork(run: Callable[[], int], limit: float) -> int | None:
    """Run a function in a child.

    Args:
        run: returns a code below 256; what else it finds out, it must write where the parent reads.
        limit: seconds of the processor.

    Returns:
        The code, or None where the child was ended or ended itself.
    """
    heard, told = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            _begin_child(int(limit))
            os.write(told, bytes([run()]))
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


def run_files(files: Sequence[str], plugin: object, *, stop: bool) -> int:
    """Run files of tests, read anew; the exit code of pytest.

    Args:
        files: paths in the tree.
        plugin: of pytest.
        stop: at the first failure.
    """
    line = ["-q", "-p", "no:cacheprovider", "--assert=plain", "--tb=no", *(["-x"] if stop else []), *files]
    return int(pytest.main(line, plugins=[plugin]))


def _begin_child(limit: int) -> None:
    os.setsid()
    multiprocessing.current_process().daemon = False  # a worker of a pool may start no processes, tests may
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores these in the background
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))
    _enter()


def _enter() -> None:
    """Be silent, and take the package from the copy of this process."""
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    os.chdir(_place)
    if sys.path[0] != str(_place):
        sys.path[:0] = [str(_place)]
