"""One mutant in a fork of a process that has torch: for `mutation.py`."""

from __future__ import annotations

import ast
import contextlib
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pytest
from mutants import Mutant
from mutants_accepted import ACCEPTED
from mutation_map import Map, places, tests_near

OVERHEAD = 0.1  # seconds that a test costs beside what was measured
PATIENCE = 10  # seconds by the clock for one of the processor, on a machine that is shared


class Verdict(NamedTuple):
    """What the tests said to a mutant."""

    mutant: Mutant
    said: str  # killed, survived, accepted, or unreached: no test executes the file
    tests: int = 0
    seconds: float = 0.0
    by: str = ""  # the test that failed


_place = Path()
_map = Map({}, {})
_seconds = 0.0
_until = 0.0


def begin(tree: Path, known: Map, compiled: Path, seconds: float, until: float) -> None:
    """Make a copy of a tree, which this process alone changes.

    Args:
        tree: the right one.
        known: which test executes which line.
        compiled: folder of the programs that are compiled already; what a mutant compiles goes elsewhere.
        seconds: of tests that a mutant is given, by what they took with the right code.
        until: reading of `time.monotonic` after which no mutant is begun.
    """
    global _place, _map, _seconds, _until
    _place, _map, _seconds, _until = tree.parent / f"tree-{os.getpid()}", known, seconds, until
    shutil.copytree(tree, _place, ignore=shutil.ignore_patterns(".assets"))
    programs = tree.parent / f"cache-{os.getpid()}"
    (programs / "staf_torch").mkdir(parents=True)
    for library in compiled.glob("*.so"):
        shutil.copy2(library, programs / "staf_torch")
    os.environ |= {"PYTHONPATH": str(_place), "XDG_CACHE_HOME": str(programs)}
    os.environ |= {"OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}


def judge(mutant: Mutant) -> Verdict | None:
    """Try a mutant; None where there is no time left."""
    if mutant.key in ACCEPTED:
        return Verdict(mutant, "accepted")
    if time.monotonic() > _until:
        return None
    path = _place / mutant.file
    source = path.read_text(encoding="utf-8")
    tests = _tests_for(mutant, source)
    if not tests:
        return Verdict(mutant, "unreached")
    begun = time.monotonic()
    path.write_text(mutant.applied(source), encoding="utf-8")
    try:
        said, by = _run_in_fork(tests, 60 + 5 * sum(_map.seconds.get(test, 0.0) for test in tests))
    finally:
        path.write_text(source, encoding="utf-8")
    return Verdict(mutant, said, len(tests), time.monotonic() - begun, by)


def _tests_for(mutant: Mutant, source: str) -> list[str]:
    """Those that execute the lines, the folder's own first and the short ones first, within the time."""
    hits = tests_near(_map, mutant.file, mutant.line, mutant.last_line, _around(mutant, source))
    near = {test: 0 if test.startswith(places(mutant.file)) else 1 for test in hits}
    chosen: list[str] = []
    total = 0.0
    for test in sorted(hits, key=lambda test: (near[test], _map.seconds.get(test, 0.0), test)):
        total += _map.seconds.get(test, 0.0) + OVERHEAD
        if chosen and total > _seconds:
            break
        chosen.append(test)
    return chosen


def _around(mutant: Mutant, source: str) -> tuple[int, int, bool]:
    """First and last line of the innermost function, class or file around; whether it runs at import."""
    kinds = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
    inside: tuple[int, int, bool] = (1, 10**9, True)
    for each in ast.walk(ast.parse(source)):  # outer ones come first
        if isinstance(each, kinds) and each.lineno <= mutant.line <= (each.end_lineno or each.lineno):
            early = isinstance(each, ast.ClassDef) or mutant.line < each.body[0].lineno
            inside = each.lineno, each.end_lineno or each.lineno, early
    return inside


class _Chosen:
    """The plugin of pytest that runs some tests in some order, and notes the first that fails."""

    def __init__(self, tests: Sequence[str]) -> None:
        self.rank = {test: at for at, test in enumerate(tests)}
        self.failed = ""

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if item.nodeid in self.rank]
        items.sort(key=lambda item: self.rank[item.nodeid])

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.failed = self.failed or (report.nodeid if report.failed else "")

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        self.failed = self.failed or (report.nodeid if report.failed else "")


def _run_in_fork(tests: Sequence[str], limit: float) -> tuple[str, str]:
    """Run tests in a child for so many seconds of the processor; what they said, and the one that failed."""
    heard, told = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.write(told, _tested(tests, int(limit)).encode())
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
    _end_group(child)
    words = os.read(heard, 4096).decode().split(" ", 1)
    os.close(heard)
    if words == [""]:
        return "killed", "by the clock, or the process ended"
    return ("survived" if words[0] in ("0", "5") else "killed"), words[1]


def _tested(tests: Sequence[str], limit: int) -> str:
    os.setsid()
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    os.chdir(_place)
    sys.path[:0] = [str(_place)]
    chosen = _Chosen(tests)
    files = sorted({test.partition("::")[0] for test in tests})
    line = ["-x", "-q", "-p", "no:cacheprovider", "--tb=no", *files]
    return f"{int(pytest.main(line, plugins=[chosen]))} {chosen.failed}"


def _end_group(child: int) -> None:
    """End the processes that the tests started and left."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
