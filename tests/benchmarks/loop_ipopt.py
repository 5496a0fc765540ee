"""Cost and time of a control beside receding-horizon IPOPT, along closed loops of one row.

    python tests/benchmarks/loop_ipopt.py [--controls 100] [--states 5]

Needs casadi. safe-control-gym's cart-pole that is driven to 1 m, and its small quadrotor on the figure eight;
IPOPT looks 20 periods ahead and begins from its last plan. Both methods steer whole episodes from the same
states: the costs. The times are CPU seconds of a control along the loop, first of each method alone, then of
both in turn, where the caches of the processor have forgotten ours: medians over a loop. Not collected by
pytest.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import time

import torch
from torch import Tensor

from staf_torch.adp import SampledProblem
from staf_torch.experiments.rival_methods import METHODS, Begin
from staf_torch.experiments.rival_plants import CASES
from staf_torch.experiments.rivals import play

_HORIZON = 20
OURS = {"cart_pole_to_1m": "near_optimal", "figure_eight": "plan followed"}


@torch.no_grad()
def taken(problem: SampledProblem, begins: list[Begin], x0: Tensor, controls: int) -> list[list[float]]:
    """CPU seconds of every control of some methods, whose loops advance in turn."""
    steers, states = [begin(x0) for begin in begins], [x0.clone() for _ in begins]
    spent: list[list[float]] = [[] for _ in begins]
    for _ in range(controls):
        for k, steer in enumerate(steers):
            began = time.process_time()
            u = steer(states[k])
            spent[k].append(time.process_time() - began)
            states[k], _ = problem.advance(states[k], problem.admissible(u))
    return spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--controls", type=int, default=100)
    parser.add_argument("--states", type=int, default=5)
    settings = parser.parse_args()
    torch.set_num_threads(1)
    for name, ours in OURS.items():
        case = dataclasses.replace(CASES[name], horizon=_HORIZON)
        problem, x0 = case.problem(), case.states(settings.states, 0)
        names = (ours, "IPOPT")
        begins = [METHODS[each].prepare(case) for each in names]
        for begin in begins:  # programs are built
            taken(problem, [begin], x0[:1], settings.controls)
        costs = [play(problem, begin, x0, case.steps).cost for begin in begins]
        over = costs[0] / costs[1]
        middle, most = float(over.median()), float(over.max())
        print(f"{name}: {ours} costs {middle:.5f} of IPOPT's in the median, {most:.5f} at most")
        alone = [statistics.median(taken(problem, [begin], x0[:1], settings.controls)[0]) for begin in begins]
        turns = [statistics.median(each) for each in taken(problem, begins, x0[:1], settings.controls)]
        for kind, (us, they) in (("alone", alone), ("in turn", turns)):
            print(f"  {kind}: {1e6 * us:.0f} us beside {1e6 * they:.0f}, 1/{they / us:.0f}", flush=True)


if __name__ == "__main__":
    main()
