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

import staf_torch as st
from staf_torch import adp, envs, optim, predictors, systems, theory
from staf_torch.adp.bases import LeadingCoordinates
from staf_torch.adp.closed_loop import ClosedLoop
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
    "ParametricPlant": "in tests/adp/adaptation/test_identifiers.py",
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
    "BoxDDP": "in tests/adp/test_trajectory_optimisation.py",
    "SampledProblem": "in tests/adp/test_trajectory_optimisation.py",
    "SampledProblem.of": "in tests/adp/test_trajectory_optimisation.py",
    "GlobalValue": "in tests/adp/test_global_value.py",
    "learn_global_value": "in tests/adp/test_global_value.py",
    "AvoidanceCost": "in tests/adp/test_avoidance.py",
    "plan_around": "in tests/adp/test_avoidance.py",
    "BoxFilter": "in tests/adp/test_box_filter.py",
    "DetourPlans": "in tests/adp/test_detour_plans.py",
    "DetourRollout": "in tests/adp/test_detours.py",
    "SafetyFilter": "in tests/adp/test_safety_filter.py",
    "TwoLinkRobot": "numbers within a list, in tests/systems/test_barrier.py",
    "StepPlant": "in tests/adp/test_user_plants.py",
    "MujocoPlant": "in tests/systems/test_mujoco_plant.py",
    "RecedingHorizon": "in tests of its own",
    "EnergyShaping": "in tests/adp/test_energy_shaping.py",
    "report": "in tests of its own",
    "near_optimal": "in tests of its own",
    "PathIntegral": "in tests/adp/test_path_integral.py",
    "SampledRollout": "in tests of its own",
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
    for path in sorted(ROOT.rglob("*.py")):
        if path.relative_to(ROOT).parts[0] in ELSEWHERE:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
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
    ("AdaptiveLQR", "a_step"),
    ("DriftLQR", "a_step"),
    ("PlantEnv", "bound"),
    ("DirectShooting", "iterations"),
    ("DirectShooting", "intervals"),
    ("simulate", "seed"),
    ("trajectory", "chunk"),
}
"""Arguments for which None has a meaning of its own."""
RULES = sorted({str(rule): rule for rule in rules() if rule.call in CALLS}.values())


def test_every_call_with_a_rule_is_known_here() -> None:
    assert {rule.call for rule in rules()} == {*CALLS} | {*OTHERS}


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
    if rule.kind == "integer" and rule.least is not None and rule[:2] != ("rings", "count"):
        edge.append(rule.least)
    for value in edge:
        CALLS[rule.call](**{rule.argument: value})
