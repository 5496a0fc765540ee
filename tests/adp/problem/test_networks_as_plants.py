"""Networks as plants, costs, constraints and policies are taken as they are, and refuse the backward pass."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor
from torch import Tensor, nn

from staf_torch import adp, systems

COST = adp.QuadraticCost(1.0, 0.1, dim=2, inputs=1)
X0 = tensor([[0.3, 0.0], [-0.2, 0.1]])


def network(inputs: int, outputs: int, dtype: torch.dtype = torch.float64) -> nn.Sequential:
    torch.manual_seed(1)
    net = nn.Sequential(nn.Linear(inputs, 6), nn.Tanh(), nn.Linear(6, outputs))
    return net.to(dtype)


NET = network(3, 2)
STEP = systems.StepPlant(lambda x, u: x + 0.05 * NET(torch.cat((x, u), -1)), dim=2, inputs=1, dt=0.05)
RATE = systems.RatePlant(lambda x, u: NET(torch.cat((x, u), -1)), dim=2, inputs=1)


class Own(systems.ControlAffineSystem):
    dim, inputs = 2, 1

    def __init__(self, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        self.net, self.push = network(2, 2, dtype), torch.tensor([[0.0], [1.0]], dtype=dtype)

    def drift(self, x: Tensor) -> Tensor:
        return self.net(x)

    def effectiveness(self, x: Tensor) -> Tensor:
        return self.push.expand(*x.shape, 1)


class Learnt(adp.QuadraticCost):
    """A cost rate that is the square of a network's output."""

    def __init__(self) -> None:
        super().__init__(1.0, 0.1, dim=2, inputs=1)
        self.net = network(2, 1)

    def state_rate(self, x: Tensor) -> Tensor:
        return self.net(x)[..., 0].square()


def refuses(result: Tensor, call: str) -> None:
    with pytest.raises(
        ValueError, match=rf"`{call}` computes no gradient.*call it under `torch.no_grad\(\)`"
    ):
        (result.sum() + sum(part.square().sum() for part in NET.parameters())).backward()


@pytest.mark.parametrize(("plant", "cost"), [(STEP, COST), (Own(), Learnt())])
def test_every_planner_takes_networks_and_refuses_the_backward_pass_to_them(
    plant: systems.Plant, cost: adp.Cost
) -> None:
    problem = adp.SampledProblem.of(plant, cost, dt=0.05, terminal=0.0)
    plan = adp.BoxDDP(problem, steps=4, iterations=2, compile=False).solve(X0)
    refuses(plan.cost, "BoxDDP.solve")
    with torch.no_grad():
        again = adp.BoxDDP(problem, steps=4, iterations=2, compile=False).solve(X0)
    assert torch.equal(again.cost, plan.cost)
    assert not again.cost.requires_grad
    planner = adp.RecedingHorizon(problem, steps=2, compile=False)
    refuses(adp.simulate(planner, plant, cost, X0, dt=0.05, steps=1).cost, "RecedingHorizon.step")
    if plant.period is None:
        shot = adp.DirectShooting(plant, cost, horizon=0.2, intervals=4, terminal=0.0).solve(X0)
        torch.testing.assert_close(shot.value, plan.cost, rtol=0.05, atol=1e-4)
        refuses(shot.control, "DirectShooting.solve")


def test_a_learnt_plant_has_the_regulator_of_the_same_plant_without_parameters() -> None:
    fixed = network(3, 2).requires_grad_(False)
    other = systems.StepPlant(lambda x, u: x + 0.05 * fixed(torch.cat((x, u), -1)), dim=2, inputs=1, dt=0.05)
    torch.testing.assert_close(adp.LQR(STEP, COST).k, adp.LQR(other, COST).k)
    torch.testing.assert_close(
        adp.SampledProblem.of(STEP, COST).k, adp.SampledProblem.of(other, COST).k, rtol=1e-6, atol=1e-9
    )


def test_policies_and_constraints_that_are_networks_run_and_are_filtered() -> None:
    policy, plant = network(2, 1), systems.Pendulum()
    run = adp.simulate(adp.Feedback(policy), plant, COST, X0, dt=0.05, steps=2, compile=False)
    (wanted,) = torch.autograd.grad(run.state.sum(), policy[0].weight)
    assert torch.isfinite(wanted).all()
    wall = network(2, 1)
    filtered = adp.SafetyFilter(policy, plant, lambda x, t: 2 + wall(x)[..., 0], dt=0.05, low=-5.0, high=5.0)
    assert torch.isfinite(filtered(X0)).all()


def test_a_set_point_at_which_a_learnt_plant_does_not_rest_names_the_nearest_and_the_call() -> None:
    aside = adp.QuadraticCost(1.0, 0.1, dim=2, inputs=1, target=[0.0, 0.0])
    said = r"does not rest at the state \[0.0, 0.0\].*The nearest one is .* away.*systems.find_equilibrium"
    with pytest.raises(ValueError, match=said):
        adp.LQR(STEP, aside)
    with pytest.raises(ValueError, match=r"drift` must be 0 at the origin.*The nearest one is"):
        adp.LQR(Own(), COST)
    rest = systems.find_equilibrium(Own(), [0.0, 0.0])
    torch.testing.assert_close(Own().motion(*rest), torch.zeros(2).double())
    there = adp.QuadraticCost(1.0, 0.1, dim=2, inputs=1, target=rest.state, target_input=rest.input)
    lqr = adp.LQR(Own(), there)
    torch.testing.assert_close(lqr(rest.state), rest.input)


def test_a_network_in_float32_says_what_it_says_first_and_what_to_do() -> None:
    net = network(3, 2, torch.float32)
    said = r"as torch tensors of float64 RuntimeError \(mat1 and mat2 must have the same dtype.*`.double\(\)`"
    with pytest.raises(ValueError, match=said):
        systems.StepPlant(lambda x, u: x + 0.05 * net(torch.cat((x, u), -1)), dim=2, inputs=1, dt=0.05)
    with pytest.raises(ValueError, match=r"`Own.drift` must map .* in float32 needs `.double\(\)`"):
        adp.LQR(Own(torch.float32), COST)


def test_a_block_that_small_inputs_do_not_move_is_a_plant() -> None:
    def rate(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((x[:, 1], u[:, 0] - u[:, 0].clamp(-2.0, 2.0) - x[:, 1]), dim=-1)

    assert systems.RatePlant(rate, dim=2, inputs=1).equilibrium().tolist() == [0.0, 0.0]
