"""The speed of a local fit beside Cholesky: `python tests/benchmarks/fit.py [--batch B]`.

The ideal coefficients of B states from given values (B, M), constant radius, exponential kernel, rings,
against `torch.linalg.cholesky` and `torch.cholesky_solve` on the same B Gram matrices, which are given to
the peer; beside that, with their formation. Rounds alternate and a time is the median of five.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable

import torch
from timing import in_turn
from torch import Tensor

import staf_torch as st

ROUNDS, CENTERS, RADIUS = 5, 15, 0.1


def programs(batch: int) -> dict[str, Callable[[], object]]:
    """By name, every program on the same states and values."""
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(CENTERS), RADIUS))
    angle = torch.linspace(0, 6.28, batch, dtype=torch.float64)
    x = torch.stack((angle.cos(), angle.sin()), dim=-1)
    values, gram = basis.values(x, st.targets.Paper()), basis.gram(x)

    def cholesky(matrices: Tensor) -> Tensor:
        return torch.cholesky_solve(values.unsqueeze(-1), torch.linalg.cholesky(matrices))

    return {
        "fit": lambda: basis.local(x).fit(values),
        "cholesky": lambda: cholesky(gram),
        "cholesky with Gram": lambda: cholesky(basis.gram(x)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=100_000)
    times = in_turn(programs(parser.parse_args().batch), ROUNDS)
    took = {name: 1e3 * statistics.median(wall for _, wall in each) for name, each in times.items()}
    for name, value in took.items():
        print(f"{name + ' (ms)':26s} {value:10.2f}")
    for name in list(took)[1:]:
        print(f"{name + ' / fit':26s} {took[name] / took['fit']:10.2f}")


if __name__ == "__main__":
    main()
