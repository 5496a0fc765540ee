"""What befalls the sweeps of `kills.py`: signals, lost workers, a full disk, and what SLURM does to jobs."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

from slurm_node import SlurmNode


class Victim(Protocol):
    """A sweep in a process of its own."""

    pid: int
    place: Path  # working directory

    def over(self) -> bool:
        """Whether the process has ended."""
        ...


Harm = Callable[[Victim, random.Random], str]
"""Does it, and says what it did."""
JOBS = 60.0  # s that a job of SLURM may take to run


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


@contextlib.contextmanager
def ended_with_us(place: Path, patience: float = 15.0) -> Iterator[None]:
    """Where a signal or an error breaks us off, end the processes that work in a folder.

    Args:
        place: the folder.
        patience: s from SIGTERM, with which they end what they began, to SIGKILL.
    """
    try:
        yield
    except BaseException:
        for number, seconds in ((signal.SIGTERM, patience), (signal.SIGKILL, 5.0)):
            for pid in working_in(place):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, number)
            until = time.monotonic() + seconds
            while working_in(place) and time.monotonic() < until:
                time.sleep(0.05)
        raise


def to_parent(number: signal.Signals) -> Harm:
    def kill(sweep: Victim, chance: random.Random) -> str:
        os.kill(sweep.pid, number)
        return f"{number.name} to the command"

    return kill


def to_worker(sweep: Victim, chance: random.Random) -> str:
    """SIGKILL to one of the processes that the command has started; to itself where there is none."""
    below = children(sweep.pid)
    os.kill(chance.choice(below or [sweep.pid]), signal.SIGKILL)
    return "SIGKILL to a worker" if below else "SIGKILL to the command"


def full_disk(sweep: Victim, chance: random.Random) -> str:
    """Fill the small disk of the sweep, for the rest of its time."""
    ballast = os.open(sweep.place / "ballast", os.O_WRONLY | os.O_CREAT)
    with contextlib.suppress(OSError):
        while os.write(ballast, bytes(4096)):
            pass
    os.close(ballast)
    return "a full disk"


def to_raylet(sweep: Victim, chance: random.Random) -> str:
    """SIGKILL to the daemon of a node of Ray, as soon as there is one, or up to five seconds later."""
    until = time.monotonic() + JOBS
    while time.monotonic() < until and not sweep.over():
        found = [pid for pid in children(sweep.pid) if "raylet/raylet" in command_of(pid)]
        if found:
            time.sleep(chance.uniform(0, 5))
            with contextlib.suppress(ProcessLookupError):
                os.kill(found[0], signal.SIGKILL)
                return "SIGKILL to the raylet"
        time.sleep(0.05)
    return "no job was running"


def command_of(pid: int) -> str:
    """The program of a process and its arguments."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    return ""


def scancel(node: SlurmNode, jobs: list[str]) -> None:
    node.run("scancel", *jobs)


def requeue(node: SlurmNode, jobs: list[str]) -> None:
    """As preemption does it."""
    node.run("scontrol", "requeue", ",".join(jobs))


def node_loss(node: SlurmNode, jobs: list[str]) -> None:
    """The node is down for a second, with what ran there."""
    host = node.run("sinfo", "-h", "-o", "%n").stdout.split()[0]
    node.run("scontrol", "update", f"NodeName={host}", "State=DOWN", "Reason=test")
    time.sleep(1)
    node.run("scontrol", "update", f"NodeName={host}", "State=RESUME")


def slurmd(node: SlurmNode, jobs: list[str]) -> None:
    """The node's daemon ends, and is started a second later."""
    host = node.run("sinfo", "-h", "-o", "%n").stdout.split()[0]
    node.stop("slurmd")
    time.sleep(1)
    node.start("slurmd", "-D", "-N", host)


def time_limit(node: SlurmNode, jobs: list[str]) -> None:
    """The jobs are out of time in a second; the controller looks every half a minute or so."""
    for job in jobs:
        node.run("scontrol", "update", f"JobId={job}", "EndTime=now+1")


def slurm_harm(node: SlurmNode, harm: Callable[[SlurmNode, list[str]], None]) -> Harm:
    def kill(sweep: Victim, chance: random.Random) -> str:
        until = time.monotonic() + JOBS
        while not (jobs := running(node)) and not sweep.over() and time.monotonic() < until:
            time.sleep(0.05)  # whoever cancels no job kills nothing
        if not jobs:
            return "no job was running"
        time.sleep(chance.uniform(0, 2))
        harm(node, jobs)
        return f"SLURM: {harm.__name__} of {len(jobs)} jobs"

    return kill


def running(node: SlurmNode) -> list[str]:
    """The jobs that run."""
    found: list[str] = node.run("squeue", "-h", "-t", "running", "-o", "%i").stdout.split()
    return found


def deck(executors: list[str], node: SlurmNode | None) -> list[tuple[str, str, Harm]]:
    """What befalls sweeps: executor, name and harm, each once."""
    kill, term, hup, interrupt = (
        to_parent(number) for number in (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
    )
    parent = {"SIGKILL": kill, "SIGTERM": term, "SIGHUP": hup, "SIGINT": interrupt}
    found: list[tuple[str, str, Harm]] = []
    for executor in executors:
        harms: dict[str, Harm] = dict(parent) if executor in ("inline", "process") else {"SIGKILL": kill}
        if executor in ("process", "submitit", "ray"):
            harms["worker"] = to_worker
        if executor == "inline" and os.geteuid() == 0:
            harms["full disk"] = full_disk
        if executor == "ray":
            harms["raylet"] = to_raylet
        if executor == "slurm" and node is not None:
            for each in (scancel, requeue, node_loss, slurmd, time_limit):
                harms[each.__name__] = slurm_harm(node, each)
        found += [(executor, name, harm) for name, harm in harms.items()]
    return found
