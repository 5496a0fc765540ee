"""What no table of rules reads from the source: shapes, sizes that do not fit, objects of another kind.

One line each; the words that a user meets.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers_swingup import double_integrator

import staf_torch as st
from staf_torch import adp, deploy, systems, theory
from staf_torch.adp.sampled_rollout import SampledRollout
from staf_torch.approximation.sensitivity import weight_jacobian
from staf_torch.deploy.controllers import ActorPolicy
from staf_torch.envs.episodes import Episodes
from staf_torch.lanes.tracing import trace
from staf_torch.systems import trajectory
from staf_torch.theory.uniform_approximation import ball_grid

PLANT, COST = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1)
LQR = adp.LQR(PLANT, COST)
HELD = adp.LQR(PLANT, COST, period=0.1)
DISCOUNTED = adp.QuadraticCost(1.0, 1.0, 2, 1, discount=0.1)
BASIS = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.rings(3), 0.3))
PAPER = st.targets.Paper()
EYE = torch.eye(2, dtype=torch.float64)
MANY = systems.Linear((-EYE).tolist(), [[1.0] * 13] * 2)
INTEGRATOR = double_integrator(-1.0, 1.0)
LIBRARY = adp.BoxDDP(INTEGRATOR, steps=60, compile=False).solve(0.3 * EYE)
MEMORY = adp.GlobalValue(INTEGRATOR, LIBRARY, [3.0, 3.0])
ACTUATORS = adp.ParametricPlant.of_effectiveness(PLANT)
WINDOWS, ESTIMATE = adp.IntegralWindows(ACTUATORS, 0.1), adp.LeastSquares([1.0], 0.5)
POINTS = adp.RandomPoints(1, 1.0)
LEARNER = adp.ActorCritic(adp.QuadraticBasis(2), PLANT, COST, POINTS)
THREE = torch.zeros(1, 3, dtype=torch.float64)
TWO = torch.zeros(1, 2, dtype=torch.float64)
STAF = st.StaF(BASIS).fit_(torch.zeros(2, dtype=torch.float64), PAPER)
EXPERIENCE = st.ExperienceMemory(BASIS, 4)
BOX = systems.Barrier(PLANT, [-2.0, None], [2.0, None])


def still(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    """A disc that stands far away."""
    return (x - 9.0).square().sum(-1) - 1.0


def regressor(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Of one parameter, in the second row of two states."""
    return torch.stack((0 * x[..., 0], x[..., 0]), -1).unsqueeze(-1)


def stream_drift(**given: Any) -> adp.StreamDrift:
    settings = {"known": PLANT, "kernel": st.GaussianKernel(2.0), "offsets": EYE, "rows": [1], **given}
    return adp.StreamDrift(
        settings.pop("known"),
        settings.pop("kernel"),
        settings.pop("offsets"),
        **{"deviation": 1.0, "length": 0.1, **settings},
    )


def parametric(**given: Any) -> adp.ParametricPlant:
    settings = {"regressor": regressor, "dim": 2, "inputs": 1, "theta": [0.5], **given}
    return adp.ParametricPlant(settings.pop("regressor"), lambda x, u: x * u, **settings)


def kalman(**given: Any) -> adp.KalmanFilter:
    return adp.ExtendedKalman(PLANT, lambda x: x[..., :1], **{"noise": [0.1], **given})


def observed(**given: Any) -> Any:
    return adp.Observed(adp.Feedback(HELD), kalman(), **{"deviation": 1.0, **given})


def regressed(x: Any = None, **given: Any) -> Any:
    """A regressor that has met one sample, where its arguments are checked."""
    x = torch.tensor([0.1, 0.2]) if x is None else x
    return st.StaFRegressor(**given).partial_fit(x, x[..., 0])


REFUSED: dict[str, tuple[Callable[[], Any], str]] = {
    # approximation
    "basis": (lambda: BASIS(THREE, TWO[0]), "must have 2 entries in its last dimension"),
    "basis of no points": (
        lambda: BASIS(TWO[0], TWO[0]),
        "`StaFBasis(y=...)` must have at least 2 dimensions",
    ),
    "local": (lambda: BASIS.local(THREE), "`StaFBasis.local(x=...)` must have 2 entries"),
    "jacobian": (lambda: weight_jacobian(BASIS, THREE, PAPER), "`weight_jacobian(x=...)` must have 2"),
    "centers": (lambda: BASIS.centers(THREE), "`StateFollowingCenters(x=...)` must have 2 entries"),
    "rowwise": (lambda: STAF.rowwise(THREE), "`StaF.rowwise(y=...)` must have 2 entries"),
    "hessian": (lambda: STAF.hessian(THREE), "`StaF.hessian(y=...)` must have 2 entries"),
    "mode of a hessian": (lambda: STAF.hessian(TWO, mode="no"), "`StaF.hessian(mode=...)` must be one of"),
    "points": (lambda: STAF(THREE), "must have 2 entries in its last dimension"),
    "target of a basis": (lambda: BASIS.values(TWO, lambda y: y), "must map points of shape (..., n)"),
    "weights of a chase": (
        lambda: st.chase(
            0.1 * torch.ones(1, 2, 2).double(), BASIS, PAPER, st.optim.SteepestDescent(), weights=TWO[0]
        ),
        "(weights=...)` must have 3 entries",
    ),
    # memory
    "start of a memory": (lambda: EXPERIENCE.start(THREE[0]), "`ExperienceMemory.start(x=...)` must have 2"),
    "points of a memory": (lambda: EXPERIENCE(THREE), "`ExperienceMemory(y=...)` must have 2 entries"),
    "state of a memory": (
        lambda: EXPERIENCE.add(THREE[0], THREE[0]),
        "`ExperienceMemory.add(x=...)` must have 2 entries",
    ),
    "coefficients of a memory": (
        lambda: EXPERIENCE.add(TWO[0], TWO[0]),
        "`ExperienceMemory.add(coefficients=...)` must have 3 entries",
    ),
    # streams
    "robust": (lambda: regressed(robust=0.0), "`StaFRegressor(robust=...)` must be positive"),
    "robust of a bank": (lambda: regressed(robust=0.0, memory=128), "(robust=...)` must be positive"),
    "noise": (lambda: regressed(noise=0.0), "`StaFRegressor(noise=...)` must be positive"),
    "forgetting": (lambda: regressed(forgetting="no"), "`StaFRegressor(forgetting=...)` must be a number"),
    "no forgetting": (lambda: regressed(forgetting=0.0), "(forgetting=...)` must be in (0, 1]"),
    "follow": (lambda: regressed(follow="no"), "`StaFRegressor(follow=...)` must be a number"),
    "scaling": (lambda: regressed(scaling=1), "`StaFRegressor(scaling=...)` must be true or false"),
    "memory": (lambda: regressed(memory=3), "`StaFRegressor(memory=...)` must be at least"),
    "neighbours": (lambda: regressed(memory=128, neighbours=7), "(neighbours=...)` must be at least 8"),
    "directions": (lambda: regressed(centers=2.0 * EYE), "must be directions (M, 2) in the closed unit ball"),
    "directions of space": (
        lambda: regressed(centers=torch.eye(3, dtype=torch.float64)),
        "must be directions (M, 2) in the closed unit ball",
    ),
    "streams to add": (
        lambda: regressed(0.1 * EYE, robust=3.0).add(0),
        "add(streams=...)` must be at least 1",
    ),
    "streams to drop": (lambda: regressed(0.1 * EYE).drop([0, 1]), "(streams=...)` must leave a stream"),
    # theory
    "states of constants": (
        lambda: theory.drift_constants(BASIS, PAPER, THREE, THREE),
        "`drift_constants(states=...)` must have 2 entries",
    ),
    "velocities of constants": (
        lambda: theory.drift_constants(BASIS, PAPER, TWO, THREE),
        "`drift_constants(velocities=...)` must",
    ),
    "states of the paper's step": (
        lambda: theory.paper_step(BASIS, PAPER, THREE, THREE, excess=1.0),
        "`paper_step(states=...)` must have 2 entries",
    ),
    "inner steps": (
        lambda: theory.ultimate_bound(
            theory.DriftConstants(10.0, 1.0, 0.1), st.optim.SteepestDescent(), dt=0.1, inner_steps=0
        ),
        "(inner_steps=...)` must be at least 1",
    ),
    "power function": (
        lambda: theory.power_function(BASIS, THREE, TWO),
        "`power_function(x=...)` must have 2 entries",
    ),
    "points of a power function": (
        lambda: theory.power_function(BASIS, TWO, THREE),
        "`power_function(z=...)` must have 2 entries",
    ),
    "layouts": (
        lambda: theory.layout_errors(st.GaussianKernel(), PAPER, TWO, 0.3, [THREE]),
        "(layouts=...)` must have 2 entries",
    ),
    "states of layouts": (
        lambda: theory.layout_errors(st.GaussianKernel(), PAPER, TWO[0, 0], 0.3, [TWO]),
        "`layout_errors(states=...)` must have at least 1 dim",
    ),
    "fineness": (lambda: ball_grid(2, 0, 3), "`ball_grid(shells=...)` must be at least 1"),
    # plants
    "path": (lambda: list(trajectory(PLANT, THREE, dt=0.1, steps=1)), "`trajectory(x0=...)` must have 2"),
    "bound": (lambda: systems.Bounds("no", None, 1), "`Bounds(low=...)` must be a number or one an input"),
    "bounds": (lambda: systems.Bounds(["no"], None, 1), "`Bounds(low=...)` must be a number or one an input"),
    "input matrix": (lambda: systems.Linear([[0.0]], [[1.0], [1.0]]), "must have 1 rows, one a state"),
    "inertia": (lambda: systems.TwoLinkRobot([1.0, 2.0]), "`TwoLinkRobot(inertia=...)` must have 3 entries"),
    "inertia of nothing": (lambda: systems.TwoLinkRobot([3.0, 0.0, 0.2]), "(inertia=...)` must be positive"),
    "friction": (lambda: systems.TwoLinkRobot(friction=[1.0]), "(friction=...)` must have 4 entries"),
    "parameters": (lambda: systems.TwoStateChain([1.0]), "`TwoStateChain(theta=...)` must have 4 entries"),
    "states of a plant": (
        lambda: systems.RatePlant(lambda x, u: x, dim=0, inputs=1),
        "`RatePlant(dim=...)` must be at least 1",
    ),
    "inputs of a plant": (
        lambda: systems.RatePlant(lambda x, u: x, dim=1, inputs=0),
        "`RatePlant(inputs=...)` must be at least 1",
    ),
    "angles of a plant": (
        lambda: systems.RatePlant(lambda x, u: x, dim=1, inputs=1, periodic=[1]),
        "`RatePlant(periodic=...)` must be coordinates of 1",
    ),
    "equilibrium": (
        lambda: systems.RatePlant(lambda x, u: x + u, dim=1, inputs=1, equilibrium=["no"]),
        "(equilibrium=...)` must be a list of numbers",
    ),
    "size of an equilibrium": (
        lambda: systems.RatePlant(lambda x, u: x + u, dim=1, inputs=1, equilibrium=[0.0, 0.0]),
        "(equilibrium=...)` must be 1 numbers, or those and 1 of the input",
    ),
    # costs
    "discount": (lambda: adp.QuadraticCost(1.0, 1.0, 2, 1, discount=-1.0), "(discount=...)` must not be neg"),
    "discount as a tensor": (
        lambda: adp.QuadraticCost(1.0, 1.0, 2, 1, discount=EYE[0, 0]),
        "(discount=...)` must be a number",
    ),
    "control": (
        lambda: adp.BoundedInputCost(1.0, [[2.0, 1.0], [1.0, 2.0]], 2, 2, bound=1.0),
        "`BoundedInputCost(control=...)` must be diagonal",
    ),
    "weights of states": (lambda: adp.QuadraticCost(["no", 1.0], 1.0, 2, 1), "must be a list of numbers"),
    "weights of a state": (lambda: adp.QuadraticCost([True, 1.0], 1.0, 2, 1), "must be a list of numbers"),
    "infinite weights": (
        lambda: adp.QuadraticCost(torch.tensor([[math.inf, 0.0], [0.0, 1.0]]), 1.0, 2, 1),
        "(state=...)` must be finite",
    ),
    "set-point": (
        lambda: adp.QuadraticCost(1.0, 1.0, 2, 1, target=[1.0]),
        "(target=...)` must have 2 numbers",
    ),
    "set-point of words": (
        lambda: adp.QuadraticCost(1.0, 1.0, 2, 1, target=["no", 1.0]),
        "(target=...)` must be a list of numbers",
    ),
    "output": (
        lambda: adp.QuadraticCost(1.0, 1.0, 2, 1, output=lambda x: x[0]),
        "(output=...)` must map (..., 2) to (..., p)",
    ),
    # controllers
    "weights of a critic": (
        lambda: adp.ActorCritic(adp.QuadraticBasis(2), PLANT, COST, POINTS, critic=TWO[0]),
        "`ActorCritic(critic=...)` must have 3 entries",
    ),
    "gains": (lambda: adp.Gains(critic="no"), "`Gains(critic=...)` must be a number"),
    "weights of a policy": (lambda: ActorPolicy(LEARNER, TWO[0]), "`ActorPolicy(weights=...)` must have 3"),
    "weights of no policy": (
        lambda: deploy.policy_of(adp.Feedback(LQR), TWO[0]),
        "`policy_of(weights=...)` must be None for Feedback",
    ),
    "model of a rollout": (
        lambda: adp.RolloutPolicy(
            BASIS, systems.StepPlant(lambda x, u: 0.9 * x + u, dim=2, inputs=1, dt=0.1), COST, LQR, LQR.value
        ),
        "`RolloutPolicy(model=...)` must be a ControlAffineSystem",
    ),
    "basis of a rollout": (
        lambda: SampledRollout(
            st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.simplex(3), 0.3)),
            *(PLANT, COST, HELD, HELD.value, HELD.p),
            period=0.1,
        ),
        "`SampledRollout(basis=...)` must have the plant's 2 states or its 1 inputs",
    ),
    "spread of a report": (
        lambda: adp.near_optimal(PLANT, COST, dt=0.1).report(spread=-1.0),
        "`report(spread=...)` must be positive",
    ),
    "states of a filter": (
        lambda: adp.SafetyFilter(LQR, PLANT, still, dt=0.1).restrain(THREE, TWO[:, :1]),
        "`SafetyFilter(x=...)` must have 2 entries",
    ),
    "controls of a filter": (
        lambda: adp.SafetyFilter(LQR, PLANT, still, dt=0.1).restrain(TWO, TWO),
        "`SafetyFilter(u=...)` must have 1 entries",
    ),
    "states of a box": (
        lambda: adp.BoxFilter(adp.LQR(BOX, COST), BOX, dt=0.1)(THREE),
        "`BoxFilter(s=...)` must have 2 entries",
    ),
    "states of a value": (lambda: MEMORY.value(THREE), "`GlobalValue.value(x=...)` must have 2 entries"),
    "region": (lambda: adp.GlobalValue(INTEGRATOR, LIBRARY, [1.0]), "(region=...)` must have 2 entries"),
    "angles of a problem": (
        lambda: adp.SampledProblem(INTEGRATOR.step, dim=2, inputs=1, periodic=[2]),
        "`SampledProblem(periodic=...)` must be coordinates of 2",
    ),
    "goal": (
        lambda: adp.SampledProblem(INTEGRATOR.step, dim=2, inputs=1, goal=THREE[0]),
        "`SampledProblem(goal=...)` must have 2 entries",
    ),
    "discount of a problem": (
        lambda: adp.SampledProblem.of(PLANT, DISCOUNTED, dt=0.1),
        "`SampledProblem.of(cost=...)` must have no discount",
    ),
    "period of a problem": (
        lambda: adp.SampledProblem.of(
            systems.StepPlant(lambda x, u: 0.9 * x + u, dim=2, inputs=1, dt=0.1), COST, dt=0.2
        ),
        "`SampledProblem.of(dt=...)` must be the plant's period, 0.1 s",
    ),
    "start of a search": (
        lambda: adp.BoxDDP(INTEGRATOR, steps=4, compile=False).solve(THREE),
        "`BoxDDP.solve(x0=...)` must have 2 entries",
    ),
    "start of shooting": (
        lambda: adp.DirectShooting(PLANT, COST).solve(THREE),
        "`DirectShooting.solve(x0=...)` must have 2 entries",
    ),
    "start of a loop": (
        lambda: adp.simulate(adp.Feedback(LQR), PLANT, COST, THREE, dt=0.1, steps=1),
        "`simulate(x0=...)` must have 2 entries",
    ),
    "seeds of a loop": (
        lambda: adp.simulate(adp.Feedback(LQR), PLANT, COST, TWO, dt=0.1, steps=1, seed=[0, 1]),
        "`simulate(seed=...)` must be one a row, 1",
    ),
    "cost of a loop": (
        lambda: adp.simulate(
            adp.Feedback(LQR), PLANT, adp.QuadraticCost(1.0, 1.0, 3, 1), TWO, dt=0.1, steps=1
        ),
        "`simulate(cost=...)` must be for the plant's 2 states",
    ),
    "example of a trace": (lambda: trace(LQR, TWO[0]), "`trace(example=...)` must have at least 2 dim"),
    # adaptation
    "model of an actor-critic": (
        lambda: adp.AdaptiveActorCritic(
            adp.ActorCritic(
                adp.QuadraticBasis(3), systems.ThreeState(), adp.QuadraticCost(1.0, 1.0, 3, 2), POINTS
            ),
            *(ACTUATORS, WINDOWS, ESTIMATE),
        ),
        "`AdaptiveActorCritic(model=...)` must have the 3 states of the learner's basis",
    ),
    "law of an actor-critic": (
        lambda: adp.AdaptiveActorCritic(LEARNER, ACTUATORS, WINDOWS, adp.LeastSquares([1.0, 1.0], 0.5)),
        "`AdaptiveActorCritic(law=...)` must have the model's 1 parameters",
    ),
    "discount of an LQR": (
        lambda: adp.AdaptiveLQR(ACTUATORS, DISCOUNTED, WINDOWS, ESTIMATE),
        "`AdaptiveLQR(cost=...)` must have no discount",
    ),
    "law of an LQR": (
        lambda: adp.AdaptiveLQR(ACTUATORS, COST, WINDOWS, adp.LeastSquares([1.0, 1.0], 0.5)),
        "`AdaptiveLQR(law=...)` must have the model's 1 parameters",
    ),
    "doublings of an LQR": (
        lambda: adp.AdaptiveLQR(ACTUATORS, COST, WINDOWS, ESTIMATE, doublings=4, a_step=3),
        "`AdaptiveLQR(a_step=...)` must divide the 4 doublings",
    ),
    "discount of a drift": (
        lambda: adp.DriftLQR(stream_drift(), DISCOUNTED),
        "`DriftLQR(cost=...)` must have no discount",
    ),
    "doublings of a drift": (
        lambda: adp.DriftLQR(stream_drift(), COST, doublings=4, a_step=3),
        "`DriftLQR(a_step=...)` must divide the 4 doublings",
    ),
    "known of a drift": (
        lambda: stream_drift(known=None),
        "`StreamDrift(known=...)` must be a ControlAffine",
    ),
    "kernel of a drift": (
        lambda: stream_drift(kernel=st.ExponentialKernel()),
        "`StreamDrift(kernel=...)` must be translation invariant",
    ),
    "offsets of a drift": (lambda: stream_drift(offsets=THREE), "(offsets=...)` must be numbers (M, 2)"),
    "offsets of nothing": (
        lambda: stream_drift(offsets=0 * EYE),
        "(offsets=...)` must be finite, and not all of them 0",
    ),
    "offsets far away": (
        lambda: stream_drift(offsets=EYE + math.inf),
        "(offsets=...)` must be finite, and not all of them 0",
    ),
    "gain": (lambda: adp.ConcurrentGradient(gain=0.0), "`ConcurrentGradient(gain=...)` must be positive"),
    "rate": (lambda: adp.ConcurrentGradient(rate=0.0), "`ConcurrentGradient(rate=...)` must be positive"),
    "noise of a filter": (lambda: kalman(noise=[]), "(noise=...)` must be positive numbers, one an output"),
    "noise of words": (lambda: kalman(noise=["no"]), "(noise=...)` must be a number"),
    "process of a filter": (
        lambda: kalman(process=[1.0]),
        "(process=...)` must be one number or a list of 2",
    ),
    "process below zero": (lambda: kalman(process=-1.0), "(process=...)` must not be negative"),
    "deviation": (
        lambda: observed(deviation=[1.0]),
        "`Observed(deviation=...)` must be one number or a list",
    ),
    "no deviation": (lambda: observed(deviation=0.0), "`Observed(deviation=...)` must be positive"),
    "mean": (lambda: observed(mean=[1.0]), "`Observed(mean=...)` must have 2 entries"),
    "noise of consideration": (
        lambda: adp.ConsiderFilter(ACTUATORS, noise=[1.0, 0.0]),
        "`ConsiderFilter(noise=...)` must be positive",
    ),
    "process of consideration": (
        lambda: adp.ConsiderFilter(ACTUATORS, noise=1.0, process=-1.0),
        "`ConsiderFilter(process=...)` must not be negative",
    ),
    "first estimate": (lambda: adp.LeastSquares(["no"], 1.0), "`LeastSquares(theta=...)` must be a list of"),
    "deviations": (
        lambda: adp.LeastSquares([1.0], [1.0, 1.0]),
        "(deviation=...)` must be one number or a list",
    ),
    "states of a parametric plant": (
        lambda: parametric(dim=0),
        "`ParametricPlant(dim=...)` must be at least 1",
    ),
    "infinite parameters": (lambda: parametric(theta=[math.inf]), "(theta=...)` must be finite"),
    "no parameters": (lambda: parametric(theta=[]), "(theta=...)` must be (..., p) with p at least 1"),
    "one number for parameters": (lambda: parametric(theta=1.0), "(theta=...)` must be (..., p) with p at l"),
    "rows of a regressor": (
        lambda: parametric(rows=[0]),
        "`ParametricPlant(rows=...)` must have all states whose regressor does not vanish",
    ),
    "regressor at rest": (
        lambda: parametric(regressor=lambda x, u: 1 + regressor(x, u)).family(),
        "`ParametricPlant(regressor=...)` must vanish at the set-point",
    ),
    "set-point of what changes": (
        lambda: adp.ChangingPlant(ACTUATORS).cost(adp.QuadraticCost(1.0, 1.0, 2, 1, target=[1.0, 0.0])),
        "`ChangingPlant(cost=...)` must be of x itself at the origin",
    ),
    "least parameters": (
        lambda: adp.RobustFilter(
            adp.Feedback(HELD),
            ACTUATORS,
            still,
            WINDOWS,
            ESTIMATE,
            theta_low=["no"],
            theta_high=[1.0],
            dt=0.1,
        ),
        "`RobustFilter(theta_low=...)` must be a list of numbers",
    ),
    "greatest parameters": (
        lambda: adp.RobustFilter(
            adp.Feedback(HELD),
            ACTUATORS,
            still,
            WINDOWS,
            ESTIMATE,
            theta_low=[0.5],
            theta_high=["no"],
            dt=0.1,
        ),
        "`RobustFilter(theta_high=...)` must be a list of numbers",
    ),
    "noise of a process": (
        lambda: st.optim.RecursiveLeastSquares(process_noise=EYE[0, 0]),
        "`RecursiveLeastSquares(process_noise=...)` must be a number",
    ),
    "prior": (lambda: st.optim.RecursiveLeastSquares(prior=0.0), "(prior=...)` must be positive"),
    "batch of a trace": (lambda: trace(LQR, TWO, batch=0), "`trace(batch=...)` must be at least 1"),
    "a truth value for a bound": (
        lambda: systems.Bounds(True, None, 1),
        "(low=...)` must be a number or one",
    ),
    "inputs of a rollout": (
        lambda: SampledRollout(
            BASIS, MANY, adp.QuadraticCost(1.0, 1.0, 2, 13), HELD, HELD.value, HELD.p, period=0.1
        ),
        "`SampledRollout(plant=...)` must have at most",
    ),
    # environments
    "controls of episodes": (
        lambda: Episodes(PLANT, COST, 1, dt=0.1, horizon=1.0, limit=5.0, penalty=1.0).step(TWO),
        "`Episodes.step(u=...)` must have the shape (1, 1)",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_is_refused_in_its_words(name: str) -> None:
    call, words = REFUSED[name]
    with pytest.raises(ValueError, match=re.escape(words)):
        call()
