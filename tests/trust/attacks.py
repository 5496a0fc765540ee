"""Hostile run folders against the commands that read them: `python tests/trust/attacks.py [NAME ...]`.

Each attack changes a copy of an honest run or sweep and gives it to one command, in a process of its own. It
succeeds where anything outside the folder changes, a secret or a control character comes out, the command
runs 5 CPU-seconds or 500 MB beyond the honest one (but for those of `LARGE`), waits, or ends in a traceback.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import attacks_on_exports as attacks_on_exports
import attacks_on_sweeps as attacks_on_sweeps
import attacks_on_tables as attacks_on_tables
from arena import ATTACKS, CONTROLS, SECRET, Arena

CPU_SECONDS, WAIT, MEMORY = 5.0, 60.0, 500 * 2**20
LARGE = {
    "base_sixty_numbers",
    "a_history_that_unpacks_to_gigabytes",
    "an_override_of_a_million_commas",
    "a_record_of_three_hundred_megabytes",
}
"""Folders that do nothing but take long to read: time and memory are the reader's own to end."""
MOST_MEMORY = 6 * 2**30  # bytes of addresses that a command may have
HONEST = ("duration=6.0", "figures=false", "seed=3")


@dataclasses.dataclass
class Outcome:
    """What one command did."""

    code: int  # negative: the signal that ended the command
    text: str  # stdout and stderr
    seconds: float  # CPU time of the command and its children
    memory: int  # bytes, largest resident size
    waited: bool  # ended by us after WAIT seconds


def outcome(command: list[str], cwd: Path, environment: dict[str, str]) -> Outcome:
    """Run a command to its end, or for WAIT seconds."""
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen(
            command,
            cwd=cwd,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
            start_new_session=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY)),
        )
        end, waited = time.monotonic() + WAIT, False
        while True:
            pid, status, used = os.wait4(process.pid, os.WNOHANG)
            if pid:
                break
            if time.monotonic() > end and not waited:
                waited = True
                os.killpg(process.pid, signal.SIGKILL)
            time.sleep(0.05)
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        text = out.read(10**7).decode(errors="surrogateescape")
    return Outcome(process.returncode, text, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024, waited)


def snapshot(root: Path, without: tuple[Path, ...]) -> dict[str, str]:
    """What is at every path below `root` but not below `without`."""
    found = {}
    for folder, names, files in os.walk(root):
        names[:] = [name for name in names if Path(folder, name) not in without]
        for name in [*names, *files]:
            path = Path(folder, name)
            if path in without:
                continue
            state = "folder"
            if path.is_symlink():
                state = os.readlink(path)
            elif path.is_file():
                state = hashlib.sha256(path.read_bytes()).hexdigest()
            found[str(path.relative_to(root))] = state
    return found


def leaks(arena: Arena, text: str) -> str | None:
    """Where the secret, also in base64, came out."""
    from base64 import b64encode

    # base64 has three phases; what lies in the middle of a secret looks the same in one of them
    shapes = [SECRET.encode()] + [b64encode(SECRET.encode()[k:])[:-4] for k in range(3)]
    if any(shape in text.encode(errors="replace") for shape in shapes):
        return "the terminal"
    line = ["grep", "-rlF", "-D", "skip", *(f"-e{shape.decode()}" for shape in shapes)]
    found = subprocess.run(
        [*line, str(arena.hostile), str(arena.cwd)], capture_output=True, text=True, check=False
    )
    return (found.stdout.splitlines() or [None])[0]


def verdict(
    arena: Arena, before: dict[str, str], result: Outcome, base: Outcome, check: Callable | None, large: bool
) -> list[str]:
    """What the attack reached; empty: nothing."""
    found = []
    after = snapshot(arena.root, (arena.hostile, arena.cwd))
    changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    if changed:
        found.append(f"changed outside: {changed[:3]}")
    if result.waited and not large:
        found.append(f"did not end in {WAIT:.0f} s")
    if result.seconds > base.seconds + CPU_SECONDS and not large:
        found.append(f"{result.seconds:.1f} CPU-s, the honest one {base.seconds:.1f}")
    if result.memory > max(MEMORY, base.memory + MEMORY // 5) and not large:
        found.append(f"{result.memory / 2**20:.0f} MB, the honest one {base.memory / 2**20:.0f}")
    if result.code < 0 and not result.waited:
        found.append(f"ended by signal {-result.code}")
    if "Traceback" in result.text:
        found.append("a traceback: " + result.text.strip().splitlines()[-1][:150])
    bad = {
        repr(c)
        for c in result.text
        if (ord(c) < 32 and c not in "\n\r\t") or 0x7F <= ord(c) < 0xA0 or c in "\u202e\u2066"
    }
    if bad:
        found.append(f"control characters on the terminal: {sorted(bad)}")
    if place := leaks(arena, result.text):
        found.append(f"the secret came out in {place}")
    if check is not None and (said := check(arena, result)):
        found.append(said)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="attacks (all)")
    parser.add_argument("--verbose", action="store_true", help="show what each command said")
    arguments = parser.parse_args()
    environment = os.environ | {"STAF_SECRET": SECRET, "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    broken = 0
    with tempfile.TemporaryDirectory(prefix="attacks.") as place:
        honest = Path(place) / "honest"
        run = outcome(["staf", *HONEST, f"hydra.run.dir={honest}/one"], Path(place), environment)
        sweep = ["staf", "-m", *HONEST, "centers.radius=0.1,0.2,0.3", f"hydra.sweep.dir={honest}/many"]
        assert run.code == 0, run.text
        made = outcome(sweep, Path(place), environment)
        assert made.code == 0, made.text
        bases = {}
        for name, attack in (CONTROLS | ATTACKS).items():
            if arguments.names and name not in arguments.names and name not in CONTROLS:
                continue
            arena = Arena(Path(place) / name)
            arena.lay_out(honest)
            command, check = attack(arena)
            before = snapshot(arena.root, (arena.hostile, arena.cwd))
            result = outcome(command, arena.cwd, environment)
            if name in CONTROLS:
                bases[command[0]] = result
                said = check(arena, result)
                assert not said, (name, said, result.text)
                print(
                    f"{name:34s} control, {result.seconds:.1f} CPU-s, {result.memory / 2**20:.0f} MB",
                    flush=True,
                )
            else:
                # a command of several is compared with the dearest of them
                base = bases.get(command[0], bases["staf"])
                found = verdict(arena, before, result, base, check, name in LARGE)
                broken += bool(found)
                print(f"{name:34s} {'; '.join(found) or 'held'}", flush=True)
            if arguments.verbose:
                print(result.text)
            subprocess.run(["rm", "-rf", str(arena.root)], check=True)  # Python's own takes no deep folders
    print(f"{len(arguments.names or ATTACKS)} attacks, {broken} of them reached something")
    return bool(broken)


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.exit(main())
