"""Run row programs on a CUDA device and compare them with their definitions: ``python -m tests.gpu``.

Not collected by pytest. Prints a line for every program; exits with 1 where one differs, 2 without a device.
"""

from __future__ import annotations

import sys
import time

import torch

from staf_torch import lanes
from tests.lanes.test_c_and_cuda import flow, given
from tests.lanes.test_programs import pendulum


def main() -> int:
    if not torch.cuda.is_available():
        print("no CUDA device here")
        return 2
    worst = 0
    for name, step in (("flow", flow), ("pendulum", pendulum)):
        for dtype, bound in ((torch.float64, 1e-12), (torch.float32, 2e-5)):
            for rows in (1, 1000, 100_000):
                worst = max(worst, compare(name, step, dtype, rows, bound))
    return worst


def compare(name: str, step: lanes.program.Step, dtype: torch.dtype, rows: int, bound: float) -> int:
    """Print the largest difference of a program's outputs, and its time; 1 where it is beyond the bound."""
    if name == "flow":
        carry, now, row = given(rows, dtype)
    else:
        carry, now = torch.randn(rows, 2, dtype=dtype), torch.randn(rows, 30, dtype=dtype)
        row = (torch.rand(rows, dtype=dtype), lanes.Shared(torch.tensor(2.0, dtype=dtype)))
    carry, now, row = (lanes.tree.moved(tree, "cuda") for tree in (carry, now, row))
    program = lanes.Program(step)
    kernel = lanes.cuda.CudaKernel(program, carry, now, row)
    found, wanted = kernel(carry, now, row), program.definition(carry, now, row)
    torch.cuda.synchronize()
    begin = time.perf_counter()
    kernel(carry, now, row)
    torch.cuda.synchronize()
    seconds = time.perf_counter() - begin
    pairs = zip(lanes.tree.flatten(found)[0], lanes.tree.flatten(wanted)[0], strict=True)
    error = max(float((a.double() - b.double()).abs().max()) for a, b in pairs)
    print(f"{name:10} {dtype!s:14} {rows:7} rows: largest difference {error:.1e}, {1e3 * seconds:.2f} ms")
    return int(not error <= 10 * bound)  # also where NaN


if __name__ == "__main__":
    sys.exit(main())
