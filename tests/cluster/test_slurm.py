"""Sweeps on a real SLURM of one node; skipped where its packages are not installed."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import environment
from slurm_node import SlurmNode, missing

from staf_torch.results.reader import collect

pytest.importorskip("submitit", reason="the extra `slurm` is not installed")
pytestmark = pytest.mark.skipif(missing() is not None, reason=missing() or "")

SHORT = ["duration=0.05", "settle_time=0", "figures=false", "history=false"]
GRID = ["kernel=gaussian,matern", "seed=0,1", "trajectories=2", *SHORT]
SLURM = ["hydra.launcher.executor=submitit", "+hydra.launcher.submitit.cluster=slurm"]
SLOW = '''
import time
from staf_torch.results.files import write_metrics

def slow(cfg, directory, progress=None):
    """Take ten minutes where the seed is large."""
    if cfg.seed > 9:
        time.sleep(600)
    metrics = {"square": float(cfg.seed**2)}
    write_metrics(directory / "metrics.json", metrics)
    return metrics
'''


@pytest.fixture(scope="module")
def node() -> Iterator[SlurmNode]:
    place = Path(tempfile.mkdtemp(prefix="slurm", dir="/tmp"))
    with SlurmNode(place) as found:
        yield found
    shutil.rmtree(place, ignore_errors=True)


@pytest.fixture
def place(node: SlurmNode) -> Iterator[Path]:
    """A working directory that the node's daemons can reach, with an experiment that takes its time."""
    found = Path(tempfile.mkdtemp(prefix="sweep", dir=node.place))
    (found / "slow.py").write_text(SLOW)
    yield found
    node.run("scancel", "--me")


def staf(node: SlurmNode, place: Path, *line: str) -> subprocess.Popen[str]:
    env = {**environment(), **node.environment}
    program = "from staf_torch.cli.staf import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", program, "-m", *line],
        cwd=place,
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def wait_for_the_first(run: subprocess.Popen[str], place: Path) -> None:
    """Wait until the first job of the sweep is complete."""
    done = place / "sweep" / "0" / "run.json"
    while not (done.exists() and json.loads(done.read_text())["status"] == "completed"):
        assert run.poll() is None
        time.sleep(0.2)


def running(node: SlurmNode, count: int) -> list[str]:
    """Wait until so many jobs run; return their numbers."""
    for _ in range(600):
        found = node.run("squeue", "-h", "-t", "running", "-o", "%i").stdout.split()
        if len(found) >= count:
            return sorted(found, key=int)
        time.sleep(0.2)
    raise AssertionError(node.run("squeue", "-t", "all").stdout)


@pytest.mark.parametrize("records", ["directories", "table"])
def test_a_sweep_on_slurm_ends_with_the_bits_of_one_that_is_not(
    records: str, node: SlurmNode, place: Path
) -> None:
    one, two = place / "inline", place / "slurm"
    for folder, more in ((one, []), (two, SLURM)):
        line = [*GRID, f"sweep.records={records}", "hydra.launcher.batch=2", f"hydra.sweep.dir={folder}"]
        out, _ = (run := staf(node, place, *line, *more)).communicate(timeout=300)
        assert run.returncode == 0, out
    if records == "table":
        assert (two / "rows.json").read_bytes() == (one / "rows.json").read_bytes()
    found, wanted = collect(two).rows, collect(one).rows
    assert [run.metrics for run in found] == [run.metrics for run in wanted]
    assert len(found) == 4


def test_a_cancelled_job_fails_alone_and_is_told_in_a_line(node: SlurmNode, place: Path) -> None:
    run = staf(node, place, "task=slow.slow", "seed=3,99", *SHORT, *SLURM, "hydra.sweep.dir=sweep")
    wait_for_the_first(run, place)
    node.run("scancel", running(node, 1)[-1])
    out, _ = run.communicate(timeout=120)
    assert run.returncode == 1
    rows = collect(place / "sweep").rows
    assert [row.status for row in rows] == ["completed", "failed"]
    assert "was cancelled" in str(rows[1].reason)
    assert len(str(rows[1].reason)) < 400
    assert "Traceback" not in out
    assert "once more" not in out


def test_a_job_out_of_time_is_told_and_not_taken_for_a_failed_batch(node: SlurmNode, place: Path) -> None:
    limit = "+hydra.launcher.submitit.timeout_min=1"
    run = staf(node, place, "task=slow.slow", "seed=99", *SHORT, *SLURM, limit, "hydra.sweep.dir=sweep")
    out, _ = run.communicate(timeout=240)
    assert run.returncode == 1
    (row,) = collect(place / "sweep").rows
    assert "ran into its time limit" in str(row.reason)
    assert "they run one by one" not in out


def test_a_sweep_that_is_killed_leaves_no_job_behind(node: SlurmNode, place: Path) -> None:
    run = staf(node, place, "task=slow.slow", "seed=3,99", *SHORT, *SLURM, "hydra.sweep.dir=sweep")
    wait_for_the_first(run, place)
    run.terminate()
    out, _ = run.communicate(timeout=60)
    assert run.returncode == 143, out
    assert "1 of 2 jobs are complete, 0 failed, 1 are to do. Resume with:" in out
    for _ in range(100):
        left = node.run("squeue", "-h", "-o", "%i %T").stdout.split("\n")
        if not any(line and "COMPLETING" not in line for line in left):
            break
        time.sleep(0.2)
    else:
        raise AssertionError(left)
