"""Run row programs on a CUDA device and compare them with their definitions: ``python -m tests.gpu``.

Not collected by pytest. Prints a line for every program; exits with 1 where one differs, 2 without a device.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from staf_torch import adp, lanes, systems
from staf_torch.adp.loop.step import ClosedLoop, program

sys.path.insert(0, str(Path(__file__).parent))  # as pytest does it
from tests.lanes.test_c_and_cuda import flow, given
from tests.lanes.test_programs import pendulum


def main() -> int:
    if not torch.cuda.is_available():
        print("no CUDA device here")
        return 2
    print(torch.cuda.get_device_name())
    worst = 0
    for name, case in CASES.items():
        for dtype, bound in ((torch.float64, 1e-12), (torch.float32, 2e-5)):
            for rows in (1, 1000, 100_000):
                most = max(bound, 1e-9) if case is mixed else bound  # a float32 sine is right to two units
                worst = max(worst, compare(name, *case(rows, dtype), most))
    return worst


Case = tuple[lanes.Program, Any, Any, Any]  # the program and its inputs


def flows(rows: int, dtype: torch.dtype) -> Case:
    return lanes.Program(flow), *given(rows, dtype)


def pendulums(rows: int, dtype: torch.dtype) -> Case:
    carry, now = torch.randn(rows, 2, dtype=dtype), torch.randn(rows, 30, dtype=dtype)
    row = torch.rand(rows, dtype=dtype), lanes.Shared(torch.tensor(2.0, dtype=dtype))
    return lanes.Program(pendulum), carry, now, row


class Motor(systems.ControlAffineSystem):
    """A mode of 127 1/s and more, held for 20 ms: exponential steps."""

    dim, inputs = 2, 1

    def drift(self, x: Tensor) -> Tensor:
        speed = x[..., 1]
        return torch.stack((speed, -127 * speed * (1 + 0.1 * speed.tanh().square())), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.tensor([[0.0], [27.8]]).to(x).expand(*x.shape[:-1], 2, 1)


def loops(rows: int, dtype: torch.dtype) -> Case:
    plant, weights = Motor(), torch.diag(torch.tensor([1550.0, 15.5], dtype=torch.float64))
    cost = adp.QuadraticCost(weights, 1 / 144, dim=2, inputs=1)
    policy = adp.Feedback(adp.LQR(plant, cost, period=0.02))
    loop = ClosedLoop(policy, plant, cost, dt=0.02, substeps=None)
    x0 = torch.randn(rows, 2, dtype=dtype)
    return program(loop.to(dtype), True), loop.init(x0), torch.zeros(rows, 30, 0, 2, dtype=dtype), {}


def mixed(rows: int, dtype: torch.dtype) -> Case:
    """float32 constants and float32 arithmetic inside a program of another dtype."""

    def step(x: Tensor, now: Any, row: Any) -> tuple[Tensor, Tensor]:
        late = torch.where(x > 0, 1.0, 0.1) * torch.tensor([0.3, 0.7])
        x = x + 0.01 * (late - x.float().sin())
        return x.to(dtype), x.to(dtype)

    return lanes.Program(step), torch.randn(rows, 2, dtype=dtype), torch.zeros(rows, 30, dtype=dtype), ()


CASES: dict[str, Callable[[int, torch.dtype], Case]] = {
    "flow": flows,
    "pendulum": pendulums,
    "stiff loop": loops,
    "float32 within": mixed,
}


def compare(name: str, program: lanes.Program, carry: Any, now: Any, row: Any, bound: float) -> int:
    """Print how far the kernel is from plain torch on the CPU, and its time; 1 where beyond the bound."""
    wanted, kernel = program.definition(carry, now, row), program
    inputs = [lanes.tree.moved(tree, "cuda") for tree in (carry, now, row)]
    found = kernel(*inputs)
    torch.cuda.synchronize()
    begin = time.perf_counter()
    kernel(*inputs)
    torch.cuda.synchronize()
    seconds = time.perf_counter() - begin
    pairs = zip(lanes.tree.flatten(found)[0], lanes.tree.flatten(wanted)[0], strict=True)
    error = max(float(_error(a.cpu().double(), b.double())) for a, b in pairs if a.numel())
    rows, dtype = len(lanes.tree.flatten(carry)[0][0]), lanes.tree.flatten(carry)[0][0].dtype
    print(f"{name:15} {dtype!s:14} {rows:7} rows: largest difference {error:.1e}, {1e3 * seconds:.2f} ms")
    return int(not error <= 10 * bound)  # also where NaN


def _error(found: Tensor, wanted: Tensor) -> Tensor:
    """The largest difference, over 1 + the size of the number."""
    return ((found - wanted).abs() / (1 + wanted.abs())).max()


if __name__ == "__main__":
    sys.exit(main())
