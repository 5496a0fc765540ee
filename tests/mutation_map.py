"""Which tests execute which line, in the processes that they start as well: for `mutation.py`.

Every file of tests runs once under coverage, in a fork of its own, with a context a test and one a shared
fixture: whoever uses a fixture counts as executing its lines. What a file of tests executes is kept under
the hash of its text, with the hashes of the package's files. For another version of the package lines are
matched with those of the map; only files of tests that changed are measured again.
"""

from __future__ import annotations

import bisect
import contextlib
import difflib
import hashlib
import json
import os
import re
import shutil
import sqlite3
import statistics
import subprocess
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import coverage
import pytest
from mutation_fork import in_fork, place, run_files

_SETTINGS = """
[run]
source = staf_torch
relative_files = true
parallel = true
data_file = {data}
context = ${{STAF_MUTATION_CONTEXT-}}
disable_warnings = no-data-collected,module-not-imported,module-not-measured,couldnt-parse
"""
_OUTSIDE = ("tests/outside/", "tests/cluster/", "tests/benchmarks/", "tests/examples/", "tests/test_wheel.py")
_OUTSIDE += ("tests/test_structure.py", "tests/test_sanitized.py")
"""These install and build things or read files, and execute no line here."""
CONTRACTS = "tests/test_contracts.py"  # of what is defined at import, which it looks at in every file
_LONGEST = 900.0  # seconds of the processor for one file of tests


class Map(NamedTuple):
    """What each test executes."""

    lines: Mapping[str, Mapping[int, set[str]]]  # file -> line -> tests
    seconds: Mapping[str, float]  # of the processor, for a test or a fixture that tests share
    fixtures: Mapping[str, Sequence[str]]  # that a test shares
    unmeasured: tuple[str, ...] = ()  # files of tests


# Measured


class Recorder:
    """The plugin of pytest that measures."""

    def __init__(self, folder: Path) -> None:
        """Write below a folder."""
        self.seen = folder / "seen.jsonl"
        self.seen.write_text("")
        self.settings = folder / "settings.ini"
        self.settings.write_text(_SETTINGS.format(data=folder / "data"))
        self.contexts: list[str] = [""]
        self.measuring: coverage.Coverage | None = None
        self.failed = False

    def pytest_sessionstart(self) -> None:
        """Start, in the process that runs the tests; those that it starts inherit what to do."""
        os.environ["COVERAGE_PROCESS_START"] = str(self.settings)
        self.measuring = coverage.Coverage(config_file=str(self.settings), context=None)
        self.measuring.start()
        self._switch()

    def _switch(self) -> None:
        os.environ["STAF_MUTATION_CONTEXT"] = self.contexts[-1]
        if self.measuring is not None:
            self.measuring.switch_context(self.contexts[-1])

    @contextlib.contextmanager
    def _counting_for(self, context: str) -> Iterator[None]:
        self.contexts.append(context)
        self._switch()
        try:
            yield
        finally:
            self.contexts.pop()
            self._switch()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """A test is a context; one that fails with the right code is no witness against a mutant."""
        shared = item._fixtureinfo.name2fixturedefs.values()  # type: ignore[attr-defined]
        names = [_name(each[-1]) for each in shared if each[-1].scope != "function"]
        begun, self.failed = _processor_seconds(), False
        with self._counting_for(item.nodeid):
            outcome = yield
        if not self.failed:
            with self.seen.open("a") as file:
                print(json.dumps([item.nodeid, names, _processor_seconds() - begun]), file=file)
        return outcome

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Notice a failure."""
        self.failed = self.failed or report.failed

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """A fixture that several tests share is a context of its own."""
        if fixturedef.scope == "function":
            return (yield)
        with self._counting_for(_name(fixturedef)):
            return (yield)

    def pytest_sessionfinish(self) -> None:
        """Write what was seen."""
        if self.measuring is not None:
            self.measuring.stop()
            self.measuring.save()


def _processor_seconds() -> float:
    """Of this process and those that it has waited for: no other program on the machine counts."""
    return sum(os.times()[:4])


def _name(fixture: Any) -> str:
    return f"fixture {fixture.baseid} {fixture.argname}"


def measure(test_file: str) -> tuple[str, dict[str, Any] | None]:
    """Run a file of tests once, in the copy of this process.

    Returns:
        The file, and for json: lines of every test and fixture, fixtures and seconds of every test, hashes
        of the package's files. None where the run was ended.
    """
    folder = Path(tempfile.mkdtemp(dir=place().parent, prefix="map-"))
    try:
        recorder = Recorder(folder)
        if in_fork(lambda: run_files([test_file], recorder, stop=False), _LONGEST) is None:
            return test_file, None
        found = _read(folder)
    finally:
        shutil.rmtree(folder)
    executed = {file for files in found["lines"].values() for file in files}
    there = [
        file for file in sorted(executed) if (place() / file).is_file()
    ]  # a test names one that never was
    found["package"] = {file: hash_of(place() / file) for file in there}
    return test_file, found


def _read(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = {"lines": {}, "tests": {}, "seconds": {}}
    for test, fixtures, spent in map(json.loads, (folder / "seen.jsonl").read_text().splitlines()):
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


# Kept


def test_files(tree: Path) -> list[str]:
    """Files of tests that can tell a mutant."""
    names = (str(path.relative_to(tree)) for path in sorted((tree / "tests").rglob("test_*.py")))
    return [name for name in names if not name.startswith(_OUTSIDE)]


def kept_at(store: Path, tree: Path, test_file: str) -> Path:
    """Where the map of a file of tests is kept, in the version that a tree has."""
    return store / f"{test_file.replace('/', '+')}@{hash_of(tree / test_file)[:16]}.json"


def hash_of(path: Path) -> str:
    """The name that git gives to the text of a file."""
    raw = path.read_bytes()
    return hashlib.sha1(b"blob %d\0" % len(raw) + raw).hexdigest()


def known(store: Path, tree: Path) -> Map:
    """The map of a tree, of what is kept for its files of tests."""
    lines: dict[str, dict[int, set[str]]] = defaultdict(lambda: defaultdict(set))
    seconds: dict[str, float] = {}
    fixtures: dict[str, list[str]] = {}
    unmeasured = []
    now = {str(path.relative_to(tree)): hash_of(path) for path in (tree / "staf_torch").rglob("*.py")}
    for test_file in test_files(tree):
        kept = kept_at(store, tree, test_file)
        if not kept.exists():
            unmeasured.append(test_file)
            continue
        found = json.loads(kept.read_text())
        places = {
            file: _matching(before, now[file]) for file, before in found["package"].items() if file in now
        }
        seconds |= _apart(found["tests"], found["seconds"])
        fixtures |= found["tests"]
        for context, users in _users(found["tests"]).items():
            for file, numbers in found["lines"].get(context, {}).items():
                for number in numbers if file in places else ():
                    if number in places[file]:
                        lines[file][places[file][number]].update(users)
    return Map(lines, seconds, fixtures, tuple(unmeasured))


def _apart(tests: Mapping[str, Sequence[str]], seconds: Mapping[str, float]) -> dict[str, float]:
    """Seconds of tests and of fixtures: what its first user takes beyond the others is a fixture's."""
    found = dict(seconds)
    for test, fixtures in tests.items():  # in the order that they ran
        new = set(fixtures) - set(found)
        others = [seconds[each] for each, used in tests.items() if each != test and new & set(used)]
        beyond = max(seconds[test] - statistics.median(others), 0.0) if others else 0.0
        found |= dict.fromkeys(new, beyond / max(len(new), 1))
        found[test] = seconds[test] - beyond
    return found


def _users(tests: Mapping[str, Iterable[str]]) -> dict[str, list[str]]:
    """Tests of every context: themselves, and what uses a fixture."""
    users: dict[str, list[str]] = defaultdict(list)
    for test, fixtures in tests.items():
        for context in (test, *fixtures):
            users[context].append(test)
    return users


@cache
def _matching(old: str, new: str) -> dict[int, int]:
    """Lines of one text, by its hash, in another; none of a text that git no longer has."""
    before = _text(old)
    if before is None or old == new:
        return {number: number for number in range(1, len(before or ()) + 1)}
    blocks = difflib.SequenceMatcher(None, before, _text(new) or [], autojunk=False).get_matching_blocks()
    return {one + at + 1: two + at + 1 for one, two, size in blocks for at in range(size)}


@cache
def _text(blob: str) -> list[str] | None:
    found = subprocess.run(
        ["git", "cat-file", "blob", blob],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    return found.stdout.splitlines() if found.returncode == 0 else None


# Asked


def tests_near(known: Map, file: str, first: int, last: int, around: tuple[int, int, bool]) -> set[str]:
    """Tests that execute some lines.

    Where that happens at import, or not at all: those of the function or class around, or else of the file,
    or else of the folder. Files of tests that were not measured count as a test each, if they are
    of the folder or import the module.

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
    near = (*places(file), *((CONTRACTS,) if around[2] else ()))
    whole = {test for test in known.unmeasured if test.startswith(near) or names(test, file)}
    if around[2]:
        whole |= {test for test in known.fixtures if test.startswith(CONTRACTS)}
    order = sorted(there)
    for begin, end in ((first, last), around[:2], (0, 10**9)):
        span = order[bisect.bisect_left(order, begin) : bisect.bisect_right(order, end)]
        hits = set().union(*(there[number] for number in span)) if span else set()
        if hits and not (around[2] and (begin, end) == (first, last)):
            return hits | whole
    return {test for test in known.fixtures if test.startswith(places(file))} | whole


def names(test: str, file: str) -> bool:
    """Whether the file of a test imports a module of the package, by its name."""
    return _imports(test.partition("::")[0], file)


@cache
def _imports(test_file: str, file: str) -> bool:
    room, *inner = Path(file).with_suffix("").parts[1:]
    if not inner:
        return False
    module = re.escape(inner[-1])
    dotted = re.escape(".".join((room, *inner[:-1])))
    text = (place() / test_file).read_text(encoding="utf-8")
    return re.search(rf"staf_torch\.{dotted}(\.{module}\b| import .*\b{module}\b)", text) is not None


def places(file: str) -> tuple[str, ...]:
    """Where the tests of a file's own folder are."""
    room = file.split("/")[1].removesuffix(".py")
    return f"tests/{room}/", f"tests/test_{room}"
