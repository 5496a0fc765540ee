"""What the tests of the fused recursion share."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from staf_torch import (
    ExponentialKernel,
    GaussianKernel,
    MaternKernel,
    PolynomialKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    ball,
    optim,
    rings,
    systems,
    targets,
)
from staf_torch.approximation.basis import GramStructure
from staf_torch.engine import compiled
from staf_torch.engine.compiled import CompiledInputs, History
from staf_torch.engine.problem import Problem
from staf_torch.engine.recursion import Carry, Inputs, Recursion, recursion
from staf_torch.lanes import build as compiled_module  # noqa: F401  (for tests of the build)

LAW = optim.SteepestDescent()
needs_compiler = pytest.mark.skipif(
    compiled.library(torch.float64, 3, shared=True) is None,
    reason="no C++ compiler: the reference runs instead",
)
# Steepest descent passes rounding on, some ten times an iteration at worst; ten iterations, well conditioned.
TOLERANCE = {torch.float64: 1e-10, torch.float32: 5e-3}


def problem(
    batch: int, times: int, count: int, dtype: torch.dtype, *, shared: bool, seed: int
) -> tuple[GramStructure, Tensor, Carry]:
    """Random well-conditioned structure, values and carry."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)

    root = normal(*(() if shared else (batch, times)), count, count)
    core = root @ root.mT / count + torch.eye(count, dtype=dtype)
    structure = GramStructure(core, 0.1 * normal(batch, times, count), normal(batch, times))
    never = torch.full((batch,), -1)
    return structure, normal(batch, times, count), Carry(normal(batch, count), (), normal(batch), 7, never)


def copied(carry: Carry) -> Carry:
    return Carry(carry.weights.clone(), (), carry.log_gain.clone(), carry.time, carry.diverged_at.clone())


def reference(structure: GramStructure, values: Tensor, carry: Carry, steps: int = 10) -> Recursion:
    problem = Problem("chase", BASES["exponential"], targets.Paper(), LAW, steps)  # law and iterations count
    return recursion(problem, Inputs.of(structure, values), carry)


def run(structure: GramStructure, values: Tensor, carry: Carry, steps: int = 10):
    """(before, after, carry), histories as (B, C, M)."""
    batch, times, count = values.shape
    before, after = values.new_empty(times, count, batch), values.new_empty(times, count, batch)
    states = values.new_zeros(batch, times, 2)  # not looked at where everything else is given
    given = CompiledInputs(structure, values)
    carry = compiled.advance(steps, states, given, copied(carry), History(before, after))
    return before.permute(2, 0, 1), after.permute(2, 0, 1), carry


def assert_equal_to_rounding(got: Tensor, want: Tensor) -> None:
    torch.testing.assert_close(got, want, rtol=0, atol=TOLERANCE[want.dtype] * float(want.abs().max()))


BASES = {
    "exponential": StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), 0.3)),
    "exponential, moving radius": StaFBasis(
        ExponentialKernel(), StateFollowingCenters(rings(3), StateRadius(0.3, 0.5))
    ),
    "gaussian": StaFBasis(GaussianKernel(0.7), StateFollowingCenters(ball(10, 2), 0.5)),
    "matern": StaFBasis(MaternKernel(1.5, 0.8), StateFollowingCenters(rings(10), 0.5)),
    "polynomial": StaFBasis(PolynomialKernel(2), StateFollowingCenters(rings(3), 0.5)),
}


def circles(batch: int, times: int) -> Tensor:
    angle = torch.arange(batch, dtype=torch.float64)
    x0 = torch.stack((angle.cos(), 0.8 * angle.sin()), dim=-1)
    return systems.simulate(systems.Oscillator(), x0, dt=0.05, steps=times - 1)
