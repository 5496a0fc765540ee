"""Change one operator, number or statement of the package at a time, and see whether a test notices.

    python tests/mutation.py [--sample 100] [--seed 0] [--package kernels optim] [--jobs 2] [--minutes 30]

A mutant runs the tests that execute its line, those of the same folder first and the short ones first,
until one fails (`mutation_fork.py`). Which tests execute which line is measured once (`mutation_map.py`) and
kept in the user's cache. The committed tree counts, not the working one. Mutants in `mutants_accepted.py`
change nothing that can be seen.
"""

from __future__ import annotations

import argparse
import compileall
import json
import multiprocessing
import os
import py_compile
import random
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mutants import Mutant, mutants_of
from mutation_fork import Verdict, begin, judge
from mutation_map import Map, as_map, measure, moved

ROOT = Path(__file__).resolve().parent.parent
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "staf_torch-mutation"
PRELOADED = ("torch", "torch._dynamo", "numpy", "scipy.linalg", "matplotlib.pyplot", "omegaconf")


def main() -> int:
    """Run the command line; the exit code is 1 where too few of them are killed."""
    options = _options()
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="staf-mutation-") as scratch:
        tree = Path(scratch) / "tree"
        commit = _git("rev-parse", options.commit).strip()
        _export(commit, tree)
        found = list(_all_mutants(tree, options.package, options.file))
        chosen = random.Random(options.seed).sample(found, min(options.sample, len(found)))[options.skip :]
        if options.again:
            chosen = list(_survivors(options.again.read_text(), found))
        known = _known(commit, tree, options.jobs)
        print(f"{len(found)} mutants, {len(chosen)} of them by seed {options.seed}", flush=True)
        _prepare(tree)
        verdicts = []
        until = begun + 60 * options.minutes
        arguments = tree, known, CACHE.parent / "staf_torch", options.seconds, until
        with multiprocessing.get_context("fork").Pool(options.jobs, begin, arguments) as pool:
            for verdict in pool.imap_unordered(judge, chosen):
                if verdict is not None:
                    verdicts.append(verdict)
                    _tell(verdict)
    print(f"{time.monotonic() - begun:.0f} s; no time for {len(chosen) - len(verdicts)} of the sample")
    return int(_report(verdicts) < options.least)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sample", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--skip", type=int, default=0, help="so many of the sample: they were tried before")
    parser.add_argument("--again", type=Path, help="output of a run: what survived in it, and nothing else")
    parser.add_argument("--package", nargs="*", default=[], help="rooms of staf_torch; all by default")
    parser.add_argument("--file", nargs="*", default=[], help="files, staf_torch/...; all by default")
    parser.add_argument("--commit", default="HEAD")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=45, help="of tests that a mutant is given")
    parser.add_argument("--least", type=float, default=95, help="score in percent that is asked for")
    parser.add_argument("--minutes", type=float, default=600, help="after which no mutant is begun")
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


def _survivors(output: str, found: Sequence[Mutant]) -> Iterator[Mutant]:
    """Mutants that an output names as not killed, in a version whose lines may have moved."""
    pattern = r"^(?:survived|unreached) +(\S+):(\d+): ('.*'|\".*\") -> ('.*'|\".*\")  \[\d+ tests"
    for file, line, was, now in re.findall(pattern, output, re.MULTILINE):
        alike = [m for m in found if (m.file, repr(m.was), repr(m.now)) == (file, was, now)]
        yield from sorted(alike, key=lambda m: abs(m.line - int(line)))[:1]


def _texts(tree: Path) -> dict[str, str]:
    paths = sorted((tree / "staf_torch").rglob("*.py"))
    return {str(path.relative_to(tree)): path.read_text(encoding="utf-8") for path in paths}


def _known(commit: str, tree: Path, jobs: int) -> Map:
    """The map of a commit: the kept one, or that of the latest ancestor with what changed measured again."""
    kept = CACHE / f"{commit}.json"
    if kept.exists():
        return as_map(json.loads(kept.read_text())["found"])
    CACHE.mkdir(parents=True, exist_ok=True)
    older = next((c for c in _git("rev-list", commit).split() if (CACHE / f"{c}.json").exists()), None)
    if older is None:
        print("measuring which test executes which line: runs the suite once", flush=True)
        found = _measured(tree, ["tests"], jobs)
    else:
        before = json.loads((CACHE / f"{older}.json").read_text())
        found = moved(before["found"], before["texts"], _texts(tree))
        changed = _git("diff", "--name-only", older, commit, "--", "tests").split()
        files = [each for each in changed if Path(each).name.startswith("test_") and (tree / each).exists()]
        print(f"map of {older[:8]}; measuring {len(files)} files of tests again", flush=True)
        for kind in ("lines", "tests", "seconds"):
            found[kind] = {
                n: value for n, value in found[kind].items() if n.partition("::")[0] not in changed
            }
        for kind, values in (_measured(tree, files, jobs) if files else {}).items():
            found[kind] |= values
    kept.write_text(json.dumps({"found": found, "texts": _texts(tree)}))
    return as_map(found)


def _measured(tree: Path, tests: Sequence[str], jobs: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="staf-mutation-map-") as folder:
        return measure(tree, tests, Path(folder), jobs)


def _prepare(tree: Path) -> None:
    """Compile by content: a file that changes within a second is seen to change. Import what is slow."""
    mode = py_compile.PycInvalidationMode.CHECKED_HASH
    compileall.compile_dir(tree / "staf_torch", quiet=1, invalidation_mode=mode)
    for name in PRELOADED:
        __import__(name)


# What is said of it


def _tell(verdict: Verdict) -> None:
    by = f" ({verdict.by})" if verdict.by else ""
    where = f"{verdict.mutant.file}:{verdict.mutant.line}"
    took = f"[{verdict.tests} tests, {verdict.seconds:.0f} s]"
    print(
        f"{verdict.said:9} {where}: {verdict.mutant.was!r} -> {verdict.mutant.now!r}  {took}{by}", flush=True
    )


def _report(verdicts: list[Verdict]) -> float:
    """Print a row a room; the score of all in percent, without the accepted ones."""
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
    counted = sum(rooms["all"][said] for said in ("killed", "survived", "unreached"))
    return 100 * rooms["all"]["killed"] / max(counted, 1)


if __name__ == "__main__":
    sys.exit(main())
