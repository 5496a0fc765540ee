"""The experiments with constraints end to end, short."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from composing import settings

from staf_torch import systems
from staf_torch.experiments import avoidance, safe_box
from staf_torch.experiments.vehicles import vehicle

FEW = ("safe_box.states=4", "safe_box.decay=20", "safe_box.followed=0.01", "safe_box.substeps=4")
SHORT = ("duration=0.02", "dt=0.01", "trajectories=2", "adp.optimum.shooting=false", "adp.compile=false")


def test_the_box_has_a_row_a_method_and_keeps_what_starts_inside(tmp_path: Path) -> None:
    cfg = settings("experiment=safe_box", *SHORT, *FEW, "figures=false")
    metrics = safe_box.run(cfg, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert metrics["constraint_violations"] == 0
    assert metrics["minimum_margin"] > 0.05
    assert metrics["optimal_cost"] is None
    assert metrics["lqr_of_s_filtered_cost"] == pytest.approx(metrics["cost"], rel=1e-3)
    assert metrics["lqr_of_s_filtered_left_near_fraction"] == metrics["left_near_unavoidable_fraction"]
    assert (
        metrics["lqr_of_s_filtered_renewed_left_near_fraction"] == metrics["left_unavoidable_fraction"] == 0
    )
    assert metrics["lqr_of_x_filtered_cost"] == metrics["lqr_of_x_cost"]  # bit for bit: no wall is near
    assert len((tmp_path / "safe_box.csv").read_text().splitlines()) == 6
    with np.load(tmp_path / "history.npz") as history:
        assert history["state"].shape == history["barrier_state"].shape == (2, 3, 2)
        assert float(history["margin"].min()) == pytest.approx(metrics["minimum_margin"])


def test_a_start_outside_the_box_is_refused_by_its_row(tmp_path: Path) -> None:
    cfg = settings("experiment=safe_box", *SHORT, *FEW, "safe_box.low=[-6,-5]")
    with pytest.raises(ValueError, match=r"must lie strictly between the walls .* not so row 0"):
        safe_box.run(cfg, tmp_path)


def test_among_discs_the_filter_has_a_row_beside_the_lqr_and_a_film(tmp_path: Path) -> None:
    short = (
        "duration=0.5",
        "dt=0.1",
        "trajectories=3",
        "adp.compile=false",
        "animation=gif",
        "figures=false",
        "avoidance.discs=2",
    )
    cfg = settings("experiment=avoidance", *short)
    metrics = avoidance.run(cfg, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert metrics["constraint_violations"] == metrics["lqr_constraint_violations"] == 0
    assert metrics["cost"] >= 0.99 * metrics["lqr_cost"]
    assert len((tmp_path / "avoidance.csv").read_text().splitlines()) == 3
    assert (tmp_path / "figures" / "avoidance.gif").stat().st_size > 5000
    with np.load(tmp_path / "history.npz") as history:
        assert history["state"].shape == (3, 6, 12)
        assert float(history["distance"].min()) == pytest.approx(metrics["minimum_margin"])


def test_a_unicycle_keeps_off_the_discs_that_its_policy_drives_into(tmp_path: Path) -> None:
    short = ("duration=4", "dt=0.2", "trajectories=6", "figures=false", "history=false", "adp.compile=false")
    cfg = settings("experiment=avoidance", "avoidance.vehicle=unicycle", "avoidance.discs=2", *short)
    metrics = avoidance.run(cfg, tmp_path)
    assert metrics["constraint_violations"] == 0 < metrics["lookahead_constraint_violations"]
    assert metrics["minimum_margin"] > 0 > metrics["lookahead_minimum_margin"]
    with pytest.raises(ValueError, match="vehicle"):
        avoidance.run(settings("experiment=avoidance", "avoidance.vehicle=tram"), tmp_path)


def test_the_point_ahead_of_a_unicycle_goes_straight_to_the_origin() -> None:
    one = vehicle(settings("experiment=avoidance", "avoidance.vehicle=unicycle"), 0.02)
    x = torch.tensor([[1.0, -2.0, 0.7], [0.1, 0.3, -2.0]], dtype=torch.float64)
    moved = x + 1e-6 * one.rate(x, one.policy(x))
    torch.testing.assert_close((one.point(moved) - one.point(x)) / 1e-6, -one.point(x), rtol=1e-5, atol=1e-5)


def test_scenarios_begin_clear_of_the_discs_and_are_the_same_again() -> None:
    cfg = settings("experiment=avoidance", "trajectories=50")
    x0 = avoidance.scenarios(cfg)
    assert x0.shape == (50, 16)
    assert float(avoidance.distance(x0, 0.4).min()) > 0.6
    assert float(x0[:, 6:8].abs().max()) <= 0.3
    away = settings("experiment=avoidance").avoidance.distance
    torch.testing.assert_close(x0[:, :2].norm(dim=-1), torch.full((50,), away, dtype=torch.float64))
    assert bool((x0[:, :2].amin(0) < -0.9 * away).all())  # from all sides
    assert bool((x0[:, :2].amax(0) > 0.9 * away).all())
    assert x0.equal(avoidance.scenarios(cfg))
    with pytest.raises(ValueError, match="must leave room for a start"):
        avoidance.scenarios(settings("experiment=avoidance", "avoidance.radius=9", "trajectories=1"))


def test_starts_beside_walls_are_beside_one_each() -> None:
    cfg = settings("experiment=safe_box", "safe_box.states=200", "safe_box.near=1e-5")
    low, high = torch.tensor([-1.0, -2.0]), torch.tensor([0.5, 3.0])
    box = systems.Barrier(systems.TwoState(), low=low.tolist(), high=high.tolist())
    x = safe_box._beside_walls(cfg, box)
    apart = torch.stack((x - box.low, box.high - x)).abs()  # (2, B, n)
    beside = (apart - 1e-5).abs() < 1e-12
    assert beside.sum((0, 2)).tolist() == [1] * 200
    assert bool((beside.sum(1) > 20).all())  # every wall has some
