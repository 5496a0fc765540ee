"""Which tests execute which line, in the processes that they start as well: for `mutation.py`.

The suite runs once under coverage, with a context a test and one a shared fixture: whoever uses a fixture
counts as executing its lines. A map is kept with its commit. For a later commit lines are matched with those
of the map, and only test files that changed are measured again.
"""

from __future__ import annotations

import bisect
import contextlib
import difflib
import json
import os
import sqlite3
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

_SETTINGS = """
[run]
source = staf_torch
relative_files = true
parallel = true
data_file = {data}
context = ${{STAF_MUTATION_CONTEXT-}}
disable_warnings = no-data-collected,module-not-imported,module-not-measured,couldnt-parse
"""
_OUTSIDE = ("tests/outside", "tests/cluster", "tests/test_wheel.py", "tests/test_structure.py")
"""These install things or read files, and execute no line here."""


class Map(NamedTuple):
    """What each test executes."""

    lines: dict[str, dict[int, set[str]]]  # file -> line -> tests
    seconds: dict[str, float]  # of the processor, for a test and the fixtures that were made for it


class Recorder:
    """The plugin of pytest that measures."""

    def __init__(self, folder: Path) -> None:
        """Write below a folder, under names of this process, test after test."""
        self.seen = folder / f"seen-{os.getpid()}.jsonl"
        self.places: list[str] = [""]
        import coverage

        self.measuring = coverage.Coverage(config_file=str(folder / "settings.ini"), context=None)
        self.measuring.start()

    def enter(self, context: str) -> None:
        """Count lines for a context, until `leave`."""
        self.places.append(context)
        self._switch()

    def leave(self) -> None:
        """Count lines for the context before."""
        self.places.pop()
        self._switch()

    def _switch(self) -> None:
        os.environ["STAF_MUTATION_CONTEXT"] = self.places[-1]  # processes that start inherit it
        self.measuring.switch_context(self.places[-1])

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """A test is a context."""
        shared = item._fixtureinfo.name2fixturedefs.values()  # type: ignore[attr-defined]
        names = [_name(each[-1]) for each in shared if each[-1].scope != "function"]
        begun = _processor_seconds()
        self.enter(item.nodeid)
        try:
            return (yield)
        finally:
            self.leave()
            with self.seen.open("a") as file:
                print(json.dumps([item.nodeid, names, _processor_seconds() - begun]), file=file)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """A fixture that several tests share is a context of its own."""
        if fixturedef.scope == "function":
            return (yield)
        self.enter(_name(fixturedef))
        try:
            return (yield)
        finally:
            self.leave()

    def pytest_sessionfinish(self) -> None:
        """Write what was seen."""
        self.measuring.stop()
        self.measuring.save()


def pytest_configure(config: pytest.Config) -> None:
    """Where this is named as a plugin: measure, but not in the process that only hands tests out."""
    if hasattr(config, "workerinput") or not config.getoption("numprocesses", None):
        config.pluginmanager.register(Recorder(Path(os.environ["STAF_MUTATION_FOLDER"])))


def _processor_seconds() -> float:
    """Of this process and those that it has waited for: no other program on the machine counts."""
    return sum(os.times()[:4])


def _name(fixture: Any) -> str:
    return f"fixture {fixture.baseid} {fixture.argname}"


def measure(tree: Path, tests: Iterable[str], folder: Path, jobs: int) -> dict[str, Any]:
    """Run tests of a tree once.

    Returns:
        Lines of every test and fixture, the fixtures of every test, and the seconds that it took, for json.
    """
    (folder / "settings.ini").write_text(_SETTINGS.format(data=folder / "data"))
    line = [
        *(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "mutation_map", "--tb=no")
    ]
    line += [*(f"--ignore={place}" for place in _OUTSIDE), *tests]
    line += ["-n", str(jobs), "--dist", "worksteal"] if jobs > 1 else []
    settings = {
        "PYTHONPATH": os.pathsep.join((str(tree), str(Path(__file__).parent))),
        "COVERAGE_PROCESS_START": str(folder / "settings.ini"),
        "STAF_MUTATION_FOLDER": str(folder),
        "STAF_MUTATION_CONTEXT": "",
    }
    with (folder / "said.txt").open("w") as said:
        ended = subprocess.run(
            line, cwd=tree, env={**os.environ, **settings}, stdout=said, stderr=said, check=False
        )
    text = (folder / "said.txt").read_text()
    print("\n".join(text.strip().splitlines()[-6:]), flush=True)
    if ended.returncode not in (0, 1):
        raise SystemExit(f"the tests did not run: exit code {ended.returncode}")
    return read(folder)


def read(folder: Path) -> dict[str, Any]:
    """What tests have written so far, also where they were ended in between; see `measure`."""
    found: dict[str, Any] = {"lines": {}, "tests": {}, "seconds": {}}
    for path in folder.glob("seen-*.jsonl"):
        for test, fixtures, spent in map(json.loads, path.read_text().splitlines()):
            found["tests"][test], found["seconds"][test] = fixtures, spent
    lines: dict[str, dict[str, set[int]]] = defaultdict(lambda: defaultdict(set))
    for path in folder.glob("data.*"):
        for file, context, numbers in _rows(path):
            lines[context][file].update(numbers)
    found["lines"] = {
        context: {file: sorted(numbers) for file, numbers in files.items()}
        for context, files in lines.items()
    }
    return found


def _rows(data: Path) -> Iterator[tuple[str, str, list[int]]]:
    """File, context and lines of one database of coverage: a bit a line, eight to a byte."""
    question = (
        "select path, context, numbits from line_bits join file on file.id = file_id "
        "join context on context.id = context_id"
    )
    with contextlib.closing(sqlite3.connect(data)) as base, contextlib.suppress(sqlite3.DatabaseError):
        for path, context, bits in base.execute(question):
            name = context.strip("|")
            if name and "staf_torch/" in path:
                numbers = [
                    8 * at + bit for at, byte in enumerate(bits) for bit in range(8) if byte >> bit & 1
                ]
                yield path[path.rindex("staf_torch/") :], name, numbers


def moved(found: dict[str, Any], old: dict[str, str], new: dict[str, str]) -> dict[str, Any]:
    """Match the lines of a map with those of another version.

    Args:
        found: what `measure` returned.
        old: the text of every file that it was measured with.
        new: that of every file now.
    """
    places = {file: _matching(old.get(file, ""), text) for file, text in new.items()}
    lines = {}
    for context, files in found["lines"].items():
        lines[context] = {
            file: [places[file][number] for number in numbers if number in places[file]]
            for file, numbers in files.items()
            if file in places
        }
    return {**found, "lines": lines}


def _matching(old: str, new: str) -> dict[int, int]:
    before, after = old.splitlines(), new.splitlines()
    if before == after:
        return {number: number for number in range(1, len(before) + 1)}
    blocks = difflib.SequenceMatcher(None, before, after, autojunk=False).get_matching_blocks()
    return {one + at + 1: two + at + 1 for one, two, size in blocks for at in range(size)}


def as_map(found: dict[str, Any]) -> Map:
    """Give every test the lines of the fixtures that it shares."""
    users: dict[str, list[str]] = defaultdict(list)
    for test, fixtures in found["tests"].items():
        users[test].append(test)
        for fixture in fixtures:
            users[fixture].append(test)
    lines: dict[str, dict[int, set[str]]] = defaultdict(lambda: defaultdict(set))
    for context, files in found["lines"].items():
        for file, numbers in files.items():
            for number in numbers:
                lines[file][number].update(users.get(context, ()))
    return Map(lines, found["seconds"])


def tests_near(known: Map, file: str, first: int, last: int, around: tuple[int, int, bool]) -> set[str]:
    """Tests that execute some lines.

    Where that happens at import, or not at all: those of the function or class around, or else of the file,
    or else of the folder.

    Args:
        known: the map.
        file: whose lines are meant.
        first: one of them.
        last: one of them.
        around: first and last line of the function, class or file around; whether the lines run at import.

    Returns:
        The tests; none where the folder has none.
    """
    there = known.lines.get(file, {})
    order = sorted(there)
    for begin, end in ((first, last), around[:2], (0, 10**9)):
        span = order[bisect.bisect_left(order, begin) : bisect.bisect_right(order, end)]
        hits = set().union(*(there[number] for number in span)) if span else set()
        if hits and not (around[2] and (begin, end) == (first, last)):
            return hits
    return {test for test in known.seconds if test.startswith(places(file))}


def places(file: str) -> tuple[str, ...]:
    """Where the tests of a file's own folder are."""
    room = file.split("/")[1].removesuffix(".py")
    return f"tests/{room}/", f"tests/test_{room}"
