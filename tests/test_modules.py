"""What every module owes: it converts, moves, loads, copies and pickles as the same function."""

from __future__ import annotations

import copy
import importlib
import inspect
import pickle
import pkgutil
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor, nn
from variants import CONTROLLERS, KERNELS, PLANTS, SYSTEMS, over

import staf_torch as st
from staf_torch import adp, systems, targets
from staf_torch.adp.critic.bases import LeadingCoordinates
from staf_torch.adp.loop.step import ClosedLoop
from staf_torch.deploy.approximators import LocalApproximator, RidgeApproximator
from staf_torch.deploy.controllers import ActorPolicy, FoldedRollout, GuardedPolicy
from staf_torch.systems.two_state_tracking import true_parameters

X = torch.tensor([[0.5, -0.4], [0.3, 0.7], [-0.2, 0.6]], dtype=torch.float64)  # (B, n)
BOX = (0.7, 1e-2)


class Case(NamedTuple):
    """A module in two versions, and what it computes."""

    make: Callable[[float], nn.Module]  # of a number that changes what is computed
    call: Callable[[Any, Tensor], Tensor] = lambda module, x: module(x)
    carried: bool = True  # by a state dict: the number is in a parameter or buffer, not in an attribute
    constant: bool = False  # made for one precision, which nothing changes


def pair(module: Any, x: Tensor) -> Tensor:
    value: Tensor = module(x, x.flip(0))
    return value


def flows(module: Any, x: Tensor) -> Tensor:
    size = module.dim
    x = torch.cat([x, x.flip(-1), x], -1)[:, :size]
    return torch.cat([module.drift(x), module.effectiveness(x).flatten(1)], -1)


def rates(module: Any, x: Tensor) -> Tensor:
    u = x[:, :1]
    return torch.stack([module.rate(x, u), module.state_rate(x), module.input_rate(u)])


def near(x: Tensor) -> Tensor:
    """h of a half-plane that the states of `X` are near to."""
    return x[..., 0] + 0.5


def control(module: Any, x: Tensor) -> Tensor:
    uniform = 0.5 * x.new_ones(len(x), max(1, module.draws), x.shape[-1])
    u, carried = module.step(x, module.init(x), uniform, 0.01)
    return torch.cat([u, *(part.reshape(len(x), -1) for part in module.recorded(carried).values())], -1)


def loop(module: Any, x: Tensor) -> Tensor:
    after, u = module(module.init(x), x.new_zeros(len(x), 1, 2))
    return torch.cat([after.x, after.cost[:, None], u], -1)


def points(module: Any, x: Tensor) -> Tensor:
    return module(x, x.new_full((len(x), 2, 2), 0.5)).flatten(1)


def learned(module: Any, x: Tensor) -> Tensor:
    return torch.cat([part.reshape(-1) for part in module(x[:2])])


def basis(s: float, kernel: st.Kernel | None = None) -> st.StaFBasis:
    kernel = st.GaussianKernel(s) if kernel is None else kernel
    return st.StaFBasis(kernel, st.StateFollowingCenters(st.rings(3), 0.3 * s))


def staf(s: float, kernel: st.Kernel | None = None) -> st.StaF:
    return st.StaF(basis(s, kernel)).fit_(X[0], targets.Paper())


def values(s: float) -> adp.StaFValueBasis:
    centers = st.StateFollowingCenters(st.rings(3), st.StateRadius(0.7 * s, 1e-2))
    return adp.StaFValueBasis(st.StaFBasis(st.AnchoredKernel(st.GaussianKernel(s)), centers))


def cost(s: float = 1.0) -> adp.QuadraticCost:
    return adp.QuadraticCost(s, 2.0, 2, 1)


def lqr(s: float = 1.0) -> adp.LQR:
    return adp.LQR(systems.TwoState(), cost(s))


def learner(s: float) -> adp.ActorCritic:
    box = adp.RandomPoints(1, st.StateRadius(2.0, 1e-2))
    return adp.ActorCritic(values(s), systems.TwoState(), cost(s), box, critic=0.4 * s, actor=0.3 * s)


def rollout(s: float) -> adp.RolloutPolicy:
    base = lqr()
    return adp.RolloutPolicy(basis(s), systems.TwoState(), cost(s), base, base.value, steps=1, horizon=0.05)


def memory(s: float) -> st.ExperienceMemory:
    held = st.ExperienceMemory(basis(s), 4)
    for x in X:
        held.add(x, staf(s).fit_(x, targets.Paper()).coefficients.detach())
    return held


def tracker(s: float) -> nn.Module:
    plant = systems.TwoStateTracking()
    box = adp.RandomPoints(1, st.StateRadius(2.0, 1e-2))
    centers = st.StateFollowingCenters(st.simplex(4), 0.3 * s)
    critic = adp.ActorCritic(
        adp.StaFValueBasis(st.StaFBasis(st.AnchoredKernel(st.GaussianKernel(s)), centers)),
        plant,
        adp.tracking_cost(1.0, 1.0),
        box,
    )
    return adp.IdentifyingTracker(critic, plant, adp.ConcurrentLearning(3, 2), s * true_parameters())


def tracked(module: Any, x: Tensor) -> Tensor:
    x = torch.cat([x, x.flip(0)], -1)
    u, after = module.step(x, module.init(x), 0.5 * x.new_ones(len(x), 1, 4), 0.01)
    return torch.cat([u, after.known.theta.flatten(1)], -1)


def onwards(t: Tensor) -> Tensor:
    return t.unsqueeze(-1)


def quadrature(s: float) -> nn.Module:
    return adp.QuadraturePoints(2, 2, s)


def listed(made: Iterable[Callable[[], nn.Module]], call: Callable[[Any, Tensor], Tensor]) -> dict[str, Case]:
    """The package's own variants of a table, by class, with the numbers that they have there."""
    kinds = {type(make()): make for make in made}
    own = {kind.__name__: make for kind, make in kinds.items() if kind.__module__.startswith("staf_torch.")}
    return {name: Case(lambda s, make=make: make(), call, carried=False) for name, make in own.items()}


MODULES: dict[str, Case] = {
    **listed((case.make for case in KERNELS.values()), pair),
    **listed((*SYSTEMS.values(), *PLANTS.values()), flows),
    **listed(CONTROLLERS.values(), control),
    "GaussianKernel": Case(st.GaussianKernel, pair),
    "MaternKernel": Case(lambda s: st.MaternKernel(2.5, s), pair),
    "InverseMultiquadricKernel": Case(st.InverseMultiquadricKernel, pair),
    "RationalQuadraticKernel": Case(lambda s: st.RationalQuadraticKernel(s, 2 * s), pair),
    "PolynomialKernel": Case(lambda s: st.PolynomialKernel(2, s), pair),
    "AnchoredKernel": Case(lambda s: st.AnchoredKernel(st.GaussianKernel(s)), pair),
    "ConstantRadius": Case(st.ConstantRadius, lambda module, x: module(x) * x[..., 0]),
    "StateRadius": Case(lambda s: st.StateRadius(s, 0.1 * s, 1.0)),
    "StateFollowingCenters": Case(lambda s: st.StateFollowingCenters(st.rings(3) * s / 2, s)),
    "StaFBasis": Case(basis, lambda module, x: module(x, x[0])),
    "StaF": Case(staf),
    "StaFValueBasis": Case(values, lambda module, x: module(x, x[0])),
    "QuadraticBasis": Case(lambda s: adp.QuadraticBasis(2), pair, carried=False),
    "RBFGridBasis": Case(lambda s: adp.RBFGridBasis(2, 3, s, 0.8), pair),
    "LeadingCoordinates": Case(
        lambda s: LeadingCoordinates(adp.RBFGridBasis(2, 3, s, 0.8), 3),
        lambda module, x: module(torch.cat([x, x], -1)[..., :3], torch.cat([x, x], -1)[..., :3]),
    ),
    "QuadraticCost": Case(cost, rates),
    "AvoidanceCost": Case(
        lambda s: adp.AvoidanceCost(s, 1.0, 2, 1, obstacles=near, reach=1.0, weight=s), rates
    ),
    "TrackingCost": Case(lambda s: adp.TrackingCost(s, 1.0, 1, 1, path=onwards), rates),
    "BoundedInputCost": Case(lambda s: adp.BoundedInputCost(s, 1.0, 2, 1, bound=2.0), rates),
    "RandomPoints": Case(lambda s: adp.RandomPoints(2, st.StateRadius(s, 0.1)), points),
    "QuadraturePoints": Case(quadrature, lambda module, x: module(x, x.new_zeros(len(x), 0, 2)).flatten(1)),
    "LQR": Case(lqr),
    "Feedback": Case(lambda s: adp.Feedback(lqr(s)), control),
    "ActorCritic": Case(learner, control),
    "Supervised": Case(lambda s: adp.Supervised(learner(s), lqr(), cost()), control),
    "RolloutPolicy": Case(rollout),
    "IdentifyingTracker": Case(tracker, tracked),
    "ClosedLoop": Case(
        lambda s: ClosedLoop(adp.Feedback(lqr(s)), systems.TwoState(), cost(s), dt=0.01), loop
    ),
    "TwoStateTracking": Case(lambda s: systems.TwoStateTracking(s * true_parameters()), flows),
    "ExperienceMemory": Case(memory),
    "Linear": Case(lambda s: systems.Linear([[0.0, s], [-s, -0.3]], [[0.0], [s]]), flows),
    "TwoStateChain": Case(lambda s: systems.TwoStateChain([1.0, s, -0.5, 0.5]), flows),
    "TwoLinkRobot": Case(lambda s: systems.TwoLinkRobot(friction=[s, 1.0, 1.0, 1.0]), flows),
    "Barrier": Case(lambda s: systems.Barrier(systems.TwoState(), -s, [s, None]), flows),
    "Clocked": Case(
        lambda s: systems.Clocked(systems.Linear([[-2 * s]], [[s]])),
        lambda module, x: module.motion(x, x[..., :1]),
    ),
    "Paper": Case(lambda s: targets.Paper(), carried=False),
    "Quadratic": Case(targets.Quadratic),
    "Cosine": Case(lambda s: targets.Cosine([s, 2 * s], 0.3)),
    "LocalApproximator": Case(
        lambda s: LocalApproximator(staf(s, st.MaternKernel(2.5, s))), learned, carried=False, constant=True
    ),
    "RidgeApproximator": Case(
        lambda s: RidgeApproximator(staf(s, st.ExponentialKernel())), learned, carried=False
    ),
    "ActorPolicy": Case(lambda s: ActorPolicy(learner(s), torch.full((3,), s, dtype=torch.float64))),
    "GuardedPolicy": Case(lambda s: GuardedPolicy(lqr(s), adp.Supervised(learner(1.0), lqr(), cost()))),
    "FoldedRollout": Case(lambda s: FoldedRollout(rollout(s))),
}
OTHERS = {
    *("KeptPrecision", "FunctionPlant", "StepPlant", "RatePlant", "SampledProblem", "ControllerOfKinds"),
    *("GlobalValue", "BoxFilter", "SafetyFilter", "Conditions", "LookAhead", "DetourPlans"),
    *(
        "DetourRollout",
        "PlanReplay",
        "RememberedPolicy",
        "AmongDiscs",
        "RecedingHorizon",
        "PathIntegral",
        "MujocoPlant",
    ),
    *("EnvironmentPlant", "EnergyShaping", "NearOptimal", "SampledRollout", "StrainedPlans"),
    *("ParametricPlant", "ChangingPlant", "AdaptiveActorCritic", "AdaptiveLQR", "DriftLQR"),
    *("ConcurrentTracker", "Measured", "RobustFilter", "Observed"),
}
"""What wraps a function of the user's own, or takes minutes to make: tested in its room."""


def concrete() -> set[str]:
    """Names of the concrete nn.Modules that the package defines."""
    found = set()
    for info in pkgutil.walk_packages(st.__path__, "staf_torch."):
        if "plugins" in info.name or "__main__" in info.name or ".conf" in info.name:
            continue
        for name, kind in vars(importlib.import_module(info.name)).items():
            own = inspect.isclass(kind) and issubclass(kind, nn.Module) and kind.__module__ == info.name
            if own and not inspect.isabstract(kind) and not name.startswith("_"):
                found.add(name)
    return found


def test_every_module_of_the_package_is_held_to_this() -> None:
    assert concrete() - OTHERS == set(MODULES)


def tensors(module: nn.Module) -> dict[str, Tensor]:
    every = (kind(remove_duplicate=False) for kind in (module.named_parameters, module.named_buffers))
    return {name: held for pairs in every for name, held in pairs if held.is_floating_point()}


@over(MODULES)
def test_a_converted_module_computes_the_same_in_the_new_precision(name: str) -> None:
    case = MODULES[name]
    module, want = case.make(0.9), case.call(case.make(0.9), X).detach()
    assert case.make(0.9).to(torch.float32).state_dict().keys() == module.state_dict().keys()
    assert module.float() is module
    assert {t.dtype for t in tensors(module).values()} <= {torch.float32}
    got = case.call(module, X.float()).detach()
    assert got.dtype == (torch.float64 if case.constant else torch.float32)
    scale = float(want.abs().max())
    torch.testing.assert_close(got.double(), want, rtol=0, atol=2e-4 * scale)
    assert {t.dtype for t in tensors(module.double()).values()} <= {torch.float64}
    again = case.call(module, X).detach()
    assert again.dtype == torch.float64
    torch.testing.assert_close(again, want, rtol=0, atol=1e-5 * scale)  # its numbers went through float32


@over(MODULES)
def test_a_state_dict_carries_the_function_into_a_module_of_other_numbers(name: str) -> None:
    case = MODULES[name]
    source, into = case.make(0.9), case.make(1.2 if case.carried else 0.9)
    want = case.call(source, X)
    if case.carried:
        assert not torch.equal(case.call(into, X), want)
    else:
        with torch.no_grad():
            for held in tensors(into).values():
                held.mul_(1.3)
    result = into.load_state_dict(source.state_dict())
    assert not result.missing_keys
    assert torch.equal(case.call(into, X), want)
    with pytest.raises((RuntimeError, ValueError)):
        into.load_state_dict({**source.state_dict(), "surplus": torch.zeros(())})


@over(MODULES)
def test_a_copy_is_the_same_function_shares_nothing_and_moves_with_all_that_it_holds(name: str) -> None:
    case = MODULES[name]
    module = case.make(0.9)
    twins = copy.deepcopy(module), pickle.loads(pickle.dumps(module))
    want = case.call(module, X).detach().clone()
    assert torch.equal(case.call(twins[0], X), want)
    with torch.no_grad():
        for held in tensors(module).values():
            held.fill_(torch.nan)
    for twin in twins:
        assert torch.equal(case.call(twin, X), want)
    held = set(tensors(module))
    moved = module.to("meta")
    assert {t.device.type for t in (*moved.parameters(), *moved.buffers())} <= {"meta"}
    assert set(tensors(moved)) == held
