"""Whether tests notice a mutant: for `mutation.py`."""

from __future__ import annotations

import ast
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import pytest
from mutants import Mutant
from mutants_accepted import accepted
from mutation_fork import begin, collected, in_fork, place, run_files, run_items
from mutation_map import CONTRACTS, Map, names, places, test_files, tests_near
from mutation_patch import Functions
from source_rules import broken

OVERHEAD = 0.01  # seconds that a test costs beside what was measured
UNKNOWN = 5.0  # seconds that a file of tests is taken for
_ENDED = "by the clock, or the process ended"
_ANEW, _CANNOT = "to be tried anew", 99
_READS = "test_structure.py"  # which reads the text, and runs no line
FAR = 5.0  # times as long a test of another folder is taken for: it is as likely to tell for that much less
FIRST = 4.0  # seconds of tests that are tried before files of more tests are read


class Verdict(NamedTuple):
    """What the tests said to a mutant."""

    mutant: Mutant
    said: (
        str  # killed, survived, accepted, unreached: no test executes the file, or too dear: all take longer
    )
    tests: int = 0
    seconds: float = 0.0
    by: str = ""  # the test that failed


_map = Map({}, {}, {})
_seconds = 0.0
_until = 0.0
_session: pytest.Session
_functions: Functions
_anew: Connection  # to a process that has not imported the package


def begin_judging(tree: Path, compiled: Path, known: Map, seconds: float, until: float) -> None:
    """Prepare a process: see `mutation_fork.begin`.

    Args:
        tree: the right one.
        compiled: folder of the programs that are compiled already.
        known: which test executes which line.
        seconds: of tests that a mutant is given, by what they took with the right code.
        until: reading of `time.monotonic` after which no mutant is begun.
    """
    global _map, _seconds, _until, _session, _functions, _anew
    begin(tree, compiled)
    _anew = _fork_that_imports_anew()
    _map, _seconds, _until = known, seconds, until
    _session = collected(test_files(place()))
    _functions = Functions(place() / "staf_torch")


def judge(mutant: Mutant) -> Verdict | None:
    """Try a mutant; None where there is no time left.

    A mutant inside a function is tried by tests that this process has read: its functions get the changed
    code; what tests made while they were read is of the right one. What happens at import is tried anew.
    """
    if accepted(mutant):
        return Verdict(mutant, "accepted")
    if time.monotonic() > _until:
        return None
    path = place() / mutant.file
    source = path.read_text(encoding="utf-8")
    changed = mutant.applied(source)
    if len(broken(changed)) > len(broken(source)):
        return Verdict(mutant, "killed", 1, 0.0, _READS)
    tests = _tests_for(mutant, source)
    if not tests:
        return Verdict(mutant, "unreached" if not _hits(mutant, source) else "too dear")
    begun = time.monotonic()
    path.write_text(changed, encoding="utf-8")
    chosen = Chosen(tests)
    try:
        said = _ANEW
        if not _around(mutant, source)[2]:
            said = _run(chosen, lambda: _functions.change(path, source, changed, mutant.line))
        if said == _ANEW:
            said = _run_anew(chosen)
    finally:
        path.write_text(source, encoding="utf-8")
    by = next(iter(chosen.read()), "")
    if said == "killed" and not by:
        by = _ENDED
        said = "too dear" if _run(chosen, lambda: True) == "killed" else said  # with the right code as well
    return Verdict(mutant, said, len(tests), time.monotonic() - begun, by)


def fail_anyway(tests: Sequence[str]) -> list[str]:
    """Those of some tests that fail in this process with the right code: they are no witnesses."""
    if not tests:
        return []
    chosen = Chosen(tests)
    _run(chosen, lambda: True, stop=False)
    return chosen.read()


def _run(chosen: Chosen, change: Callable[[], bool], *, stop: bool = True) -> str:
    """Try tests that are collected, where the change can be made in the child."""

    def tried() -> int:
        if not change():
            return _CANNOT
        return run_items(chosen.items(_session), chosen, stop=lambda: stop and chosen.failed)

    code = in_fork(tried, 30 + 3 * _cost(chosen.tests))
    return _ANEW if code == _CANNOT else "killed" if chosen.read() or code is None else "survived"


def _run_anew(chosen: Chosen) -> str:
    """Try tests in a process that imports the package: those that are short first.

    The rest only where that says nothing, since reading its files takes a while.
    """
    tests = chosen.tests
    first = max(1, sum(_cost(tests[: at + 1]) < FIRST for at in range(len(tests))))
    for group in (Chosen(tests[:first], chosen.said), Chosen(tests[first:], chosen.said)):
        if group.tests:
            _anew.send((group.tests, group.said, 30 + 3 * _cost(group.tests)))
            if _anew.recv() not in (0, 5):
                return "killed"
    return "survived"


def _fork_that_imports_anew() -> Connection:
    """Fork a process before this one imports the package: its children import what the tree holds then.

    It is sent tests, where to write what fails, and seconds, and sends back what `in_fork` returns.
    """
    ours, its = Pipe()
    if os.fork() != 0:
        its.close()
        return ours
    ours.close()
    try:
        while True:
            tests, said, limit = its.recv()
            chosen = Chosen(tests, said)
            its.send(in_fork(partial(run_files, chosen.files, chosen, stop=True), limit))
    finally:  # the other one has ended
        os._exit(0)


def _tests_for(mutant: Mutant, source: str) -> list[str]:
    """Those that execute the lines, the short ones first, within the time.

    Of what happens at import the contracts come first. A test of the mutant's own folder, or whose file
    imports the module, comes where another one that takes a part of its time would.
    """
    far = {
        test: 1.0 if names(test, mutant.file) or test.startswith((*places(mutant.file), CONTRACTS)) else FAR
        for test in _hits(mutant, source)
    }
    early = _around(mutant, source)[2]

    def rank(test: str) -> tuple[bool, float, bool, str]:
        looks = early and test.startswith(CONTRACTS)  # at what is made at import, quickly
        return not looks, far[test] * _cost([test]), not names(test, mutant.file), test

    order = sorted(far, key=rank)
    chosen: list[str] = []
    for test in order:
        if _cost([*chosen, test]) <= _seconds:
            chosen.append(test)
    return chosen


def _hits(mutant: Mutant, source: str) -> set[str]:
    return tests_near(_map, mutant.file, mutant.line, mutant.last_line, _around(mutant, source))


def _cost(tests: Sequence[str]) -> float:
    """Seconds of tests with the fixtures that they share."""
    shared = {each for test in tests for each in _map.fixtures.get(test, ())}
    own = sum(_map.seconds.get(test, UNKNOWN) for test in tests)
    return own + sum(_map.seconds[each] for each in shared) + OVERHEAD * len(tests)


def _file(test: str) -> str:
    return test.partition("::")[0]


def _around(mutant: Mutant, source: str) -> tuple[int, int, bool]:
    """First and last line of the innermost function, class or file around; whether it runs at import."""
    kinds = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
    inside: tuple[int, int, bool] = (1, 10**9, True)
    for each in ast.walk(ast.parse(source)):  # outer ones come first
        if isinstance(each, kinds) and each.lineno <= mutant.line <= (each.end_lineno or each.lineno):
            early = isinstance(each, ast.ClassDef) or mutant.line < each.body[0].lineno
            inside = each.lineno, each.end_lineno or each.lineno, early
    return inside


class Chosen:
    """The plugin of pytest that runs some tests in some order, and writes down which of them fail."""

    def __init__(self, tests: Sequence[str], said: Path | None = None) -> None:
        """Tests are named as pytest does, files before their tests; a file may be named for what is said."""
        self.tests = list(tests)
        self.rank = {test: at for at, test in enumerate(tests)}
        self.files = sorted({_file(test) for test in tests})
        self.said = place().parent / f"failed-{place().name}.txt" if said is None else said
        self.said.write_text("")
        self.failed = False

    def items(self, session: pytest.Session) -> list[pytest.Item]:
        """The chosen ones of those that are collected."""
        at = {
            id(item): self.rank.get(item.nodeid, self.rank.get(_file(item.nodeid))) for item in session.items
        }
        return sorted(
            (item for item in session.items if at[id(item)] is not None), key=lambda item: at[id(item)]
        )

    def pytest_collection_modifyitems(self, session: pytest.Session, items: list[pytest.Item]) -> None:
        """Keep the chosen ones."""
        session.items = items
        items[:] = self.items(session)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Write down a test that fails."""
        self._note(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Write down a file that cannot be read."""
        self._note(report)

    def _note(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        if report.failed:
            self.failed = True
            with self.said.open("a") as file:
                print(report.nodeid, file=file)

    def read(self) -> list[str]:
        """What has failed, in the parent."""
        return list(dict.fromkeys(self.said.read_text().splitlines()))
