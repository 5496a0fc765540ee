"""The published barrier examples with parameters that nobody knows at the start, learned behind the walls.

    python tests/benchmarks/unknown_behind_walls.py [chain,robot]

`AdaptiveLQR` in barrier coordinates on equations of x (`IntegralWindows(states=box.inverse)`), 1 ms. The two
states begin at theta = 0 under the LQR of the input's part alone, the robot at 5 under the LQR of that. The
cost is of s; that of the informed LQR stands beside it. The optimum is `BoxDDP`'s in s, held for 10 ms, with
the LQR's value where it ends, which every row then pays, too: the problem goes on; and with an end that costs
nothing, which leaves to be brought home what no regulator may leave.
"""

from __future__ import annotations

import sys
import time
from typing import NamedTuple

import torch
from torch import Tensor

from staf_torch import adp, systems

_HELD = 0.01  # s, of the optimum's control


class Example(NamedTuple):
    plant: adp.ParametricPlant
    low: tuple[float, ...]
    high: tuple[float, ...]
    x0: tuple[float, ...]
    weights: tuple[float, float]  # Q and R
    first: list[float]  # theta at the start
    gain: float | None  # of the robust policy on the last state; None for the LQR of the first theta
    duration: float  # s
    a_step: int  # doublings a control


def chain() -> Example:
    def square(x: Tensor) -> Tensor:
        return (2 * x[..., 0]).cos() + 2

    def regressor(x: Tensor, u: Tensor) -> Tensor:
        x1, x2 = x.unbind(-1)
        none = torch.zeros_like(x1)
        rows = (x2, none, none, none), (none, x1, x2, x2 * square(x).square())
        return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)

    def known(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((torch.zeros_like(x[..., 0]), square(x) * u[..., 0]), dim=-1)

    plant = adp.ParametricPlant(regressor, known, dim=2, inputs=1, theta=[1.0, -1.0, -0.5, 0.5])
    # Of x' = u with these weights the LQR has the gain sqrt(Q/R).
    return Example(plant, (-7, -5), (5, 7), (-6.5, 6.5), (10.0, 0.1), [0.0] * 4, 10.0, 10.0, 14)


def robot() -> Example:
    frictionless = systems.TwoLinkRobot(friction=[0.0] * 4)

    def regressor(x: Tensor, u: Tensor) -> Tensor:
        speed = x[..., 2:].unsqueeze(-2)
        pushed = frictionless.effectiveness(x)  # (..., 4, 2)
        return -torch.cat((pushed * speed, pushed * speed.tanh()), dim=-1)

    true = [5.3, 1.1, 8.45, 2.35]
    plant = adp.ParametricPlant(regressor, frictionless.rate, dim=4, inputs=2, theta=true, rows=[2, 3])
    walls = (-7, -7, -5, -5), (5, 5, 7, 7)
    return Example(plant, *walls, (-5, -5, 5, 5), (1.0, 1.0), [5.0] * 4, None, 60.0, 1)


def optimum(box: systems.Plant, cost: adp.Cost, s0: Tensor, duration: float) -> float:
    """What the best plan costs, its end with it."""
    problem = adp.SampledProblem.of(box, cost, dt=_HELD)
    found = adp.BoxDDP(problem, steps=round(duration / _HELD), iterations=200).solve(s0)
    if not bool(found.converged[0]):
        raise RuntimeError("no optimum was found")
    return float(found.cost[0])


@torch.no_grad()
def main(names: list[str]) -> None:
    torch.set_num_threads(1)
    columns = ("example", "policy", "cost of s", "over the optimum", "with an end that costs nothing")
    print("| " + " | ".join((*columns, "least margin", "found after (s)", "theta", "CPU s")) + " |")
    print("|---" * 9 + "|")
    for name in names:
        case = {"chain": chain, "robot": robot}[name]()
        box = systems.Barrier(case.plant, case.low, case.high)
        dim, inputs = int(box.dim or 0), box.inputs
        cost = adp.QuadraticCost(*case.weights, dim=dim, inputs=inputs)
        s0 = box.transform(torch.tensor([case.x0], dtype=torch.float64))
        lqr, free = (
            adp.LQR(box, cost),
            adp.QuadraticCost(*case.weights, dim, inputs, terminal=[[0.0] * dim] * dim),
        )
        best, unpaid = (optimum(box, each, s0, case.duration) for each in (cost, free))
        law = adp.LeastSquares(case.first, deviation=5.0, floor=1e-6)
        windows = adp.IntegralWindows(case.plant, 0.002, states=box.inverse)
        gain = case.gain
        robust = None if gain is None else (lambda s, gain=gain: -gain * s[..., -1:])
        model = adp.ParametricPlant.of_barrier(box)
        adaptive = adp.AdaptiveLQR(model, cost, windows, law, robust=robust, a_step=case.a_step)
        for label, policy in (("informed LQR", adp.Feedback(lqr)), ("unknown", adaptive)):
            clock = time.process_time()
            settings = {"dt": 1e-3, "steps": round(1000 * case.duration), "every": 10, "compile": True}
            run = adp.simulate(policy, box, cost, s0, **settings)  # type: ignore[arg-type]
            spent, paid = time.process_time() - clock, float(run.cost[0])
            found, theta = "-", "-"
            if policy is adaptive:
                now = adaptive.adaptation(run.identifier)
                found = f"{float(run.time[int(now.certain[0].argmax())]):.3g}"
                theta = ", ".join(f"{value:.4f}" for value in now.estimate.theta[0, -1])
            ratio = f"{(paid + float(lqr.value(run.state[0, -1]))) / best:.4f} | {paid / unpaid:.4f}"
            margin = "left" if bool(run.diverged[0]) else f"{float(box.margin(run.state).min()):.3g}"
            print(
                f"| {name} | {label} | {paid:.3f} | {ratio} | {margin} | {found} | {theta} | {spent:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1].split(",") if len(sys.argv) > 1 else ["chain", "robot"])
