"""What `safe_box` compares: its methods, starts, margins, and what it makes of their runs."""

from __future__ import annotations

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

from staf_torch import adp, systems
from staf_torch.experiments import safe_box
from staf_torch.experiments.safe_box import Method

LOW, HIGH = [-7.0, -5.0], [5.0, 7.0]
NAMES = ["LQR of s", "LQR of s, filtered", "LQR of s, filtered, renewed", "LQR of x, filtered", "LQR of x"]


class Filtered(torch.nn.Module):
    """Stands for the filter of a box, which takes seconds to be compiled: what it is asked for."""

    def __init__(self, policy: Any, box: systems.Barrier, *, dt: float, renewed: bool = False) -> None:
        super().__init__()
        self.policy, self.dt, self.renewed = policy, dt, renewed

    def forward(self, s: Tensor) -> Tensor:
        return self.policy(s)  # type: ignore[no-any-return]

    def share(self, s: Tensor) -> Tensor:
        return torch.zeros(len(s))


@pytest.fixture(autouse=True)
def _no_filter_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safe_box, "BoxFilter", Filtered)


def cfg_of(*more: str) -> Any:
    return settings("experiment=safe_box", "safe_box.decay=20", *more)


def parts(low: Any = None, high: Any = None) -> tuple[systems.Barrier, adp.QuadraticCost]:
    plant = systems.TwoState()
    box = systems.Barrier(plant, low=low or LOW, high=high or HIGH)
    return box, adp.QuadraticCost([1.0, 2.0], 0.5, dim=2, inputs=1)


def test_every_method_is_the_recorded_one(record: Record) -> None:
    box, cost = parts()
    cfg = cfg_of("dt=0.02", "safe_box.decay=20", "safe_box.substeps=3")
    found = safe_box.methods(cfg, box, cost)
    assert list(found) == NAMES
    for name in NAMES[:3]:
        assert found[name].plant is box
        assert found[name].cost is cost
    for name in NAMES[3:]:
        assert found[name].plant is box.plant
        x, u = uniform(4, 2, low=-4, high=4, seed=1), uniform(4, 1, seed=2)
        s = box.coordinates(x)  # what is paid is of s, for all
        paid = (s.square() * tensor([1.0, 2.0])).sum(-1) + 0.5 * u[:, 0] ** 2
        torch.testing.assert_close(found[name].cost.rate(x, u), paid, rtol=1e-9, atol=1e-9)
    assert [found[name].substeps for name in NAMES] == [1, (1, 3), (1, 3), 1, 1]
    assert [found[name].renew for name in NAMES] == [False, False, True, False, False]
    described = {name: made_of(one.controller) for name, one in found.items()}
    record(
        {f"{name}: {path}": part for name, each in described.items() for path, part in each.items()},
        rtol=1e-5,
    )
    single = safe_box.methods(cfg_of("dt=0.02", "safe_box.substeps=1"), box, cost)
    assert single["LQR of s, filtered"].substeps == (1, 1)
    assert list(safe_box.methods(cfg_of("safe_box.filter=false"), box, cost)) == [NAMES[0], NAMES[4]]
    assert (
        Method(found[NAMES[0]].controller, box, cost).substeps,
        Method(found[NAMES[0]].controller, box, cost).renew,
    ) == (1, False)


def test_starts_are_anywhere_in_the_box_and_those_beside_a_wall_are_moved_there(record: Record) -> None:
    box, _ = parts()
    cfg = cfg_of("safe_box.states=300", "safe_box.near=0.125", "seed=5")
    x, beside = safe_box._anywhere(cfg, box), safe_box._beside_walls(cfg, box)
    drawn = torch.rand(300, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    torch.testing.assert_close(x, tensor(LOW) + 12 * drawn)
    moved = x != beside
    assert (moved.sum(1) <= 1).all()
    near = torch.stack((beside - tensor(LOW), tensor(HIGH) - beside)).amin(0)[moved]
    torch.testing.assert_close(near, torch.full_like(near, 0.125))
    assert safe_box._anywhere(cfg_of("safe_box.states=1"), box).shape == (1, 2)
    record({"few": beside[:7], "again": safe_box._beside_walls(cfg, box)[:7]})
    # Where a wall is missing no start is beside it, and the box is taken as [-1, 1] around its middle.
    open_box = systems.Barrier(systems.TwoState(), low=[-2.0, None], high=[3.0, None])
    spread = safe_box._anywhere(cfg, open_box)
    assert -1 <= float(spread[:, 1].min()) < -0.95
    assert 0.95 < float(spread[:, 1].max()) <= 1
    assert torch.equal(safe_box._beside_walls(cfg, open_box)[:, 1], spread[:, 1])


def test_a_start_is_never_on_a_wall() -> None:
    box, _ = parts()
    wide = SimpleNamespace(
        _size=lambda: 2, floor=10 * box.low, ceiling=10 * box.high, low=box.low, high=box.high
    )
    x = safe_box._anywhere(cfg_of("safe_box.states=200"), wide)  # type: ignore[arg-type]
    for k in range(2):
        assert float(x[:, k].min() - box.low[k]) == pytest.approx(1e-9, rel=1e-4)
        assert float(box.high[k] - x[:, k].max()) == pytest.approx(1e-9, rel=1e-4)


def test_a_method_in_the_box_is_run_in_its_coordinates(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(safe_box, "simulate", lambda *given, **named: asked.append((given, named)) or "done")
    box, cost = parts()
    cfg = cfg_of("dt=0.02", "seed=9", "adp.compile=false", "safe_box.substeps=3")
    found, x0 = safe_box.methods(cfg, box, cost), uniform(3, 2, low=-4, high=4, seed=1)
    for name, start in ((NAMES[2], box.transform(x0)), (NAMES[4], x0)):
        assert safe_box._simulated(cfg, found[name], box, x0, 12, 4) == "done"
        (given, named) = asked.pop()
        assert given[:3] == (found[name].controller, found[name].plant, found[name].cost)
        torch.testing.assert_close(given[3], start)
        assert named == {
            **{"dt": 0.02, "steps": 12, "every": 4, "seed": 9, "compile": False},
            **{"substeps": found[name].substeps, "renew": found[name].renew},
        }
    safe_box._simulated(cfg, found[NAMES[0]], box, x0.float(), 1, 1)
    assert asked[0][0][3].dtype == torch.float32


def result_of(**more: Any) -> Any:
    given = {
        "time": 0.1 * torch.arange(3).double(),
        "state": uniform(2, 3, 2, low=-4, high=4, seed=3),
        "control": tensor([[[1.0], [-3.0], [9.0]], [[50.0], [0.0], [0.0]]]),
        "running_cost": uniform(2, 3, seed=4),
        "cost": tensor([6.0, 2.0]),
        "diverged": torch.tensor([False, True]),
    }
    return SimpleNamespace(**given | more)


def test_a_row_has_the_cost_and_the_largest_control_of_the_first_start() -> None:
    margin = tensor([[0.5, 0.25, 1.0], [2.0, 3.0, 4.0]])
    found = safe_box._measured(result_of(), margin, 3.0)
    assert found == {
        **{"minimum_margin": 0.25, "constraint_violations": 1.0},  # the second start diverged
        **{"cost": 6.0, "cost_ratio": 2.0, "largest_control": 3.0},  # the last control is not applied
    }
    assert safe_box._measured(result_of(), margin, None)["cost_ratio"] is None
    lost = safe_box._measured(result_of(diverged=torch.tensor([True, False])), margin, 3.0)
    assert lost["cost"] is lost["cost_ratio"] is None


@pytest.mark.parametrize("known", [True, False])
def test_the_optimum_is_sought_from_the_first_start_and_said_where_it_is_not_found(
    known: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[Any] = []

    class Shooting:
        def __init__(self, plant: Any, cost: Any) -> None:
            asked.append((plant, cost))

        def solve(self, s0: Tensor) -> Any:
            asked.append(s0)
            value = tensor([2.5 if known else math.nan])
            return SimpleNamespace(value=value, converged=torch.tensor([known]), reason=["why not"])

    monkeypatch.setattr(safe_box, "DirectShooting", Shooting)
    box, cost = parts()
    found = safe_box._optimum(box, cost, torch.ones(1, 2))
    assert found == (2.5 if known else None)
    assert asked[0] == (box, cost)
    assert asked[1].dtype == torch.float64
    assert caplog.messages == ([] if known else ["the optimum is not known: why not"])


@pytest.mark.parametrize("count", [0, 2, 20, 21])
def test_starts_that_cannot_be_kept_are_counted_and_named(
    count: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Guard:
        def __init__(self, policy: Any, plant: Any, dt: float) -> None:
            assert isinstance(policy, adp.LQR)
            assert dt == 0.02

        def share(self, s: Tensor) -> Tensor:
            found = torch.full((len(s),), 0.999)
            found[1 : 1 + count] = 1.0
            found[1] = 1.5 if count else 0.0
            return found

    monkeypatch.setattr(safe_box, "BoxFilter", Guard)
    caplog.set_level("INFO")
    box, cost = parts()
    x = uniform(25, 2, seed=1)
    found = safe_box._unavoidable(cfg_of("dt=0.02"), box, cost, {"left_near": x, "left": x})
    assert found == {f"{what}_unavoidable_fraction": count / 25 for what in ("left_near", "left")}
    if count == 0:
        assert caplog.messages == []
        return
    named = ", ".join(map(str, range(1, 1 + min(20, count)))) + (" and more" if count > 20 else "")
    said = "cannot be kept inside by any control held for 0.02 s: number"
    assert caplog.messages == [
        f"{count} of 25 starts beside a wall {said} {named}",
        f"{count} of 25 starts in the box {said} {named}",
    ]


def test_margins_and_pictures_are_in_the_coordinates_of_the_box() -> None:
    box, cost = parts()
    s = uniform(2, 3, 2, low=-1, high=1, seed=5)
    of_s, of_x = result_of(state=s), result_of()
    torch.testing.assert_close(safe_box._margin(box, box, of_s), box.margin(s))
    torch.testing.assert_close(
        safe_box._margin(box, box.plant, of_x), box.margin(box.coordinates(of_x.state))
    )
    idle: Any = None
    compared = {"LQR of s": Method(idle, box, cost), "LQR of x": Method(idle, box.plant, cost)}
    margins = {"LQR of s": uniform(2, 3, seed=6), "LQR of x": uniform(2, 3, seed=7)}
    drawn = safe_box._drawn(box, compared, {"LQR of s": of_s, "LQR of x": of_x}, margins)
    np.testing.assert_allclose(drawn.paths["LQR of s"], box.inverse(s[0]).numpy())
    np.testing.assert_array_equal(drawn.paths["LQR of x"], of_x.state[0].numpy())
    np.testing.assert_array_equal(drawn.barrier_state, s[0].numpy())
    np.testing.assert_array_equal(drawn.time, of_s.time.numpy())
    for name, margin in margins.items():
        np.testing.assert_array_equal(drawn.margins[name], margin[0].numpy())
        np.testing.assert_array_equal(drawn.costs[name], of_x.running_cost[0].numpy())
    assert (drawn.low.tolist(), drawn.high.tolist()) == (LOW, HIGH)
    assert safe_box._prefix("LQR of s, filtered") == "lqr_of_s_filtered_"


@pytest.mark.parametrize("shooting", [True, False])
def test_every_method_runs_from_the_same_states_and_from_those_that_are_followed(
    shooting: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    pictures: list[Any] = []

    def simulated(cfg: Any, method: Method, box: Any, x0: Tensor, steps: int, every: int) -> Any:
        asked.append((method, x0, steps, every))
        rows = len(x0)
        if rows == 4:  # the starts that are followed: the first of them leaves
            state = torch.zeros(rows, 2, 2).double()
            state[0] = 100.0 if method.plant is not box else math.nan
            return result_of(state=state, diverged=torch.zeros(rows, dtype=torch.bool))
        return result_of(state=torch.zeros(2, 3, 2).double() + 0.5, diverged=torch.zeros(2, dtype=torch.bool))

    monkeypatch.setattr(safe_box, "_simulated", simulated)
    monkeypatch.setattr(safe_box, "_optimum", lambda box, cost, s0: 3.0 + len(s0))
    monkeypatch.setattr(safe_box, "draw_box", lambda drawn: pictures.append(drawn))
    monkeypatch.setattr(safe_box, "images", lambda figure: {"txt": b"drawn"})
    given = ("dt=0.01", "duration=40.05", "safe_box.followed=0.07", "safe_box.states=4", "trajectories=2")
    cfg = cfg_of(*given, f"adp.optimum.shooting={shooting}", "figures=true", "history=true")
    found = safe_box.run(cfg, tmp_path)
    assert found["optimal_cost"] == (4.0 if shooting else None)
    assert found["cost_ratio"] == (1.5 if shooting else None)
    assert found["left_fraction"] == found["left_near_fraction"] == 0.25
    assert found["lqr_of_x_left_fraction"] == 0.25
    assert {name for name in found if name.endswith("unavoidable_fraction")} == {
        "left_unavoidable_fraction",
        "left_near_unavoidable_fraction",
    }
    assert len(asked) == 3 * 5
    for (method, x0, steps, every), kind in zip(asked, [0, 1, 1] * 5, strict=True):
        assert x0.dtype == torch.float64
        in_box = isinstance(method.plant, systems.Barrier)
        assert (len(x0), steps) == ((2, 4005), (4, 7))[kind]
        assert every == (3 if kind == 0 else 7 if in_box else 1)  # 2 does not divide 4005
    assert torch.equal(asked[1][1], safe_box._anywhere(cfg, pictures_box(cfg)))
    assert torch.equal(asked[2][1], safe_box._beside_walls(cfg, pictures_box(cfg)))
    with np.load(tmp_path / "history.npz") as history:
        assert history["barrier_state"].shape == (2, 3, 2)
        assert {*history.files} >= {"state", "control", "running_cost", "margin", "time"}
        np.testing.assert_allclose(history["time"], [0.0, 0.1, 0.2])
        inside = pictures_box(cfg).inverse(torch.full((2,), 0.5).double()).numpy()
        np.testing.assert_allclose(history["state"][1, 2], inside)
    assert len((tmp_path / "safe_box.csv").read_text().splitlines()) == 6
    assert (tmp_path / "figures" / "safe_box.txt").exists()
    other = tmp_path / "other"
    other.mkdir()
    short = ("duration=0.001", "safe_box.followed=0.001", "figures=false", "history=false", "dtype=float32")
    safe_box.run(cfg_of("dt=0.01", "safe_box.states=4", *short), other)
    assert [each[2:] for each in asked[-3:]] == [(1, 1)] * 3
    assert {each[1].dtype for each in asked[-3:]} == {torch.float32}
    assert not (other / "figures").exists()
    assert not (other / "history.npz").exists()


def pictures_box(cfg: Any) -> systems.Barrier:
    return systems.Barrier(systems.TwoState(), low=list(cfg.safe_box.low), high=list(cfg.safe_box.high))
