"""Every argument of a run matters: times, seeds, pieces, limits, discounts, and when a loop is compiled."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from helpers import tensor
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp import simulation
from staf_torch.adp.closed_loop import ClosedLoop
from staf_torch.adp.simulation import uniform_numbers

PLANT = systems.Linear([[0.0, 1.0], [-1.0, -0.5]], [[0.0], [1.0]])
COST = adp.QuadraticCost(2.0, 0.5, dim=2, inputs=1)
X0 = tensor([[1.0, 0.0], [-0.5, 0.8], [0.2, -0.3]])
STEP = systems.StepPlant(lambda x, u: 0.9 * x + u, dim=2, inputs=1, dt=0.25)


class Noisy(adp.Controller):
    """u is the sum of its random numbers; it carries how many steps it has taken, and the last dt."""

    draws = 2

    def init(self, x0: Tensor) -> Tensor:
        return x0.new_zeros(len(x0), 2)

    def step(self, x: Tensor, carried: Tensor, uniform: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        assert uniform.shape == (len(x), 2, 2)
        return uniform.flatten(1).sum(-1, keepdim=True), carried + tensor([1.0, dt])


def zero(x: Tensor) -> Tensor:
    return torch.zeros_like(x[..., :1])


def run(controller: Any = zero, plant: Any = PLANT, cost: Any = COST, x0: Tensor = X0, **given: Any) -> Any:
    with torch.no_grad():
        return adp.simulate(controller, plant, cost, x0, **{"dt": 0.01, "steps": 6, "compile": False} | given)


def test_a_control_is_held_for_the_period_of_the_controller_or_the_plant_or_a_millisecond() -> None:
    held = Noisy()
    held.period = 0.5
    for controller, plant, dt, wanted in (
        (zero, PLANT, None, 0.001),
        (zero, PLANT, 0.02, 0.02),
        (zero, STEP, None, 0.25),
        (zero, STEP, 0.5, 0.5),
        (held, PLANT, None, 0.5),
        (held, STEP, None, 0.5),
        (adp.LQR(PLANT, COST, period=0.1), PLANT, None, 0.1),
    ):
        found = run(controller, plant, dt=dt, steps=4, every=2)
        torch.testing.assert_close(found.time, tensor([0.0, 2.0, 4.0]) * wanted)
        assert found.time.dtype == torch.float64


@pytest.mark.parametrize("every", [1, 3, 4, 12])
@pytest.mark.parametrize("ahead", [1, 5, 1024])
def test_pieces_of_a_run_change_nothing(monkeypatch: pytest.MonkeyPatch, every: int, ahead: int) -> None:
    whole = run(Noisy(), steps=24, seed=3)
    monkeypatch.setattr(simulation, "_DRAWN_AHEAD", ahead)
    done: list[int] = []
    some = run(Noisy(), steps=24, seed=3, every=every, progress=done.append)
    assert sum(done) == 24
    assert max(done) <= ahead
    assert min(done) >= 1
    for name in ("time", "state", "control", "running_cost"):
        parts = [getattr(each, name) for each in (whole, some)]
        wanted = parts[0][::every] if name == "time" else parts[0][:, ::every]
        torch.testing.assert_close(parts[1], wanted, rtol=1e-12, atol=1e-14, equal_nan=True)
    if every <= ahead:
        assert all(piece % every == 0 for piece in done)
        assert len(done) == math.ceil(24 / (ahead // every * every))


def test_random_numbers_are_drawn_for_as_many_steps_as_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    for numbers, controller, wanted in (
        (3 * 2 * 2 * 5, Noisy(), [5, 5, 2]),  # rows, coordinates and draws
        (3 * 2 * 5, adp.Feedback(zero), [5, 5, 2]),
        (1, Noisy(), [1] * 12),
    ):
        monkeypatch.setattr(simulation, "_NUMBERS", numbers)
        done: list[int] = []
        run(controller, steps=12, progress=done.append)
        assert done == wanted


def test_rows_draw_from_seeds_of_their_own() -> None:
    first = run(Noisy(), seed=5)
    for row in range(3):
        alone = run(Noisy(), x0=X0[row : row + 1], seed=5 + row)
        torch.testing.assert_close(first.control[row, :-1], alone.control[0, :-1])
    listed = run(Noisy(), seed=[7, 5, 7])
    torch.testing.assert_close(listed.control[1, :-1], first.control[0, :-1])
    torch.testing.assert_close(listed.control[0, :-1], listed.control[2, :-1])
    torch.testing.assert_close(listed.control[0, :-1], first.control[2, :-1])
    assert not torch.allclose(first.control[0, :-1], first.control[1, :-1])
    torch.testing.assert_close(run(Noisy()).control[:, :-1], run(Noisy(), seed=0).control[:, :-1])
    for wrong, message in (
        ([1, 2], r"`simulate\(seed=...\)` must be one a row, 3; got 2"),
        (-1, r"`simulate\(seed=...\)` must be at least 0"),
        ([0, 1, -1], r"`simulate\(seed=...\)` must be at least 0"),
    ):
        with pytest.raises(ValueError, match=message):
            run(Noisy(), seed=wrong)


def test_random_numbers_fill_the_interval_evenly_in_the_dtype_of_the_states() -> None:
    generators = [torch.Generator().manual_seed(k) for k in (1, 2)]
    drawn = uniform_numbers(torch.zeros(2, 3), 500, 4, generators)
    assert drawn.shape == (2, 500, 4, 3)
    assert drawn.dtype == torch.float32
    assert float(drawn.min()) < -0.995
    assert float(drawn.max()) > 0.995
    assert float(drawn.abs().max()) <= 1
    assert abs(float(drawn.mean())) < 0.03
    wanted = torch.empty(500, 4, 3, dtype=torch.float64).uniform_(
        -1.0, 1.0, generator=torch.Generator().manual_seed(2)
    )
    torch.testing.assert_close(drawn[1], wanted.float(), rtol=0, atol=0)
    assert uniform_numbers(torch.zeros(2, 3), 5, 0, []).shape == (2, 5, 0, 3)


@pytest.mark.parametrize("discount", [0.0, 0.7])
@pytest.mark.parametrize("integrator", ["runge_kutta", "euler"])
def test_what_is_paid_is_the_sum_over_the_steps(discount: float, integrator: str) -> None:
    cost = adp.QuadraticCost(2.0, 0.5, dim=2, inputs=1, discount=discount)
    found = run(Noisy(), cost=cost, dt=0.1, steps=8, integrator=integrator)
    spent, x = torch.zeros(3).double(), X0
    for k in range(8):
        u = found.control[:, k]
        if integrator == "euler":
            step, paid = x + 0.1 * PLANT.rate(x, u), 0.1 * cost.rate(x, u)
        else:
            z = torch.cat((x, u), -1)
            flow = torch.cat((torch.cat((PLANT.matrix, PLANT.input_matrix), 1), torch.zeros(1, 3).double()))
            step, paid = (z @ torch.linalg.matrix_exp(0.1 * flow).mT)[:, :2], torch.zeros(3).double()
            for share, mass in ((0.0, 1.0), (0.5, 4.0), (1.0, 1.0)):  # Simpson's rule
                at = (z @ torch.linalg.matrix_exp(0.1 * share * flow).mT)[:, :2]
                paid = paid + 0.1 * mass / 6 * math.exp(-discount * 0.1 * share) * cost.rate(at, u)
        spent, x = spent + math.exp(-discount * 0.1 * k) * paid, step
        torch.testing.assert_close(found.state[:, k + 1], x, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(found.running_cost[:, k + 1], spent, rtol=1e-5, atol=1e-6)
        x = found.state[:, k + 1]
    assert torch.equal(found.cost, found.running_cost[:, 8])
    assert torch.equal(found.running_cost[:, 0], torch.zeros(3).double())
    assert bool(found.control[:, 8].isnan().all())
    assert found.control.shape == (3, 9, 1)


def test_a_row_at_the_limit_lives_and_one_beyond_is_frozen_in_time() -> None:
    still = systems.StepPlant(lambda x, u: x + u, dim=2, inputs=1, dt=0.5)

    def off(x: Tensor) -> Tensor:  # the third row walks away, a unit a step
        return torch.where(x[..., :1] == x[..., 1:], torch.ones_like(x[..., :1]), 0.0)

    x0 = tensor([[3.0, 4.0], [4.0, 3.1], [0.0, 0.0]])
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    found = run(off, still, cost, x0, dt=0.5, steps=8, limit=5.0)
    assert found.frozen_at.tolist() == [math.inf, 0.0, 1.5]
    assert found.diverged.tolist() == [False, True, True]
    assert found.state[2, :, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0]
    assert found.control[2].isnan().flatten().tolist() == [False] * 3 + [True] * 6
    assert float(found.cost[1]) == 0.0
    assert float(found.cost[2]) == pytest.approx(0.5 * (3 + 2 * (0 + 1 + 4)))
    assert run(zero, x0=1e6 * tensor([[0.6, 0.8]]), plant=STEP, dt=0.25, steps=1).diverged.tolist() == [False]
    assert run(zero, x0=1e6 * tensor([[1.3, 0.0]]), plant=STEP, dt=0.25, steps=1).diverged.tolist() == [True]


class Growing(Noisy):
    """Its memory becomes infinite in the second step of the first row."""

    def step(self, x: Tensor, carried: Tensor, uniform: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        u, after = super().step(x, carried, uniform, dt)
        late = (after[:, :1] == 2) & (x[:, :1] > 0.5)
        return u, torch.where(late, torch.inf, after)


def test_a_memory_that_is_lost_freezes_its_row_alone() -> None:
    found = run(Growing(), steps=5, dt=0.02)
    assert found.frozen_at.tolist() == [0.02, math.inf, math.inf]
    assert bool(torch.isfinite(found.state).all())
    assert found.actor_weights.shape == found.critic_weights.shape == found.identifier.shape == (3, 6, 0)


def test_a_control_that_is_renewed_follows_the_state_within_its_bounds() -> None:
    cost = adp.QuadraticCost(2.0, 0.5, dim=2, inputs=1, low=-0.3, high=0.2)

    def policy(x: Tensor) -> Tensor:
        return -2 * x[..., 1:]

    found = run(policy, cost=cost, dt=0.2, steps=3, substeps=4, renew=True)
    fine = run(policy, cost=cost, dt=0.05, steps=12, every=4)
    torch.testing.assert_close(found.state, fine.state, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(found.cost, fine.cost)
    held = run(policy, cost=cost, dt=0.2, steps=3, substeps=4)
    assert float((held.state - fine.state).abs().max()) > 1e-4
    free = run(policy, dt=0.2, steps=3, substeps=4, renew=True)
    torch.testing.assert_close(free.state, run(policy, dt=0.05, steps=12, every=4).state)
    for controller, plant in ((Noisy(), PLANT), (zero, STEP)):
        with pytest.raises(
            ValueError, match=r"`ClosedLoop\(renew=...\)` needs a feedback law and a plant in"
        ):
            run(controller, plant, dt=0.25, renew=True)


def test_substeps_are_taken_within_a_step() -> None:
    one, four = (run(zero, dt=0.8, steps=2, substeps=each).state for each in (1, 4))
    fine = run(zero, dt=0.2, steps=8, every=4).state
    torch.testing.assert_close(four, fine, rtol=1e-13, atol=1e-14)
    assert float((one - fine).abs().max()) > 1e-5
    assert ClosedLoop(adp.Feedback(zero), PLANT, COST, dt=0.1, substeps=(2, 5)).substeps == 5
    assert ClosedLoop(adp.Feedback(zero), PLANT, COST, dt=0.1).substeps == 1


# --- when a loop is compiled --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({"steps": 2985}, False),  # times 1 + 1/200 for the one row, 2999.9
        ({"steps": 2986}, True),
        ({"steps": 2000, "rows": 100}, True),  # times 1.5, to the last step
        ({"steps": 1999, "rows": 100}, False),
        ({"steps": 1492, "substeps": 2}, False),
        ({"steps": 1493, "substeps": 2}, True),
        ({"steps": 1493, "substeps": (1, 2)}, True),
        ({"steps": 995, "work": 3.0}, False),
        ({"steps": 996, "work": 3.0}, True),
        ({"steps": 747, "work": 3.0, "substeps": 2}, True),
        ({"steps": 746, "work": 3.0, "substeps": 2}, False),
        ({"steps": 1, "compile": True}, True),
        ({"steps": 5000, "compile": False}, False),
        ({"steps": 5000, "costly": True}, False),
        ({"steps": 1, "costly": True, "compile": True}, True),
        ({"steps": 5000, "foreign": True}, False),
        ({"steps": 1, "foreign": True, "compile": True}, False),
    ],
)
def test_a_loop_is_compiled_where_it_pays(
    given: dict[str, Any], wanted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Foreign(systems.Linear):
        @property
        def traceable(self) -> bool:
            return "foreign" not in given

    asked: list[bool] = []

    def program(loop: Any, compile: bool) -> None:
        asked.append(compile)
        raise StopIteration

    monkeypatch.setattr(simulation, "program", program)
    controller = Noisy()
    controller.work, controller.costly = given.get("work", 1.0), "costly" in given
    more = {name: given[name] for name in ("steps", "substeps", "compile") if name in given}
    x0 = torch.ones(given.get("rows", 1), 2).double()
    plant = Foreign(PLANT.matrix, PLANT.input_matrix)
    with pytest.raises(StopIteration):
        adp.simulate(controller, plant, COST, x0, dt=0.01, **more)
    assert asked == [wanted]


class Misshapen(systems.Linear):
    def __init__(self, drift: Any = None, effectiveness: Any = None) -> None:
        super().__init__(PLANT.matrix, PLANT.input_matrix)
        self.other = {"drift": drift, "effectiveness": effectiveness}

    def drift(self, x: Tensor) -> Any:  # type: ignore[override]
        return super().drift(x) if self.other["drift"] is None else self.other["drift"](x)

    def effectiveness(self, x: Tensor) -> Any:  # type: ignore[override]
        g = self.other["effectiveness"]
        return super().effectiveness(x) if g is None else g(x)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"controller": 3}, r"`simulate\(controller=...\)` must be a Controller or a function of x; got 3"),
        ({"steps": 0}, r"`simulate\(steps=...\)` must be at least 1"),
        ({"every": 0}, r"`simulate\(every=...\)` must be at least 1"),
        ({"every": 4}, r"`simulate\(every=...\)` must divide the 6 steps; got 4"),
        ({"compile": "no"}, r"`simulate\(compile=...\)` must be one of"),
        ({"substeps": 0}, r"`simulate\(substeps=...\)` must be at least 1"),
        ({"substeps": (3, 2)}, r"`simulate\(substeps=...\)` must be at least 3"),
        ({"x0": torch.zeros(2, 1, 2).double()}, r"must have the shape \(B, n\); got \(2, 1, 2\)"),
        ({"x0": torch.zeros(0, 2).double()}, r"must have the shape \(B, n\); got \(0, 2\)"),
        ({"x0": torch.zeros(2, 3).double()}, r"`simulate\(x0=...\)` must have 2 entries"),
        (
            {"cost": adp.QuadraticCost(1.0, 1.0, 3, 1)},
            r"`simulate\(cost=...\)` must be for the plant's 2 states",
        ),
        ({"plant": Misshapen(drift=lambda x: None)}, r"`Misshapen.drift` must map \(3, 2\) .*; got None"),
        ({"plant": Misshapen(drift=lambda x: x[:, :1])}, r"`Misshapen.drift` .* got \(3, 1\)"),
        ({"plant": Misshapen(effectiveness=lambda x: x)}, r"`Misshapen.effectiveness` .* to \(3, 2, 1\)"),
        ({"limit": 0.0}, r"`ClosedLoop\(limit=...\)` must be positive"),
    ],
)
def test_arguments_of_a_run_are_refused_by_name(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        run(**given)


@pytest.mark.parametrize("kind", [adp.LoopResult, adp.Gains])
def test_what_a_run_returns_and_gains_are_not_changed(kind: type) -> None:
    found = object.__new__(kind)
    for name in kind.__dataclass_fields__:  # type: ignore[attr-defined]
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(found, name, None)


def test_arguments_at_their_edges_are_taken() -> None:
    assert run(steps=1, every=1, x0=X0[:1]).state.shape == (1, 2, 2)
