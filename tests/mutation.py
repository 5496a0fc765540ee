"""Change one operator, number or statement of the package at a time, and see whether a test notices.

    python tests/mutation.py [--sample 100] [--seed 0] [--package kernels optim]

A mutant runs the tests that execute its line, those of the same folder first, until one fails. Which tests
execute which line is measured once for every commit, by coverage contexts, and kept in the user's cache. The
committed tree counts, not the working one. Mutants in `mutants_accepted.py` change nothing that can be seen.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from mutants import Mutant, mutants_of
from mutants_accepted import ACCEPTED

ROOT = Path(__file__).resolve().parent.parent
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "staf_torch-mutation"
OUTSIDE = ("tests/outside", "tests/test_notebooks.py", "tests/test_wheel.py", "tests/test_structure.py")
"""These run processes or read files: they execute no line here, and are not asked."""
SECONDS = 45.0  # of tests that a mutant is given, by what they took with the right code
TESTS = 120  # at most


class Map(NamedTuple):
    """Which tests execute which lines."""

    lines: dict[str, dict[int, set[str]]]  # file -> line -> tests
    seconds: dict[str, float]  # of a test


class Verdict(NamedTuple):
    """What the tests said to a mutant."""

    mutant: Mutant
    said: str  # killed, survived, accepted, or unreached: no test executes the line
    tests: int = 0
    seconds: float = 0.0
    by: str = ""  # the test that failed


def main() -> int:
    """Run the command line; the exit code is 1 where a mutant that is not accepted survives."""
    options = _options()
    commit = _git("rev-parse", options.commit).strip()
    with tempfile.TemporaryDirectory(prefix="staf-mutation-") as scratch:
        tree = Path(scratch) / "tree"
        _export(commit, tree)
        found = list(_all_mutants(tree, options.package, options.file))
        chosen = random.Random(options.seed).sample(found, min(options.sample, len(found)))
        known = _map(commit, tree, options.tests)
        print(f"{len(found)} mutants, {len(chosen)} of them by seed {options.seed}", flush=True)
        verdicts = []
        with ThreadPoolExecutor(options.jobs) as pool:
            for verdict in pool.map(lambda one: _judge(one, tree, known), chosen):
                verdicts.append(verdict)
                _tell(verdict)
    return _report(verdicts)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sample", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--package", nargs="*", default=[], help="rooms of staf_torch; all by default")
    parser.add_argument("--file", nargs="*", default=[], help="files, staf_torch/...; all by default")
    parser.add_argument("--commit", default="HEAD")
    parser.add_argument("--tests", nargs="*", default=["tests"], help="that are asked; all by default")
    parser.add_argument("--jobs", type=int, default=1)
    return parser.parse_args()


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout


def _export(commit: str, tree: Path) -> None:
    tree.mkdir()
    archive = subprocess.Popen(["git", "archive", commit], cwd=ROOT, stdout=subprocess.PIPE)
    subprocess.run(["tar", "-x", "-C", str(tree)], stdin=archive.stdout, check=True)
    if archive.wait() != 0:
        raise SystemExit(f"git archive {commit} failed")


def _all_mutants(tree: Path, packages: Iterable[str], files: Iterable[str]) -> Iterator[Mutant]:
    for path in sorted((tree / "staf_torch").rglob("*.py")):
        name = str(path.relative_to(tree))
        if (packages and name.split("/")[1] not in packages) or (files and name not in files):
            continue
        yield from mutants_of(name, path.read_text(encoding="utf-8"))


# Which tests execute a line


def _map(commit: str, tree: Path, tests: Sequence[str]) -> Map:
    key = hashlib.sha256(" ".join(sorted(tests)).encode()).hexdigest()[:8]
    data, times = CACHE / f"{commit}-{key}.coverage", CACHE / f"{commit}-{key}.json"
    if not times.exists():
        print("measuring which test executes which line; this runs the suite once", flush=True)
        CACHE.mkdir(parents=True, exist_ok=True)
        _measure(tree, tests, data, times)
    seconds = {name: float(spent) for name, spent in json.loads(times.read_text()).items()}
    lines: dict[str, dict[int, set[str]]] = defaultdict(lambda: defaultdict(set))
    with contextlib.closing(sqlite3.connect(data)) as base:
        rows = base.execute(
            "select path, context, numbits from line_bits join file on file.id = file_id "
            "join context on context.id = context_id"
        )
        for path, context, bits in rows:
            name, test = path[path.index("staf_torch/") :], context.partition("|")[0]
            if test:
                for number in _numbers(bits):
                    lines[name][number].add(test)
    return Map(lines, seconds)


def _numbers(bits: bytes) -> Iterator[int]:
    """Lines in coverage's format: a bit a line, eight to a byte."""
    for index, byte in enumerate(bits):
        for bit in range(8):
            if byte >> bit & 1:
                yield 8 * index + bit


def _measure(tree: Path, tests: Sequence[str], data: Path, times: Path) -> None:
    settings = tree / "mutation.coveragerc"
    settings.write_text(f"[run]\nsource = staf_torch\nrelative_files = true\ndata_file = {data}.part\n")
    shown = tree / "durations.txt"
    line = [
        *(
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "--cov=staf_torch",
            "--cov-report=",
        ),
        *(f"--cov-config={settings}", "--cov-context=test", "--durations=0", "--durations-min=0.001"),
        *("-n", "2", "--dist", "worksteal", *(f"--ignore={place}" for place in OUTSIDE), *tests),
    ]
    with shown.open("w") as file:
        ended = subprocess.run(line, cwd=tree, env=_environment(tree), stdout=file, check=False)
    text = shown.read_text()
    if ended.returncode not in (0, 1):
        raise SystemExit(text[-3000:])
    print(text.splitlines()[-1], flush=True)
    spent: Counter[str] = Counter()
    for number, test in re.findall(r"^([\d.]+)s (?:call|setup) +(.+)$", text, re.MULTILINE):
        spent[test] += float(number)
    os.replace(f"{data}.part", data)
    times.write_text(json.dumps(spent))


def _environment(tree: Path) -> dict[str, str]:
    return {
        **os.environ,
        "PYTHONPATH": str(tree),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OMP_NUM_THREADS": "1",
    }


# One mutant


def _tests_for(mutant: Mutant, known: Map) -> list[str]:
    """Those that execute the lines, the folder's own first and the short ones first, within the time."""
    hits: set[str] = set()
    for number in range(mutant.line, mutant.last_line + 1):
        hits |= known.lines[mutant.file].get(number, set())
    room = mutant.file.split("/")[1].removesuffix(".py")
    near = {test: 0 if test.startswith((f"tests/{room}/", f"tests/test_{room}")) else 1 for test in hits}
    chosen, total = [], 0.0
    for test in sorted(hits, key=lambda test: (near[test], known.seconds.get(test, 0.0), test)):
        total += known.seconds.get(test, 0.0)
        if chosen and (total > SECONDS or len(chosen) == TESTS):
            break
        chosen.append(test)
    return chosen


def _judge(mutant: Mutant, tree: Path, known: Map) -> Verdict:
    if mutant.key in ACCEPTED:
        return Verdict(mutant, "accepted")
    tests = _tests_for(mutant, known)
    if not tests:
        return Verdict(mutant, "unreached")
    begun = time.monotonic()
    limit = 60 + 6 * sum(known.seconds.get(test, 0.0) for test in tests)
    with tempfile.TemporaryDirectory(prefix="staf-mutant-") as folder:
        copy = Path(folder) / "tree"
        shutil.copytree(tree, copy, ignore=shutil.ignore_patterns(".assets", "__pycache__"))
        changed = mutant.applied((tree / mutant.file).read_text(encoding="utf-8"))
        (copy / mutant.file).write_text(changed, encoding="utf-8")
        line = [*(sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--tb=no"), *tests]
        running = subprocess.Popen(
            line,
            cwd=copy,
            env=_environment(copy),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        try:
            said, _ = running.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            os.killpg(running.pid, signal.SIGKILL)
            running.communicate()
            return Verdict(mutant, "killed", len(tests), time.monotonic() - begun, "by the clock")
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", said, re.MULTILINE)
    outcome = "survived" if running.returncode == 0 else "killed"
    return Verdict(mutant, outcome, len(tests), time.monotonic() - begun, failed[1] if failed else "")


# What is said of it


def _tell(verdict: Verdict) -> None:
    by = f" ({verdict.by})" if verdict.by else ""
    where = f"{verdict.mutant.file}:{verdict.mutant.line}"
    print(
        f"{verdict.said:9} {where}: {verdict.mutant.was!r} -> {verdict.mutant.now!r}"
        f"  [{verdict.tests} tests, {verdict.seconds:.0f} s]{by}",
        flush=True,
    )


def _report(verdicts: list[Verdict]) -> int:
    rooms: dict[str, Counter[str]] = defaultdict(Counter)
    for verdict in verdicts:
        rooms[verdict.mutant.file.split("/")[1]][verdict.said] += 1
        rooms["all"][verdict.said] += 1
    print(f"\n{'room':16} {'killed':>7} {'survived':>9} {'unreached':>10} {'accepted':>9} {'score':>6}")
    for room, count in sorted(rooms.items(), key=lambda item: (item[0] == "all", item[0])):
        counted = count["killed"] + count["survived"] + count["unreached"]
        score = f"{100 * count['killed'] / counted:.0f} %" if counted else "-"
        row = f"{count['killed']:7} {count['survived']:9} {count['unreached']:10} {count['accepted']:9}"
        print(f"{room:16} {row} {score:>6}")
    return int(rooms["all"]["survived"] + rooms["all"]["unreached"] > 0)


if __name__ == "__main__":
    sys.exit(main())
