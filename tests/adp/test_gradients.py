"""A gradient is right, or it raises: none is absent without a word."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from helpers_adaptation import DAMPING
from torch import Tensor, nn
from variants import by_turns

import staf_torch as st
from staf_torch import adp, lanes, online, systems

COST = adp.QuadraticCost(1.0, 0.1, dim=2, inputs=1)
PLANT = systems.Pendulum()
X0 = tensor([[0.5, 0.1], [0.2, -0.3]])


class Gravity(systems.ControlAffineSystem):
    dim, inputs = 2, 1

    def __init__(self, gravity: Tensor) -> None:
        super().__init__()
        self.gravity = gravity

    def drift(self, x: Tensor) -> Tensor:
        return torch.stack((x[..., 1], self.gravity * x[..., 0].sin()), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return tensor([[0.0], [1.0]]).expand(*x.shape, 1)


def loop(
    policy: Any = lambda x: -x.sum(-1, keepdim=True), plant: Any = PLANT, cost: Any = COST, x: Any = X0
) -> Tensor:
    return adp.simulate(policy, plant, cost, x, dt=0.02, steps=2, compile=False).cost


def wanted_control(x: Tensor) -> Tensor:
    return 9 * x.sum(-1, keepdim=True)


def numpy_step(x: Any, u: Any) -> Any:
    return 0.9 * x + 0.1 * u.repeat(2, 1)


def samples() -> tuple[Tensor, Tensor]:
    return uniform(20, 2), uniform(20)


PROBLEM = adp.SampledProblem.of(PLANT, COST, dt=0.05)
BOX = systems.StepPlant(numpy_step, dim=2, inputs=1, dt=0.1)
BASIS = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.rings(3), radius=0.1))
REGRESSOR = st.StaFRegressor().fit(*samples())
WITHOUT: dict[str, tuple[Callable[[Tensor], Any], Tensor]] = {
    "LQR system": (lambda g: adp.LQR(Gravity(g), COST).k, tensor(1.0)),
    "SampledProblem.of plant": (lambda g: adp.SampledProblem.of(Gravity(g), COST, dt=0.05).k, tensor(1.0)),
    "adp.near_optimal plant": (
        lambda g: adp.near_optimal(Gravity(g), COST, dt=0.1, reach="local"),
        tensor(1.0),
    ),
    "BoxDDP.solve x0": (lambda x: adp.BoxDDP(PROBLEM, steps=3, compile=False).solve(x).cost, X0),
    "RecedingHorizon.init x0": (
        lambda x: adp.RecedingHorizon(PROBLEM, steps=3, compile=False).init(x).plan,
        X0,
    ),
    "DirectShooting terminal": (
        lambda s: adp.DirectShooting(
            PLANT, COST, horizon=0.2, intervals=4, terminal=lambda x: s * x[..., 0] ** 2
        ),
        tensor(1.0),
    ),
    "DirectShooting.solve x0": (
        lambda x: adp.DirectShooting(PLANT, COST, horizon=0.2, intervals=4, terminal=0.0).solve(x).value,
        X0,
    ),
    "SafetyFilter constraints": (
        lambda w: adp.SafetyFilter(
            wanted_control, PLANT, lambda x, t: w - x[:, 0], dt=0.02, low=-9.0, high=9.0
        )(X0),
        tensor(0.6),
    ),
    "held_stability policy": (
        lambda k: adp.held_stability(lambda x: -x @ k.mT, PLANT, 0.1),
        tensor([[9.0, 2.0]]),
    ),
    "find_equilibrium plant": (lambda g: systems.find_equilibrium(Gravity(g), [0.1, 0.0]).state, tensor(1.0)),
    "Bounds low": (lambda low: systems.Bounds(low, None, 1).low, tensor([-1.0])),
    "predict x": (REGRESSOR.predict, X0[0]),
    "add coefficients": (
        lambda w: online.ExperienceMemory(BASIS, capacity=2).add(X0[0], w),
        torch.ones(3).double(),
    ),
    "fit_ x": (lambda x: st.StaF(BASIS).fit_(x, st.targets.Paper()), X0[0]),
    "fit_ target": (lambda s: st.StaF(BASIS).fit_(X0[0], lambda x: s * x[..., 0]), tensor(1.0)),
    "fit y": (lambda y: st.StaFRegressor().fit(uniform(20, 2), y), samples()[1]),
}


@pytest.mark.parametrize("name", WITHOUT)
def test_what_runs_without_autograd_refuses_what_requires_a_gradient(name: str) -> None:
    function, at = WITHOUT[name]
    with pytest.raises(
        ValueError, match=rf"{name.split()[1]}` (requires|holds).*`torch.no_grad\(\)`"
    ) as said:
        function(at.clone().requires_grad_())
    assert "\n" not in str(said.value)
    with torch.no_grad():
        function(at.clone().requires_grad_())


def test_the_gradient_of_a_closed_loop_is_there_for_all_that_it_reads() -> None:
    gain = nn.Parameter(torch.ones(1, 2).double())
    own = nn.Module()
    own.gain, own.forward = gain, lambda x: -x @ gain.mT  # type: ignore[method-assign]
    own.lock = threading.Lock()  # what cannot be written down hides nothing beside it
    assert loop(own).requires_grad
    gain.requires_grad_(False)
    assert not loop(own).requires_grad
    stiff = systems.Linear(tensor([[0.0, 1.0], [-1e4, -200.0]]).requires_grad_(), [[0.0], [1.0]])
    with pytest.raises(ValueError, match=r"simulate\(substeps=...\)` must be given where the plant"):
        loop(plant=stiff)


def test_a_policy_that_plans_has_no_derivative() -> None:
    policy = adp.near_optimal(PLANT, COST, dt=0.05, low=-9.0, high=9.0, plan=True, reach="local")
    with pytest.raises(
        ValueError, match=r"`near_optimal\(plan=True\)` computes no gradient, and `x` requires one"
    ):
        policy(X0.clone().requires_grad_())


def test_what_is_designed_without_autograd_refuses_to_be_asked_later() -> None:
    with torch.no_grad():
        lqr = adp.LQR(Gravity(tensor(1.0).requires_grad_()), COST)
    with pytest.raises(ValueError, match="`LQR` computes no gradient"):
        lqr(X0).sum().backward()
    after = BOX.step(X0.clone().requires_grad_(), X0[:, :1])
    with pytest.raises(ValueError, match="of a function without derivatives` computes no gradient"):
        after.sum().backward()


def learner(law: Callable[[adp.Gains], adp.ActorCriticLaw]) -> Callable[..., Tensor]:
    """The cost of a loop of an actor-critic, of a gain, the first weights, Gam(0) and the state."""
    centers = st.StateFollowingCenters(st.rings(3), st.StateRadius(0.7, 1e-5))
    basis = adp.StaFValueBasis(st.StaFBasis(st.AnchoredKernel(st.ExponentialKernel()), centers)).double()
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    points = adp.QuadraturePoints(3, 2, half_width=0.4)

    def found(actor: Tensor, critic: Tensor, weights: Tensor, gain: Tensor, x: Tensor) -> Tensor:
        first = {"critic": critic, "actor": weights, "gain": gain}
        control = adp.ActorCritic(basis, plant, cost, points, law(adp.Gains(actor=actor)), **first)
        return adp.simulate(control, plant, cost, x, dt=0.01, steps=2, compile=False).cost

    return found


def identified(theta: Tensor, critic: Tensor, x: Tensor) -> Tensor:
    plant, cost = systems.TwoStateTracking(), adp.tracking_cost(10.0, 1.0)
    basis = adp.LeadingCoordinates(adp.QuadraticBasis(2), dim=4)
    inside = adp.ActorCritic(basis, plant, cost, adp.RandomPoints(1, half_width=0.3), critic=critic)
    control = adp.IdentifyingTracker(inside, plant, adp.ConcurrentLearning(3, 2), theta)
    return adp.simulate(control, plant, cost, x, dt=0.005, steps=4, compile=False).cost


def adapted(critic: Tensor, actor: Tensor, x: Tensor) -> Tensor:
    first = {"critic": critic, "actor": actor}
    points = adp.QuadraturePoints(3, 2, half_width=0.2)
    inside = adp.ActorCritic(adp.QuadraticBasis(2), DAMPING, COST, points, adp.PolicyIteration(), **first)
    law = adp.LeastSquares([0.0], deviation=1.0, floor=1e-5)
    control = adp.AdaptiveActorCritic(inside, DAMPING, adp.IntegralWindows(DAMPING, 0.02), law)
    return adp.simulate(control, DAMPING, COST, x, dt=0.02, steps=6, compile=False).cost


def tracked(q: Tensor, r: Tensor, size: Tensor, x: Tensor) -> Tensor:
    plant = systems.Clocked(PLANT)
    path = lambda t: torch.stack((size * t.sin(), size * t.cos()), dim=-1)  # noqa: E731
    cost = adp.TrackingCost(q, r, dim=2, inputs=1, path=path)
    return loop(lambda x: x[..., :2] @ tensor([[-9.0], [-3.0]]), plant, cost, plant.at(x))


WEIGHTS = tensor([0.4, 0.3, 0.5]), tensor([0.28, 0.2, 0.3])
LEARNED = tensor(1.2), *WEIGHTS, tensor(2.0), X0
POLICIES: dict[str, tuple[Callable[..., Tensor], tuple[Tensor, ...]]] = {
    "LQR": (adp.LQR(PLANT, COST), (X0,)),
    "near_optimal": (adp.near_optimal(PLANT, COST, dt=0.1, reach="local").control, (X0[:1],)),
    "RolloutPolicy": (adp.RolloutPolicy.of_lqr(PLANT, COST, steps=2), (X0[:1],)),
    "SafetyFilter": (
        lambda x, k, w: adp.SafetyFilter(
            lambda x: x @ k.mT, PLANT, lambda x, t: w - x[:, 0], dt=0.02, decay=9.0
        )(x),
        (tensor([[0.5, 0.1], [0.59, 0.4]]), tensor([[3.0, 1.0]]), tensor(0.6)),
    ),
    "hjb_residual": (
        lambda x, s, g: adp.hjb_residual(Gravity(g), COST, lambda y: s * y.square().sum(-1) ** 2, x),
        (X0, tensor(1.3), tensor(2.0)),
    ),
    "a constant V": (lambda x: adp.hjb_residual(PLANT, COST, lambda y: 0 * y[..., 0] + 1, x), (X0,)),
    "adp.simulate": (
        lambda k, x, g, q: loop(
            lambda x: -x @ k.mT, Gravity(g), adp.QuadraticCost(q, 0.1, dim=2, inputs=1), x
        ),
        (tensor([[1.0, 2.0]]), X0, tensor(1.0), tensor([1.0, 2.0])),
    ),
    "Published": (learner(adp.Published), LEARNED),
    "Information": (learner(adp.Information), LEARNED),
    "Frozen": (learner(adp.Frozen), LEARNED),
    "PolicyIteration": (learner(adp.PolicyIteration), LEARNED),
    "IdentifyingTracker": (identified, (0.1 * torch.ones(3, 2).double(), WEIGHTS[0], uniform(1, 4))),
    "AdaptiveActorCritic": (adapted, (*WEIGHTS, X0[:1])),
    "TrackingCost": (tracked, (tensor([1.0, 2.0]), tensor([[0.1]]), tensor(0.3), X0)),
    "Linear": (lambda a: loop(plant=systems.Linear(a, [[0.0], [1.0]])), (torch.eye(2).double(),)),
    "systems.simulate": (lambda x, g: systems.simulate(Gravity(g), x, dt=0.1, steps=2), (X0, tensor(1.0))),
}


@pytest.mark.parametrize("name", POLICIES)
def test_gradients_that_are_computed_are_right(name: str) -> None:
    function, at = POLICIES[name]
    given = tuple(part.clone().requires_grad_() for part in at)
    assert torch.autograd.gradcheck(function, given, fast_mode=True, atol=1e-4, rtol=1e-3)
    assert not function(*at).requires_grad


FLAT: dict[str, Callable[[Tensor], Tensor]] = {
    "zero": lambda x: 0 * x[..., 0],
    "linear": lambda x: x[..., 0] - 2 * x[..., 1],
    "constant": lambda x: torch.ones_like(x[..., 0]),
}
DOORS: dict[str, Callable[[Callable[[Tensor], Tensor]], Tensor]] = {  # that differentiate a user's function
    "DirectShooting terminal": lambda f: (
        adp.DirectShooting(PLANT, COST, horizon=0.2, intervals=4, terminal=f).solve(X0[:1]).value
    ),
    "BoxDDP terminal": lambda f: (
        adp.BoxDDP(adp.SampledProblem.of(PLANT, COST, dt=0.05, terminal=f), steps=3, compile=False)
        .solve(X0)
        .cost
    ),
    "SafetyFilter constraints": lambda f: adp.SafetyFilter(
        wanted_control, PLANT, lambda x, t: 1 - x[..., 0] + 0.1 * f(x), dt=0.02, decay=9.0
    )(X0),
    "RatePlant rate": lambda f: adp.near_optimal(
        systems.RatePlant(
            lambda x, u: torch.stack((x[..., 1], u[..., 0] + f(x) - f(0 * x)), -1), dim=2, inputs=1
        ),
        COST,
        dt=0.1,
        reach="local",
    )(X0),
    "chase target, tangent": lambda f: (
        st.chase(
            systems.simulate(systems.Oscillator(), X0, dt=0.1, steps=3),
            BASIS,
            f,
            st.optim.SteepestDescent(),
            predictor=st.predictors.Tangent(),
        ).weights
    ),
    "StaF.gradient target": lambda f: st.StaF(BASIS).fit_(X0[0], f).gradient(X0[:1], mode="total", target=f),
    "ChaseOptimizer loss": lambda f: st.optim.ChaseOptimizer(
        [weights := nn.Parameter(X0.clone())], st.optim.SteepestDescent()
    ).step(lambda: f(weights).sum() + 0 * weights.sum()),
}


@pytest.mark.parametrize(("door", "name"), by_turns(DOORS, [*FLAT]))
def test_functions_that_are_linear_or_constant_are_differentiated(door: str, name: str) -> None:
    with lanes.compiling("never"):
        assert bool(DOORS[door](FLAT[name]).isfinite().all())


def test_a_constant_policy_of_one_entry_for_all_rows_is_held() -> None:
    still = adp.held_stability(lambda x: tensor([0.0]), PLANT, 0.1)
    assert still == adp.held_stability(lambda x: 0 * x[..., :1], PLANT, 0.1)
