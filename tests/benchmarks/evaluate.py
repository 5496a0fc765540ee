"""The speed of an evaluation: `python tests/benchmarks/evaluate.py [--batch B]`.

Six centers in the plane, exponential kernel. V^, and V^ with its gradient, at one point in eager torch,
float64, one thread; and a batch of B compiled by `torch.compile`, float32, two threads: B points of one
approximation, and B approximations with a point each. A time is the median of many calls.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable

import torch
from timing import in_turn

import staf_torch as st

CENTERS, RADIUS = 6, 0.1


def say(name: str, program: Callable[[], object], calls: int, unit: str) -> None:
    """Print the median time of a call."""
    times = in_turn({name: program}, calls + calls // 5)[name][calls // 5 :]
    scale = {"us": 1e6, "ms": 1e3}[unit]
    print(
        f"{f'{name} ({unit})':70s} {scale * statistics.median(wall for _, wall in times):10.2f}", flush=True
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=100_000)
    batch = parser.parse_args().batch
    torch.set_num_threads(1)
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(CENTERS), RADIUS))
    at = torch.tensor([0.5, 0.4], dtype=torch.float64)
    staf, y = st.StaF(basis).fit_(at, st.targets.Paper()), (at + 0.01).unsqueeze(0)
    with torch.no_grad():
        say("one value, eager", lambda: staf(y), 2000, "us")
        say("one value and gradient, eager", lambda: staf.value_and_gradient(y), 2000, "us")
    torch.set_num_threads(2)
    generator, paper = torch.Generator().manual_seed(0), st.targets.Paper()
    x = torch.rand(batch, 2, generator=generator)
    step = RADIUS * (torch.rand(batch, 2, generator=generator) - 0.5)
    single = basis.float()
    one = st.StaF(single, dtype=torch.float32).fit_(x[0], paper), x[0] + step
    many = st.StaF(single, (batch,), dtype=torch.float32).fit_(x, paper), (x + step).unsqueeze(-2)
    for name, (found, points) in {"points of one": one, "one point of many": many}.items():
        for what, call in (("value", found.forward), ("value and gradient", found.value_and_gradient)):
            run = torch.compile(call, fullgraph=True)
            with torch.no_grad():
                say(f"{name}, {what}, compiled", lambda run=run, points=points: run(points), 100, "ms")


if __name__ == "__main__":
    main()
