"""The studies of faults, gains, boxes and discs: plants by formulas of their own, and what is claimed."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers import tensor, uniform
from helpers_experiments import ran, run, words

from staf_torch import adp, systems
from staf_torch.experiments import avoidance, faults, icl, safe_box
from staf_torch.experiments.avoidance import AmongDiscs, Vehicle, chosen_vehicle
from staf_torch.experiments.study import Study
from staf_torch.results.run_directory import RunDirectory

KINDS = ("mass", "unicycle")


def test_a_study_has_a_row_metrics_and_a_line_a_method(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    columns = {"method": "method", "a_b": "A", "c": "C", "time": "s"}
    study = Study("both", columns, ("a_b",), logging.getLogger("staf_torch.test"), digits=5)
    study.add("", {"a_b": 1.23456789, "c": None}, {"time": 3.0}, method="mine")
    study.add("other_", {"a_b": math.inf, "c": 2.0}, method="other")
    found = study.write(settings("figures=false"), RunDirectory(tmp_path), pytest.fail)
    assert found == {"a_b": 1.23456789, "c": None, "other_a_b": None, "other_c": 2.0}
    assert caplog.messages[0] == "mine: a b 1.2346"
    assert {path.name for path in tmp_path.iterdir()} == {"both.csv", "both.md", "metrics.json"}


# x' of a state, an input and the parameters theta, by hand.
RATES: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray], list[float]]] = {
    "short_period": lambda x, u, t: [
        t[0] * x[0] + t[1] * x[1] + -0.194 * u[0] * t[4] + -0.03593 * u[1] * t[5],
        t[2] * x[0] + t[3] * x[1] + -19.29 * u[0] * t[4] + -3.803 * u[1] * t[5],
    ],
    "unstable": lambda x, u, t: [x[1], 25 * x[0] + t[0] * u[0] + t[1] * u[1] / 10],
    "mass": lambda x, u, t: [x[1], 9.81 * math.sin(x[0]) + t[0] * (u[0] - 0.1 * x[1])],
}
AFTER = {
    "short_period": [-1.175, 0.9871, -8.458, -0.8776, 0.7, 0.0],
    "unstable": [0.5, 1.0],
    "mass": [2.0],  # 1 / mass
}


@pytest.mark.parametrize("name", RATES)
def test_a_plant_with_a_fault_moves_as_its_text_says_and_is_drawn_by_the_seed_alone(name: str) -> None:
    def made(rows: int) -> faults.FaultCase:
        return faults.CASES[name](rows, torch.Generator().manual_seed(1))

    case = made(4)
    x, u = uniform(5, 2, seed=1), uniform(5, case.model.inputs, seed=2)
    theta = uniform(5, case.model.parameters_count, seed=3)
    expected = tensor([RATES[name](*row) for row in zip(x.numpy(), u.numpy(), theta.numpy(), strict=True)])
    torch.testing.assert_close(case.model.believing(theta).motion(x, u), expected, rtol=1e-12, atol=1e-12)
    assert [len(part) for part in (case.x0, case.before, case.after, case.at)] == [4] * 4
    assert torch.equal(case.x0, made(4).x0)
    assert torch.equal(case.at, made(4).at)
    assert case.after[0].tolist() == AFTER[name]


def test_first_estimates_and_times_of_faults_are_drawn_from_the_intervals_of_the_text() -> None:
    generator = torch.Generator().manual_seed(3)
    drawn, at = faults.short_period(400, generator).adaptive.theta[:, :4], faults.unstable(50, generator).at
    assert -5 <= float(drawn.min()) < -4.9 < 4.9 < float(drawn.max()) <= 5
    assert 0.1 <= float(at.min()) < float(at.max()) <= 0.5


def test_who_knows_the_fault_pays_least_and_the_adaptive_policy_finds_it() -> None:
    unstable, start = ran("faults").metrics, ran("faults from the start").metrics
    worst = [unstable[f"unstable_{name}_cost_max"] for name in ("informed_LQR", "adaptive", "ignorant_LQR")]
    assert worst == sorted(worst)
    assert 0 < unstable["unstable_adaptive_found_median"] < 0.2
    assert start["short_period_adaptive_parameter_error"] < 1e-4
    assert start["short_period_adaptive_ratio_median"] < start["short_period_ignorant_LQR_ratio_median"]
    assert "unstable_adaptive_ratio_median" not in unstable  # whose optimum nobody knows
    methods = {row["method"] for row in ran("faults").rows("faults")}
    assert methods == {"ignorant LQR", "informed LQR", "adaptive"}


def test_the_plant_and_the_reference_of_concurrent_learning_are_the_published_ones() -> None:
    x1, x2, time = 0.3, -1.2, 0.7
    decay, sine, cosine = math.exp(-0.1 * time), math.sin(time), math.cos(time)
    z, u = tensor([[x1, x2, decay, sine, cosine]]), tensor([[0.4, -0.9]])
    first = 5 * x1**2 + 10 * math.sin(x2) + 0.4
    second = 10 * x2 * sine + 15 * x1 + 20 * x1 * x2 - 0.9
    expected = tensor([[first, second, -0.1 * decay, cosine, -sine]])
    torch.testing.assert_close(icl.published().velocity(z, u), expected)
    along = torch.tensor([0.0, 0.7, 12.3], dtype=torch.float64, requires_grad=True)
    clock = torch.stack((along * 0, along * 0, (-0.1 * along).exp(), along.sin(), along.cos()), dim=-1)
    wanted, rate = icl.reference(clock)
    wide = 10 * (1 - (-0.1 * along).exp())
    torch.testing.assert_close(wanted[:, 0], wide * (2 * along).sin())
    torch.testing.assert_close(wanted[:, 1], wide * 0.4 * (3 * along).cos())
    for k in range(2):
        (slope,) = torch.autograd.grad(wanted[:, k].sum(), along, retain_graph=True)
        torch.testing.assert_close(rate[:, k], slope)


def test_integral_and_derivative_have_a_row_each_and_the_better_one_is_counted() -> None:
    result = ran("icl")
    assert [row["method"] for row in result.rows("icl")] == ["integral", "derivative"]
    for what in ("error", "parameter_error"):
        for name in ("integral", "derivative"):
            best, middle, worst = (result.metrics[f"{name}_{what}_{k}"] for k in ("best", "median", "worst"))
            assert 0 < best <= middle <= worst
        assert 3 * result.metrics[f"integral_better_{what}"] in range(4)


def test_in_the_box_only_the_policies_of_barrier_coordinates_stay_where_a_control_can(tmp_path: Path) -> None:
    result = ran("safe_box")
    metrics = result.metrics
    assert metrics["constraint_violations"] == 0
    assert metrics["lqr_of_s_filtered_cost"] == pytest.approx(metrics["cost"], rel=1e-3)
    assert metrics["lqr_of_s_filtered_left_near_fraction"] == metrics["left_near_unavoidable_fraction"]
    assert metrics["lqr_of_s_filtered_renewed_left_near_fraction"] == 0
    assert metrics["lqr_of_x_filtered_cost"] == metrics["lqr_of_x_cost"]  # bit for bit: no wall is near
    assert len(result.rows("safe_box")) == 5
    with np.load(result.directory / "history.npz") as history:
        assert float(history["margin"].min()) == pytest.approx(metrics["minimum_margin"])
    with pytest.raises(ValueError, match=r"must lie strictly between the walls .* not so row 0"):
        run(tmp_path, *words("safe_box"), "safe_box.low=[-6,-5]")


def test_every_method_in_the_box_pays_for_the_barrier_coordinates() -> None:
    box = systems.Barrier(systems.TwoState(), low=[-7.0, -5.0], high=[5.0, 7.0])
    cost = adp.QuadraticCost([1.0, 2.0], 0.5, dim=2, inputs=1)
    cfg = settings("experiment=safe_box", "safe_box.filter=false")
    x, u = uniform(4, 2, low=-4, high=4, seed=1), uniform(4, 1, seed=2)
    paid = (box.coordinates(x).square() * tensor([1.0, 2.0])).sum(-1) + 0.5 * u[:, 0] ** 2
    for method in safe_box.methods(cfg, box, cost).values():
        at = box.coordinates(x) if method.plant is box else x
        torch.testing.assert_close(method.cost.rate(at, u), paid, rtol=1e-9, atol=1e-9)


def made(kind: str, *more: str) -> tuple[Any, Vehicle]:
    cfg = settings("experiment=avoidance", f"avoidance.vehicle={kind}", *more)
    return cfg, chosen_vehicle(cfg, 0.1)


def test_a_mass_is_pushed_by_the_lqr_of_the_sampled_double_integrator() -> None:
    _, one = made("mass", "avoidance.bound=3", "adp.q=2", "adp.r=0.5")
    x, u = uniform(5, 4, low=-0.2, high=0.2, seed=3), uniform(5, 2, seed=2)
    torch.testing.assert_close(one.rate(x, u), torch.cat((x[:, 2:], u), dim=-1))
    one_axis = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    lqr = adp.LQR(one_axis, adp.QuadraticCost(2.0, 0.5, dim=2, inputs=1), period=0.1)
    wanted = torch.cat([lqr(x[:, axis::2]) for axis in range(2)], dim=-1)
    torch.testing.assert_close(one.policy(x), wanted, rtol=1e-6, atol=1e-9)
    assert float(one.policy(1e3 * x).abs().max()) == 3.0  # within its bounds


def test_a_unicycle_drives_along_its_heading_and_its_point_ahead_goes_straight_home() -> None:
    _, one = made("unicycle", "avoidance.bound=3", "avoidance.ahead=0.5")
    assert (one.size, one.bounds, one.reach) == (3, (3.0, 6.0), 0.5)
    x = uniform(4, 3, low=-3, high=3, seed=1)
    heading = torch.stack((x[:, 2].cos(), x[:, 2].sin()), -1)
    rate = one.rate(x, tensor([[2.0, -0.7]]).expand(4, 2))
    torch.testing.assert_close(rate, torch.cat((2 * heading, torch.full((4, 1), -0.7).double()), -1))
    torch.testing.assert_close(one.point(x), x[:, :2] + 0.5 * heading)
    moved = x + 1e-6 * one.rate(x, one.policy(x))
    torch.testing.assert_close((one.point(moved) - one.point(x)) / 1e-6, -one.point(x), rtol=1e-5, atol=1e-5)


def test_scenarios_begin_at_rest_on_a_circle_clear_of_the_discs() -> None:
    cfg, _ = made("unicycle", "trajectories=300", "avoidance.discs=2", "avoidance.speed=0.7")
    x0 = avoidance.scenarios(cfg)
    assert x0.equal(avoidance.scenarios(cfg))
    away = torch.full((300,), float(cfg.avoidance.distance), dtype=torch.float64)
    torch.testing.assert_close(x0[:, :2].norm(dim=-1), away)
    assert 2 * math.pi - 0.1 < float(x0[:, 2].max() - x0[:, 2].min()) < 2 * math.pi
    discs = x0[:, 3:].reshape(300, 2, 4)
    for part, wide in ((discs[..., :2], 2.0), (discs[..., 2:], 0.7)):
        assert 0.97 * wide < float(part.abs().max()) <= wide
    assert float(avoidance.distance(x0, cfg.avoidance.radius, 3).min()) > 0.6
    assert avoidance.scenarios(made("mass", "trajectories=2")[0])[:, 2:4].abs().max() == 0  # at rest
    with pytest.raises(ValueError, match="must leave room for a start"):
        avoidance.scenarios(made("mass", "avoidance.radius=9", "trajectories=1")[0])


@pytest.mark.parametrize("kind", KINDS)
def test_discs_move_straight_on_and_neither_their_state_nor_their_speed_is_paid_for(kind: str) -> None:
    cfg, one = made(kind, "adp.q=2", "adp.r=0.5", "avoidance.ahead=0.25", "avoidance.bound=3")
    plant = AmongDiscs(one, 2)
    x, u = uniform(4, one.size + 8, seed=1), uniform(4, 2, seed=2)
    own, discs = x[:, : one.size], x[:, one.size :].reshape(4, 2, 4)
    still = torch.zeros(4, 2, 2).double()
    expected = torch.cat((one.rate(own, u), torch.cat((discs[..., 2:], still), -1).flatten(1)), dim=-1)
    torch.testing.assert_close(plant.motion(x, u), expected)
    affine = plant.drift(x) + (plant.effectiveness(x) * u.unsqueeze(1)).sum(-1)
    torch.testing.assert_close(affine, expected)
    cost = avoidance.vehicle_cost(cfg, one, one.size + 8)
    paid = own if kind == "mass" else one.point(own)
    torch.testing.assert_close(cost.rate(x, u), 2 * paid.square().sum(-1) + 0.5 * u.square().sum(-1))
    assert cost.bounds.high.tolist() == list(one.bounds)
    reach = 0.25 if kind == "unicycle" else 0.0
    for k in range(2):
        clear = (one.point(own) - discs[:, k, :2]).square().sum(-1) - (0.4 + reach) ** 2
        torch.testing.assert_close(avoidance.apart(one, k, 0.4)(x, torch.zeros(4)), clear)
    nearest = torch.stack([(x[:, :2] - discs[:, k, :2]).norm(dim=-1) for k in range(2)]).amin(0)
    torch.testing.assert_close(avoidance.distance(x, 0.4, one.size), nearest - 0.4)


def test_behind_the_filter_a_unicycle_keeps_off_the_discs_that_its_policy_drives_into() -> None:
    result = ran("avoidance of a unicycle")
    metrics = result.metrics
    assert metrics["constraint_violations"] == 0 < metrics["lookahead_constraint_violations"]
    assert metrics["minimum_margin"] > 0 > metrics["lookahead_minimum_margin"]
    plane, apart, share, cost = result.figures[0].axes
    labels = [line.get_label() for line in apart.get_lines()[:2]]
    assert labels == ["lookahead, filtered", "lookahead"]
    with np.load(result.directory / "history.npz") as history:
        assert float(history["distance"].min()) == pytest.approx(metrics["minimum_margin"])
        # What is drawn is a scenario in which the bare policy comes nearest.
        row = int(np.argmin(np.abs(history["distance"] - apart.get_lines()[0].get_ydata()).sum(1)))
        assert row == int(np.argmin(history["lookahead_distance"].min(1)))
        np.testing.assert_allclose(apart.get_lines()[1].get_ydata(), history["lookahead_distance"][row])
        np.testing.assert_allclose(cost.get_lines()[0].get_ydata(), history["running_cost"][row])
        np.testing.assert_allclose(plane.get_lines()[0].get_xydata(), history["state"][row, :, :2])
        np.testing.assert_allclose(
            np.sort(history["distance"].min(1)), share.get_lines()[0].get_xdata(), rtol=1e-12
        )
