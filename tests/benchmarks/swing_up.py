"""Swing-ups by a memory of local models, measured in full: cost over the optimum, and what it takes.

    python tests/benchmarks/swing_up.py pendulum [--seeds 5] [--grid 640]
    python tests/benchmarks/swing_up.py cartpole [--draws 99,7] [--ipopt 100]

--ipopt needs casadi, ten starts from each of so many states of the first draw: half a minute a state.

pendulum: Gymnasium's own Pendulum-v1, reset with the seeds 0 to 99, 200 steps, for several seeds of the
memory; beside it dynamic programming on a grid of the same steps (20 minutes; --grid 0: none). cartpole: 100
states of a box for each seed of --draws, 10 N, held for 20 ms; the optimum is the least of what `BoxDDP`
makes of the policy's own trajectory and of the memory's plans behind held bounds. Not collected by pytest.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from helpers_swingup import CART_REGION, REGION, cart_pole, pendulum, step

from staf_torch import adp
from staf_torch.adp.planning.global_value_learning import best_from

_GRID, _CONTROLS, _EPISODE = 640, 33, 200


def main() -> None:
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plant", choices=("pendulum", "cartpole"))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--grid", type=int, default=_GRID, help="0: no dynamic programming")
    parser.add_argument("--draws", default="99", help="seeds of 100 states each")
    parser.add_argument("--memory", type=int, default=0, help="seed of the cart-pole's memory")
    parser.add_argument("--ipopt", type=int, default=0, help="states from which IPOPT solves too")
    settings = parser.parse_args()
    torch.set_num_threads(1)
    found = swing_pendulum(settings) if settings.plant == "pendulum" else swing_cart(settings)
    print(json.dumps(found, indent=2))


def swing_pendulum(settings: argparse.Namespace) -> dict[str, Any]:
    import gymnasium

    resets = []
    for seed in range(100):
        env = gymnasium.make("Pendulum-v1")
        env.reset(seed=seed)
        resets.append(np.asarray(env.unwrapped.state))
    x0 = torch.tensor(np.array(resets), dtype=torch.float64)
    grid = dynamic_programming(x0, settings.grid) if settings.grid else None
    runs = []
    for seed in range(settings.seeds):
        began = time.process_time()
        memory = adp.learn_global_value(pendulum(), REGION, steps=150, seed=seed)
        offline = time.process_time() - began
        returns, times = episodes(memory)
        cost = -torch.tensor(returns, dtype=torch.float64)
        run = {
            "seed": seed,
            "offline_cpu_s": offline,
            "models": len(memory.entries),
            "mean_cost_50": float(cost[:50].mean()),
            "mean_cost_100": float(cost.mean()),
            "us_a_control_median": statistics.median(times),
            "us_a_control_p99": float(np.quantile(times, 0.99)),
        }
        if grid is not None:
            run |= {
                "over_grid_50": float(cost[:50].mean() / grid[:50].mean()),
                "over_grid_100": float(cost.mean() / grid.mean()),
                "worst_excess": float((cost - grid).max()),
            }
        runs.append(run)
        print(run, flush=True)
    names = [name for name in runs[0] if name != "seed"]
    return {"runs": runs, "median": {name: statistics.median(run[name] for run in runs) for name in names}}


def episodes(memory: adp.GlobalValue) -> tuple[list[float], list[float]]:
    """Returns of the real environment from 100 resets, and microseconds of every control."""
    import gymnasium

    returns, times = [], []
    env = gymnasium.make("Pendulum-v1")
    for seed in range(100):
        env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            x = torch.from_numpy(np.asarray(env.unwrapped.state, dtype=np.float64)).unsqueeze(0)
            began = time.perf_counter()
            u = memory(x)
            times.append(1e6 * (time.perf_counter() - began))
            _, reward, terminated, truncated, _ = env.step(u[0].numpy())
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    return returns, times


def dynamic_programming(x0: Tensor, count: int) -> Tensor:
    """Cost of 200 steps from x0 (B, 2) under the greedy control of values on a grid, interpolated: (B,)."""
    angles = -math.pi + 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    rates = torch.linspace(-8, 8, count + 1, dtype=torch.float64)
    states = torch.cartesian_prod(angles, rates)
    controls = torch.linspace(-2, 2, _CONTROLS, dtype=torch.float64)

    def place(x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        a = (x[..., 0] + math.pi) / (2 * math.pi) * count
        b = (x[..., 1] + 8) / 16 * count
        i, k = a.floor(), b.floor().clamp(0, count - 1)
        low = (i.long() % count) * (count + 1) + k.long()
        high = ((i.long() + 1) % count) * (count + 1) + k.long()
        return low.int(), high.int(), (a - i).float(), (b - k).float()

    def at(value: Tensor, where: tuple[Tensor, ...]) -> Tensor:
        low, high, fa, fb = where
        low, high = low.long(), high.long()
        near = (1 - fb) * value[low] + fb * value[low + 1]
        return (1 - fa) * near + fa * ((1 - fb) * value[high] + fb * value[high + 1])

    moves = []
    for u in controls:
        after, paid = step(states, u.expand(len(states), 1))
        moves.append((place(after), paid))
    values = [torch.zeros(len(states), dtype=torch.float64)]
    for _ in range(_EPISODE):
        best = torch.full_like(values[-1], torch.inf)
        for where, paid in moves:
            best = torch.minimum(best, paid + at(values[-1], where))
        values.append(best)
    fine = torch.linspace(-2, 2, 401, dtype=torch.float64)
    x, spent = x0, torch.zeros(len(x0), dtype=torch.float64)
    for left in range(_EPISODE - 1, -1, -1):
        pairs = x.unsqueeze(1).expand(-1, len(fine), -1), fine.expand(len(x), -1).unsqueeze(-1)
        after, paid = step(*pairs)
        u = fine[(paid + at(values[left], place(after))).argmin(1)].unsqueeze(-1)
        x, paid = step(x, u)
        spent = spent + paid
    return spent


def swing_cart(settings: argparse.Namespace) -> dict[str, Any]:
    problem = cart_pole()
    width = torch.tensor(CART_REGION, dtype=torch.float64)
    began = time.process_time()
    memory = adp.learn_global_value(
        problem, CART_REGION, steps=200, rounds=6, candidates=64, lookahead=120, seed=settings.memory
    )
    found: dict[str, Any] = {
        "offline_cpu_s": time.process_time() - began,
        "models": len(memory.entries),
    }
    search = adp.BoxDDP(problem, steps=300)
    for k, seed in enumerate(int(seed) for seed in settings.draws.split(",")):
        generator = torch.Generator().manual_seed(seed)
        x0 = width * (2 * torch.rand(100, 4, generator=generator, dtype=torch.float64) - 1)
        x, spent, states, controls = x0, torch.zeros(100, dtype=torch.float64), [x0], list[Tensor]()
        for _ in range(300):
            controls.append(memory(x))
            x, paid = problem.advance(x, controls[-1])
            states.append(x)
            spent = spent + paid
        refined = search.solve(x0, torch.stack(controls, dim=1)).cost
        best = torch.minimum(refined, best_from(memory, search, x0).cost)
        row = {"up": float((problem.terminal(x) < 1e-3).double().mean()), **ratios("over_best", spent / best)}
        if settings.ipopt and k == 0:
            from shooting import CASES, Peer

            case, held = CASES["cart_pole_swing_up"], torch.full((300,), 0.02, dtype=torch.float64)
            solver, peer = Peer(case, problem.p, held, held=True), list[float]()
            ways = torch.stack(states, dim=1), torch.stack(controls, dim=1)
            for state, cost, *plan in zip(x0[: settings.ipopt], spent, *ways, strict=False):
                peer.append(min(solver.costs(state, plan, 10, np.random.default_rng(0))))
                ratio = float(cost) / peer[-1]
                print(f"{len(peer)} policy {cost:.5f} IPOPT {peer[-1]:.5f} ratio {ratio:.5f}", flush=True)
            row |= ratios("over_ipopt", spent[: settings.ipopt] / torch.tensor(peer).double())
        found[f"draw_{seed}"] = row
        print(seed, row, flush=True)
    return found


def ratios(name: str, ratio: Tensor) -> dict[str, float]:
    return {
        f"{name}_mean": float(ratio.mean()),
        f"{name}_median": float(ratio.median()),
        f"{name}_max": float(ratio.max()),
    }


if __name__ == "__main__":
    main()
