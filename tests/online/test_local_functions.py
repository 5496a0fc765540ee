"""How far a state may move before its local functions say nothing of the new place."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor

import staf_torch as st
from staf_torch.online.local_functions import LocalFunctions

OFFSETS = 0.5 * torch.cat((st.cross_polytope(2), torch.zeros(1, 2, dtype=torch.float64)))


@pytest.mark.parametrize(
    ("kernel", "most"), [(st.ExponentialKernel(), 2.0), (st.InverseMultiquadricKernel(1.0), 5e7)]
)
def test_beyond_its_reach_a_kernel_says_nothing(kernel: st.Kernel, most: float) -> None:
    """Four radii where the scale of a kernel grows with the state, and 1e8 for any."""
    functions = LocalFunctions.of(kernel, OFFSETS)
    steps = tensor([[0.0, most], [most * (1 - 1e-9), 0.0], [0.0, -most * (1 + 1e-9)], [3 * most, 0.0]])
    transfer, factor = functions.transfer(torch.zeros_like(steps.mT), steps.mT)
    largest = transfer.abs().amax((0, 1))
    assert (largest > 0).tolist() == [True, True, False, False]
    if factor is not None:
        gains = (steps.square().sum(-1) / 2).exp()  # of e^{x'x / 2}, the amplitude at a state
        wanted = torch.where(largest > 0, gains, 1.0)
        torch.testing.assert_close(factor, wanted)


@pytest.mark.parametrize("step", [1.0, 36.0, 40.0, 1e4, 1e7])
@pytest.mark.parametrize("radius", [18.0, 20.0])
def test_a_move_between_centers_that_are_far_apart_overflows_nothing(step: float, radius: float) -> None:
    functions = LocalFunctions.of(st.GaussianKernel(1.0), radius * st.cross_polytope(2))
    transfer, factor = functions.transfer(torch.zeros(2, 1).double(), tensor([[step], [0.0]]))
    assert factor is None
    found = transfer[..., 0]
    assert float(torch.linalg.matrix_norm(found, 2)) <= 1 + 1e-9
    if radius == 18:  # the functions are the kernels themselves, in another order
        between = functions.kernel(functions.offsets + tensor([step, 0.0]), functions.offsets)
        wanted = between.flatten().sort().values
        torch.testing.assert_close(found.flatten().sort().values, wanted, rtol=0, atol=1e-9)


def test_functions_of_single_precision_stay_so_and_a_center_alone_will_do() -> None:
    alone = OFFSETS[:1]
    for kernel in (st.GaussianKernel(0.8), st.MaternKernel(), st.ExponentialKernel(), st.PolynomialKernel(2)):
        functions = LocalFunctions.of(kernel, alone)
        x, z = torch.zeros(2, 3), 0.1 * torch.ones(2, 3)
        local = functions.local(x, z)
        prior = torch.as_tensor(functions.prior(x, z))
        assert local.psi.dtype == torch.float32
        assert local.psi.shape == (1, 3)
        assert bool((local.psi[0].square() <= prior * (1 + 1e-5)).all())
        transfer, _ = functions.transfer(x, z)
        assert (transfer.dtype, transfer.shape) == (torch.float32, (1, 1, 3))
        assert float(transfer.abs().max()) <= 1 + 1e-6
