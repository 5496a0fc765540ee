"""Change one operator, number or statement of the package at a time, and see whether a test notices.

    python tests/mutation.py [--sample 100] [--seed 1] [--jobs 2] [--seconds 60] [--room kernels optim]

A mutant runs the files of tests that say most of its module's public names, those of its own room first, in
a process and a copy of the tree of its own, until one fails or its time is over. Those that survive are
printed. It is a lamp and no score: many changes do no harm, and other files of tests may notice.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import functools
import os
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

ROOT = Path(__file__).resolve().parent.parent
PAIRS = "Lt LtE, Gt GtE, Eq NotEq, Is IsNot, In NotIn, Add Sub, Mult Div, BitAnd BitOr, And Or"
OPERATORS = {a: b for pair in PAIRS.split(", ") for a, b in (pair.split(), pair.split()[::-1])}
OPERATORS |= dict.fromkeys(("FloorDiv", "Mod", "Pow"), "Mult")
SAYS = ("warn", "info", "debug", "warning", "error")  # calls that only say something


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
        changed = not value if isinstance(value, bool) else value + 1 if value == int(value) else 2 * value
        yield node, repr(changed)
    elif isinstance(node, ast.If | ast.IfExp | ast.While):
        yield node.test, f"(not ({ast.unparse(node.test)}))"
    elif isinstance(node, ast.Raise) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        yield node, "pass"


# --- what becomes of a mutant -------------------------------------------------------------------------------


@functools.cache
def words_of_tests() -> dict[str, set[str]]:
    """Files of tests, and the words in each."""
    files = sorted((ROOT / "tests").rglob("test_*.py"))
    return {str(p.relative_to(ROOT)): set(re.findall(r"\w+", p.read_text(encoding="utf-8"))) for p in files}


def tests_of(file: str) -> list[str]:
    """At most six files of tests that say most of the public names of a module, those of its room first."""
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    names = {each.name for each in tree.body if isinstance(each, ast.ClassDef | ast.FunctionDef)}
    names = {name for name in names | {Path(file).stem} if name[0] != "_"}
    room = f"tests/{file.split('/')[1]}/"
    stem = Path(file).stem
    rank = {
        test: (test.startswith(room), stem in test, len(names & words))
        for test, words in words_of_tests().items()
    }
    return sorted((test for test in rank if rank[test][2]), key=lambda test: rank[test], reverse=True)[:6]


def judged(mutant: Mutant, tree: Path, seconds: float) -> str:
    """Run tests on a mutant: "killed", "out of time", or "survives"."""
    path, tests = tree / mutant.file, tests_of(mutant.file)
    if not tests:
        return "survives: no test names it"
    source = path.read_text(encoding="utf-8")
    path.write_text(mutant.applied(source), encoding="utf-8")
    line = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider", "--tb=no", *tests]
    line = ["bash", "-c", 'ulimit -v 25000000; exec "$@"', "_", *line]  # kB
    python = os.pathsep.join(str(tree / part) for part in ("", "staf_torch/plugins", "tests"))
    own = {"PYTHONPATH": python, "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(
        line, cwd=tree, env={**os.environ, **own}, start_new_session=True, stdout=quiet, stderr=quiet
    )
    try:
        return "killed" if process.wait(seconds) else "survives"
    except subprocess.TimeoutExpired:
        return "out of time"
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        path.write_text(source, encoding="utf-8")


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
        hidden = shutil.ignore_patterns(".*", "__pycache__", "runs")
        for job in range(options.jobs):
            trees.put(Path(shutil.copytree(ROOT, Path(scratch, str(job)), ignore=hidden)))

        def tried(mutant: Mutant) -> None:
            tree = trees.get()
            found[mutant] = judged(mutant, tree, options.seconds)
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
    return parser.parse_args()


if __name__ == "__main__":
    main()
