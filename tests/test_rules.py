"""Every argument with a rule: its edge is accepted, what lies beyond is refused by name, rule and value.

The rules are read from the source, `integer("rings", "count", count, least=1)`; how to call is written here.
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

import staf_torch as st
from staf_torch import adp, envs, optim, predictors, systems, theory
from staf_torch.adp.bases import LeadingCoordinates
from staf_torch.adp.closed_loop import ClosedLoop
from staf_torch.adp.sampled_rollout import SampledRollout
from staf_torch.adp.sampling import exact_hold
from staf_torch.approximation.conditioning import lebesgue_constant, sup_error
from staf_torch.deploy.approximators import RidgeApproximator
from staf_torch.envs.episodes import Episodes
from staf_torch.systems import trajectory

ROOT = Path(st.__file__).parent
ELSEWHERE = {
    "settings",
    "experiments",
    "sweeps",
    "cli",
}  # rules of the command line: tests/cli/test_cli_errors.py
OTHERS = {
    "ConcurrentTracker": "in tests/adp/adaptation/test_identifiers.py",
    "RobustFilter": "in tests/adp/adaptation/test_robust_filter.py",
    "Observed": "in tests/adp/adaptation/test_kalman.py",
    "ConsiderFilter": "in tests/adp/adaptation/test_consider.py",
    "trace": "takes an exported program",
    "Cosine": "numbers and lists alike, in tests/test_targets.py",
    "paper_step": "of the theorem, in tests/theory/test_errata.py",
    "StaF.gradient": "in tests/approximation/test_module.py",
    "StaF.hessian": "in tests/approximation/test_hessian.py",
    "ChaseOptimizer": "in tests/optim/test_torch_optimizer.py",
    "AvoidanceCost": "in tests/adp/test_avoidance.py",
    "plan_around": "in tests/adp/test_avoidance.py",
    "BoxFilter": "in tests/adp/test_box_filter.py",
    "DetourPlans": "in tests/adp/test_detour_plans.py",
    "TwoLinkRobot": "numbers within a list, in tests/systems/test_barrier.py",
    "MujocoPlant": "in tests/systems/test_mujoco_plant.py",
    "EnergyShaping": "in tests/adp/test_energy_shaping.py",
}
"""Calls whose rules are held elsewhere."""


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
CONSTANTS = theory.DriftConstants(condition_number=10.0, speed=1.0, growth=0.1)
GRID = adp.RBFGridBasis(2, 2)
ACTUATORS = adp.ParametricPlant.of_effectiveness(PLANT)


def stream_drift(**given: Any) -> adp.StreamDrift:
    usual = {"rows": [1], "deviation": 1.0, "length": 0.1}
    return adp.StreamDrift(PLANT, st.GaussianKernel(2.0), torch.eye(2).double(), **{**usual, **given})


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


REPORTED = adp.near_optimal(PLANT, COST, dt=0.1)
WINDOWS, ESTIMATE = adp.IntegralWindows(ACTUATORS, 0.1), adp.LeastSquares([1.0], 0.5)


def bound(name: str) -> Callable[..., Any]:
    function = getattr(theory, name)

    def call(**given: Any) -> Any:
        usual = {
            "ultimate_bound": {"dt": 0.01, "inner_steps": 2},
            "step_for_bound": {"excess": 1.0, "inner_steps": 2},
        }
        settings = usual.get(name, {"excess": 1.0, "dt": 0.01})
        return function(CONSTANTS, optim.SteepestDescent(), **{**settings, **given})

    return call


def loop(**given: Any) -> Any:
    return ClosedLoop(adp.Feedback(LQR), PLANT, COST, **{"dt": 0.01, **given})


def rollout(**given: Any) -> Any:
    return adp.RolloutPolicy(BASIS, PLANT, COST, LQR, LQR.value, **{"steps": 1, "horizon": 0.1, **given})


def simulated(**given: Any) -> Any:
    usual = {"dt": 0.01, "steps": 2, "compile": False}
    return adp.simulate(adp.Feedback(LQR), PLANT, COST, X, **{**usual, **given})


def episodes(**given: Any) -> Any:
    return Episodes(PLANT, COST, 1, **{"dt": 0.1, "horizon": 1.0, "limit": 5.0, "penalty": 1.0, **given})


def trajectories(**given: Any) -> Any:
    usual = {"dt": 0.1, "steps": 2, "chunk": 2}
    return list(trajectory(systems.Oscillator(), X, **{**usual, **given}))


CALLS: dict[str, Callable[..., Any]] = {
    "ActorCritic": lambda **given: adp.ActorCritic(
        adp.QuadraticBasis(2), PLANT, COST, adp.RandomPoints(1, 1.0), **given
    ),
    "StaFValueBasis": lambda **given: adp.StaFValueBasis(BASIS, **given),
    "QuadraticBasis": lambda **given: adp.QuadraticBasis(**given),
    "RBFGridBasis": lambda **given: adp.RBFGridBasis(**{"dim": 2, "points": 2, **given}),
    "LeadingCoordinates": lambda **given: LeadingCoordinates(GRID, **given),
    "ClosedLoop": loop,
    "Supervised": lambda **given: adp.Supervised(adp.Feedback(LQR, LQR.value), LQR, COST, **given),
    "RandomPoints": lambda **given: adp.RandomPoints(**{"count": 1, "half_width": 1.0, **given}),
    "QuadraturePoints": lambda **given: adp.QuadraturePoints(
        **{"order": 1, "dim": 1, "half_width": 1.0, **given}
    ),
    "ConcurrentLearning": lambda **given: adp.ConcurrentLearning(**{"parameters": 2, "outputs": 2, **given}),
    "RolloutPolicy": rollout,
    "exact_hold": lambda **given: exact_hold(-EYE, EYE[:, :1], EYE, EYE[:1, :1], **given),
    "DirectShooting": lambda **given: adp.DirectShooting(PLANT, COST, **given),
    "simulate": simulated,
    "lebesgue_constant": lambda **given: lebesgue_constant(BASIS, X, **given),
    "sup_error": lambda **given: sup_error(BASIS, X, st.targets.Paper(), **given),
    "StaF": lambda **given: st.StaF(BASIS, **given),
    "rings": st.rings,
    "polygon": st.polygon,
    "simplex": st.simplex,
    "cross_polytope": st.cross_polytope,
    "ball": lambda **given: st.ball(**{"count": 2, "dim": 2, **given}),
    "probe_points": lambda **given: st.centers.probe_points(**{"dim": 2, **given}),
    "ConstantRadius": st.ConstantRadius,
    "StateRadius": lambda **given: st.StateRadius(**{"radius": 1.0, "offset": 0.1, **given}),
    "RidgeApproximator": lambda **given: RidgeApproximator(
        st.StaF(BASIS).fit_(X[0], st.targets.Paper()), **given
    ),
    "Tangent": predictors.Tangent,
    "PlantEnv": lambda **given: envs.PlantEnv(**given),
    "PlantVectorEnv": lambda **given: envs.PlantVectorEnv(**given),
    "Episodes": episodes,
    "Agent": lambda **given: envs.Agent(LQR, **given),
    "classic_control": envs.classic_control,
    "GaussianKernel": st.GaussianKernel,
    "MaternKernel": st.MaternKernel,
    "PolynomialKernel": st.PolynomialKernel,
    "RationalQuadraticKernel": st.RationalQuadraticKernel,
    "ExperienceMemory": lambda **given: st.ExperienceMemory(BASIS, **{"capacity": 2, **given}),
    "FixedStep": optim.FixedStep,
    "HeavyBall": lambda **given: optim.HeavyBall(**{"step": 0.5, "momentum": 0.5, **given}),
    "Nesterov": lambda **given: optim.Nesterov(**{"step": 0.5, "momentum": 0.5, **given}),
    "NormalisedLMS": optim.NormalisedLMS,
    "PolicyIteration": adp.PolicyIteration,
    "PreconditionedDescent": optim.PreconditionedDescent,
    "trajectory": trajectories,
    "Oscillator": systems.Oscillator,
    "Pendulum": systems.Pendulum,
    "PlanarQuadrotor": systems.PlanarQuadrotor,
    "VanDerPol": systems.VanDerPol,
    "CartPole": systems.CartPole,
    "ultimate_bound": bound("ultimate_bound"),
    "step_for_bound": bound("step_for_bound"),
    "steps_for_bound": bound("steps_for_bound"),
    "disc": theory.disc,
    "IntegralWindows": lambda **given: adp.IntegralWindows(ACTUATORS, **{"length": 0.1, **given}),
    "SlopeWindows": lambda **given: adp.SlopeWindows(ACTUATORS, **given),
    "HistoryStack": lambda **given: adp.HistoryStack(**{"rows": 1, "parameters": 1, **given}),
    "LeastSquares": lambda **given: adp.LeastSquares([1.0], **{"deviation": 1.0, **given}),
    "AdaptiveActorCritic": lambda **given: adp.AdaptiveActorCritic(
        adp.ActorCritic(adp.QuadraticBasis(2), PLANT, COST, adp.RandomPoints(1, 1.0)),
        ACTUATORS,
        WINDOWS,
        ESTIMATE,
        **given,
    ),
    "AdaptiveLQR": lambda **given: adp.AdaptiveLQR(ACTUATORS, COST, WINDOWS, ESTIMATE, **given),
    "StreamDrift": lambda **given: stream_drift(**given),
    "DriftLQR": lambda **given: adp.DriftLQR(stream_drift(), COST, **given),
    "BoxDDP": lambda **given: adp.BoxDDP(INTEGRATOR, **{"steps": 4, "compile": False, **given}),
    "RecedingHorizon": lambda **given: adp.RecedingHorizon(
        INTEGRATOR, **{"steps": 4, "compile": False, **given}
    ),
    "PathIntegral": lambda **given: adp.PathIntegral(
        INTEGRATOR, **{"steps": 4, "knots": 2, "compile": False, **given}
    ),
    "SampledProblem": lambda **given: adp.SampledProblem(INTEGRATOR.step, **{"dim": 2, "inputs": 1, **given}),
    "SampledProblem.of": lambda **given: adp.SampledProblem.of(PLANT, COST, **{"dt": 0.1, **given}),
    "GlobalValue": lambda **given: adp.GlobalValue(INTEGRATOR, LIBRARY, [3.0, 3.0], **given),
    "learn_global_value": lambda **given: adp.learn_global_value(
        INTEGRATOR,
        **{"region": [1.0, 1.0], "steps": 40, "trajectories": 2, "rounds": 0, "states": 1, **given},
    ),
    "DetourRollout": lambda **given: adp.DetourRollout(
        LQR,
        PLANT,
        COST,
        still,
        **{"axes": EYE, "dt": 0.1, "steps": 2, "terminal": LQR.value, **listed(given, "sizes", "lengths")},
    ),
    "BoundedInputCost": lambda **given: adp.BoundedInputCost(
        1.0, 1.0, **{"dim": 2, "inputs": 1, "bound": 1.0, **given}
    ),
    "SafetyFilter": lambda **given: adp.SafetyFilter(LQR, PLANT, still, **{"dt": 0.1, **given}),
    "SampledRollout": lambda **given: SampledRollout(
        BASIS, PLANT, COST, LQR, LQR.value, LQR.p, **{"period": 0.1, "steps": 4, **given}
    ),
    "StepPlant": lambda **given: systems.StepPlant(
        lambda x, u: 0.9 * x + 0.1 * u, **{"dim": 1, "inputs": 1, "dt": 0.1, **given}
    ),
    "ParametricPlant": lambda **given: parametric(**given),
    "held_stability": lambda **given: adp.held_stability(LQR, PLANT, **{"period": 0.1, **given}),
    "near_optimal": lambda **given: adp.near_optimal(PLANT, COST, **{"dt": 0.1, **given}),
    "report": lambda **given: REPORTED.report(**{"states": 2, "optimum": False, **given}),
    "riccati_rows": lambda **given: adp.riccati_rows(-EYE, EYE, EYE, EYE, **given),
}
"""How to call, with arguments that are right beside the one in question."""

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
    ("RBFGridBasis", "width"),
    ("Supervised", "momentum"),
    ("HeavyBall", "momentum"),
    ("Nesterov", "momentum"),
}
ABSENT |= {
    ("HeavyBall", "step"),
    ("RolloutPolicy", "period"),
    ("DirectShooting", "horizon"),
    ("StaF", "out_features"),
}
ABSENT |= {
    ("IntegralWindows", "first"),
    ("LeastSquares", "alarm"),
    ("HistoryStack", "outputs"),
    ("AdaptiveLQR", "a_step"),
    ("DriftLQR", "a_step"),
    ("PlantEnv", "bound"),
    ("DirectShooting", "iterations"),
    ("DirectShooting", "intervals"),
    ("simulate", "seed"),
    ("trajectory", "chunk"),
    ("near_optimal", "dt"),
    ("near_optimal", "horizon"),
    ("report", "spread"),
    ("SafetyFilter", "weight"),
    ("BoundedInputCost", "bound"),
    ("PathIntegral", "noise"),
}
"""Arguments for which None has a meaning of its own."""
NOT_ALONE = {("rings", "count"), ("SampledProblem", "dim"), ("StepPlant", "dim")}
"""Arguments whose least value needs others beside it."""
EVERY = tuple(rules())
RULES = sorted({str(rule): rule for rule in EVERY if rule.call in CALLS}.values())


def test_every_call_with_a_rule_is_known_here() -> None:
    assert {rule.call for rule in EVERY} == {*CALLS} | {*OTHERS}


@pytest.mark.parametrize("rule", RULES, ids=str)
def test_what_breaks_a_rule_is_refused_by_name(rule: Rule) -> None:
    wrong = [value for value in WRONG[rule.kind] if value is not None or rule[:2] not in ABSENT]
    if rule.kind == "integer" and rule.least is not None:
        wrong += [rule.least - 1, rule.least - 100]
    for value in wrong:
        named = re.escape(f"`{rule.call}({rule.argument}=...)` must ")
        with pytest.raises(ValueError, match=named):
            CALLS[rule.call](**{rule.argument: value})


@pytest.mark.parametrize("rule", RULES, ids=str)
def test_the_edge_of_a_rule_is_accepted(rule: Rule) -> None:
    edge = list(EDGE.get(rule.kind, ())) + list(rule.allowed)
    if rule.kind == "integer" and rule.least is not None and rule[:2] not in NOT_ALONE:
        edge.append(rule.least)
    for value in edge:
        CALLS[rule.call](**{rule.argument: value})
