"""Change one operator, number or statement of the package at a time, and see whether a test notices.

    python tests/mutation.py [--sample 100] [--seed 1] [--jobs 2] [--seconds 60] [--room kernels optim]

Coverage measures once which test executes which line (a run of the suite; `--remap` measures again). A
mutant runs the tests that execute its line, short ones first, in a process and a copy of the tree of its
own, until one fails or there is no time for more. Those that survive are printed. It is a lamp and no
score: many changes do no harm.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import contextlib
import copy
import itertools
import json
import os
import py_compile
import queue
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import coverage
import pytest

ROOT = Path(__file__).resolve().parent.parent
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "staf_torch-mutation"
MEASURED, SECONDS = CACHE / "coverage", CACHE / "seconds.json"
SETTINGS = "[run]\nsource = staf_torch\nrelative_files = true\ncore = ctrace\n"
PAIRS = "Lt LtE, Gt GtE, Eq NotEq, Is IsNot, In NotIn, Add Sub, Mult Div, BitAnd BitOr, And Or"
OPERATORS = {a: b for pair in PAIRS.split(", ") for a, b in (pair.split(), pair.split()[::-1])}
OPERATORS |= dict.fromkeys(("FloorDiv", "Mod", "Pow"), "Mult")
SAYS = ("warn", "info", "debug", "warning", "error")  # calls that only say something
SOONEST = 0.3  # share of a mutant's time that its tests take without it: what takes all of it hangs


# --- what is changed ----------------------------------------------------------------------------------------


class Mutant(NamedTuple):
    """One change of a file."""

    file: str
    line: int
    last: int
    begin: int  # in bytes
    end: int
    was: str
    now: str

    def applied(self, source: str) -> str:
        """The changed file."""
        raw = source.encode()
        return (raw[: self.begin] + self.now.encode() + raw[self.end :]).decode()

    def __str__(self) -> str:
        short = (" ".join(each.split())[:70] for each in (self.was, self.now))
        return f"{self.file}:{self.line}: {' -> '.join(short)}"


def mutants_of(file: str, source: str) -> Iterator[Mutant]:
    """Every mutant of a file."""
    tree, raw, starts = ast.parse(source), source.encode(), [0]
    for line in raw.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    skipped = {id(inner) for part in idle(tree) for inner in ast.walk(part)}
    for node in ast.walk(tree):
        for place, now in () if id(node) in skipped else changes(node):
            begin = starts[place.lineno - 1] + place.col_offset
            end = starts[(place.end_lineno or 0) - 1] + (place.end_col_offset or 0)
            was = raw[begin:end].decode()
            if now != was:
                yield Mutant(file, place.lineno, place.end_lineno or place.lineno, begin, end, was, now)


def idle(tree: ast.AST) -> Iterator[ast.AST]:
    """Parts that decide nothing when the program runs: annotations, texts of errors, what is logged."""
    for node in ast.walk(tree):
        parts: Sequence[ast.AST | None] = ()
        called = ast.unparse(node.func).rpartition(".")[2] if isinstance(node, ast.Call) else ""
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            parts = [node.returns, *node.decorator_list]
        elif isinstance(node, ast.arg | ast.AnnAssign):
            parts = [node.annotation]
        elif isinstance(node, ast.Raise):
            parts = [node.exc, node.cause]
        elif isinstance(node, ast.JoinedStr | ast.Assert) or called in (*SAYS, "cast", "TypeVar"):
            parts = [node]
        yield from filter(None, parts)


def exchanged(operator: ast.AST) -> Any:
    """The operator in the place of another one; None for the few that stay."""
    name = OPERATORS.get(type(operator).__name__)
    return name and getattr(ast, name)()


def changes(node: ast.AST) -> Iterator[tuple[ast.expr | ast.stmt, str]]:
    """Places of a node, and what stands there in a mutant."""
    other = copy.deepcopy(node)
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        other.ops = [exchanged(node.ops[0])]  # type: ignore[attr-defined]
        yield node, f"({ast.unparse(other)})"
    elif isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign) and exchanged(node.op) is not None:
        other.op = exchanged(node.op)  # type: ignore[attr-defined]
        text = ast.unparse(other)
        if "'" not in text:  # texts cannot be subtracted
            yield node, text if isinstance(node, ast.AugAssign) else f"({text})"
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
        yield node, f"({ast.unparse(node.operand)})"
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float):
        value = node.value
        changed = (
            not value
            if isinstance(value, bool)
            else value + 1
            if isinstance(value, int)
            else value * 2 or 1.0
        )
        yield node, repr(changed)
    elif isinstance(node, ast.If | ast.IfExp | ast.While):
        yield node.test, f"(not ({ast.unparse(node.test)}))"
    elif isinstance(node, ast.Raise) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        yield node, "pass"
    elif isinstance(node, ast.Call):
        for keyword in node.keywords:
            if keyword.arg not in (None, "stacklevel", "maxsplit"):
                fewer = copy.copy(node)
                fewer.keywords = [each for each in node.keywords if each is not keyword]
                yield node, ast.unparse(fewer)


# --- which tests execute what -------------------------------------------------------------------------------


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """As a plugin of the run that is measured: what each test that passes takes."""
    _taken[report.nodeid] = _taken.get(report.nodeid, 0.0) + report.duration
    if not report.passed:
        _failed.add(report.nodeid)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write it down, but in the workers of pytest-xdist."""
    if not hasattr(session.config, "workerinput"):
        kept = {name: seconds for name, seconds in _taken.items() if name not in _failed}
        Path(os.environ["STAF_MUTATION_SECONDS"]).write_text(json.dumps(kept), encoding="utf-8")


_taken: dict[str, float] = {}
_failed: set[str] = set()


def measure(tree: Path, jobs: int, tests: Sequence[str]) -> None:
    """Run the suite once, and keep which test executed which line, and what each takes."""
    CACHE.mkdir(parents=True, exist_ok=True)
    (CACHE / "coveragerc").write_text(SETTINGS, encoding="utf-8")
    line = ["-m", "pytest", "-q", "-p", "mutation", "-p", "no:cacheprovider", "--tb=no", f"-n{jobs}"]
    line += [
        "--cov=staf_torch",
        "--cov-context=test",
        "--cov-report=",
        f"--cov-config={CACHE / 'coveragerc'}",
    ]
    told = {"COVERAGE_FILE": str(MEASURED), "STAF_MUTATION_SECONDS": str(SECONDS)}
    subprocess.run([sys.executable, *line, *tests], cwd=tree, env=environment(tree) | told, check=False)


def environment(tree: Path) -> dict[str, str]:
    """In which tests run: the package of a tree, and a cache of programs that mutants share."""
    path = os.pathsep.join(str(tree / part) for part in ("", "staf_torch/plugins", "tests"))
    own = {"PYTHONPATH": path, "XDG_CACHE_HOME": str(CACHE / "programs"), "PYTHONDONTWRITEBYTECODE": "1"}
    return {**os.environ, **own, "OMP_NUM_THREADS": "1"}


def tests_of(mutant: Mutant, data: coverage.CoverageData, taken: dict[str, float], most: float) -> list[str]:
    """Tests that execute the line, the short ones first; of a line that runs at import those of the file."""
    lines = data.contexts_by_lineno(mutant.file)
    own = {each for line in range(mutant.line, mutant.last + 1) for each in lines.get(line, ())} - {""}
    names = {each.rpartition("|")[0] for each in own or {each for line in lines.values() for each in line}}
    known = sorted(names & taken.keys(), key=lambda name: (taken[name], name))[:300]
    until = itertools.accumulate(taken[name] for name in known)
    return [name for name, seconds in zip(known, until, strict=True) if seconds < most] or files_that_name(
        mutant
    )


def files_that_name(mutant: Mutant) -> list[str]:
    """For what only other processes execute: files of tests that name the module."""
    word = re.compile(rf"\b{Path(mutant.file).stem}\b")
    files = [path.relative_to(ROOT) for path in sorted((ROOT / "tests").rglob("test_*.py"))]
    return [str(path) for path in files if word.search((ROOT / path).read_text(encoding="utf-8"))][:5]


# --- what becomes of a mutant -------------------------------------------------------------------------------


def judged(mutant: Mutant, tree: Path, tests: Sequence[str], seconds: float) -> str:
    """Run tests on a mutant: "killed", "hangs", "survives", or why nothing can be said."""
    if not tests:
        return "survives: no test executes it"
    path = tree / mutant.file
    source = path.read_text(encoding="utf-8")
    path.write_text(mutant.applied(source), encoding="utf-8")
    line = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider", "--tb=no", *tests]
    line = ["bash", "-c", 'ulimit -v 25000000; exec "$@"', "_", *line]  # kB
    with (tree / "said.txt").open("w+", encoding="utf-8") as said:
        process = subprocess.Popen(
            line, cwd=tree, env=environment(tree), start_new_session=True, stdout=said, stderr=said
        )
        try:
            code = process.wait(seconds)
        except subprocess.TimeoutExpired:
            return "hangs"
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            path.write_text(source, encoding="utf-8")
        said.seek(0)
        if code == 5 or "no match in any of" in said.read():  # such a test is no longer there
            return "unknown: the map is old, --remap"
    return "killed" if code else "survives"


def copied(into: Path) -> Path:
    """The files of the working tree that git knows, compiled so that a changed file is compiled anew."""
    named = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    for name in filter(None, named.stdout.split("\0")):
        if (ROOT / name).is_file():
            (into / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, into / name)
    mode = py_compile.PycInvalidationMode.CHECKED_HASH
    compileall.compile_dir(into / "staf_torch", quiet=2, invalidation_mode=mode)
    return into


def main() -> None:
    """Draw mutants, try them and print those that survive."""
    options = _options()
    files = sorted(path for path in (ROOT / "staf_torch").rglob("*.py") if "plugins" not in path.parts)
    names = [str(path.relative_to(ROOT)) for path in files]
    chosen = [name for name in names if not options.room or name.split("/")[1] in options.room]
    every = [each for name in chosen for each in mutants_of(name, (ROOT / name).read_text(encoding="utf-8"))]
    sample = random.Random(options.seed).sample(every, min(options.sample, len(every)))
    begun, found = time.monotonic(), dict[Mutant, str]()
    with tempfile.TemporaryDirectory(prefix="staf-mutation-") as scratch:
        trees: queue.Queue[Path] = queue.Queue()
        for job in range(options.jobs):
            trees.put(copied(Path(scratch, str(job))))
        if options.remap or not SECONDS.exists():
            measure(Path(scratch, "0"), options.jobs, options.tests)
        taken = json.loads(SECONDS.read_text(encoding="utf-8"))
        data = coverage.CoverageData(str(MEASURED))
        data.read()
        tests = {each: tests_of(each, data, taken, SOONEST * options.seconds) for each in sample}

        def tried(mutant: Mutant) -> None:
            tree = trees.get()
            try:
                found[mutant] = judged(mutant, tree, tests[mutant], options.seconds)
            finally:
                trees.put(tree)
            print(f"[{len(found)}/{len(sample)}] {mutant}: {found[mutant]}", flush=True)

        with ThreadPoolExecutor(options.jobs) as pool:
            list(pool.map(tried, sample))
    alive = [mutant for mutant in sample if found[mutant].startswith("survives")]
    seconds = time.monotonic() - begun
    print(f"\n{len(alive)} of {len(sample)} survive, of {len(every)} mutants, {seconds:.0f} s:")
    print(*sorted(map(str, alive)), sep="\n")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sample", type=int, default=100, help="mutants that are drawn")
    for name, usual in (("--seed", 1), ("--jobs", 2)):
        parser.add_argument(name, type=int, default=usual)
    parser.add_argument("--seconds", type=float, default=60.0, help="for a mutant")
    parser.add_argument("--room", nargs="*", help="of the package; all by default")
    parser.add_argument("--remap", action="store_true", help="measure again which test executes what")
    parser.add_argument("--tests", nargs="*", default=["tests"], help="that are measured; all by default")
    return parser.parse_args()


if __name__ == "__main__":
    main()
