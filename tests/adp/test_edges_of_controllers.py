"""Controllers at their edges: one state, no noise, a bound or rate that is just met, what a report counts."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor, nn

import staf_torch as st
from staf_torch import adp, systems
from staf_torch.adp.controllers import carrying
from staf_torch.adp.holding import Holding
from staf_torch.adp.sampled_rollout import SampledRollout
from staf_torch.adp.trajectory_optimisation import _definite

DECAY = 0.5
ONE = systems.Linear([[-DECAY]], [[1.0]])
COST = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1)
X = tensor([[0.8], [-0.3], [0.05]])


class Limited(systems.Linear):
    """One that asks for substeps."""

    def step_limit(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.full_like(x[..., -1], 0.15)


@pytest.mark.parametrize("plant", [ONE, Limited([[-DECAY]], [[1.0]])])
def test_one_state_that_decays_is_held_as_its_exponential(plant: systems.Linear) -> None:
    u, t = tensor([[0.4], [0.0], [-1.0]]), 0.4
    x, spent = Holding("Test", plant, COST, t, 4)(X, u)
    center, apart, left = u / DECAY, X - u / DECAY, math.exp(-DECAY * t)
    torch.testing.assert_close(x, center + left * apart, rtol=1e-7, atol=1e-9)
    square = center**2 * t + 2 * center * apart * (1 - left) / DECAY + apart**2 * (1 - left**2) / (2 * DECAY)
    torch.testing.assert_close(spent, (square + u**2 * t).squeeze(-1), rtol=1e-6, atol=1e-8)


@torch.no_grad()
def test_rollouts_of_one_state_cost_what_its_riccati_equation_says() -> None:
    value = math.sqrt(DECAY**2 + 1) - DECAY  # P of 0 = -2 a P + 1 - P^2
    policy = adp.RolloutPolicy.of_lqr(ONE, COST, centers=3, steps=4)
    torch.testing.assert_close(policy.rollout(X), value * X.square().squeeze(-1), rtol=1e-4, atol=0)
    held = adp.near_optimal(ONE, COST, dt=0.1, low=-2.0, high=0.25)
    p = float(held.lqr.p)
    assert value < p < 1.01 * value
    torch.testing.assert_close(
        held.rollout(0.1 * X).whole, p * (0.1 * X).square().squeeze(-1), rtol=1e-5, atol=0
    )
    assert held.meets_bound(X).tolist() == [[0.0], [0.0], [0.0]]
    edge = -0.25 / float(held.lqr.k)
    around = tensor([[0.999 * edge], [1.001 * edge], [-7.0]])
    assert held.meets_bound(around).tolist() == [[0.0], [1.0], [1.0]]


@torch.no_grad()
def test_a_control_that_is_just_at_a_bound_meets_it() -> None:
    held = adp.near_optimal(ONE, COST, dt=0.1, low=-2.0, high=0.25)
    del held.base
    for level, met in ((0.25, 1.0), (0.2499, 0.0), (-2.0, 1.0), (-1.999, 0.0), (3.0, 1.0)):
        held.base = lambda x, level=level: torch.full_like(x, level)
        assert held.meets_bound(X[:1]).tolist() == [[met]]


@torch.no_grad()
def test_an_input_that_moves_nothing_is_left_as_it_is() -> None:
    chain = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    plant = systems.Linear(chain, [[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    cost = adp.QuadraticCost(1.0, 1.0, dim=3, inputs=2)
    lqr = adp.LQR(plant, cost, period=0.1)
    around = torch.cat((st.cross_polytope(2), torch.zeros(1, 2).double()))
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(around, 0.1))
    held = SampledRollout(basis, plant, cost, lqr, lqr.value, lqr.p, period=0.1)
    assert held.along is not None
    x = uniform(4, 3, seed=1)
    step = held.proposal(x, lqr(x))
    assert bool(step.isfinite().all())
    torch.testing.assert_close(step[:, 1], torch.zeros(4).double(), rtol=0, atol=1e-8)
    torch.testing.assert_close(held(x)[:, 1], torch.zeros(4).double(), rtol=0, atol=1e-8)


def test_four_inputs_are_the_most_that_are_improved_by_samples() -> None:
    for inputs in (4, 5):
        plant = systems.Linear(torch.zeros(2, 2).double(), uniform(2, inputs, seed=2))
        cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=inputs)
        basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(6), 0.1))

        def made(plant: Any = plant, cost: Any = cost, basis: Any = basis, inputs: int = inputs) -> Any:
            return SampledRollout(
                basis,
                plant,
                cost,
                lambda x: x.new_zeros(*x.shape[:-1], inputs),
                lambda x: x.square().sum(-1),
                torch.eye(2).double(),
                period=0.1,
            )

        if inputs == 4:
            assert made().steps == 20
        else:
            with pytest.raises(ValueError, match="at most 4 inputs"):
                made()


def test_feedback_carries_nothing_and_what_is_carried_is_recorded_as_it_is() -> None:
    x = uniform(3, 2, seed=3)
    rest = adp.Feedback(lambda x: x[:, :1]).init(x)
    assert [tuple(part.shape) for part in rest] == [(3, 0), (3, 0), (3, 0, 0), (3, 0)]
    known = carrying(x)
    assert [tuple(part.shape) for part in known] == [(3, 0), (3, 0), (3, 0, 0), (3, 2)]
    assert known.identifier is x


MODULES: dict[str, Any] = {
    "Feedback": lambda: adp.Feedback(lambda x: x),
    "Measured": lambda: adp.Measured(adp.Feedback(lambda x: x), noise=0.1, dim=2),
    "ChangingPlant": lambda: adp.ChangingPlant(adp.ParametricPlant.of_effectiveness(systems.Pendulum())),
    "Clocked": lambda: systems.Clocked(systems.Pendulum()),
    "StepPlant": lambda: systems.StepPlant(lambda x, u: 0.9 * x + u, dim=1, inputs=1, dt=0.1),
    "RatePlant": lambda: systems.RatePlant(lambda x, u: u - x, dim=1, inputs=1),
    "Barrier": lambda: systems.Barrier(systems.Pendulum(), -3.0, 3.0),
    "near_optimal": lambda: adp.near_optimal(ONE, COST, dt=0.1),
    "Supervised": lambda: adp.Supervised(adp.Feedback(lambda x: x), adp.LQR(ONE, COST), COST),
}


@pytest.mark.parametrize("name", sorted(MODULES))
def test_controllers_and_plants_are_modules_that_know_their_parts(name: str) -> None:
    made: nn.Module = MODULES[name]()
    assert made.training
    assert not made.eval().training
    assert made.to(torch.float64) is made
    assert isinstance(made.state_dict(), dict)
    assert made in list(made.modules())


def test_measured_states_without_noise_draw_nothing() -> None:
    quiet = adp.Measured(adp.Feedback(lambda x: x), noise=0.0, dim=3)
    assert quiet.draws == 0
    x = uniform(2, 3, seed=4).float()
    assert torch.equal(quiet.step(x, quiet.init(x), x.new_zeros(2, 0, 3), 0.1)[0], x)
    loud = adp.Measured(adp.Feedback(lambda x: x), noise=[0.0, 0.1, 0.3], dim=3)
    assert (loud.draws, loud.noise.tolist()) == (2, [0.0, 0.1, 0.3])
    assert adp.Measured(adp.Feedback(lambda x: x), noise=0.1, dim=2).draws == 1


def test_a_change_at_time_0_has_happened_and_numbers_keep_their_digits() -> None:
    plant = adp.ChangingPlant(adp.ParametricPlant.of_effectiveness(systems.Pendulum()))
    x0 = uniform(2, 2, seed=5)
    assert plant.theta(plant.start(x0, [0.1], [0.7])).tolist() == [[0.7], [0.7]]
    late = plant.start(x0, [0.1], [0.7], at=0.3)
    assert plant.theta(late).tolist() == [[0.1], [0.1]]
    torch.testing.assert_close(late[:, -1], tensor([math.exp(0.03)] * 2), rtol=1e-15, atol=0)
    same = plant.start(x0, tensor([[0.1], [0.2]]), at=tensor([0.1, 0.2]))
    assert same[:, 2:4].tolist() == [[0.1, 0.1], [0.2, 0.2]]
    torch.testing.assert_close(same[:, -1], (tensor([0.1, 0.2]) / 10).exp(), rtol=1e-15, atol=0)


def wall(x: Tensor, t: Tensor) -> Tensor:
    return 1 - x[:, 0]


def guarded(**given: Any) -> adp.SafetyFilter:
    plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    return adp.SafetyFilter(lambda x: 0 * x[..., :1], plant, **({"constraints": wall, "dt": 0.5} | given))


def test_a_rate_of_one_over_the_hold_is_the_largest_for_degree_two() -> None:
    assert guarded(decay=2.0).degree == (2,)
    with pytest.raises(ValueError, match="at most 1/dt = 2 "):
        guarded(decay=2.001)
    assert guarded(decay=9.0, degree=1).degree == (1,)
    both = guarded(constraints=[wall, lambda x, t: 3 - x[:, 1]], degree=[2, 1], decay=[2.0, 9.0])
    assert both.degree == (2, 1)
    with pytest.raises(ValueError, match="degree"):
        guarded(degree=[1, 2])
    with pytest.raises(ValueError, match="degree"):
        guarded(degree=3)


def test_a_report_counts_rows_below_zero_and_slack_above_a_millionth() -> None:
    # steps, least margin, largest slack, steps with another control; h at the end is 1 - x_1
    record = tensor(
        [[4.0, 0.0, 0.0, 1.0], [4.0, -0.1, 2e-6, 0.0], [4.0, 0.3, 0.9e-6, 2.0], [4.0, 0.3, 0.5, 0.0]]
    )
    end = tensor([[0.5, 0.0], [0.5, 0.0], [1.0, 0.0], [1.25, 0.0]])
    other = uniform(4, 3, 2, seed=6)
    result: Any = SimpleNamespace(
        identifier=torch.stack((0 * record, record), dim=1), state=torch.cat((other, end.unsqueeze(1)), dim=1)
    )
    assert guarded().report(result) == {
        "minimum_margin": -0.25,
        "constraint_violations": 2,
        "infeasible": [1, 3],
        "largest_slack": 0.5,
        "acted": 3 / 16,
    }
    first = guarded().init(torch.zeros(2, 2).double())
    assert first.identifier.tolist() == [[0.0, math.inf, 0.0, 0.0]] * 2


def test_pivots_of_zero_are_not_positive() -> None:
    matrices = tensor([[[1.0, 2.0], [2.0, 5.0]], [[1.0, 2.0], [2.0, 4.0]], [[0.0, 0.0], [0.0, 1.0]]])
    assert _definite(matrices).tolist() == [1.0, 0.0, 0.0]
    assert _definite(tensor([[[0.0]], [[1e-9]], [[0.5]], [[-1.0]]])).tolist() == [0.0, 1.0, 1.0, 0.0]


def test_a_plant_whose_rows_have_parameters_of_their_own_is_tried_with_those_rows() -> None:
    scale = uniform(2, 3, 1, seed=7)

    def regressor(x: Tensor, u: Tensor) -> Tensor:
        return (scale * u).unsqueeze(-1)

    plant = adp.ParametricPlant(regressor, dim=1, inputs=1, theta=uniform(2, 3, 1, seed=8))
    assert plant.parameters_count == 1
    x, u = uniform(2, 3, 1, seed=9), uniform(2, 3, 1, seed=10)
    torch.testing.assert_close(plant.rate(x, u), scale * u * plant.theta)


def test_a_set_point_at_which_nothing_moves_is_stable_at_no_period() -> None:
    found = adp.held_stability(
        lambda x: 0 * x[..., :1], systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]), 0.1
    )
    assert found.spectral_radius == pytest.approx(1.0, abs=1e-6)
    assert found.largest_period is None


def test_one_state_is_optimised_by_shooting_as_its_riccati_equation_says() -> None:
    value = math.sqrt(DECAY**2 + 1) - DECAY
    found = adp.DirectShooting(ONE, COST, intervals=8, horizon=1.0).solve(X)
    assert found.converged.tolist() == [True] * 3
    torch.testing.assert_close(found.value, value * X.square().squeeze(-1), rtol=1e-5, atol=0)
    torch.testing.assert_close(found.gradient, 2 * value * X, rtol=1e-4, atol=0)
    torch.testing.assert_close(found.control, -value * X, rtol=1e-4, atol=0)
    tight = adp.DirectShooting(ONE, COST, intervals=8, horizon=1.0, low=-0.1, high=0.1).solve(X)
    assert tight.converged.tolist() == [True] * 3
    assert float(tight.control[0]) == pytest.approx(-0.1)
    assert float(tight.value[0]) > float(found.value[0])
    torch.testing.assert_close(tight.value[2], found.value[2], rtol=1e-5, atol=0)


@pytest.mark.needs_compiler
@torch.no_grad()
def test_two_states_are_asked_at_once_and_one_by_one() -> None:
    policy = adp.RolloutPolicy.of_lqr(ONE, COST, centers=3, steps=2)
    policy._compiled._asked = float("inf")
    wanted = policy.control(X)
    for x, u in ((X, wanted), (X[:2], wanted[:2]), (X[:1], wanted[:1]), (X[1], wanted[1])):
        for _ in range(2):
            torch.testing.assert_close(policy(x), u, rtol=1e-10, atol=1e-12)
    assert policy._compiled.compiled
