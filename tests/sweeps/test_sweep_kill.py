"""A sweep that is killed, at any moment."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from command_line import environment

KILLED = """
import os, random, signal, sys, time
import staf_torch.cli.staf as app
import staf_torch.experiments.gradient_chase  # so that the children share it

GRID = ["centers.count=3,4", "centers.radius=0.1,0.2", "hydra.launcher.batch=1"]
GRID += ["duration=0.05", "settle_time=0", "figures=false", "history=false"]

def start(*argv):
    child = os.fork()
    if child == 0:
        sys.stdout = sys.stderr = open(os.devnull, "w")
        sys.argv = ["staf", "-m", *argv]
        try:
            app.main()
        except SystemExit:
            pass
        os._exit(0)
    return child

begin = time.monotonic()
os.waitpid(start(*GRID, "hydra.sweep.dir=whole"), 0)
whole = time.monotonic() - begin
chance = random.Random(int(sys.argv[1]))
for attempt in range(2):
    place = f"killed{attempt}"
    child = start(*GRID, f"hydra.sweep.dir={place}")
    # Anywhere from the first file of the sweep on.
    while not os.path.exists(f"{place}/sweep.json"):
        assert os.waitpid(child, os.WNOHANG) == (0, 0), "the sweep ended before it began"
        time.sleep(0.001)
    time.sleep(chance.uniform(0, whole))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    os.waitpid(start(f"sweep.resume={place}"), 0)
"""


def test_a_sweep_killed_at_a_random_time_ends_as_if_it_had_not_been(tmp_path: Path) -> None:
    line = [sys.executable, "-c", KILLED, "5"]
    subprocess.run(line, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=True)
    expected = table(tmp_path / "whole")
    assert len(expected) == 4
    assert sum(isinstance(row, str) for row in expected.values()) == 2
    for attempt in range(2):
        assert table(tmp_path / f"killed{attempt}") == expected


def table(sweep: Path) -> dict[str, object]:
    """Every job of the sweep: its metrics to the last bit, or why it has none."""
    rows: dict[str, object] = {}
    for job in json.loads((sweep / "sweep.json").read_text())["jobs"]:
        run = sweep / str(job["num"])
        about = json.loads((run / "run.json").read_text())
        assert about["overrides"] == job["overrides"]
        assert about["status"] in ("completed", "failed")
        done = about["status"] == "completed"
        rows[" ".join(job["overrides"])] = (
            json.loads((run / "metrics.json").read_text()) if done else about["reason"]
        )
    return rows
