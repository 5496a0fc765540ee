"""Sweeps killed at random moments, and taken up again: `python tests/trust/kills.py [--kills 50]`.

Every kill begins a sweep, ends it (or one of its workers, or its disk) at a moment drawn uniformly from the
time that it takes, resumes it, and compares the table with that of a sweep that nobody touched, byte by byte.
Executors: inline, process, Hydra's basic launcher, submitit and ray where they are installed. Jobs on a real
SLURM are in tests/cluster.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
os.environ["OMP_NUM_THREADS"] = "1"  # torch's threads do not survive a fork

import torch._dynamo  # noqa: E402, F401

import staf_torch.experiments.gradient_chase  # noqa: E402, F401
from staf_torch.cli import staf  # noqa: E402

GRID = ["kernel=gaussian,matern", "centers.count=3,6", "seed=range(4)", "trajectories=2"]
GRID += ["duration=0.2", "settle_time=0.1", "figures=false", "history=false"]
EXECUTORS = {
    "inline": ["hydra.launcher.batch=2"],
    "process": ["hydra.launcher.executor=process", "hydra.launcher.workers=2", "hydra.launcher.batch=2"],
    "basic": ["hydra/launcher=basic"],
    "submitit": [
        *("hydra.launcher.executor=submitit", "+hydra.launcher.submitit.cluster=local"),
        "hydra.launcher.batch=8",
    ],
    "ray": ["hydra.launcher.executor=ray", "hydra.launcher.batch=4"],
}
TRACE = 99  # exit code of a command that ends in a traceback
WAIT, STAY = 240.0, 120.0  # s that a sweep may take, and its processes to end after it: they may be importing


class Sweep:
    """A sweep as a process of its own, forked from this one, which has imported torch for all.

    Args:
        place: working directory.
        line: arguments.
    """

    def __init__(self, place: Path, line: list[str]) -> None:
        self.place, self.line = place, line
        self.process = multiprocessing.get_context("fork").Process(target=self._run)
        self.process.start()

    @property
    def pid(self) -> int:
        """The number of the process."""
        assert self.process.pid is not None
        return self.process.pid

    def over(self) -> bool:
        """Whether the process has ended."""
        return not self.process.is_alive()

    def end(self) -> int:
        """Wait for the exit code; a sweep that does not end in time is killed."""
        self.process.join(WAIT)
        if not self.over():
            self.process.kill()
            self.process.join()
        return self.process.exitcode or 0

    def _run(self) -> None:
        os.chdir(self.place)
        os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        log = os.open("log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        for stream in (1, 2):
            os.dup2(log, stream)
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
        for number in (signal.SIGTERM, signal.SIGHUP):  # `nohup python kills.py` ignores SIGHUP
            signal.signal(number, signal.SIG_DFL)
        sys.argv = ["staf", "-m", *self.line]
        try:
            staf.main()
        except Exception:
            traceback.print_exc()
            sys.exit(TRACE)


def children(pid: int) -> list[int]:
    """The processes below one, deepest last."""
    found: list[int] = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = stat.read_text().rpartition(")")[2].split()
            if int(fields[1]) == pid and fields[0] not in "ZX":
                child = int(stat.parent.name)
                found += [child, *children(child)]
    return found


def working_in(place: Path) -> list[int]:
    """The processes that have that working directory, or one below it."""
    found = []
    for link in Path("/proc").glob("[0-9]*/cwd"):
        with contextlib.suppress(OSError):
            if Path(os.readlink(link)).is_relative_to(place):
                found.append(int(link.parent.name))
    return found


Harm = Callable[[Sweep, random.Random], str]
"""Does it, and says what it did."""


def to_parent(number: signal.Signals) -> Harm:
    def kill(sweep: Sweep, chance: random.Random) -> str:
        os.kill(sweep.pid, number)
        return f"{number.name} to the command"

    return kill


def to_worker(sweep: Sweep, chance: random.Random) -> str:
    """SIGKILL to one of the processes that the command has started; to itself where there is none."""
    below = children(sweep.pid)
    os.kill(chance.choice(below or [sweep.pid]), signal.SIGKILL)
    return "SIGKILL to a worker" if below else "SIGKILL to the command"


def full_disk(sweep: Sweep, chance: random.Random) -> str:
    """Fill the small disk of the sweep, for the rest of its time."""
    ballast = os.open(sweep.place / "ballast", os.O_WRONLY | os.O_CREAT)
    with contextlib.suppress(OSError):
        while os.write(ballast, bytes(4096)):
            pass
    os.close(ballast)
    return "a full disk"


def deck(executors: list[str]) -> list[tuple[str, str, Harm]]:
    """What befalls sweeps: executor, name and harm, each once."""
    signals = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
    found: list[tuple[str, str, Harm]] = []
    for executor in executors:
        apart = executor not in ("inline", "process")
        found += [(executor, each.name, to_parent(each)) for each in signals[: 1 if apart else None]]
        if executor in ("process", "submitit", "ray"):
            found.append((executor, "worker", to_worker))
        if executor == "inline" and os.geteuid() == 0:
            found.append((executor, "full disk", full_disk))
    return found


@contextlib.contextmanager
def small_disk(place: Path) -> Iterator[None]:
    """Mount a disk of a few megabytes at a folder."""
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", str(place)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def one(base: Path, executor: str, harm: Harm, chance: random.Random, whole: tuple[bytes, float]) -> str:
    """One kill; say what happened, first `same` for the same table."""
    place = base / f"{executor}{chance.randrange(10**9)}"
    with small_disk(place) if harm is full_disk else contextlib.nullcontext(place.mkdir()):
        begin = time.monotonic()
        line = [*GRID, *EXECUTORS[executor], "hydra.sweep.dir=sweep"]
        sweep = Sweep(place, line)
        while not (place / "sweep" / "sweep.json").exists() and not sweep.over():
            time.sleep(0.005)
        moment = chance.uniform(0, max(0.1, whole[1] - (time.monotonic() - begin)))
        time.sleep(moment)
        said = "it was over before" if sweep.over() else harm(sweep, chance)
        code = sweep.end()
        until = time.monotonic() + STAY
        # Ray's processes are its own daemons' to end.
        while (stayed := 0 if executor == "ray" else len(working_in(place))) and time.monotonic() < until:
            time.sleep(0.1)
        (place / "ballast").unlink(missing_ok=True)
        # Where no job had begun, the sweep has taken its directory back and says nothing of resuming.
        begun = (place / "sweep" / "sweep.json").exists()
        again = Sweep(place, ["sweep.resume=sweep", "--trust"] if begun else line).end()
        table = place / "sweep" / "table.csv"
        same = again == 0 and table.exists() and table.read_bytes() == whole[0]
        log = (place / "log").read_text(errors="replace").splitlines()[-15:]
        trouble = [] if same and code != TRACE else log
        trouble += [f"{stayed} processes stayed"] * bool(stayed)
    shutil.rmtree(place, ignore_errors=True)
    verdict = "same" if same and not trouble else "ANOTHER"
    ended = f"exit {code}, resumed with {again}"
    return "\n".join([f"{verdict}: {executor}, {said} after {moment:.1f} s, {ended}", *trouble])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--executors", default=",".join(EXECUTORS), help="of " + ", ".join(EXECUTORS))
    chosen = parser.parse_args()
    absent = [name for name in ("ray", "submitit") if importlib.util.find_spec(name) is None]
    executors = [name for name in chosen.executors.split(",") if name not in absent]
    print(f"executors: {', '.join(executors)}; absent: {', '.join(absent) or 'none'}", flush=True)
    chance, bad, counts = random.Random(chosen.seed), 0, Counter[str]()
    with tempfile.TemporaryDirectory(prefix="kills.") as folder:
        wholes: dict[str, tuple[bytes, float]] = {}
        for executor in executors:
            begin = time.monotonic()
            place = Path(folder) / f"whole_{executor}"
            place.mkdir()
            code = Sweep(place, [*GRID, *EXECUTORS[executor], "hydra.sweep.dir=sweep"]).end()
            assert code == 0, (place / "log").read_text()
            wholes[executor] = (place / "sweep" / "table.csv").read_bytes(), time.monotonic() - begin
        cards = deck(executors)
        for number in range(chosen.kills):
            if number % len(cards) == 0:
                chance.shuffle(cards)
            executor, name, harm = cards[number % len(cards)]
            said = one(Path(folder), executor, harm, chance, wholes[executor])
            counts[f"{name} ({executor})"] += "over before" not in said
            bad += not said.startswith("same")
            print(f"{number + 1}: {said}", flush=True)
    for name, count in sorted(counts.items()):
        print(f"{count:4d} {name}")
    print(f"{chosen.kills - bad} of {chosen.kills} resumed to the same table")
    return bool(bad)


if __name__ == "__main__":
    sys.exit(main())
