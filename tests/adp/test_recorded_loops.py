"""What every controller did from a few states, recorded: controls, states, costs, and all that it carries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from helpers_adaptation import PENDULUM
from helpers_adp import BOX, PLANT, learner
from helpers_swingup import double_integrator, pendulum
from recorded import Record
from torch import Tensor
from variants import COSTS

import staf_torch as st
from staf_torch import adp, lanes, systems

COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
LQR = adp.LQR(PLANT, COST)
X0 = tensor([[-1.0, 1.0], [0.7, 0.4], [1.9, -1.6]])
HANGING = tensor([[3.0, 0.2], [-2.5, 0.5], [0.3, -0.4]])
DOUBLE = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])  # of `test_near_optimal.py`: one program
PUSHED = tensor([[2.0, 1.0], [0.05, 0.0]])  # from the first the LQR would meet a bound
LIMITED = adp.QuadraticCost(1.0, 0.3, dim=2, inputs=1, low=-2.0, high=1.5)
PLANE = systems.Linear(torch.eye(4).roll(2, dims=1).triu().tolist(), torch.eye(4)[:, 2:].tolist())
COST4 = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2, low=-1.0, high=1.0)
BESIDE = tensor([[2.0, 0.1, 0.0, 0.0], [1.9, -0.2, -0.8, 0.1], [-1.0, 1.5, 0.4, 0.0]])


def loop(controller: Any, plant: Any, cost: adp.Cost, x0: Tensor, steps: int, dt: float, **more: Any) -> Any:
    with torch.no_grad():
        return adp.simulate(controller, plant, cost, x0, dt=dt, steps=steps, compile=False, **more)


def crossing(x: Tensor, t: Tensor) -> Tensor:
    """A disc on the way home, that moves up."""
    return (x[:, 0] - 1.0).square() + (x[:, 1] + 0.5 - 0.3 * t).square() - 0.16


def wall(x: Tensor, t: Tensor) -> Tensor:
    return 1.2 - x[:, 0] + 0.1 * t


def rollout(kernel: st.Kernel, **settings: Any) -> adp.RolloutPolicy:
    basis = st.StaFBasis(kernel, st.StateFollowingCenters(st.rings(6), st.StateRadius(0.3, 0.1)))
    return adp.RolloutPolicy(basis, PLANT, COST, LQR, LQR.value, **{"steps": 3, "horizon": 0.3} | settings)


def actor_critic(law: str) -> Any:
    laws: dict[str, adp.ActorCriticLaw] = {
        "information": adp.Information(),
        "published": adp.Published(),
        "policy iteration": adp.PolicyIteration(),
    }
    control = learner(laws[law], adp.QuadraturePoints(7, 2, BOX))
    return loop(control, PLANT, COST, 0.5 * X0[:2], 30, 0.005)


def explored(points: adp.Extrapolation) -> Any:
    control = learner(adp.Information(), points)
    return loop(control, PLANT, COST, 0.5 * X0[:2], 30, 0.005, every=6, substeps=2, seed=5)


def identified() -> Any:
    tracking = adp.TwoStateTracking()
    basis = adp.LeadingCoordinates(adp.RBFGridBasis(2, 3, 1.0, 0.8), 4)
    critic = adp.ActorCritic(basis, tracking, adp.tracking_cost(10.0, 1.0), adp.RandomPoints(1, 0.3))
    learning = adp.ConcurrentLearning(3, 2, 5, gain=5.0, novelty=0.05)
    control = adp.IdentifyingTracker(critic, tracking, learning, torch.zeros(3, 2).double())
    start = tensor([[-0.5, 0.5, 0.0, 1.0], [0.4, 0.2, 0.5, -1.0]])
    return loop(control, tracking, adp.tracking_cost(10.0, 1.0), start, 60, 0.02)


def guarded(policy: Any, **given: Any) -> Any:
    guard = adp.SafetyFilter(policy, PLANE, crossing, **{"dt": 0.1, "decay": 3.0} | given)
    run = loop(guard, PLANE, COST4, BESIDE, 8, 0.1)
    return run, guard.report(run)


def around(**given: Any) -> adp.DetourRollout:
    lqr = adp.LQR(PLANE, COST4, period=0.2)
    usual = {"axes": torch.eye(2, 4), "dt": 0.2, "steps": 16, "stride": 2, "terminal": lqr.value}
    usual |= {"margin": 0.02, "sizes": [0.4, 1.0], "lengths": [4, 12]} | given
    return adp.DetourRollout(lqr, PLANE, COST4, crossing, **usual)


def in_a_box(**given: Any) -> Any:
    box = systems.Barrier(systems.TwoStateChain(), low=[-7.0, -5.0], high=[5.0, 7.0])
    cost = adp.QuadraticCost(10.0, 0.1, dim=2, inputs=1)
    guard = adp.BoxFilter(adp.LQR(box, cost), box, dt=0.01, **given)
    s0 = box.transform(tensor([[4.9, 3.0], [-6.5, -2.0], [0.0, 6.9], [1.0, 0.5]]))
    renewed = bool(given.get("renewed"))
    run = loop(adp.Feedback(guard), box, cost, s0, 8, 0.01, substeps=4, renew=renewed)
    return run, guard.share(s0), guard.hold(s0)


def measured(control: Any, noise: Any, x0: Tensor, steps: int, dt: float, theta: Tensor, **more: Any) -> Any:
    truth = adp.ChangingPlant(PENDULUM)
    seen = adp.Measured(control, noise=noise, dim=2)
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    return loop(seen, truth, truth.cost(cost), truth.start(x0, theta, **more), steps, dt, seed=2)


def learned_gains(**settings: Any) -> Any:
    windows = adp.IntegralWindows(PENDULUM, 0.1, shape="smooth", first=0.02, noise=0.01)
    law = adp.LeastSquares([0.2, 0.7], deviation=[0.2, 0.6], floor=1e-4, forgetting=0.1, alarm=8.0)
    control = adp.AdaptiveLQR(PENDULUM, COST, windows, law, **{"doublings": 12, "a_step": 3} | settings)
    before, after = tensor([[0.05, 0.5], [0.2, 2.0]]), tensor([[0.3, 0.9], [0.2, 0.7]])
    return measured(control, 0.003, 0.4 * X0[:2], 90, 0.01, before, after=after, at=0.5)


def learned_drift() -> Any:
    known = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    drift = adp.StreamDrift(
        known, st.GaussianKernel(3.0), 0.5 * st.rings(3), rows=[1], deviation=3.0, length=0.04, floor=1e-4
    )
    control = adp.DriftLQR(drift, COST, doublings=10, a_step=5)
    return loop(control, systems.VanDerPol(0.7), COST, X0[:2], 40, 0.02)


def kept_from_an_edge() -> Any:
    windows = adp.IntegralWindows(PENDULUM, 0.1, first=0.03)
    law = adp.LeastSquares([0.2, 1.0], deviation=[0.1, 0.3])
    box = {"theta_low": [0.0, 0.6], "theta_high": [0.4, 1.5]}
    wanted = adp.Feedback(lambda x: -10 * (x[..., :1] - 1.0) - 3 * x[..., 1:])
    safe = adp.RobustFilter(
        wanted, PENDULUM, lambda x, t: 0.5 - x[:, 0], windows, law, dt=0.01, decay=4.0, **box
    )
    start = tensor([[0.2, 0.3], [0.45, 0.1]])
    return measured(safe, 0.0, start, 20, 0.01, tensor([[0.05, 0.6], [0.4, 1.5]]))


def waiting() -> Any:
    def drift(x: Tensor) -> Tensor:
        return torch.stack((x[..., 0], x[..., 1], x[..., 1] * (x[..., 0].cos() + 2).square()), dim=-1)

    def both_rows(x: Tensor, u: Tensor) -> Tensor:
        s = drift(x)
        zero = torch.zeros_like(s)
        return torch.stack((torch.cat((s, zero), -1), torch.cat((zero, s), -1)), dim=-2)

    def pushed(x: Tensor, u: Tensor) -> Tensor:
        return (PLANT.effectiveness(x) * u.unsqueeze(-2)).sum(-1)

    model = adp.ParametricPlant(both_rows, pushed, dim=2, inputs=1, theta=[-1.0, 1.0, 0.0, -0.5, -0.5, 0.1])
    first, points = [1.0, 0.0, 1.0], adp.QuadraturePoints(3, 2, half_width=0.2)
    critic = adp.ActorCritic(
        adp.QuadraticBasis(2), PLANT, COST, points, adp.PolicyIteration(), critic=first, actor=first
    )
    law = adp.LeastSquares([0.0] * 6, deviation=3.0, floor=1e-5)
    control = adp.AdaptiveActorCritic(
        critic, model, adp.IntegralWindows(model, 0.01), law, confidence=2.0, share=0.2
    )
    return loop(control, PLANT, COST, X0[:2], 60, 0.01)


def followed(kind: type[adp.KalmanFilter]) -> Any:
    plant = systems.Pendulum()
    filter = kind(plant, lambda x: x[..., :1].sin(), noise=[0.01], process=0.02)
    inside = adp.Observed(adp.Feedback(adp.LQR(plant, COST)), filter, deviation=0.5)
    seen = adp.Measured(inside, noise=0.01, dim=1, output=lambda x: x[..., :1].sin())
    return loop(seen, plant, COST, 0.3 * X0, 40, 0.02)


def tracked(source: str) -> Any:
    def reference(z: Tensor) -> tuple[Tensor, Tensor]:
        rate = torch.stack((0.5 * z[..., 0].cos(), -z[..., 0].sin()), dim=-1)
        return torch.stack((0.5 * z[..., 0].sin(), 0.5 * z[..., 1].cos()), dim=-1), rate

    theta = tensor([0.5, 1.2])
    actuated = adp.ParametricPlant(
        lambda x, u: torch.diag_embed(x), lambda x, u: u, dim=2, inputs=2, theta=theta
    )
    control = adp.ConcurrentTracker(
        actuated, reference, length=0.1, feedback=[4.0, 8.0], gain=0.5, size=6, source=source
    )
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=2)
    seen = adp.Measured(control, noise=0.0 if source == "slope" else 0.01, dim=2)
    return loop(seen, actuated, cost, X0[:2], 60, 0.02)


def near_optimal(
    plant: Any, cost: adp.Cost, x0: Tensor, steps: int, report: float = 0.4, **given: Any
) -> Any:
    policy = adp.near_optimal(plant, cost, **given)
    with torch.no_grad():
        run = loop(policy.controller(), plant, cost, x0, steps, policy.period)
        if not report:  # of states so far away: it takes a second of loops
            return run, policy(x0), policy.rollout(x0), policy.steps, policy.substeps
        lanes.ready(policy, x0)  # the report does so at its end
        said = policy.report(states=3, spread=report, optimum=False, seed=1)
        return run, policy(x0), policy.rollout(x0), {k: v for k, v in said.items() if k != "microseconds"}


def swung(**more: Any) -> Any:
    mpc = adp.RecedingHorizon(pendulum(), **{"steps": 25, "iterations": 2, "compile": False} | more)
    x, carried, found = HANGING, mpc.init(HANGING), []
    for _ in range(3):
        u, carried = mpc.step(x, carried, x.new_zeros(0), 0.0)
        x, paid = mpc.problem.advance(x, u)
        found.append((u, x, paid))
    return found, carried


def sampled(**more: Any) -> Any:
    mpc = adp.PathIntegral(pendulum(), steps=20, samples=32, compile=False, **more)
    x, carried, found = HANGING, mpc.init(HANGING), []
    for k in range(5):
        u, carried = mpc.step(x, carried, uniform(3, mpc.draws, 2, seed=k), 0.0)
        x, _ = mpc.problem.advance(x, u)
        found.append(u)
    return found, carried.identifier


def remembered() -> Any:
    grown = adp.learn_global_value(
        double_integrator(-1.0, 1.0), [3.0, 3.0], steps=60, trajectories=6, rounds=1, states=8, seed=4
    )
    x = 2 * uniform(6, 2, seed=1)
    with (
        torch.no_grad()
    ):  # which of two entries that cost the same is taken, rounding decides; slopes are its
        choice = grown.choose(x)
        return choice._replace(entry=choice.covered), grown.value(x), grown(x), grown.library.cost


def shot(plant: Any, cost: adp.Cost, x0: Tensor, **more: Any) -> Any:
    best = adp.DirectShooting(plant, cost, **{"intervals": 24, "horizon": 2.5} | more).solve(x0)
    return best, best.reason


def improved(problem: adp.SampledProblem, x0: Tensor, steps: int, **more: Any) -> Any:
    solver = adp.BoxDDP(problem, steps=steps, compile=False, **more)
    return solver.solve(x0, torch.zeros(len(x0), steps, 1).double())


def planned() -> Any:
    cost = adp.AvoidanceCost(
        1.0,
        1.0,
        *(2, 1),
        low=-1.0,
        high=1.0,
        obstacles=lambda x: x[..., 1] + 0.4,
        reach=0.3,
        kind="log",
    )
    line = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    start = tensor([[2.0, 0.0], [1.0, 0.2]])
    found = adp.plan_around(
        line, cost, start, dt=0.3, steps=12, shrink=(1.0, 0.01), iterations=6, compile=False
    )
    return found


def simulator(x: Any, u: Any) -> Any:
    """A pendulum in steps of 50 ms, in NumPy."""
    import numpy as np

    rate = np.clip(x[:, 1] + 0.05 * (15.0 * np.sin(x[:, 0]) + 3.0 * u[:, 0]), -8.0, 8.0)
    return np.stack((x[:, 0] + 0.05 * rate, rate), axis=1)


SIMULATOR = systems.StepPlant(simulator, dim=2, inputs=1, dt=0.05, periodic=[0], low=-2.0, high=2.0)
CASES: dict[str, Callable[[], Any]] = {
    "lqr": lambda: loop(adp.Feedback(LQR), PLANT, COST, X0, 40, 0.02, every=8),
    "bounded lqr": lambda: loop(
        adp.Feedback(adp.LQR(PLANT, COSTS["bounded_input"]())), PLANT, COSTS["bounded_input"](), X0, 40, 0.02
    ),
    "held lqr": lambda: loop(adp.Feedback(adp.LQR(PLANT, LIMITED, period=0.2)), PLANT, LIMITED, X0, 10, 0.2),
    "rollout": lambda: loop(adp.Feedback(rollout(st.ExponentialKernel())), PLANT, COST, X0, 20, 0.02),
    "rollout of a held control": lambda: loop(
        adp.Feedback(rollout(st.GaussianKernel(0.9), period=0.05)), PLANT, COST, X0, 10, 0.05
    ),
    "rollout of a rollout": lambda: loop(
        adp.Feedback(rollout(st.ExponentialKernel(), depth=2, steps=1)), PLANT, COST, X0, 3, 0.05
    ),
    "information": lambda: actor_critic("information"),
    "published": lambda: actor_critic("published"),
    "policy iteration": lambda: actor_critic("policy iteration"),
    "random points": lambda: explored(adp.RandomPoints(2, BOX)),
    "supervised": lambda: loop(
        adp.Supervised(learner(adp.Information()), LQR, COST), PLANT, COST, X0, 30, 0.02
    ),
    "identifying tracker": identified,
    "safety filter": lambda: guarded(adp.LQR(PLANE, COST4, period=0.1)),
    "safety filter with bounds": lambda: guarded(
        lambda x: -2 * x[..., :2] - x[..., 2:], low=[-0.5, -1.0], high=[1.0, 0.7], margin=0.05
    ),
    "detours": lambda: loop(around(), PLANE, COST4, BESIDE, 12, 0.2),
    "plans around": lambda: loop(
        adp.DetourPlans(around(steps=4, lengths=[2]), first=1), PLANE, COST4, BESIDE[:2], 2, 0.2
    ),
    "box filter": in_a_box,
    "box filter, renewed": lambda: in_a_box(renewed=True),
    "adaptive lqr": learned_gains,
    "adaptive lqr that probes": lambda: learned_gains(probe=0.2, confidence=1.0),
    "drift lqr": learned_drift,
    "robust filter": kept_from_an_edge,
    "adaptive actor-critic": waiting,
    "extended kalman": lambda: followed(adp.ExtendedKalman),
    "unscented kalman": lambda: followed(adp.UnscentedKalman),
    "concurrent tracker": lambda: tracked("integral"),
    "concurrent tracker of slopes": lambda: tracked("slope"),
    "near optimal": lambda: near_optimal(PLANT, COST, X0, 3, dt=0.1, horizon=0.8),
    "near optimal, by the rules": lambda: near_optimal(
        systems.Pendulum(), COST, 0.3 * X0, 8, report=0.0, dt=0.05
    ),
    "near optimal within bounds": lambda: near_optimal(
        *(DOUBLE, COST, PUSHED, 5), report=0.0, dt=0.25, low=-1.0, high=1.0
    ),
    "near optimal that plans": lambda: near_optimal(
        *(DOUBLE, COST, PUSHED, 4), report=0.8, dt=0.25, low=-1.0, high=1.0, plan=True
    ),
    "near optimal of a simulator": lambda: near_optimal(SIMULATOR, LIMITED, 0.2 * X0, 6),
    "receding horizon": swung,
    "receding horizon, held": lambda: swung(held=True, iterations=1, steps=15),
    "receding horizon, followed": lambda: swung(iterations=0, steps=8),
    "path integral": sampled,
    "path integral of few knots": lambda: sampled(knots=3, noise=0.7),
    "global value": remembered,
    "shooting": lambda: shot(systems.VanDerPol(), COST, 0.6 * X0[:2]),
    "bounded shooting": lambda: shot(systems.Pendulum(), COST, 0.5 * X0[:2], low=-6.0, high=5.0, starts=3),
    "shooting of a saturated input": lambda: shot(
        systems.Pendulum(), COSTS["bounded_input"](), 0.5 * X0[:2], intervals=16
    ),
    "shooting of three inputs": lambda: shot(
        systems.RatePlant(
            lambda x, u: torch.stack((x[..., 1] + u[..., 2], x[..., 0].sin() + u[..., 0] - u[..., 1]), -1),
            dim=2,
            inputs=3,
        ),
        adp.QuadraticCost(1.0, 1.0, dim=2, inputs=3),
        0.6 * X0[:2],
    ),
    "shooting from rest": lambda: shot(systems.VanDerPol(), COST, 0 * X0[:1]),
    "box ddp": lambda: improved(pendulum(), HANGING, 30, iterations=12),
    "box ddp of a linear plant": lambda: improved(double_integrator(-1.0, 1.0), 2 * X0, 20),
    "plans around an edge": planned,
    "energy": lambda: loop(
        adp.Feedback(
            adp.EnergyShaping(
                systems.Pendulum(),
                LIMITED,
                lambda x: 0.5 * x[..., 1].square() + 9.81 * x[..., 0].cos(),
                gain=1.0,
                capture=0.5,
                period=0.02,
            )
        ),
        *(systems.Pendulum(), LIMITED, HANGING, 60, 0.02),
    ),
}


def marked(name: str) -> Any:
    """A search that grows a memory takes another way where its rounding is that of plain torch."""
    return pytest.param(name, marks=pytest.mark.needs_compiler) if name == "global value" else name


@pytest.mark.parametrize("name", [marked(name) for name in CASES])
def test_what_a_controller_does_is_the_recorded(name: str, record: Record) -> None:
    record(CASES[name]())
