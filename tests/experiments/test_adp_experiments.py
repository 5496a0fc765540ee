"""Closed loops: alone and in batches, methods and laws beside each other, and a drift that is identified."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from composing import settings
from helpers import tensor
from helpers_experiments import ran, run

from staf_torch import adp, systems
from staf_torch.experiments import adp_comparison
from staf_torch.experiments.adp import count_the_restless, held_radius
from staf_torch.settings.adp import adp_problem

SHORT = ("experiment=adp", "duration=0.1", "dt=0.005", "figures=false")


@pytest.mark.parametrize(
    "overrides",
    [
        ["adp/policy=none", "trajectories=3", "system=two_state_as_printed", "adp.optimum.shooting=false"],
        [
            "adp/basis=rbf_grid",
            "adp.rbf_grid.points=3",
            "dt=0.02",
            "adp/extrapolation=quadrature",
            "adp.order=3",
        ],
        ["adp/policy=lqr", "system=pendulum", "adp.optimum.horizon=2.5", "adp.optimum.intervals=40"],
        ["experiment=adp_three_state", "duration=0.02", "adp.optimum.shooting=false"],
    ],
    ids=" ".join,
)
def test_a_closed_loop_has_its_cost_beside_the_optimum_and_a_history(
    overrides: list[str], tmp_path: Path
) -> None:
    metrics = run(tmp_path, *SHORT, *overrides).metrics
    assert metrics["diverged_fraction"] == 0
    if "adp.optimum.shooting=false" in overrides:
        assert metrics["optimal_cost"] is metrics["cost_ratio"] is None
    else:  # by formula or by shooting, there is an optimum for every plant
        assert metrics["cost_ratio"] == pytest.approx(metrics["cost"] / metrics["optimal_cost"])
        assert min(metrics[name] for name in ("optimal_cost", "control_error", "value_error")) >= 0
    with np.load(tmp_path / "history.npz") as history:
        batch, times = history["state"].shape[:2]
        assert history["time"].shape == (times,)
        for name in ("control", "actor_weights", "critic_weights", "running_cost"):
            assert history[name].shape[:2] == (batch, times)


def test_walls_have_metrics_of_their_own_and_a_run_says_what_is_not_as_printed(tmp_path: Path) -> None:
    walls = ("adp/policy=lqr", "adp.walls.low=[-6,-6]", "adp.walls.high=[6,6]", "adp.walls.decay=1.0")
    found = run(tmp_path, *SHORT, *walls, "duration=0.01", "history=false")
    assert found.metrics["wall_constraint_violations"] == 0
    assert 0 <= found.metrics["wall_acted"] <= 1
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]
    assert "not as the paper prints it" not in found.log
    learned = ran("adp")
    assert not any(name.startswith("wall_") for name in learned.metrics)
    assert "adp.law Information (print: Published)" in learned.log
    assert "experiment=adp_as_printed" in learned.log
    printed = ("experiment=adp_as_printed", "duration=0.004", "dt=0.002", "adp.optimum.shooting=false")
    assert "not as the paper prints it" not in run(tmp_path, *printed, "figures=false").log


def test_the_held_radius_is_that_of_the_linear_loop_with_its_gain() -> None:
    cfg = settings(*SHORT, "adp/policy=lqr", "system=linear", "dt=0.1", "duration=0.2")
    cfg.system.matrix, cfg.system.input_matrix = [[0.0, 1.0], [-2.0, 0.0]], [[0.0], [1.0]]
    problem = adp_problem(cfg)
    result = adp.simulate(
        problem.controller, problem.system, problem.cost, problem.initial_states, dt=0.1, steps=2
    )
    gain = -problem.controller.step(
        torch.eye(2).double(), problem.controller.init(torch.eye(2).double()), torch.zeros(2, 0, 2), 0.1
    )[0]
    a = torch.tensor([[0.0, 1.0, 0.0], [-2.0, 0.0, 1.0], [0.0, 0.0, 0.0]]).double()
    held = torch.linalg.matrix_exp(0.1 * a)
    closed = held[:2, :2] - held[:2, 2:] @ gain.T
    expected = float(torch.linalg.eigvals(closed).abs().max())
    assert held_radius(problem, result) == pytest.approx(expected, rel=1e-6)


def test_trajectories_that_do_not_come_to_rest_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    plant, cost = systems.VanDerPol(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    x0 = tensor([[2.0, 0.0], [0.0, -1.5], [0.0, 0.0]])
    idle = adp.Feedback(lambda x: torch.zeros_like(x[..., :1]))
    count_the_restless(cost, adp.simulate(idle, plant, cost, x0, dt=0.1, steps=80, compile=False))
    (said,) = [line for line in caplog.messages if "not regulated" in line]
    assert said.startswith("2 of 3 trajectories are not regulated: in the last quarter of the 8 s")


def test_the_figure_of_a_loop_shows_the_first_trajectory_and_the_optimal_cost() -> None:
    result = ran("adp")
    panels = {axes.get_ylabel(): axes for axes in result.figures[0].axes if axes.get_visible()}
    so_far, optimal = panels["cost"].get_lines()
    with np.load(result.directory / "history.npz") as history:
        drawn = panels["state $x$"].get_lines()[0].get_ydata()
        np.testing.assert_array_equal(so_far.get_ydata(), history["running_cost"][0])
        np.testing.assert_array_equal(drawn, history["state"][0, :, 0])
    assert 0 < optimal.get_ydata()[0] < so_far.get_ydata()[-1] * 10


def test_every_method_runs_from_the_same_states_without_the_equilibrium() -> None:
    rows = {row["method"]: row for row in ran("adp_comparison").rows("comparison")}
    assert len(rows) == 12
    assert rows["LQR"]["functions"] == rows["LQR"]["points"] == "0"
    assert int(rows["StaF, information, quadrature"]["points"]) > int(rows["StaF, no learning"]["points"])
    cfg = settings("experiment=adp_comparison", "dt=0.01", "duration=0.1", "trajectories=4")
    first, published = (adp_comparison.variant(cfg, law) for law in ({}, {"law": "published"}))
    assert (first.dt, first.every, published.dt) == (0.01, first.steps, 0.001)
    assert torch.equal(first.initial_states, published.initial_states)
    assert first.initial_states.norm(dim=-1).gt(0).tolist() == [True] * 4


def test_the_published_law_diverges_from_large_initial_weights_and_the_supervised_does_not() -> None:
    found = ran("adp_initial_weights").metrics
    assert found["supervised_diverged_fraction"] == 0 < found["published_diverged_fraction"]
    header = "law,W0 = 0.1,W0 = 1,all"
    assert (ran("adp_initial_weights").directory / "adp_initial_weights.csv").read_text().startswith(header)


def test_an_identified_drift_comes_nearer_to_the_true_one() -> None:
    pytest.importorskip("scipy", reason="the optimum is a Riccati equation's")
    result = ran("adp_tracking")
    found = result.metrics
    assert found["optimal_cost"] == pytest.approx(1.4223, abs=1e-3)
    assert found["identified_parameter_error"] < found["unidentified_parameter_error"]
    with np.load(result.directory / "history.npz") as history:
        panels = result.figures[0].axes
        drawn = [line.get_ydata() for line in panels[2].get_lines()[:6]]
        np.testing.assert_allclose(np.stack(drawn, -1), history["parameters"].reshape(31, 6))
        x, desired = (line.get_ydata() for line in panels[0].get_lines()[:2])
        np.testing.assert_allclose(x - desired, history["state"][0, :, 0], atol=1e-12)


def test_a_plant_without_inputs_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"`staf system=...` must be a plant with inputs; got 'Oscillator'"):
        run(tmp_path, "experiment=adp", "system=oscillator")
    assert not list(tmp_path.iterdir())
