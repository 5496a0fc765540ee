"""No step reads a tensor back to the host: on the meta device, which has no numbers, that would raise."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch import StaFBasis, adp, centers, kernels, lanes, optim, systems, targets
from staf_torch.adp.closed_loop import ClosedLoop
from staf_torch.metrics.ball_error import StateErrorPass
from staf_torch.optim.objective import NativeError, Precomputed

DIRECTIONS = torch.tensor([[1.0, 0.0], [-0.5, 0.8], [-0.5, -0.8]], dtype=torch.float64)


@pytest.mark.parametrize("kernel", [kernels.ExponentialKernel(), kernels.GaussianKernel(1.0)])
@pytest.mark.parametrize("radius", [0.3, centers.StateRadius(0.7, 0.01)])
@pytest.mark.parametrize("law", [optim.SteepestDescent(), optim.ConjugateGradient(), optim.Nesterov()])
def test_a_chase_on_a_device_stays_there(kernel: Any, radius: Any, law: optim.UpdateLaw) -> None:
    following = centers.StateFollowingCenters(DIRECTIONS, radius)

    def step(carry: Any, x: Tensor, _: Any) -> Any:
        near = following(x)
        gram = kernel(near, near)
        objective = NativeError(gram, near.square().sum(-1), Precomputed(extremes=torch.ones_like(x) * 2.0))
        carry = carry[0], law.begin(objective, *carry)
        carry = lanes.repeat(2, lambda c: law.step(objective, *c), carry)
        return carry, carry[0]

    states = torch.empty(5, 4, 2, dtype=torch.float64, device="meta")
    weights = states.new_empty(5, 3)
    end, history = lanes.Program(step)((weights, law.init(weights)), states)
    assert end[0].device.type == history.device.type == "meta"
    assert history.shape == (5, 4, 3)


def test_the_meta_device_notices_a_value_that_is_read() -> None:
    x = torch.empty(3, 2, device="meta")
    with pytest.raises((RuntimeError, NotImplementedError), match="meta"):
        lanes.Program(lambda x, _, __: (x if bool((x > 0).all()) else -x, ()))(x, steps=1)


@pytest.mark.parametrize("kernel", [kernels.ExponentialKernel, kernels.GaussianKernel, kernels.MaternKernel])
@pytest.mark.parametrize("radius", [0.3, centers.StateRadius(0.7, 0.01)])
def test_the_errors_around_states_on_a_device_stay_there(kernel: Any, radius: Any) -> None:
    basis = StaFBasis(kernel(), centers.StateFollowingCenters(DIRECTIONS, radius)).to("meta")
    x = torch.empty(3, 6, 2, dtype=torch.float64, device="meta")
    ideal = basis.ideal_weights(x, targets.Paper())
    errors = StateErrorPass(basis, targets.Paper())(x, ideal, ideal)
    assert {(part.device.type, tuple(part.shape)) for part in errors} == {("meta", (3, 6))}


@pytest.mark.parametrize("law", [adp.laws.Information, adp.laws.Published, adp.laws.Frozen])
def test_a_learning_closed_loop_on_a_device_stays_there(law: Any) -> None:
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    following = centers.StateFollowingCenters(DIRECTIONS, centers.StateRadius(0.7, 1e-5))
    basis = adp.StaFValueBasis(StaFBasis(kernels.AnchoredKernel(kernels.ExponentialKernel()), following))
    points = adp.RandomPoints(1, centers.StateRadius(2.1, 1e-5))
    loop = ClosedLoop(adp.ActorCritic(basis, plant, cost, points, law()), plant, cost, dt=1e-3).to("meta")
    x0 = torch.empty(3, 2, dtype=torch.float64, device="meta")
    state, u = loop(loop.init(x0), x0.new_empty(3, loop.controller.draws, 2))
    assert {part.device.type for part in (u, state.x, state.alive, state.cost, *state.carried)} == {"meta"}


def test_a_rollout_policy_on_a_device_stays_there() -> None:
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    policy = adp.RolloutPolicy.of_lqr(plant, cost, steps=2).to("meta")
    assert policy(torch.empty(3, 2, dtype=torch.float64, device="meta")).device.type == "meta"
