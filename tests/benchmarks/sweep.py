"""A hundred jobs by `staf -m`, `staf_torch.sweep` and Hydra's basic launcher; a thousand rows of a table.

With nothing else running: `python tests/benchmarks/sweep.py [--only batched,python]`. What
many jobs and rows cost beside their numbers (40 steps each): `--only jobs2000,rows20000`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LENGTH = ["duration=5", "settle_time=1", "figures=false"]  # 500 steps
RADII, COUNTS = "centers.radius=0.05,0.1,0.15,0.2,0.3", "centers.count=3,6,10,15"
JOBS = ["-m", RADII, COUNTS, "seed=range(5)", "trajectories=2", *LENGTH]
SHORT = ["trajectories=2", "duration=0.4", "settle_time=0.2", "figures=false", "history=false"]
STAF = ["-m", "staf_torch"]
TABLE = ["-m", "sweep.records=table", "hydra.sweep.dir=sweep"]
PYTHON = f"import staf_torch; assert len(staf_torch.sweep(*{JOBS[1:]!r}, directory='sweep')) == 100"
MEMORY = f"""
import gc, pathlib, sys, staf_torch
sizes = []
for i in range(10):
    staf_torch.sweep(*{JOBS[1:]!r}, directory=f"sweep{{i}}")
    gc.collect()
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
    sizes.append(round(pages * 4096 / 2**20, 1))
print("memory after each of ten sweeps of 100 runs in one process, MiB:", sizes, file=sys.stderr)
"""
COMMANDS = {
    "batched": [*STAF, *JOBS, "hydra.sweep.dir=sweep"],
    "python": ["-c", PYTHON],
    "memory": ["-c", MEMORY],
    "basic": [*STAF, *JOBS, "hydra.sweep.dir=sweep", "hydra/launcher=basic"],
    "jobs2000": [*STAF, "-m", RADII, COUNTS, "seed=range(100)", *SHORT, "hydra.sweep.dir=sweep"],
    "rows20000": [*STAF, *TABLE, RADII, COUNTS, "seed=range(1000)", *SHORT],
    "rows": [*STAF, *TABLE, RADII, COUNTS, "seed=range(50)", "trajectories=2", *LENGTH],
}


def measured(argv: list[str]) -> dict[str, float]:
    """Wall and CPU seconds of a command with all its processes, and the most memory of its first one, MiB."""
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        line, environment = [sys.executable, *argv], {**os.environ, "PYTHONPATH": path}
        process = subprocess.Popen(line, cwd=folder, env=environment, stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise subprocess.CalledProcessError(process.returncode, line)
    cpu = used.ru_utime + used.ru_stime
    return {"wall": round(wall, 2), "cpu": round(cpu, 2), "memory": round(used.ru_maxrss / 1024)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default=",".join(name for name in COMMANDS if not name[-1].isdigit()))
    chosen = parser.parse_args()
    found: dict[str, dict[str, float]] = {}
    for name in chosen.only.split(","):
        found[name] = measured(COMMANDS[name])
        text = "{wall:7.2f} s wall {cpu:7.2f} s CPU {memory:5.0f} MiB".format(**found[name])
        print(f"{name:14s} {text}", flush=True)
    if {"batched", "python"} <= set(found):
        ratio = found["python"]["cpu"] / found["batched"]["cpu"]
        print(f"staf_torch.sweep takes {ratio:.3f} of the CPU seconds of staf -m")
    if {"batched", "basic"} <= set(found):
        ratio = found["batched"]["cpu"] / found["basic"]["cpu"]
        print(f"the batched launcher takes {ratio:.3f} of the basic one's CPU seconds")


if __name__ == "__main__":
    main()
