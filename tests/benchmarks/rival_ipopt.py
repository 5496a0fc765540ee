"""CasADi's IPOPT on the swing-ups: multiple shooting with the same Runge-Kutta steps, from several starts."""

from __future__ import annotations

import math

import casadi
import numpy as np
import torch
from torch import Tensor

from staf_torch import adp

_STEPS, _STARTS = 300, 10


def cart_pole_step() -> tuple[casadi.Function, casadi.Function]:
    """One step of 20 ms of `helpers_swingup.cart_pole` with its cost, and the terminal angle unwrapped."""
    x, u = casadi.MX.sym("x", 4), casadi.MX.sym("u")

    def rate(x: casadi.MX) -> casadi.MX:
        sine, cosine = casadi.sin(x[1]), casadi.cos(x[1])
        pushed = (u + 0.05 * x[3] ** 2 * sine) / 1.1
        bent = (9.8 * sine - cosine * pushed) / (0.5 * (4 / 3 - 0.1 * cosine**2 / 1.1))
        return casadi.vertcat(x[2], x[3], pushed - 0.05 * bent * cosine / 1.1, bent)

    def paid(x: casadi.MX) -> casadi.MX:
        angle = x[1] - 2 * math.pi * casadi.floor(x[1] / (2 * math.pi) + 0.5)
        return x[0] ** 2 + angle**2 + 0.1 * x[2] ** 2 + 0.1 * x[3] ** 2 + 0.01 * u**2

    h = 0.02
    k1, c1 = rate(x), paid(x)
    x2 = x + 0.5 * h * k1
    k2, c2 = rate(x2), paid(x2)
    x3 = x + 0.5 * h * k2
    k3, c3 = rate(x3), paid(x3)
    x4 = x + h * k3
    k4, c4 = rate(x4), paid(x4)
    after = x + (h / 6) * (k1 + 2 * (k2 + k3) + k4)
    step = casadi.Function("step", [x, u], [after, (h / 6) * (c1 + 2 * (c2 + c3) + c4)])
    end = casadi.vertcat(x[0], x[1] - 2 * math.pi * casadi.floor(x[1] / (2 * math.pi) + 0.5), x[2], x[3])
    return step, casadi.Function("end", [x], [end])


def solve_cart_pole(x0: Tensor, memory: adp.GlobalValue) -> Tensor:
    """The lowest cost of ten starts: the memory's own trajectory, four around it, five cold ones."""
    step, end = cart_pole_step()
    opti = casadi.Opti()
    x, u = opti.variable(4, _STEPS + 1), opti.variable(1, _STEPS)
    total = 0
    opti.subject_to(x[:, 0] == x0.numpy())
    opti.subject_to(opti.bounded(-10, u, 10))
    for k in range(_STEPS):
        after, paid = step(x[:, k], u[k])
        opti.subject_to(x[:, k + 1] == after)
        total = total + paid
    last = end(x[:, _STEPS])
    p = memory.problem.p.numpy()
    total = total + casadi.bilin(p, last, last)
    opti.minimize(total)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "max_iter": 500, "sb": "yes"})
    states, controls = [x0.unsqueeze(0)], []
    for _ in range(_STEPS):
        controls.append(memory(states[-1]))
        states.append(memory.problem.advance(states[-1], controls[-1])[0])
    warm_x, warm_u = torch.cat(states).numpy().T, torch.cat(controls).numpy().T
    draw = np.random.default_rng(0)
    best = math.inf
    for start in range(_STARTS):
        if start < 5:
            shake = 0.0 if start == 0 else 0.3 * start
            guess_u = np.clip(warm_u + shake * draw.normal(size=warm_u.shape), -10, 10)
            guess_x = warm_x + 0.1 * shake * draw.normal(size=warm_x.shape)
        else:
            guess_u = 10 * np.sign(draw.normal(size=(1, _STEPS // 10))).repeat(10, 1)
            turn = 2 * math.pi * draw.integers(-1, 2)
            goal = np.array([0.0, turn, 0.0, 0.0])
            guess_x = np.linspace(x0.numpy(), goal, _STEPS + 1).T
        opti.set_initial(x, guess_x)
        opti.set_initial(u, guess_u)
        try:
            best = min(best, float(opti.solve().value(total)))
        except RuntimeError:  # IPOPT gives up from this start
            continue
    return torch.tensor(best, dtype=torch.float64)
