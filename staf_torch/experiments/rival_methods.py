"""The methods that are compared: each from a plant and a cost to controls, as a user would write it."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
from collections.abc import Callable
from importlib import metadata
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .. import adp
from ..adp import SampledProblem
from ..numerics.runge_kutta import SHARES, runge_kutta_mean, runge_kutta_stages
from ..results.build import installed
from .rival_plants import RivalPlant

Steer = Callable[[Tensor], Tensor]
"""u (B, m) from x (B, n), called once a period: it may remember its last plan."""
Begin = Callable[[Tensor], Steer]
"""Steering from the initial states (B, n)."""
_SAMPLES = 200  # control sequences of MPPI
_TEMPERATURE = 0.01  # of MPPI, times the LQR's value at the initial states
_NOISE = 0.25  # its standard deviation, of the range of an input: as large as served on two plants


class UnsuitableError(Exception):
    """A method is not made for a plant; the message says why."""


def lqr(case: RivalPlant) -> Begin:
    """Gains in continuous time, held for the period."""
    if case.discrete:
        raise UnsuitableError("needs a plant in continuous time")
    policy = adp.LQR(case.plant(), case.cost())
    return lambda x0: policy


def discrete_lqr(case: RivalPlant) -> Begin:
    """The gains that are made for the period."""
    policy = adp.LQR(case.plant(), case.cost(), period=case.dt)
    return lambda x0: policy


def near_optimal(case: RivalPlant) -> Begin:
    """The discrete LQR improved by rollouts, and by a plan as long as a bound is met."""
    if case.path is not None:
        raise UnsuitableError("follows no path")
    policy = adp.near_optimal(case.plant(), case.cost(), dt=case.dt, reach="local")
    return steered(case, policy.controller())


def planned(case: RivalPlant) -> Begin:
    """`near_optimal` with a plan that it carries, where bounds bite."""
    if case.path is not None:
        raise UnsuitableError("follows no path")
    policy = adp.near_optimal(case.plant(), case.cost(), dt=case.dt, plan=True, reach="local")
    return steered(case, policy.controller())


def global_value(case: RivalPlant) -> Begin:
    """A memory of optimal trajectories."""
    if not case.swing:
        raise UnsuitableError("the LQR reaches the goal")
    deep = {"rounds": 6, "candidates": 64, "lookahead": 120} if case.dim > 2 else {}
    width = [math.pi, 8.0] if case.dim == 2 else list(case.box)
    memory = adp.learn_global_value(case.problem(), width, steps=min(200, case.steps - 50), **deep)
    return lambda x0: memory


def box_ddp(case: RivalPlant) -> Begin:
    """Receding horizon by box-DDP, three iterations a period."""
    return steered(case, adp.RecedingHorizon(case.problem(), steps=case.horizon))


def plan(case: RivalPlant) -> Begin:
    """Follow a plan of the whole episode by box-DDP with its feedback."""
    return steered(case, adp.RecedingHorizon(case.problem(), steps=case.steps, iterations=0))


def path_integral(case: RivalPlant) -> Begin:
    """Our own sampling, around the feedback."""
    return steered(case, adp.PathIntegral(case.problem(), steps=case.horizon, samples=_SAMPLES))


def steered(case: RivalPlant, mpc: adp.Controller) -> Begin:
    """A controller that carries a state, as a function of x."""

    def begin(x0: Tensor) -> Steer:
        state, drawn = mpc.init(x0), torch.Generator().manual_seed(0)

        def steer(x: Tensor) -> Tensor:
            nonlocal state
            shape = (*x.shape[:1], mpc.draws, x.shape[1])
            uniform = 2 * torch.rand(shape, generator=drawn, dtype=x.dtype, device="cpu") - 1
            u, state = mpc.step(x, state, uniform, case.dt)
            return u

        return steer

    return begin


def ipopt(case: RivalPlant) -> Begin:
    """Receding horizon by CasADi and IPOPT: multiple shooting, begun from the last plan."""
    import casadi

    n, m, steps = case.dim, case.inputs, case.horizon
    solve = ipopt_program(casadi, case, case.problem(), steps)

    def begin(x0: Tensor) -> Steer:
        rest = np.tile(case.rest or [0.0] * m, steps)
        plans = [np.concatenate([np.tile(x, steps + 1), rest]) for x in x0[:, :n].numpy()]
        time = 0.0

        def steer(x: Tensor) -> Tensor:
            nonlocal time
            control = []
            for row, at in enumerate(x[:, :n].numpy()):
                plan = np.array(solve(x0=plans[row], p=np.append(at, time))["x"]).ravel()
                if not np.isfinite(plan).all():
                    plan = plans[row]
                states, inputs = plan[: n * (steps + 1)], plan[n * (steps + 1) :]
                control.append(inputs[:m])
                ahead = np.concatenate([states[n:], states[-n:]]), np.concatenate([inputs[m:], inputs[-m:]])
                plans[row] = np.concatenate(ahead)
            time += case.dt
            return torch.from_numpy(np.array(control))

        return steer

    return begin


def mppi(case: RivalPlant) -> Begin:
    """Model-predictive path integrals: 200 sampled sequences a period."""
    from pytorch_mppi import MPPI_Batched

    problem = case.problem()
    low, high = problem.bounds.low, problem.bounds.high

    def paid(x: Tensor, u: Tensor, t: int) -> Tensor:
        # It asks for the cost after the step. The last state pays the LQR's value as well.
        cost = problem.advance(x, u)[1]
        return cost + problem.terminal(x) if t == case.horizon - 1 else cost

    def begin(x0: Tensor) -> Steer:
        controller = MPPI_Batched(
            lambda x, u, t: problem.advance(x, u)[0],
            paid,
            problem.dim,
            torch.diag((_NOISE * (high - low)) ** 2),
            len(x0),
            num_samples=_SAMPLES,
            horizon=case.horizon,
            lambda_=_TEMPERATURE * float(problem.terminal(x0).mean()),
            u_min=low,
            u_max=high,
            step_dependent_dynamics=True,
        )
        controller.U = torch.zeros_like(controller.U)  # it would begin from noise
        return controller.command  # type: ignore[no-any-return]

    return begin


def ipopt_program(casadi: Any, case: RivalPlant, problem: SampledProblem, steps: int) -> Any:
    """IPOPT on min sum l(x, u) + V_T over (states, controls): called with a guess x0 and p = (x, t)."""
    n, m = case.dim, case.inputs
    x, u, t = casadi.MX.sym("x", n), casadi.MX.sym("u", m), casadi.MX.sym("t")
    weights, rest = case.weights, case.rest or [0.0] * m

    def deviation(x: Any, t: Any) -> Any:
        goal = case.goal().tolist() if case.path is None else case.path(casadi, t)
        away = [x[i] - goal[i] for i in range(n)]
        turns = {i: casadi.floor(away[i] / (2 * math.pi) + 0.5) for i in case.periodic}
        return [part - 2 * math.pi * turns[i] if i in turns else part for i, part in enumerate(away)]

    def paid(x: Any, t: Any) -> Any:
        state = sum(q * e**2 for q, e in zip(weights[0], deviation(x, t), strict=True))
        return state + sum(r * (u[j] - rest[j]) ** 2 for j, r in enumerate(weights[1]))

    def motion(x: Any) -> Any:
        parts = case.equations(casadi, [x[i] for i in range(n)], [u[j] for j in range(m)])
        return casadi.vertcat(*parts)

    h = case.dt
    if case.discrete:
        after, spent = motion(x), h * paid(x, t)
    else:
        at, slopes = runge_kutta_stages(lambda at, share: motion(at), x, h)
        after = x + runge_kutta_mean(slopes, h)
        spent = runge_kutta_mean([paid(each, t + s * h) for each, s in zip(at, SHARES, strict=True)], h)
    step = casadi.Function("step", [x, u, t], [after, spent])
    states, controls = casadi.MX.sym("X", n, steps + 1), casadi.MX.sym("U", m, steps)
    start = casadi.MX.sym("p", n + 1)
    times = start[n] + h * casadi.DM(range(steps)).T
    moved, costs = step.map(steps)(states[:, :-1], controls, times)
    last = casadi.vertcat(*deviation(states[:, -1], start[n] + h * steps))
    total = casadi.sum2(costs) + casadi.bilin(problem.p[:n, :n].numpy(), last, last)
    program = {
        "x": casadi.vertcat(casadi.vec(states), casadi.vec(controls)),
        "p": start,
        "f": total,
        "g": casadi.vertcat(states[:, 0] - start[:n], casadi.vec(states[:, 1:] - moved)),
    }
    quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.max_iter": 300}
    warm = {"ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-3}
    options = quiet | (warm if steps < case.steps else {}) | {"error_on_fail": False}
    solver = casadi.nlpsol("mpc", "ipopt", program, options)
    free, none = np.full(n * (steps + 1), np.inf), dict.fromkeys(("lbg", "ubg"), 0.0)
    low = np.concatenate([-free, np.tile(case.low, steps)])
    high = np.concatenate([free, np.tile(case.high, steps)])
    return lambda x0, p: {**solver(x0=x0, p=p, lbx=low, ubx=high, **none), **solver.stats()}


@dataclasses.dataclass(frozen=True)
class Rival:
    """A row of the table."""

    name: str
    prepare: Callable[[RivalPlant], Begin]
    packages: tuple[str, ...] = ()  # that it needs beside torch, by their distributions
    helpers: tuple[Callable[..., Any], ...] = ()  # that a user would write as well
    slow: bool = False  # tens of milliseconds a control of one state: fewer states

    @property
    def lines(self) -> int:
        """Lines of code from a plant and a cost to controls, without blank lines and comments."""
        return sum(map(_lines, (self.prepare, *self.helpers)))

    @property
    def missing(self) -> str | None:
        """The first package that is not installed."""
        return next((name for name in self.packages if installed(name) is None), None)

    @property
    def megabytes(self) -> float:
        """Return the size of the packages on disk, beside torch and NumPy."""
        return sum(_size(name) for name in self.packages) / 2**20


METHODS = {
    method.name: method
    for method in (
        Rival("LQR", lqr, ("scipy",)),
        Rival("discrete LQR", discrete_lqr, ("scipy",)),
        Rival("near_optimal", near_optimal, ("scipy",), (steered,)),
        Rival("near_optimal planned", planned, ("scipy",), (steered,)),
        Rival("GlobalValue", global_value, ("scipy",)),
        Rival("box-DDP", box_ddp, ("scipy",), (steered,)),
        Rival("PathIntegral", path_integral, ("scipy",), (steered,)),
        Rival("plan followed", plan, ("scipy",), (steered,)),
        Rival("IPOPT", ipopt, ("casadi",), (ipopt_program,), slow=True),
        Rival("MPPI", mppi, ("pytorch-mppi",), slow=True),
    )
}


def _lines(function: Callable[..., Any]) -> int:
    code = [line.strip() for line in inspect.getsourcelines(function)[0]]
    return sum(bool(line) and not line.startswith(("#", '"""')) for line in code)


@functools.cache
def _size(name: str) -> int:
    files = metadata.distribution(name).files or []
    return sum(path.stat().st_size for file in files if (path := file.locate()).is_file())  # type: ignore[attr-defined]
