"""The speed of a local fit beside Cholesky: `python tests/benchmarks/fit.py [--json FILE] [--batch B]`.

The ideal coefficients of B states from given values (B, M), constant radius, exponential kernel, rings,
against `torch.linalg.cholesky` and `torch.cholesky_solve` on the same B Gram matrices, which are given to
the peer; beside that, with their formation. Rounds alternate and a time is the median of five. Also the
time to set up the graded basis of 28 centers. Exit status 1 where a goal is missed.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

import staf_torch as st  # noqa: E402
from staf_torch.local_basis import Interpolation, graded_basis  # noqa: E402

ROUNDS = 5
CENTERS, RADIUS = 15, 0.1
SETUP_CENTERS = 28
RATIO, SETUP_MS = 20.0, 50.0  # the goals


def setup() -> Interpolation:
    """What a constant radius pays once."""
    basis = graded_basis(st.rings(SETUP_CENTERS))
    return Interpolation.of(basis, torch.tensor(RADIUS**2, dtype=torch.float64), None)


def programs(batch: int) -> dict[str, Callable[[], object]]:
    """By name, every program on the same states and values."""
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(CENTERS), RADIUS))
    angle = torch.linspace(0, 6.28, batch, dtype=torch.float64)
    x = torch.stack((angle.cos(), angle.sin()), dim=-1)
    values, gram = basis.values(x, st.targets.Paper()), basis.gram(x)
    column = values.unsqueeze(-1)

    def cholesky(matrices: Tensor) -> Tensor:
        return torch.cholesky_solve(column, torch.linalg.cholesky(matrices))

    return {
        "fit": lambda: basis.local(x).fit(values),
        "cholesky": lambda: cholesky(gram),
        "cholesky with Gram": lambda: cholesky(basis.gram(x)),
        "setup": setup,
    }


def measure(batch: int) -> dict[str, float]:
    """Medians in milliseconds, and the ratios."""
    compared = programs(batch)
    seconds: dict[str, list[float]] = {name: [] for name in compared}
    for program in compared.values():
        program()
    for _ in range(ROUNDS):
        for name, program in compared.items():
            start = time.perf_counter()
            program()
            seconds[name].append(time.perf_counter() - start)
    found = {f"{name} (ms)": 1e3 * statistics.median(times) for name, times in seconds.items()}
    ratios = {
        f"{name} / fit": found[f"{name} (ms)"] / found["fit (ms)"]
        for name in ("cholesky", "cholesky with Gram")
    }
    return found | ratios


def main() -> None:
    parser = argparse.ArgumentParser(description="Local fit against batched Cholesky.")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--batch", type=int, default=100_000)
    arguments = parser.parse_args()
    found = measure(arguments.batch)
    for name, value in found.items():
        print(f"{name:26s} {value:10.2f}")
    about = {
        "batch": arguments.batch,
        "centers": CENTERS,
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "machine": platform.machine(),
    }
    if arguments.json:
        arguments.json.write_text(json.dumps(about | found, indent=2) + "\n")
    met = found["cholesky / fit"] >= RATIO and found["setup (ms)"] <= SETUP_MS
    print(f"goals (ratio >= {RATIO:g}, setup <= {SETUP_MS:g} ms): {'met' if met else 'missed'}")
    sys.exit(0 if met else 1)


if __name__ == "__main__":
    main()
