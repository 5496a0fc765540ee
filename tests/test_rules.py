"""Every argument with a rule: its edge is accepted, what lies beyond is refused by name, rule and value.

The rules are read from the source, `integer("rings", "count", count, least=1)`; how to call is written here.
What no rule in the source says, shapes and kinds that do not fit, is in `REFUSED`.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from helpers_swingup import double_integrator
from variants import CONTROLLERS

import staf_torch as st
from staf_torch import adp, envs, kernels, optim, predictors, systems, theory
from staf_torch.adp.critic.bases import LeadingCoordinates
from staf_torch.adp.estimation import KalmanFilter
from staf_torch.adp.loop.step import ClosedLoop
from staf_torch.adp.policies.sampled_rollout import SampledRollout
from staf_torch.adp.problem.held_linear import exact_hold
from staf_torch.approximation.conditioning import lebesgue_constant, sup_error
from staf_torch.deploy.approximators import RidgeApproximator
from staf_torch.envs.plant_env import Episodes
from staf_torch.numerics.registry import variants, without_arguments
from staf_torch.numerics.riccati import riccati_rows
from staf_torch.systems import trajectory

ROOT = Path(st.__file__).parent
ELSEWHERE = {"settings", "experiments", "sweeps", "cli"}  # rules of the command line
OTHERS = {
    *("ConcurrentTracker", "RobustFilter", "Observed", "ConsiderFilter", "trace", "export_onnx"),
    *("paper_step", "StaF.gradient", "StaF.hessian", "ChaseOptimizer", "AvoidanceCost", "plan_around"),
    *("BoxFilter", "DetourPlans", "TwoLinkRobot", "MujocoPlant", "EnergyShaping"),
}
"""Calls whose rules the tests of their rooms hold."""


class Rule(NamedTuple):
    """A check in the source."""

    call: str
    argument: str
    kind: str
    least: int | None  # of integers
    allowed: tuple[object, ...]  # of choices, where they are written out

    def __str__(self) -> str:
        return f"{self.call}-{self.argument}-{self.kind}"


def rules() -> Iterator[Rule]:
    asked = re.compile(rf"\b({'|'.join(WRONG)})\(")
    for path in sorted(ROOT.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if path.relative_to(ROOT).parts[0] in ELSEWHERE or not asked.search(text):
            continue
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name) or len(node.args) < 3:
                continue
            if node.func.id not in WRONG:
                continue
            names = [arg.value for arg in node.args[:2] if isinstance(arg, ast.Constant)]
            if len(names) != 2 or not all(isinstance(name, str) for name in names):
                continue
            least, allowed = None, ()
            for keyword in node.keywords:
                if keyword.arg == "least" and isinstance(keyword.value, ast.Constant):
                    least = keyword.value.value
            if node.func.id == "choice":
                try:
                    allowed = tuple(ast.literal_eval(node.args[3]))
                except ValueError:
                    allowed = ()
            yield Rule(*names, node.func.id, least, allowed)


PLANT, COST = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1)
LQR = adp.LQR(PLANT, COST)
BASIS = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.rings(3), 0.3))
X = torch.tensor([[0.5, -0.4]], dtype=torch.float64)
EYE = torch.eye(2, dtype=torch.float64)
BOUND = theory.DriftConstants(10.0, speed=1.0, growth=0.1), optim.SteepestDescent()
GRID = adp.RBFGridBasis(2, 2)
ACTUATORS = adp.ParametricPlant.of_effectiveness(PLANT)


def stream_drift(**given: Any) -> adp.StreamDrift:
    usual = {"known": PLANT, "kernel": st.GaussianKernel(2.0), "offsets": EYE}
    return adp.StreamDrift(**{**usual, "rows": [1], "deviation": 1.0, "length": 0.1, **given})


INTEGRATOR = double_integrator(-1.0, 1.0)
LIBRARY = adp.BoxDDP(INTEGRATOR, steps=60, compile=False).solve(X)


def still(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    """A disc that stands far away."""
    return (x - 9.0).square().sum(-1) - 1.0


def listed(given: dict[str, Any], *names: str) -> dict[str, Any]:
    """The given arguments, those with these names as lists of one."""
    return {name: [value] if name in names else value for name, value in given.items()}


def parametric(**given: Any) -> adp.ParametricPlant:
    settings = {"dim": 1, "inputs": 1, "theta": [0.5], **given}

    def regressor(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return x.unsqueeze(-1)

    def known(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return 0 * x if u.shape[-1] == 0 else u

    return adp.ParametricPlant(regressor, known, **settings)


REPORTED = adp.near_optimal(PLANT, COST, dt=0.1, horizon=0.4, substeps=1, reach="local")
WINDOWS, ESTIMATE = adp.IntegralWindows(ACTUATORS, 0.1), adp.LeastSquares([1.0], 0.5)


def of(make: Callable[..., Any], *given: Any, **usual: Any) -> Callable[..., Any]:
    """A call with arguments that are right beside the one in question."""
    return lambda **asked: make(*given, **{**usual, **asked})


def trajectories(**given: Any) -> Any:
    usual = {"dt": 0.1, "steps": 2, "chunk": 2}
    return list(trajectory(systems.Oscillator(), X, **{**usual, **given}))


PLAIN: tuple[Callable[..., Any], ...] = (
    *(adp.QuadraticBasis, st.rings, st.polygon, st.simplex, st.cross_polytope),
    *(st.ConstantRadius, predictors.Tangent, envs.PlantEnv, envs.PlantVectorEnv, envs.classic_control),
    *(adp.PolicyIteration, theory.disc),
)
ROOMS = ((kernels, kernels.Kernel), (optim, optim.UpdateLaw), (systems, systems.Plant))
VARIANTS = {
    **{
        kind.__name__: kind
        for r, base in ROOMS
        for kind in without_arguments(variants(r.__name__, base)).values()
    },
    **{type(make()).__name__: make for make in CONTROLLERS.values()},
}
"""What needs no argument: files of the rooms, and controllers that `tests/variants.py` lists."""
CALLS: dict[str, Callable[..., Any]] = {
    **{each.__name__: each for each in PLAIN},
    "Measured": of(adp.Measured, adp.Feedback(LQR), dim=2),
    "ActorCritic": of(adp.ActorCritic, adp.QuadraticBasis(2), PLANT, COST, adp.RandomPoints(1, 1.0)),
    "StaFValueBasis": of(adp.StaFValueBasis, st.StaFBasis(st.ExponentialKernel(), BASIS.centers)),
    "RBFGridBasis": of(adp.RBFGridBasis, dim=2, points=2),
    "LeadingCoordinates": of(LeadingCoordinates, GRID),
    "ClosedLoop": of(ClosedLoop, adp.Feedback(LQR), PLANT, COST, dt=0.01),
    "Supervised": of(adp.Supervised, adp.Feedback(LQR, LQR.value), LQR, COST),
    "RandomPoints": of(adp.RandomPoints, count=1, half_width=1.0),
    "QuadraturePoints": of(adp.QuadraturePoints, order=1, dim=1, half_width=1.0),
    "ConcurrentLearning": of(adp.ConcurrentLearning, parameters=2, outputs=2),
    "RolloutPolicy": of(adp.RolloutPolicy, BASIS, PLANT, COST, LQR, LQR.value, steps=1, horizon=0.1),
    "exact_hold": of(exact_hold, -EYE, EYE[:, :1], EYE, EYE[:1, :1]),
    "DirectShooting": of(adp.DirectShooting, PLANT, COST),
    "simulate": of(adp.simulate, adp.Feedback(LQR), PLANT, COST, X, dt=0.01, steps=2, compile=False),
    "lebesgue_constant": of(lebesgue_constant, BASIS, X),
    "sup_error": of(sup_error, BASIS, X, st.targets.Paper()),
    "StaF": of(st.StaF, BASIS),
    "ball": of(st.ball, count=2, dim=2),
    "probe_points": of(st.centers.probe_points, dim=2),
    "StateRadius": of(st.StateRadius, radius=1.0, offset=0.1),
    "RidgeApproximator": of(RidgeApproximator, st.StaF(BASIS).fit_(X[0], st.targets.Paper())),
    "Episodes": of(Episodes, PLANT, COST, 1, dt=0.1, horizon=1.0, limit=5.0, penalty=1.0),
    "Agent": of(envs.Agent, LQR),
    "ExperienceMemory": of(st.ExperienceMemory, BASIS, capacity=2),
    "HeavyBall": of(optim.HeavyBall, step=0.5, momentum=0.5),
    "Nesterov": of(optim.Nesterov, step=0.5, momentum=0.5),
    "trajectory": trajectories,
    "ultimate_bound": of(theory.ultimate_bound, *BOUND, dt=0.01, inner_steps=2),
    "step_for_bound": of(theory.step_for_bound, *BOUND, excess=1.0, inner_steps=2),
    "steps_for_bound": of(theory.steps_for_bound, *BOUND, excess=1.0, dt=0.01),
    "IntegralWindows": of(adp.IntegralWindows, ACTUATORS, length=0.1),
    "SlopeWindows": of(adp.SlopeWindows, ACTUATORS),
    "HistoryStack": of(adp.HistoryStack, rows=1, parameters=1),
    "LeastSquares": of(adp.LeastSquares, [1.0], deviation=1.0),
    "AdaptiveActorCritic": of(
        adp.AdaptiveActorCritic,
        adp.ActorCritic(adp.QuadraticBasis(2), PLANT, COST, adp.RandomPoints(1, 1.0)),
        ACTUATORS,
        WINDOWS,
        ESTIMATE,
    ),
    "AdaptiveLQR": of(adp.AdaptiveLQR, ACTUATORS, COST, WINDOWS, ESTIMATE),
    "StreamDrift": stream_drift,
    "DriftLQR": of(adp.DriftLQR, stream_drift(), COST),
    "BoxDDP": of(adp.BoxDDP, INTEGRATOR, steps=4, compile=False),
    "RecedingHorizon": of(adp.RecedingHorizon, INTEGRATOR, steps=4, compile=False),
    "PathIntegral": of(adp.PathIntegral, INTEGRATOR, steps=4, knots=2, compile=False),
    "SampledProblem": of(adp.SampledProblem, INTEGRATOR.step, dim=2, inputs=1),
    "GlobalValue": of(adp.GlobalValue, INTEGRATOR, LIBRARY, [3.0, 3.0]),
    "learn_global_value": of(
        adp.learn_global_value, INTEGRATOR, region=[1.0, 1.0], steps=40, trajectories=2, rounds=0, states=1
    ),
    "DetourRollout": lambda **given: adp.DetourRollout(
        LQR,
        PLANT,
        COST,
        still,
        **{"axes": EYE, "dt": 0.1, "steps": 2, "terminal": LQR.value, **listed(given, "sizes", "lengths")},
    ),
    "BoundedInputCost": of(adp.BoundedInputCost, 1.0, 1.0, dim=2, inputs=1, bound=1.0),
    "SafetyFilter": of(adp.SafetyFilter, LQR, PLANT, still, dt=0.1),
    "SampledRollout": of(SampledRollout, BASIS, PLANT, COST, LQR, LQR.value, LQR.p, period=0.1, steps=4),
    "StepPlant": of(systems.StepPlant, lambda x, u: 0.9 * x + 0.1 * u, dim=1, inputs=1, dt=0.1),
    "ParametricPlant": parametric,
    "held_stability": of(adp.held_stability, LQR, PLANT, period=0.1),
    "near_optimal": of(adp.near_optimal, PLANT, COST, dt=0.1),
    "report": of(REPORTED.report, states=2, optimum=False),
    "riccati_rows": of(riccati_rows, -EYE, EYE, EYE, EYE),
}
"""How to call, with arguments that are right beside the one in question."""

HELD, DISCOUNTED = adp.LQR(PLANT, COST, period=0.1), adp.QuadraticCost(1.0, 1.0, 2, 1, discount=0.1)
EXPERIENCE = st.ExperienceMemory(BASIS, 4)
HELD_PLANT = systems.StepPlant(lambda x, u: 0.9 * x + u, dim=2, inputs=1, dt=0.1)
POINTS, PAPER = adp.RandomPoints(1, 1.0), st.targets.Paper()
TWO, THREE = (torch.zeros(1, size, dtype=torch.float64) for size in (2, 3))
STAF = st.StaF(BASIS).fit_(TWO[0], PAPER)


def regressor(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Of one parameter, in the second row of two states."""
    return torch.stack((0 * x[..., 0], x[..., 0]), -1).unsqueeze(-1)


def rows(**given: Any) -> adp.ParametricPlant:
    settings = {"regressor": regressor, "dim": 2, "inputs": 1, "theta": [0.5], **given}
    return adp.ParametricPlant(settings.pop("regressor"), lambda x, u: x * u, **settings)


def kalman(**given: Any) -> KalmanFilter:
    return adp.ExtendedKalman(PLANT, lambda x: x[..., :1], **{"noise": [0.1], **given})


def observed(**given: Any) -> Any:
    return adp.Observed(adp.Feedback(HELD), kalman(), **{"deviation": 1.0, **given})


def regressed(x: Any = None, **given: Any) -> Any:
    """A regressor that has met one sample, where its arguments are checked."""
    x = torch.tensor([0.1, 0.2]) if x is None else x
    return st.StaFRegressor(**given).partial_fit(x, x[..., 0])


def mixed(**given: Any) -> Any:
    """A mixture that has met one sample."""
    return st.MixtureRegressor(**given).partial_fit(TWO[0], 1.0)


PATH = torch.zeros(1, 3, 2, dtype=torch.float64)
REFUSED: list[tuple[Callable[[], Any], str]] = [
    (lambda: systems.find_equilibrium(PLANT, [0.0, math.nan]), "(x=...)` must be finite"),
    (lambda: st.StaF(BASIS, batch_shape=5), "`StaF(batch_shape=...)` must be a tuple: write `(5,)`"),  # type: ignore[arg-type]
    (lambda: st.chase(PATH, BASIS, PAPER, optim.SteepestDescent), "write `SteepestDescent(...)`"),  # type: ignore[arg-type]
    (lambda: st.chase(PATH, BASIS, None, optim.Exact()), "(target=...)` must be a function of points"),  # type: ignore[arg-type]
    (lambda: adp.QuadraticCost([1.0] * 3, 1.0, 2, 1), "(state=...)` must have 2 entries of a diagonal, or"),
    (lambda: BASIS(THREE, TWO[0]), "must have 2 entries in its last dimension"),
    (lambda: STAF(THREE), "must have 2 entries in its last dimension"),
    (lambda: EXPERIENCE.add(THREE[0], THREE[0]), "`ExperienceMemory.add(x=...)` must have 2 entries"),
    (lambda: regressed(noise=0.0), "`StaFRegressor(noise=...)` must be positive"),
    (lambda: regressed(forgetting="no"), "`StaFRegressor(forgetting=...)` must be a number"),
    (lambda: mixed(memory=3), "`MixtureRegressor(memory=...)` must be at least"),
    (lambda: theory.drift_constants(BASIS, PAPER, THREE, THREE), "`drift_constants(states=...)` must have 2"),
    (
        lambda: systems.Bounds("no", None, 1),
        "`Bounds(low=...)` must be a number or one for each of the 1 inputs",
    ),
    (lambda: systems.Linear([[0.0]], [[1.0], [1.0]]), "must have 1 rows, one a state"),
    (lambda: adp.QuadraticCost(1.0, 1.0, 2, 1, discount=-1.0), "(discount=...)` must not be neg"),
    (
        lambda: adp.BoundedInputCost(1.0, [[2.0, 1.0], [1.0, 2.0]], 2, 2, bound=1.0),
        "`BoundedInputCost(control=...)` must be diagonal",
    ),
    (
        lambda: adp.QuadraticCost(1.0, 1.0, 2, 1, output=lambda x: x[0]),
        "output=...)` must map rows (5, 2)",
    ),
    (
        lambda: adp.ActorCritic(adp.QuadraticBasis(2), PLANT, COST, POINTS, critic=TWO[0]),
        "`ActorCritic(critic=...)` must have 3 entries",
    ),
    (lambda: adp.RolloutPolicy(BASIS, HELD_PLANT, COST, LQR, LQR.value), "(model=...)` must be a Control"),
    (lambda: adp.SafetyFilter(LQR, PLANT, still, dt=0.1).restrain(THREE, TWO[:, :1]), "(x=...)` must have 2"),
    (lambda: adp.SampledProblem.of(HELD_PLANT, COST, dt=0.2), "(dt=...)` must be the plant's period, 0.1 s"),
    (lambda: adp.simulate(adp.Feedback(LQR), PLANT, COST, THREE, dt=0.1, steps=1), "(x0=...)` must have 2"),
    (
        lambda: adp.simulate(
            adp.Feedback(LQR), PLANT, adp.QuadraticCost(1.0, 1.0, 3, 1), TWO, dt=0.1, steps=1
        ),
        "`simulate(cost=...)` must be for the plant's 2 states",
    ),
    (lambda: adp.AdaptiveLQR(ACTUATORS, DISCOUNTED, WINDOWS, ESTIMATE), "(cost=...)` must have no discount"),
    (
        lambda: adp.AdaptiveLQR(ACTUATORS, COST, WINDOWS, adp.LeastSquares([1.0, 1.0], 0.5)),
        "`AdaptiveLQR(law=...)` must have the model's 1 parameters",
    ),
    (lambda: stream_drift(kernel=st.ExponentialKernel()), "`StreamDrift(kernel=...)` must be translation"),
    (lambda: observed(deviation=[1.0]), "`Observed(deviation=...)` must be one number or a list"),
    (lambda: rows(rows=[0]), "`ParametricPlant(rows=...)` must have all states whose regressor does not"),
]
NO_NUMBER: tuple[object, ...] = (math.nan, math.inf, "0.1", True, None)
WRONG: dict[str, tuple[object, ...]] = {
    "positive": (*NO_NUMBER, 0.0, -1.0, torch.tensor([1.0, 0.0]), torch.tensor([1]), torch.tensor(math.nan)),
    "positive_real": (*NO_NUMBER, 0, -1.0, torch.tensor(1.0)),
    "non_negative": (*NO_NUMBER, -1e-300, torch.tensor([0.0, -1.0])),
    "real": (*NO_NUMBER, torch.tensor(1.0)),
    "integer": (True, "3", 2.0, None),
    "flag": (1, "yes", None),
    "choice": ("no such choice",),
}
EDGE: dict[str, tuple[object, ...]] = {"non_negative": (0.0,), "flag": (True, False)}
ABSENT = {
    *("RBFGridBasis.width", "Supervised.momentum", "HeavyBall.momentum", "Nesterov.momentum"),
    *(
        "HeavyBall.step",
        "RolloutPolicy.period",
        "RolloutPolicy.steps",
        "DirectShooting.horizon",
        "StaF.out_features",
    ),
    *("IntegralWindows.first", "LeastSquares.alarm", "HistoryStack.outputs"),
    *("PlantEnv.bound", "PlantEnv.spread", "PlantVectorEnv.spread"),
    *("DirectShooting.iterations", "DirectShooting.intervals"),
    *(
        "simulate.seed",
        "simulate.dt",
        "trajectory.chunk",
        "near_optimal.dt",
        "near_optimal.horizon",
        "report.spread",
        "report.states",
    ),
    *("SafetyFilter.weight", "SafetyFilter.decay", "BoundedInputCost.bound", "PathIntegral.noise"),
}
"""Arguments for which None has a meaning of its own."""
NOT_ALONE = {("rings", "count"), ("SampledProblem", "dim"), ("StepPlant", "dim"), ("report", "states")}
"""Arguments whose least value needs others beside it, or takes seconds."""
EVERY = tuple(rules())
CALLS |= {
    name: make for name, make in VARIANTS.items() if name in {rule.call for rule in EVERY} - {*CALLS, *OTHERS}
}
RULES = sorted({str(rule): rule for rule in EVERY if rule.call in CALLS}.values())


def test_every_call_with_a_rule_is_known_here() -> None:
    assert {rule.call for rule in EVERY} == {*CALLS} | {*OTHERS}


@pytest.mark.parametrize("rule", RULES, ids=str)
def test_the_edge_of_a_rule_is_accepted_and_what_breaks_it_refused_by_name(rule: Rule) -> None:
    wrong = [
        value
        for value in WRONG[rule.kind]
        if value is not None or f"{rule.call}.{rule.argument}" not in ABSENT
    ]
    if rule.kind == "integer" and rule.least is not None:
        wrong += [rule.least - 1, rule.least - 100]
    for value in wrong:
        named = re.escape(f"`{rule.call}({rule.argument}=...)` must ")
        with pytest.raises(ValueError, match=named):
            CALLS[rule.call](**{rule.argument: value})
    if rule.kind not in ("integer", "flag", "choice"):
        with pytest.raises(ValueError, match=rf"`\w+(\.of)?\({rule.argument}=.* (row 1|for all rows)"):
            CALLS[rule.call](**{rule.argument: st.rows(torch.tensor([0.05, math.nan]).double())})
    edge = list(EDGE.get(rule.kind, ())) + list(rule.allowed)
    if rule.kind == "integer" and rule.least is not None and rule[:2] not in NOT_ALONE:
        edge.append(rule.least)
    for value in edge:
        CALLS[rule.call](**{rule.argument: value})


@pytest.mark.parametrize(("call", "words"), REFUSED, ids=[words for _, words in REFUSED])
def test_what_does_not_fit_is_refused_in_its_words(call: Callable[[], Any], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        call()
