"""An experiment of a user's own: code and one YAML in the user's folder, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import Outcome, run_all

CODE = '''
import dataclasses
from staf_torch.experiments.registry import BatchedExperiment
from staf_torch.results.files import write_metrics

def energy(cfg, directory, progress=None):
    """Alone: a function."""
    metrics = {"energy": sum(x**2 for x in cfg.initial_state)}
    write_metrics(directory / "metrics.json", metrics)
    return metrics

@dataclasses.dataclass
class Square:
    metrics: dict

class Squares(BatchedExperiment[Square]):
    """Batched: a class."""
    batchable = frozenset({"seed"})

    def __call__(self, cfg, directory, progress=None):
        return self.write(cfg, directory, self.solve([cfg], progress)[0])

    def solve(self, cfgs, progress):
        together = float(len(cfgs))
        if any(cfg.seed == 7 for cfg in cfgs):
            raise RuntimeError("seven")
        return [Square({"square": float(cfg.seed**2), "together": together}) for cfg in cfgs]

    def write(self, cfg, directory, solution):
        write_metrics(directory / "metrics.json", solution.metrics)
        return solution.metrics

number = 3
'''
YAML = "# @package _global_\ntask: {task}\nfigures: false\n"
CONF = "--config-dir=../conf"
JOBS = {
    "alone": [CONF, "experiment=energy", "initial_state=[2.0,1.0]"],
    "swept": ["-m", CONF, "experiment=energy", "initial_state=[1.0,0.0],[2.0,0.0]", "hydra.sweep.dir=runs/s"],
    "rows": [
        *("-m", "hydra.searchpath=[file://../conf]", "experiment=squares", "seed=range(4)"),
        *("sweep.records=table", "hydra.sweep.dir=runs/s"),
    ],
    "one fails": ["-m", CONF, "experiment=squares", "seed=6,7", "hydra.sweep.dir=runs/s"],
    "no experiment": ["task=plants.number"],
}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Outcome]:
    base = tmp_path_factory.mktemp("own")
    (base / "conf" / "experiment").mkdir(parents=True)
    for name in ("energy", "Squares"):
        text = YAML.format(task=f"plants.{name}")
        (base / "conf" / "experiment" / f"{name.lower()}.yaml").write_text(text)
    return run_all(JOBS, base, CODE)


def metrics(folder: Path) -> dict[str, float | None]:
    found: dict[str, float | None] = json.loads((folder / "metrics.json").read_text())
    return found


def test_a_function_runs_by_the_command(outcomes: dict[str, Outcome]) -> None:
    assert outcomes["alone"].code == 0, outcomes["alone"]
    (run,) = (outcomes["alone"].folder / "runs").iterdir()
    assert metrics(run) == {"energy": 5.0}
    assert json.loads((run / "run.json").read_text())["task"] == "plants.energy"


def test_a_function_is_swept_and_has_a_table(outcomes: dict[str, Outcome]) -> None:
    assert outcomes["swept"].code == 0, outcomes["swept"]
    sweep = outcomes["swept"].folder / "runs" / "s"
    assert [metrics(sweep / str(num))["energy"] for num in range(2)] == [1.0, 4.0]
    assert "energy" in (sweep / "table.csv").read_text()


def test_a_class_shares_a_tensor_batch(outcomes: dict[str, Outcome]) -> None:
    assert outcomes["rows"].code == 0, outcomes["rows"]
    rows = json.loads((outcomes["rows"].folder / "runs" / "s" / "rows.json").read_text())["rows"]
    assert [row["metrics"]["square"] for row in rows] == [0.0, 1.0, 4.0, 9.0]
    assert {row["metrics"]["together"] for row in rows} == {4.0}


def test_a_batch_that_raises_is_tried_job_by_job(outcomes: dict[str, Outcome]) -> None:
    sweep = outcomes["one fails"].folder / "runs" / "s"
    assert metrics(sweep / "0") == {"square": 36.0, "together": 1.0}
    record = json.loads((sweep / "1" / "run.json").read_text())
    assert (record["status"], record["reason"]) == ("failed", "RuntimeError: seven")


def test_what_is_no_experiment_is_refused(outcomes: dict[str, Outcome]) -> None:
    refused = outcomes["no experiment"]
    assert refused.code == 1
    words = "`staf task=...` must be an experiment, which can be called; got 'plants.number'."
    assert words in refused.err
    assert "Traceback" not in refused.err
