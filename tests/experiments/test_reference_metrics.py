"""Metrics of every experiment, run short, as they were: what any constant of a case changes.

    python tests/experiments/test_reference_metrics.py [case ...]  # records them anew

A change that is meant is seen in the difference of `reference_metrics.json`.
"""

from __future__ import annotations

import functools
import json
import sys
import tempfile
from pathlib import Path

import pytest
from composing import settings

from staf_torch.adp import DirectShooting
from staf_torch.experiments.registry import EXPERIMENTS, experiment

RECORDED = Path(__file__).with_name("reference_metrics.json")
CASES: dict[str, str] = {
    "adp": "experiment=adp duration=0.3 dt=0.005 trajectories=2",
    "adp_comparison": "experiment=adp_comparison duration=0.1 dt=0.01",
    "adp_initial_weights": "experiment=adp_initial_weights duration=0.1 dt=0.01",
    "adp_tracking": "experiment=adp_tracking duration=0.3 dt=0.01 trajectories=2",
    "avoidance": "experiment=avoidance trajectories=3 duration=2.0 adp.compile=false",
    "avoidance of a unicycle": "experiment=avoidance avoidance.vehicle=unicycle trajectories=2 duration=1.0 "
    "adp.compile=false",
    "exponential_bound": "experiment=exponential_bound exponential_bound.states=9 "
    "exponential_bound.radii=[0.1]",
    "faults": "experiment=faults trajectories=3 duration=0.6",
    "feasibility": "experiment=feasibility feasibility.states=16 feasibility.radii=[0.1] "
    "feasibility.epsilons=[0.1,0.01]",
    "flat_limit": "experiment=flat_limit",
    "gradient_chase": "dt=0.05 duration=1.0 settle_time=0.5 trajectories=3 certificate=true centers.count=6 "
    "spread=0.4",
    "icl": "experiment=icl trajectories=3 dt=0.005 duration=0.5 settle_time=0.1 icl.length=[0.02,0.04]",
    "laws": "experiment=laws dt=0.05 duration=1.0 settle_time=0.5 laws.steps=[0.1,0.05] laws.work=4",
    "layouts": "experiment=layouts layouts.states=4 layouts.radii=[0.1,0.2]",
    "memory": "experiment=memory",
    "safe_box": "experiment=safe_box duration=0.2 dt=0.01 trajectories=2 safe_box.states=4 safe_box.decay=20 "
    "safe_box.substeps=4",
}


def metrics_of(name: str, directory: Path) -> dict[str, float | None]:
    """The metrics of a case."""
    cfg = settings("figures=false", *CASES[name].split())
    run = experiment(cfg.task)
    with pytest.MonkeyPatch.context() as patch:  # the optimum in a box on a mesh of its own takes 11 s
        coarse = functools.partial(DirectShooting, horizon=2.0, intervals=16)
        patch.setattr("staf_torch.experiments.safe_box.DirectShooting", coarse)
        found: dict[str, float | None] = run(cfg, directory)
    return found


def test_every_experiment_has_recorded_metrics() -> None:
    assert {name.split()[0] for name in CASES} == EXPERIMENTS.keys() - {"rivals"}  # which times others
    assert json.loads(RECORDED.read_text()).keys() == CASES.keys()


@pytest.mark.parametrize("name", CASES)
def test_metrics_are_the_recorded_ones(name: str, tmp_path: Path) -> None:
    if name == "adp_tracking":  # its optimum is a Riccati equation's
        pytest.importorskip("scipy", reason="needs the extra adp")
    recorded = json.loads(RECORDED.read_text())[name]
    found = metrics_of(name, tmp_path)
    assert found.keys() == recorded.keys()
    for metric, number in recorded.items():
        assert found[metric] == (None if number is None else pytest.approx(number, rel=1e-4, abs=1e-9)), (
            metric
        )


if __name__ == "__main__":
    known = json.loads(RECORDED.read_text()) if RECORDED.exists() else {}
    for case in sys.argv[1:] or CASES:
        with tempfile.TemporaryDirectory() as folder:
            known[case] = metrics_of(case, Path(folder))
    RECORDED.write_text(json.dumps({case: known[case] for case in CASES}, indent=1) + "\n")
