"""The ADP experiments end to end, short."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from composing import settings
from PIL import Image

from staf_torch import adp, systems
from staf_torch.adp import reference_optimum
from staf_torch.experiments import adp as adp_experiment
from staf_torch.experiments import adp_comparison, adp_tracking

SHORT = ["duration=0.1", "dt=0.005"]
TRACKED = ("duration=0.03", "dt=0.01", "animation=gif", "figures=false")


def moves(path: Path) -> None:
    """Check that the last frame of a GIF is not the first, and nearly so."""
    with Image.open(path) as picture:
        assert 2 <= picture.n_frames <= 60
        first = np.asarray(picture.convert("RGB"))
        picture.seek(picture.n_frames - 1)
        assert 20 < (first != np.asarray(picture.convert("RGB"))).any(-1).sum() < 0.2 * first[..., 0].size


@pytest.mark.parametrize(
    "overrides",
    [
        ["experiment=adp"],
        ["experiment=adp", "adp/law=published", "dt=0.001"],
        ["experiment=adp", "adp.gradient=partial", "adp.extrapolated_centers=fixed"],
        [
            "experiment=adp",
            "adp/extrapolation=quadrature",
            "adp.order=3",
            "adp.trust=0.5",
            "animation=gif",
            "dt=0.02",
        ],
        ["experiment=adp", "adp/policy=rollout", "adp.rollout.depth=1"],
        ["experiment=adp", "adp/policy=lqr", "system=pendulum"],
        ["experiment=adp", "adp/policy=none", "trajectories=3"],
        ["experiment=adp", "system=two_state_as_printed", "adp.optimum.shooting=false"],
        ["experiment=adp", "adp/basis=rbf_grid", "adp.rbf_grid.points=3"],
        ["experiment=adp_three_state"],
    ],
    ids=lambda o: " ".join(o),
)
def test_experiment_writes_its_run_directory(overrides: list[str], tmp_path: Path) -> None:
    drawn = (
        overrides == ["experiment=adp"] or "adp/policy=lqr" in overrides
    )  # with weights, without; figures are slow
    cfg = settings(*SHORT, f"figures={drawn}", *overrides)
    metrics = adp_experiment.ClosedLoop()(cfg, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert metrics["diverged_fraction"] == 0
    if "adp.optimum.shooting=false" in overrides:
        assert metrics["optimal_cost"] is None
    else:  # by formula or by shooting, there is an optimum for every plant
        if "experiment=adp_three_state" in overrides:
            pytest.importorskip("scipy")  # without it the run says that the optimum is not known
        assert metrics["optimal_cost"] > 0
        assert metrics["cost_ratio"] > 0
        assert metrics["control_error"] >= 0
        assert metrics["value_error"] >= 0
    names = {"cost", "optimal_cost", "cost_ratio", "final_state_norm", "control_error", "value_error"}
    assert names | {"regulated_fraction", "diverged_fraction"} <= metrics.keys()
    with np.load(tmp_path / "history.npz") as history:
        batch, times = history["state"].shape[:2]
        assert history["time"].shape == (times,)
        for name in ("control", "actor_weights", "critic_weights", "running_cost"):
            assert history[name].shape[:2] == (batch, times)
    if "animation=gif" in overrides:
        moves(tmp_path / "figures" / "closed_loop.gif")
    for ending in (".png", ".pdf") if drawn else ():
        assert (tmp_path / "figures" / cfg.task).with_suffix(ending).stat().st_size > 5000


def test_comparison_takes_a_plant_whose_optimum_no_formula_knows(tmp_path: Path) -> None:
    pytest.importorskip("scipy")
    overrides = ["system=van_der_pol", "duration=0.01", "trajectories=1", "adp.order=2", "figures=false"]
    metrics = adp_comparison.run(settings("experiment=adp_comparison", *overrides), tmp_path)
    assert metrics["lqr_diverged"] == 0
    cfg = settings("experiment=adp_comparison", *overrides, "adp.optimum.shooting=false")
    with pytest.raises(ValueError, match=r"needs a plant whose optimum is known.*got VanDerPol"):
        adp_comparison.run(cfg, tmp_path)


def test_initial_weights_leave_a_row_a_law(tmp_path: Path) -> None:
    overrides = ["duration=0.5", "dt=0.02", "trajectories=5", "figures=false", "initial_weights=[0.1,1.0]"]
    metrics = adp_comparison.initial_weights(settings("experiment=adp_initial_weights", *overrides), tmp_path)
    assert metrics["supervised_diverged_fraction"] == 0
    assert metrics["published_diverged_fraction"] > 0
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    lines = (tmp_path / "adp_initial_weights.csv").read_text().splitlines()
    assert lines[0] == "law,W0 = 0.1,W0 = 1,all"
    assert len(lines) == 4
    for bad, message in (
        ("[]", r"`staf initial_weights=...` must have at least one entry"),
        ("1", r"`staf initial_weights=...` must be a list of numbers"),
    ):
        cfg = settings("experiment=adp_initial_weights", f"initial_weights={bad}")
        with pytest.raises(ValueError, match=message):
            adp_comparison.initial_weights(cfg, tmp_path)


def test_tracking_writes_its_run_directory(tmp_path: Path) -> None:
    pytest.importorskip("scipy")
    metrics = adp_tracking.run(settings("experiment=adp_tracking", *TRACKED), tmp_path)
    assert metrics["optimal_cost"] == pytest.approx(1.4223, abs=1e-3)
    assert metrics["identified_parameter_error"] < metrics["unidentified_parameter_error"]
    with np.load(tmp_path / "history.npz") as history:
        assert history["parameters"].shape == (1, 4, 3, 2)
    moves(tmp_path / "figures" / "tracking.gif")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["adp.policy=ppo"], r"`staf adp.policy=...` must be an option of the group: adp/policy=NAME"),
        (["adp.extrapolated_around=0"], r"`RandomPoints\(around=...\)` must be one of 'state', 'origin'"),
        (["adp.extrapolated_around=origin"], r"`RandomPoints\(half_width=...\)` must be constant"),
        (["adp.rbf_grid.flat=1", "adp/basis=rbf_grid"], r"`RBFGridBasis\(flat=...\)` must be true or false"),
        (["adp.optimum.shooting=1"], r"`staf adp.optimum.shooting=...` must be true or false"),
        (["adp.optimum.states=-1"], r"`staf adp.optimum.states=...` must be at least 0"),
        (["adp.law=newton"], r"`staf adp.law=...` must be an option of the group: adp/law=NAME"),
        (["adp.basis=fourier"], r"`staf adp.basis=...` must be an option of the group: adp/basis=NAME"),
        (
            ["adp.extrapolation=grid"],
            r"`staf adp.extrapolation=...` must be an option of the group: adp/extrapolation=NAME",
        ),
        (["adp.cost.state=[[1,0],[0,-1]]"], r"`QuadraticCost\(state=...\)` must be positive semidefinite"),
        (["adp.cost.control=0"], r"`QuadraticCost\(control=...\)` must be positive"),
        (["system=oscillator"], r"`staf system=...` must be a plant with inputs; got 'Oscillator'"),
        (["initial_state=[1,2,3]"], r"`staf initial_state=...` must have 2 entries"),
        (["duration=1e-9"], r"`staf duration=...` must be at least one step"),
    ],
)
def test_bad_setting_is_refused_by_name(overrides: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        adp_experiment.ClosedLoop()(settings("experiment=adp", *overrides), tmp_path)
    assert not list(tmp_path.iterdir())


def test_trajectories_that_do_not_come_to_rest_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    plant, cost = systems.VanDerPol(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    x0 = torch.tensor([[2.0, 0.0], [0.0, -1.5], [0.0, 0.0]], dtype=torch.float64)
    idle = adp.Feedback(lambda x: torch.zeros_like(x[..., :1]))
    for policy in (idle, adp.Feedback(adp.LQR(plant, cost))):
        run = adp.simulate(policy, plant, cost, x0, dt=0.1, steps=80, compile=False)
        adp_experiment.count_the_restless(cost, run)
    (said,) = [record.getMessage() for record in caplog.records if "not regulated" in record.getMessage()]
    assert said.startswith("2 of 3 trajectories are not regulated: in the last quarter of the 8 s")


@pytest.mark.parametrize("points", ["random", "quadrature"])
def test_tracking_learns_at_points_of_either_kind(points: str) -> None:
    cfg = settings("experiment=adp_tracking", f"adp/extrapolation={points}")
    plant, cost = adp.TwoStateTracking(), adp_tracking.tracking_cost(10.0, 1.0)
    learner = adp_tracking._controllers(cfg, plant, cost)["known"]
    assert isinstance(learner, adp.ActorCritic)
    kind = {"random": adp.RandomPoints, "quadrature": adp.QuadraturePoints}[points]
    assert isinstance(learner.extrapolation, kind)


def test_the_optimum_is_sought_over_the_horizon_that_is_stated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    class Heard(reference_optimum.DirectShooting):
        def __init__(self, *given, **named):  # type: ignore[no-untyped-def]
            asked.append(named)
            super().__init__(*given, **named)

    monkeypatch.setattr(reference_optimum, "DirectShooting", Heard)
    lines = (
        "experiment=adp",
        "system=pendulum",
        "adp/policy=lqr",
        "figures=false",
        "adp.optimum.horizon=2.5",
    )
    adp_experiment.ClosedLoop()(settings(*lines, "adp.optimum.intervals=40", *SHORT), tmp_path)
    assert [(named["horizon"], named["intervals"]) for named in asked] == [(2.5, 40)]
