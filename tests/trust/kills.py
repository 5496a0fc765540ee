"""Sweeps killed at random moments, and taken up again: `python tests/trust/kills.py [--kills 50]`.

Every kill begins a sweep, ends it (or one of its processes, its jobs, its node, its disk) at a moment drawn
uniformly from the time that it takes, resumes it, and compares the table with that of a sweep that nobody
touched, byte by byte. Executors: inline, process, Hydra's basic launcher, submitit and ray where they are
installed, SLURM where it is (as root). What befell how many is printed in the end.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
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
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
os.environ["OMP_NUM_THREADS"] = "1"  # torch's threads do not survive a fork

import torch._dynamo  # noqa: E402, F401
from harms import Harm, deck, ended_with_us, full_disk, to_raylet, working_in  # noqa: E402
from slurm_node import SlurmNode, missing  # noqa: E402

import staf_torch.experiments.gradient_chase  # noqa: E402, F401
from staf_torch.cli import staf  # noqa: E402

GRID = ["kernel=gaussian,matern", "centers.count=3,6", "seed=range(4)", "trajectories=2"]
GRID += ["duration=0.2", "settle_time=0.1", "figures=false", "history=false"]
EXECUTORS = {
    "inline": ["hydra.launcher.batch=2"],
    "process": ["hydra.launcher.executor=process", "hydra.launcher.workers=2", "hydra.launcher.batch=2"],
    "basic": ["hydra/launcher=basic"],
    "submitit": [
        "hydra.launcher.executor=submitit",
        "+hydra.launcher.submitit.cluster=local",
        "hydra.launcher.batch=8",
    ],
    "ray": ["hydra.launcher.executor=ray", "hydra.launcher.batch=4"],
    "slurm": [
        "hydra.launcher.executor=submitit",
        "+hydra.launcher.submitit.cluster=slurm",
        "hydra.launcher.batch=8",
    ],
}
SHARES = (1.0, 0.5, 0.2, 0.05)  # of a sweep's time, one after the other where it was over before the kill
TRACE = 99  # exit code of a command that ends in a traceback
WAIT, STAY = 240.0, 120.0  # s that a sweep may take, and its processes to end after it: they may be importing


class Sweep:
    """A sweep as a process of its own, forked from this one, which has imported torch for all.

    Args:
        place: working directory.
        line: arguments.
        environment: variables beside those of this process.
    """

    def __init__(self, place: Path, line: list[str], environment: dict[str, str]) -> None:
        self.place, self._code = place, -1
        self.pid = os.fork()
        if self.pid:
            return
        code = TRACE
        try:
            os.chdir(place)
            os.environ.update(environment)
            log = os.open("log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            for stream in (1, 2):
                os.dup2(log, stream)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
            for number in (signal.SIGTERM, signal.SIGHUP):  # `nohup python kills.py` ignores SIGHUP
                signal.signal(number, signal.SIG_DFL)
            sys.argv = ["staf", "-m", *line]
            staf.main()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
            os.write(2, f"{end.code}\n".encode())
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(code)

    def over(self) -> bool:
        """Whether the process has ended."""
        if self.pid and (found := os.waitpid(self.pid, os.WNOHANG))[0]:
            self.pid, self._code = 0, os.waitstatus_to_exitcode(found[1])
        return not self.pid

    def end(self) -> int:
        """Wait for the exit code; a sweep that does not end in time is killed, and the code is 98."""
        until = time.monotonic() + WAIT
        while not self.over():
            if time.monotonic() > until:
                os.kill(self.pid, signal.SIGKILL)
                os.waitpid(self.pid, 0)
                return 98
            time.sleep(0.02)
        return self._code


@contextlib.contextmanager
def small_disk(place: Path) -> Iterator[None]:
    """Mount a disk of a few megabytes at a folder."""
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", str(place)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def one(
    base: Path,
    executor: str,
    harm: Harm,
    environment: dict[str, str],
    chance: random.Random,
    whole: tuple[bytes, float],
    share: float,
) -> str:
    """One kill in the first ``share`` of a sweep; say what happened, first `same` for the same table."""
    place = base / f"{executor}{chance.randrange(10**9)}"
    apart = executor in ("slurm", "ray")  # their processes are their own daemons' to end
    disk = small_disk(place) if harm is full_disk else contextlib.nullcontext(place.mkdir())
    with disk, ended_with_us(place):
        begin = time.monotonic()
        line = [*GRID, *EXECUTORS[executor], "hydra.sweep.dir=sweep"]
        sweep = Sweep(place, line, environment)
        while not (place / "sweep" / "sweep.json").exists() and not sweep.over():
            time.sleep(0.005)
        left = max(0.1, whole[1] - (time.monotonic() - begin))
        waits = executor == "slurm" or harm is to_raylet  # for what they harm
        moment = share * chance.uniform(0, left / 4 if waits else left)
        time.sleep(moment)
        said = "it was over before" if sweep.over() else harm(sweep, chance)
        code = sweep.end()
        until = time.monotonic() + STAY
        while (stayed := 0 if apart else len(working_in(place))) and time.monotonic() < until:
            time.sleep(0.1)
        (place / "ballast").unlink(missing_ok=True)
        # Where no job had begun, the sweep has taken its directory back and says nothing of resuming.
        begun = (place / "sweep" / "sweep.json").exists()
        line = ["sweep.resume=sweep", "--trust"] if begun else line
        again = Sweep(place, line, environment).end()
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
    parser.add_argument(
        "--executors", default=",".join(EXECUTORS), help="one after the other, of " + ", ".join(EXECUTORS)
    )
    parser.add_argument(
        "--kinds", help="of kills, such as SIGHUP,scancel,node_loss; all, each as often, else"
    )
    chosen = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended by SIGTERM"))  # and what we began with us
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {"PYTHONPATH": path}
    absent = {name: name for name in ("ray", "submitit") if importlib.util.find_spec(name) is None}
    absent |= {"slurm": missing() or absent.get("submitit", "")}
    executors = [name for name in chosen.executors.split(",") if not absent.get(name)]
    print(
        f"executors: {', '.join(executors)}; absent: {', '.join(filter(absent.get, absent)) or 'none'}",
        flush=True,
    )
    chance, bad, missed = random.Random(chosen.seed), 0, 0
    with contextlib.ExitStack() as stack:
        base = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="kills.")))
        base.chmod(0o755)
        node = None
        if "slurm" in executors:
            (base / "slurm").mkdir()
            node = stack.enter_context(SlurmNode(base / "slurm"))
        wholes: dict[str, tuple[bytes, float]] = {}
        for executor in dict.fromkeys(executors):
            own = {**environment, **(node.environment if node is not None and executor == "slurm" else {})}
            begin = time.monotonic()
            place = base / f"whole_{executor}"
            place.mkdir()
            with ended_with_us(place):
                code = Sweep(place, [*GRID, *EXECUTORS[executor], "hydra.sweep.dir=sweep"], own).end()
            assert code == 0, (place / "log").read_text()
            wholes[executor] = (place / "sweep" / "table.csv").read_bytes(), time.monotonic() - begin
        wanted = chosen.kinds.split(",") if chosen.kinds else None
        cards = [card for card in deck(executors, node) if wanted is None or card[1] in wanted]
        counts: Counter[str] = Counter()
        for number in range(chosen.kills):
            if number % len(cards) == 0:
                chance.shuffle(cards)
            executor, name, harm = cards[number % len(cards)]
            own = {**environment, **(node.environment if node is not None and executor == "slurm" else {})}
            for share in SHARES:
                said = one(base, executor, harm, own, chance, wholes[executor], share)
                hit = "over before" not in said and "no job was" not in said
                if hit or not said.startswith("same"):
                    break
                print(f"{number + 1}: drawn again, earlier: {said}", flush=True)
            counts[f"{name} ({executor})"] += hit
            missed += not hit
            bad += not said.startswith("same")
            print(f"{number + 1}: {said}", flush=True)
    for name, count in sorted(counts.items()):
        print(f"{count:4d} {name}")
    print(f"{chosen.kills - bad} of {chosen.kills} resumed to the same table; {missed} found nothing to kill")
    return bool(bad + missed)


if __name__ == "__main__":
    sys.exit(main())
