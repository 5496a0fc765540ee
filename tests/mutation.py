"""Change one operator, number or statement of the package at a time, and see whether a test notices.

    python tests/mutation.py [--sample 100] [--seed 0] [--package kernels optim] [--jobs 2] [--minutes 30]

A mutant runs the tests that execute its line, those of the same folder and the short ones first,
until one fails (`mutation_judge.py`). Which tests execute which line is measured once a file of tests
(`mutation_map.py`) and kept in the user's cache. The committed tree counts, not the working one. Mutants in
`mutants_accepted.py` change nothing that can be seen.
"""

from __future__ import annotations

import argparse
import compileall
import json
import multiprocessing
import os
import py_compile
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

from mutants import Mutant, mutants_of, room_of
from mutation_fork import begin
from mutation_judge import Verdict, begin_judging, fail_anyway, judge
from mutation_map import Map, kept_at, known, measure, places, test_files
from mutation_notes import Notes

ROOT = Path(__file__).resolve().parent.parent
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "staf_torch-mutation"
PRELOADED = ("torch", "torch._dynamo", "numpy", "scipy.linalg", "matplotlib.pyplot", "omegaconf")
PRELOADED += (
    "hypothesis.extra.numpy",
    "hypothesis.strategies",
    "hydra._internal.hydra",
    "hydra.core.plugins",
)


def main() -> int:
    """Run the command line; the exit code is 1 where too few of them are killed."""
    os.environ["OMP_NUM_THREADS"] = "1"  # before torch is imported: threads of OpenMP do not survive a fork
    options = _options()
    begun = time.monotonic()
    until = begun + 60 * options.minutes
    compiled = CACHE.parent / "staf_torch"
    with tempfile.TemporaryDirectory(prefix="staf-mutation-") as scratch:
        tree = Path(scratch) / "tree"
        _export(_git("rev-parse", options.commit).strip(), tree)
        _prepare(tree)
        found = list(_all_mutants(tree, options.package, options.file))
        if options.few:
            found = _seldom_executed(found, known(CACHE / "map", tree), options.few)
        drawn = random.Random(options.seed).sample(found, min(options.sample, len(found)))
        notes = Notes(options.into, found, drawn)
        left = notes.left(again=options.again, without=options.without)
        near = tuple({place for _, each in left for place in places(each.file)})
        _measure_the_new(tree, compiled, options.jobs, begun + 60 * options.mapping, near)
        print(f"{len(found)} mutants, {len(notes.sample)} of them drawn, {len(left)} to try", flush=True)
        arguments = tree, compiled, known(CACHE / "map", tree), options.seconds, until
        with multiprocessing.get_context("fork").Pool(options.jobs, begin_judging, arguments) as pool:
            tried = []
            for (at, _), verdict in zip(left, pool.imap(judge, [each for _, each in left]), strict=True):
                if verdict is not None:
                    _tell(verdict)
                    notes.add(at, verdict)
                    tried.append((at, verdict))
            liars = pool.apply(fail_anyway, [sorted({each.by for _, each in tried if "::" in each.by})])
    for at, verdict in tried:
        if verdict.by in liars:
            print(f"no witness, fails with the right code: {verdict.by}")
            notes.add(at, verdict._replace(said="survived"))
    verdicts = notes.verdicts()
    print(f"{time.monotonic() - begun:.0f} s, {sum(os.times()[:4]):.0f} of the processor")
    print(f"tried, in its order: {len(verdicts)} of {len(notes.sample)}")
    return int(_report(verdicts) < options.least)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sample", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--package", nargs="*", default=[], help="to draw from; all of staf_torch by default")
    parser.add_argument("--file", nargs="*", default=[], help="to draw from, staf_torch/...; all by default")
    parser.add_argument(
        "--few", type=int, default=0, help="draw from lines that at most so many tests execute"
    )
    parser.add_argument("--into", type=Path, help="file of the sample and its verdicts, where a run goes on")
    parser.add_argument("--again", action="store_true", help="try what survived once more")
    parser.add_argument("--without", nargs="*", default=[], help="packages that are left for another run")
    parser.add_argument("--commit", default="HEAD")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=45, help="of tests that a mutant is given")
    parser.add_argument("--least", type=float, default=95, help="score in percent that is asked for")
    parser.add_argument("--minutes", type=float, default=600, help="after which no mutant is begun")
    parser.add_argument("--mapping", type=float, default=600, help="minutes of these for the map")
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
        if (packages and room_of(name) not in packages) or (files and name not in files):
            continue
        yield from mutants_of(name, path.read_text(encoding="utf-8"))


def _seldom_executed(mutants: Iterable[Mutant], measured: Map, most: int) -> list[Mutant]:
    """Those in lines that few tests execute, as far as the map goes: what survives is mostly there."""
    few = []
    for mutant in mutants:
        lines = measured.lines.get(mutant.file, {})
        tests = set[str]().union(*(lines.get(n, set()) for n in range(mutant.line, mutant.last_line + 1)))
        if 0 < len(tests) <= most:
            few.append(mutant)
    return few


def _measure_the_new(tree: Path, compiled: Path, jobs: int, until: float, near: tuple[str, ...]) -> None:
    """Measure which lines are executed by the files of tests that changed since the map was made.

    Those of the folders in which the mutants are, ``near``, come first: there may be no time for all.
    """
    store = CACHE / "map"
    store.mkdir(parents=True, exist_ok=True)
    new = [each for each in test_files(tree) if not kept_at(store, tree, each).exists()]
    new.sort(key=lambda name: not name.startswith(near))
    if not new or time.monotonic() >= until:
        return
    print(f"measuring which lines {len(new)} files of tests execute", flush=True)
    with multiprocessing.get_context("fork").Pool(jobs, begin, (tree, compiled)) as pool:
        for name, found in pool.imap_unordered(measure, new):
            if found is not None:
                kept_at(store, tree, name).write_text(json.dumps(found))
                print(f"{sum(found['seconds'].values()):6.1f} s {len(found['seconds']):4} {name}", flush=True)
            if time.monotonic() > until:
                pool.terminate()
                print("no time to measure the others: whole files of them run, of the mutant's own folder")
                break


def _prepare(tree: Path) -> None:
    """Compile by content: a file that changes within a second is seen to change. Import what is slow."""
    mode = py_compile.PycInvalidationMode.CHECKED_HASH
    for folder in ("staf_torch", "tests"):
        compileall.compile_dir(tree / folder, quiet=1, invalidation_mode=mode)
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
        rooms[verdict.mutant.room][verdict.said] += 1
        rooms["all"][verdict.said] += 1
    kinds = ("killed", "survived", "too dear", "unreached", "accepted")
    print(f"\n{'room':16} " + " ".join(f"{kind:>9}" for kind in kinds) + "  score")
    for room, count in sorted(rooms.items(), key=lambda item: (item[0] == "all", item[0])):
        counted = count.total() - count["accepted"]
        score = f"{100 * count['killed'] / counted:.0f} %" if counted else "-"
        print(f"{room:16} " + " ".join(f"{count[kind]:9}" for kind in kinds) + f"  {score:>5}")
    return 100 * rooms["all"]["killed"] / max(rooms["all"].total() - rooms["all"]["accepted"], 1)


if __name__ == "__main__":
    sys.exit(main())
