"""The closed loop: rows are alone, trouble stays in its row, bad input is named."""

from __future__ import annotations

import pytest
import torch
from helpers_adp import BOX, COST, PLANT, learner, staf_basis, uniform
from torch import Tensor

from staf_torch import adp, systems

LQR = adp.LQR(PLANT, COST)


def controllers() -> list[adp.Controller]:
    return [
        adp.Feedback(LQR, LQR.value),
        learner(adp.Information()),
        learner(adp.Published()),
        learner(adp.Frozen()),
        learner(adp.Information(), adp.RandomPoints(3, BOX, "fixed")),
        adp.ActorCritic(adp.QuadraticBasis(2), PLANT, COST, adp.QuadraturePoints(2, 2, BOX)),
        adp.Supervised(learner(adp.Information()), LQR, COST),
    ]


@pytest.mark.parametrize("controller", controllers(), ids=lambda c: type(c).__name__)
def test_rows_are_alone(controller: adp.Controller) -> None:
    x0 = uniform(4, 1.0)
    settings = {"dt": 0.005, "steps": 16}
    whole = adp.simulate(controller, PLANT, COST, x0, seed=10, **settings)
    for row in range(4):
        alone = adp.simulate(controller, PLANT, COST, x0[row : row + 1], seed=10 + row, **settings)
        for name in ("state", "critic_weights", "actor_weights", "running_cost"):
            torch.testing.assert_close(
                getattr(whole, name)[row], getattr(alone, name)[0], rtol=1e-9, atol=1e-12
            )


class Broken(systems.TwoState):
    """Returns NaN on one side of a line."""

    def drift(self, x: Tensor) -> Tensor:
        return torch.where(x[..., :1] > 0.71, torch.nan, super().drift(x))


def test_row_of_a_plant_that_returns_nan_freezes_and_the_others_do_not_notice() -> None:
    x0 = torch.tensor([[-1.0, 1.0], [0.7, 1.5], [0.5, -0.5]], dtype=torch.float64)
    run = adp.simulate(adp.Feedback(LQR), Broken(), COST, x0, dt=0.01, steps=120)
    sound = adp.simulate(adp.Feedback(LQR), PLANT, COST, x0, dt=0.01, steps=120)
    assert run.diverged.tolist() == [False, True, False]
    assert 0 < float(run.frozen_at[1]) < 1
    for row in (0, 2):
        torch.testing.assert_close(run.state[row], sound.state[row], rtol=0, atol=0)
    assert torch.isfinite(run.state).all()
    assert torch.isfinite(run.cost).all()
    frozen = round(float(run.frozen_at[1]) / 0.01)
    torch.testing.assert_close(
        run.state[1, frozen:], run.state[1, frozen].expand(121 - frozen, 2), rtol=0, atol=0
    )
    assert torch.isnan(run.control[1, frozen:]).all()


class BrokenStrip(systems.TwoState):
    """Returns NaN in a strip that the state from (-1, 1) runs into."""

    def drift(self, x: Tensor) -> Tensor:
        return torch.where((x[..., :1] + 0.5).abs() < 0.3, torch.nan, super().drift(x))


def test_weights_of_a_row_whose_plant_returns_nan_freeze_with_it() -> None:
    x0 = torch.tensor([[0.1, 0.1], [-1.0, 1.0]], dtype=torch.float64)
    controller = learner(adp.Information(), adp.RandomPoints(1, 1e-3))
    run = adp.simulate(controller, BrokenStrip(), COST, x0, dt=0.01, steps=60)
    alone = adp.simulate(controller, PLANT, COST, x0[:1], dt=0.01, steps=60)
    assert run.diverged.tolist() == [False, True]
    torch.testing.assert_close(run.critic_weights[0], alone.critic_weights[0], rtol=1e-12, atol=0)
    frozen = round(float(run.frozen_at[1]) / 0.01)
    assert 0 < frozen < 60
    assert torch.isfinite(run.critic_weights).all()
    assert torch.equal(run.critic_weights[1, frozen], run.critic_weights[1, -1])


def test_state_that_leaves_the_limit_counts_as_diverged() -> None:
    idle = adp.Feedback(lambda x: torch.zeros_like(x[..., :1]))
    plant = systems.Linear([[1.0, 0.0], [0.0, 2.0]], [[1.0], [1.0]])
    run = adp.simulate(
        idle, plant, COST, uniform(5, 1.0), dt=0.05, steps=200, every=200, limit=50.0, compile=False
    )
    assert run.diverged.all()
    assert (run.state[:, -1].norm(dim=-1) <= 50).all()


def test_initial_state_that_is_not_finite_is_frozen_from_the_start() -> None:
    x0 = torch.tensor([[float("nan"), 0.0], [0.1, 0.1]], dtype=torch.float64)
    run = adp.simulate(adp.Feedback(LQR), PLANT, COST, x0, dt=0.01, steps=10)
    assert run.frozen_at.tolist() == [0.0, float("inf")]


def test_cost_of_the_lqr_on_a_linear_plant_is_the_riccati_value() -> None:
    plant = systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]])
    lqr = adp.LQR(plant, COST)
    x0 = uniform(6, 2.0)
    run = adp.simulate(adp.Feedback(lqr), plant, COST, x0, dt=0.005, steps=2000, every=2000, compile=True)
    torch.testing.assert_close(run.cost, lqr.value(x0), rtol=1e-4, atol=0)
    torch.testing.assert_close(plant.optimal_value(x0, COST.q, COST.r), lqr.value(x0))


def test_recorded_times_are_those_of_every_step() -> None:
    x0 = uniform(2, 1.0)
    every = adp.simulate(learner(adp.Information()), PLANT, COST, x0, dt=0.005, steps=20)
    some = adp.simulate(learner(adp.Information()), PLANT, COST, x0, dt=0.005, steps=20, every=5)
    assert every.state.shape == (2, 21, 2)
    torch.testing.assert_close(some.time, every.time[::5])
    torch.testing.assert_close(some.state, every.state[:, ::5])
    torch.testing.assert_close(some.control[:, :-1], every.control[:, :-1:5])
    torch.testing.assert_close(some.running_cost, every.running_cost[:, ::5])


def test_supervised_control_stays_in_its_tube_and_is_untouched_inside() -> None:
    guard = adp.Supervised(learner(adp.Information()), LQR, COST, trust=0.5)
    x = uniform(200, 2.0)
    base = LQR(x)
    far = base + 10 * torch.randn(200, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert ((guard.restrain(x, far) - base).abs() <= 0.5 * base.abs() * (1 + 1e-12)).all()
    near = 1.3 * base
    torch.testing.assert_close(guard.restrain(x, near), near, rtol=1e-14, atol=0)
    assert torch.isfinite(guard.restrain(torch.zeros(1, 2).double(), torch.ones(1, 1).double())).all()


def test_supervised_linear_plant_is_stable_for_any_weights() -> None:
    plant = systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]])
    lqr = adp.LQR(plant, COST)
    guard = adp.Supervised(learner(adp.Information()), lqr, COST, trust=0.5)
    x = uniform(500, 3.0)
    u = guard.restrain(
        x, 100 * torch.randn(500, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    )
    field = plant.drift(x) + (plant.effectiveness(x) @ u.unsqueeze(-1)).squeeze(-1)
    fall = 2 * ((x @ lqr.p) * field).sum(-1)
    assert (fall <= -COST.state_rate(x) + 1e-9).all()


def test_supervisor_regulates_a_grid_of_initial_weights() -> None:
    scales = torch.tensor([0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.0], dtype=torch.float64).repeat_interleave(40)
    critic = scales.unsqueeze(-1).expand(-1, 3)
    points = adp.RandomPoints(1, BOX)
    inner = adp.ActorCritic(staf_basis(), PLANT, COST, points, critic=critic, actor=0.7 * critic)
    x0 = uniform(40, 2.0, seed=11).repeat(7, 1)
    guarded = adp.Supervised(inner, LQR, COST)
    run = adp.simulate(guarded, PLANT, COST, x0, dt=0.01, steps=1000, every=1000, compile=True)
    regulated = ~run.diverged & (run.state[:, -1].norm(dim=-1) < 1e-3)
    assert float(regulated.double().mean()) >= 0.95


def test_bounded_input_policy_minimises_the_hamiltonian() -> None:
    cost = adp.BoundedInputCost(1.0, 2.0, 2, 1, bound=0.7)
    x, gradient = uniform(20, 1.5), uniform(20, 3.0, seed=1)
    g = PLANT.effectiveness(x)
    u = cost.policy(g, gradient)
    assert (u.abs() < 0.7).all()

    def hamiltonian(v: Tensor) -> Tensor:
        return cost.rate(x, v) + ((g @ v.unsqueeze(-1)).squeeze(-1) * gradient).sum(-1)

    for step in (1e-3, -1e-3):
        assert (hamiltonian(u + step) > hamiltonian(u)).all()
    small = 1e-4 * u
    torch.testing.assert_close(cost.input_rate(small), 2.0 * small.square().sum(-1), rtol=1e-6, atol=1e-14)
    edge = cost.input_rate(torch.full((1, 1), 0.7, dtype=torch.float64))
    assert float(edge) == pytest.approx(2 * 0.49 * 2.0 * 0.6931471805599453)


class WrongShape(systems.TwoState):
    def effectiveness(self, x: Tensor) -> Tensor:
        return super().effectiveness(x).squeeze(-1)


class Pushed(systems.TwoState):
    def drift(self, x: Tensor) -> Tensor:
        return super().drift(x) + 1.0


@pytest.mark.parametrize(
    ("plant", "x0", "settings", "message"),
    [
        (PLANT, torch.zeros(2, 3), {}, r"`simulate\(x0=...\)` must have 2 entries in its last dimension"),
        (PLANT, torch.zeros(2), {}, r"`simulate\(x0=...\)` must have at least 2 dimensions"),
        (PLANT, torch.zeros(0, 2), {}, r"`simulate\(x0=...\)` must have the shape \(B, n\)"),
        (PLANT, torch.zeros(1, 2), {"steps": 0}, r"`simulate\(steps=...\)` must be at least 1"),
        (PLANT, torch.zeros(1, 2), {"every": 3}, r"`simulate\(every=...\)` must divide the 10 steps"),
        (PLANT, torch.zeros(1, 2), {"dt": -1.0}, r"`ClosedLoop\(dt=...\)` must be positive"),
        (PLANT, torch.zeros(1, 2), {"integrator": "rk"}, r"`ClosedLoop\(integrator=...\)` must be one of"),
        (PLANT, torch.zeros(1, 2), {"compile": "yes"}, r"`simulate\(compile=...\)` must be one of"),
        (WrongShape(), torch.zeros(1, 2), {}, r"`WrongShape.effectiveness` must map \(1, 2\) to \(1, 2, 1\)"),
        (Pushed(), torch.zeros(1, 2), {}, r"`Pushed.drift` must be 0 at the origin"),
    ],
)
def test_bad_input_is_refused_by_name(
    plant: systems.ControlAffineSystem, x0: Tensor, settings: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        adp.simulate(adp.Feedback(LQR), plant, COST, x0.double(), **{"dt": 0.01, "steps": 10} | settings)


def test_trust_outside_its_range_is_refused() -> None:
    with pytest.raises(ValueError, match=r"`Supervised\(trust=...\)` must be in \(0, 1\]; got 1.5"):
        adp.Supervised(adp.Feedback(LQR), LQR, COST, trust=1.5)
