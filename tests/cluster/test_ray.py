"""Sweeps on two Ray nodes of this machine; skipped where Ray is not installed."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import environment

from staf_torch.results.reader import collect

pytest.importorskip("ray", reason="the extra `ray` is not installed")

SHORT = ["duration=0.05", "settle_time=0", "figures=false", "history=false", "trajectories=2"]
GRID = ["kernel=gaussian,matern", "seed=0,1", *SHORT]
DYING = '''
import os, signal
from pathlib import Path
from staf_torch.results.files import write_metrics

def dying(cfg, directory, progress=None):
    """A task whose worker is killed: always with seed 1, the first time with seed 2."""
    note = Path("PLACE", f"note{cfg.seed}")
    if cfg.seed == 1 or (cfg.seed == 2 and not note.exists()):
        note.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    write_metrics(directory / "metrics.json", {"seed": float(cfg.seed)})
    return {"seed": float(cfg.seed)}
'''


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("ray")
    (found / "dying.py").write_text(DYING.replace("PLACE", str(found)))
    return found


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """A head and a second node on loopback, one core each."""
    from ray.cluster_utils import Cluster

    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    nodes.add_node(num_cpus=1)
    yield nodes.address
    nodes.shutdown()


def staf(place: Path, *line: str) -> tuple[int, str]:
    program = "from staf_torch.cli.staf import main; main()"
    ended = subprocess.run(
        [sys.executable, "-c", program, "-m", *line],
        cwd=place,
        env={**environment(), "RAY_DEDUP_LOGS": "0"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    return ended.returncode, ended.stdout + ended.stderr


@pytest.mark.parametrize("records", ["directories", "table"])
def test_a_sweep_on_two_nodes_ends_with_the_bits_of_one_that_is_not(
    records: str, cluster: str, place: Path
) -> None:
    ray = ["hydra.launcher.executor=ray", f"+hydra.launcher.ray.address='{cluster}'"]
    one, two = place / f"{records}_inline", place / f"{records}_two"
    for folder, more in ((one, []), (two, ray)):
        line = [*GRID, f"sweep.records={records}", "hydra.launcher.batch=2", f"hydra.sweep.dir={folder}"]
        code, out = staf(place, *line, *more)
        assert code == 0, out
    if records == "table":
        assert (two / "rows.json").read_bytes() == (one / "rows.json").read_bytes()
    found, wanted = collect(two).rows, collect(one).rows
    assert [run.metrics for run in found] == [run.metrics for run in wanted]
    assert len(found) == 4


def test_a_killed_worker_is_tried_once_more_and_fails_alone(cluster: str, place: Path) -> None:
    ray = ["hydra.launcher.executor=ray", f"+hydra.launcher.ray.address='{cluster}'"]
    code, out = staf(place, "task=dying.dying", "seed=0,1,2", *SHORT, *ray, "hydra.sweep.dir=dying")
    assert code == 1
    rows = collect(place / "dying").rows
    assert [row.status for row in rows] == ["completed", "failed", "completed"], out
    assert str(rows[1].reason).startswith("the worker was lost twice")
    assert len(str(rows[1].reason)) < 400
    assert os.path.exists(place / "note2")
