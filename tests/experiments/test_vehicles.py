"""Vehicles among discs by formulas of their own: how they move, what is safe, paid, shown and told."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers import tensor, uniform
from helpers_experiments import made_of
from recorded import Record
from torch import Tensor

from staf_torch import adp
from staf_torch.experiments import avoidance
from staf_torch.experiments.avoidance import AmongDiscs
from staf_torch.experiments.vehicles import Vehicle, vehicle

KINDS = ("mass", "unicycle")


def cfg_of(kind: str, *more: str) -> Any:
    return settings("experiment=avoidance", f"avoidance.vehicle={kind}", *more)


def made(kind: str, *more: str) -> Vehicle:
    return vehicle(cfg_of(kind, *more), 0.1)


def test_a_mass_is_pushed_by_the_lqr_that_is_made_for_the_period() -> None:
    one = made("mass", "avoidance.bound=3", "adp.q=2", "adp.r=0.5")
    x, u = uniform(5, 4, seed=1), uniform(5, 2, seed=2)
    torch.testing.assert_close(one.rate(x, u), torch.cat((x[:, 2:], u), dim=-1))
    assert torch.equal(one.point(x), x[:, :2])
    assert (one.label, one.size, one.bounds, one.reach) == ("LQR", 4, (3.0, 3.0), 0.0)
    # One axis alone: P of the Riccati equation of the sampled double integrator, by iteration.
    h = 0.1
    a, b = np.array([[1, h], [0, 1]]), np.array([[h * h / 2], [h]])
    p, k = np.zeros((2, 2)), np.zeros((1, 2))
    big = np.zeros((4, 4))  # of the integral of the cost over a period with the control held
    nodes, weights = np.polynomial.legendre.leggauss(6)
    for node, weight in zip(nodes, weights, strict=True):
        t = h * (node + 1) / 2
        z = np.array([[1, t, t * t / 2], [0, 1, t]])
        big[:3, :3] += h * weight / 2 * (2.0 * z.T @ z)
    big[2, 2] += h * 0.5
    q, cross, r = big[:2, :2], big[:2, 2:3], big[2:3, 2:3]
    for _ in range(5000):
        k = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a + cross.T)
        p = q + a.T @ p @ a - (a.T @ p @ b + cross) @ k
    x = uniform(5, 4, low=-0.2, high=0.2, seed=3)
    expected = -(x[:, :2] * k[0, 0] + x[:, 2:] * k[0, 1])
    torch.testing.assert_close(one.policy(x), expected, rtol=1e-6, atol=1e-9)
    assert float(one.policy(1e3 * x).abs().max()) == 3.0  # within its bounds


def test_a_unicycle_drives_along_its_heading_and_steers_the_point_ahead_of_it() -> None:
    one = made("unicycle", "avoidance.bound=3", "avoidance.ahead=0.5")
    assert (one.label, one.size, one.bounds, one.reach) == ("lookahead", 3, (3.0, 6.0), 0.5)
    for row in uniform(4, 3, low=-3, high=3, seed=1):
        x1, x2, heading = row.tolist()
        e1, e2 = math.cos(heading), math.sin(heading)
        rate = one.rate(row.unsqueeze(0), tensor([[2.0, -0.7]]))
        torch.testing.assert_close(rate, tensor([[2 * e1, 2 * e2, -0.7]]))
        point = [x1 + 0.5 * e1, x2 + 0.5 * e2]
        torch.testing.assert_close(one.point(row), tensor(point))
        forward, turning = one.policy(row).tolist()
        # The point moves by v e + ahead w e', and that is straight to the origin.
        assert forward * e1 - 0.5 * turning * e2 == pytest.approx(-point[0])
        assert forward * e2 + 0.5 * turning * e1 == pytest.approx(-point[1])


@pytest.mark.parametrize("kind", KINDS)
def test_a_vehicle_and_its_scenarios_are_the_recorded_ones(kind: str, record: Record) -> None:
    cfg = cfg_of(kind, "trajectories=6", "avoidance.discs=2", "seed=4")
    one = vehicle(cfg, 0.02)
    x0 = avoidance.scenarios(cfg)
    assert x0.dtype == torch.float64
    assert x0.shape == (6, one.size + 8)
    record(made_of({"vehicle": one, "scenarios": x0, "rate": one.rate(x0[:, : one.size], x0[:, -2:])}))


def test_scenarios_are_drawn_from_a_square_at_speeds_up_to_one_and_any_heading() -> None:
    cfg = cfg_of("unicycle", "trajectories=300", "avoidance.discs=2", "avoidance.speed=0.7")
    x0 = avoidance.scenarios(cfg)
    assert 0 <= float(x0[:, 2].min()) < 0.1
    assert 2 * math.pi - 0.1 < float(x0[:, 2].max()) < 2 * math.pi
    discs = x0[:, 3:].reshape(300, 2, 4)
    for part, wide in ((discs[..., :2], 2.0), (discs[..., 2:], 0.7)):
        assert 0.97 * wide < float(part.max()) <= wide
        assert -wide <= float(part.min()) < -0.97 * wide
    clear = cfg.avoidance.radius + 0.6
    apart = (discs[..., :2] - x0[:, None, :2]).norm(dim=-1)
    assert clear < float(apart.min()) < clear + 0.1
    assert avoidance.scenarios(cfg_of("mass", "trajectories=1", "avoidance.discs=1")).shape == (1, 8)
    mass = avoidance.scenarios(cfg_of("mass", "trajectories=2"))
    assert mass[:, 2:4].abs().max() == 0  # at rest
    assert not torch.equal(mass, avoidance.scenarios(cfg_of("mass", "trajectories=2", "seed=9")))


def test_as_many_discs_are_tried_as_are_stated_before_none_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[int] = []
    rand = torch.rand

    def counted(*size: int, **named: Any) -> Tensor:
        drawn.append(1)
        return rand(*size, **named)

    cfg = cfg_of("mass", "trajectories=2", "avoidance.radius=50")
    monkeypatch.setattr(avoidance, "_DRAWS", 7)
    monkeypatch.setattr(avoidance.torch, "rand", counted)
    with pytest.raises(ValueError, match=r"`staf avoidance.discs=...` must leave room .* of radius 50"):
        avoidance.scenarios(cfg)
    assert len(drawn) == 2 * 7 * 2


@pytest.mark.parametrize("kind", KINDS)
def test_discs_move_straight_on_beside_the_vehicle(kind: str) -> None:
    one = made(kind)
    plant = AmongDiscs(one, 2)
    assert (plant.dim, plant.inputs) == (one.size + 8, 2)
    x, u = uniform(4, one.size + 8, seed=1), uniform(4, 2, seed=2)
    own, discs = x[:, : one.size], x[:, one.size :].reshape(4, 2, 4)
    still = torch.zeros(4, 2, 2).double()
    expected = torch.cat((one.rate(own, u), torch.cat((discs[..., 2:], still), -1).flatten(1)), dim=-1)
    for found in (plant.rate(x, u), plant.motion(x, u)):
        torch.testing.assert_close(found, expected)
    affine = plant.drift(x) + (plant.effectiveness(x) * u.unsqueeze(1)).sum(-1)
    torch.testing.assert_close(affine, expected)
    torch.testing.assert_close(plant.rate(x[0], u[0]), expected[0])
    assert plant.effectiveness(x.float()).dtype == torch.float32


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_safe_what_is_paid_and_what_is_rest(kind: str) -> None:
    one = made(kind, "avoidance.ahead=0.25")
    x = uniform(6, one.size + 8, seed=3)
    own, discs = x[:, : one.size], x[:, one.size :].reshape(6, 2, 4)
    reach = 0.25 if kind == "unicycle" else 0.0
    for k in range(2):
        expected = (one.point(own) - discs[:, k, :2]).square().sum(-1) - (0.4 + reach) ** 2
        torch.testing.assert_close(avoidance.apart(one, k, 0.4)(x, torch.zeros(6)), expected)
    nearest = torch.stack([(x[:, :2] - discs[:, k, :2]).norm(dim=-1) for k in range(2)]).amin(0)
    torch.testing.assert_close(avoidance.distance(x, 0.4, one.size), nearest - 0.4)
    cfg = cfg_of(kind, "adp.q=2", "adp.r=0.5", "avoidance.ahead=0.25", "avoidance.bound=3")
    cost = avoidance.vehicle_cost(cfg, vehicle(cfg, 0.1), one.size + 8)
    u = uniform(6, 2, seed=4)
    paid = own if kind == "mass" else one.point(own)
    torch.testing.assert_close(cost.rate(x, u), 2 * paid.square().sum(-1) + 0.5 * u.square().sum(-1))
    assert (cost.dim, cost.inputs) == (one.size + 8, 2)
    assert cost.bounds is not None
    assert cost.bounds.high.tolist() == [3.0, 3.0 if kind == "mass" else 12.0]
    assert cost.bounds.low.tolist() == [-3.0, -3.0 if kind == "mass" else -12.0]
    far = torch.cat((one.point(own), own[:, 2:] if kind == "mass" else own[:, :0]), dim=-1)
    torch.testing.assert_close(avoidance._still(one, x), far.norm(dim=-1))


def test_distances_are_of_a_mass_by_default() -> None:
    x = tensor([[0.0, 0.0, 9.0, 9.0, 3.0, 4.0, 0.0, 0.0]])
    assert float(avoidance.distance(x, 1.0)) == 4.0


def test_the_scenario_that_is_shown_is_one_in_which_the_bare_policy_collides_and_the_filter_is_nearest() -> (
    None
):
    bare = tensor([[1.0, 0.1], [0.5, -0.1], [-0.2, 1.0], [0.0, 2.0]])
    filtered = tensor([[0.01, 0.01], [0.9, 0.3], [0.2, 0.8], [0.0, 0.0]])
    both = {avoidance.FILTERED: filtered, avoidance.BARE: bare}
    assert avoidance._telling(both) == 2
    assert avoidance._telling({**both, avoidance.BARE: bare.abs()}) == 3  # none collides: the nearest of all
    assert avoidance._telling({**both, avoidance.FILTERED: -filtered}) == 1


def result_of(one: Vehicle, times: int, seed: int) -> Any:
    return SimpleNamespace(
        time=0.1 * torch.arange(times).double(),
        state=uniform(3, times, one.size + 8, seed=seed),
        control=uniform(3, times, 2, seed=seed + 1),
        running_cost=uniform(3, times, low=0, seed=seed + 2),
        cost=tensor([1.0, 2.0, 6.0]),
        diverged=torch.zeros(3, dtype=torch.bool),
    )


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_drawn_is_of_the_chosen_scenario(kind: str) -> None:
    one = made(kind)
    results = {"filtered": result_of(one, 100, 1), "bare": result_of(one, 100, 5)}
    distances = {name: avoidance.distance(each.state, 0.4, one.size) for name, each in results.items()}
    drawn = avoidance._drawn(one, results, distances, 2, 0.4)
    names = {"filtered": f"{one.label}, filtered", "bare": one.label}
    np.testing.assert_array_equal(drawn.time, results["filtered"].time.numpy())
    discs = results["filtered"].state[2, :, one.size :].reshape(100, 2, 4)[..., :2]
    np.testing.assert_array_equal(drawn.discs, discs.numpy())
    assert drawn.radius == 0.4
    for key, label in names.items():
        np.testing.assert_array_equal(drawn.paths[label], results[key].state[2, :, :2].numpy())
        np.testing.assert_array_equal(drawn.distances[label], distances[key][2].numpy())
        np.testing.assert_array_equal(drawn.costs[label], results[key].running_cost[2].numpy())
        np.testing.assert_array_equal(drawn.nearest[label], distances[key].amin(-1).numpy())
    scene = avoidance._scene(one, results, distances, 2, 0.4)
    at = [round(66 * k / 59) for k in range(60)]  # two thirds of the time
    np.testing.assert_allclose(scene.time, 0.1 * np.array(at))
    np.testing.assert_array_equal(scene.state, drawn.paths[names["filtered"]][at])
    np.testing.assert_array_equal(scene.followed, drawn.paths[names["bare"]][at])
    np.testing.assert_array_equal(scene.discs[..., :2], drawn.discs[at])
    assert scene.discs.shape == (60, 2, 3)
    assert (scene.discs[..., 2] == 0.4).all()
    both = np.stack([drawn.distances[names[key]][at] for key in ("filtered", "bare")], axis=1)
    np.testing.assert_array_equal(scene.curves[1], both)
    assert (scene.centers.shape, scene.radius.tolist()) == ((60, 0, 2), [0.0] * 60)
    assert scene.along.tolist() == [-1.0, 1.0]
    assert scene.value is scene.estimate is scene.grid is None
    few = {name: result_of(one, 4, 1) for name in results}
    apart = {name: avoidance.distance(each.state, 0.4, one.size) for name, each in few.items()}
    assert avoidance._scene(one, few, apart, 0, 0.4).time.tolist() == pytest.approx([0.0, 0.1, 0.2])


@pytest.mark.parametrize("kind", KINDS)
def test_the_filter_and_the_bare_policy_have_the_same_plant_cost_and_starts(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[Any] = []
    pictures: list[Any] = []

    class Guard:
        def __init__(self, policy: Any, plant: Any, kept: Any, **named: Any) -> None:
            asked.append((policy, plant, kept, named))

        def to(self, device: object) -> Guard:
            return self

        def report(self, result: object) -> dict[str, Any]:
            return {"infeasible": list(range(1, 23)), "acted": 0.25}

    def simulate(controller: Any, plant: Any, cost: Any, x0: Tensor, **named: Any) -> Any:
        asked.append((controller, plant, cost, x0, named))
        found = result_of(one, 5, 1 if isinstance(controller, Guard) else 5)
        found.state[:, :, :2] *= 1 if isinstance(controller, Guard) else 0.5
        return found

    monkeypatch.setattr(avoidance, "SafetyFilter", Guard)
    monkeypatch.setattr(avoidance, "simulate", simulate)
    monkeypatch.setattr(avoidance, "draw_avoidance", lambda drawn: pictures.append(drawn))
    monkeypatch.setattr(avoidance, "images", lambda figure: {"txt": b"drawn"})
    monkeypatch.setattr(avoidance, "animate", lambda scene, kind: {"gif": kind.encode()})
    caplog.set_level("INFO")
    given = ("trajectories=3", "avoidance.discs=2", "dt=0.1", "duration=0.4", "avoidance.decay=0.3")
    cfg = cfg_of(kind, *given, "animation=gif", "avoidance.margin=0.01", "adp.compile=false")
    one = vehicle(cfg, 0.1)
    found = avoidance.run(cfg, tmp_path)
    (policy, plant, kept, named), *runs = asked
    assert named == {
        **{"dt": 0.1, "decay": 0.3, "margin": 0.01},
        **{"low": [-bound for bound in one.bounds], "high": list(one.bounds)},
    }
    x = uniform(4, one.size + 8, seed=8)
    torch.testing.assert_close(policy(x), one.policy(x[:, : one.size]))
    for k, constraint in enumerate(kept):
        expected = avoidance.apart(one, k, cfg.avoidance.radius)(x, torch.zeros(4))
        torch.testing.assert_close(constraint(x, torch.zeros(4)), expected)
    assert len(kept) == 2
    (guard, *first), (bare, *second) = runs
    assert isinstance(guard, Guard)
    assert isinstance(bare, adp.Feedback)
    torch.testing.assert_close(bare.policy(x), one.policy(x[:, : one.size]))
    assert first[0] is second[0] is plant
    assert torch.equal(first[2], avoidance.scenarios(cfg))
    assert torch.equal(first[2], second[2])
    assert first[3] == second[3] == {"dt": 0.1, "steps": 4, "compile": False}
    results = {"": result_of(one, 5, 1), f"{one.label.lower()}_": result_of(one, 5, 5)}
    results[f"{one.label.lower()}_"].state[:, :, :2] *= 0.5
    for prefix, result in results.items():
        apart = avoidance.distance(result.state, cfg.avoidance.radius, one.size)
        assert found[f"{prefix}minimum_margin"] == pytest.approx(float(apart.min()))
        assert found[f"{prefix}constraint_violations"] == float((apart.amin(1) < 0).sum())
        assert (found[f"{prefix}cost"], found[f"{prefix}cost_mean"]) == (2.0, 3.0)
        last = avoidance._still(one, result.state[:, -1])
        assert found[f"{prefix}final_state_norm"] == pytest.approx(float(last.median()))
    assert (found["infeasible"], found["acted"]) == (22.0, 0.25)
    assert f"{one.label.lower()}_infeasible" not in found
    lines = [line for line in caplog.messages if line.startswith("scenario")]
    assert lines == [f"scenario {k}: at a time no admissible control met the condition" for k in range(1, 21)]
    with np.load(tmp_path / "history.npz") as history:
        np.testing.assert_array_equal(history["state"], results[""].state.numpy())
        np.testing.assert_array_equal(history["control"], results[""].control.numpy())
        np.testing.assert_array_equal(history["running_cost"], results[""].running_cost.numpy())
        np.testing.assert_allclose(history["time"], 0.1 * np.arange(5))
        for prefix, result in results.items():
            apart = avoidance.distance(result.state, cfg.avoidance.radius, one.size)
            np.testing.assert_allclose(history[f"{prefix}distance"], apart.numpy())
    files = {path.name for path in (tmp_path / "figures").iterdir()}
    assert files == {"avoidance.gif", "avoidance.txt"}
    first, *rows = csv.reader((tmp_path / "avoidance.csv").read_text().splitlines())
    assert first[0] == "method"
    assert [row[0] for row in rows] == [f"{one.label}, filtered", one.label]
    other = tmp_path / "other"
    other.mkdir()
    cfg = cfg_of(kind, *given, "figures=false", "history=false", "duration=0.001", "dtype=float32")
    avoidance.run(cfg, other)
    assert asked[-1][-1]["steps"] == 1
    assert asked[-1][3].dtype == torch.float32
    assert not (other / "figures").exists()
    assert not (other / "history.npz").exists()
    assert avoidance.run.animates is True
