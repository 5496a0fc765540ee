"""How far a state may move before its local functions say nothing of the new place."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform
from variants import over

import staf_torch as st
from staf_torch.online.kalman_filter import LocalFilter
from staf_torch.online.local_functions import LocalFunctions
from staf_torch.online.stream_state import StreamState

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


KERNELS = {
    "gaussian": st.GaussianKernel(0.8),
    "matern": st.MaternKernel(2.5, 1.1),
    "polynomial": st.PolynomialKernel(2),
}


@over(KERNELS, "kernel")
@pytest.mark.parametrize("forgetting", [1.0, 0.9])
def test_a_moving_filter_is_the_dense_recursion(kernel: str, forgetting: float) -> None:
    """u <- T u, D <- T D T', then D <- lambda D and the Kalman update with P = I - D, in matrices."""
    functions = LocalFunctions.of(KERNELS[kernel], 0.4 * st.rings(3))
    ratio, steps = 1e-2, 6
    filter_ = LocalFilter(functions, tensor([ratio]), tensor([forgetting]), slack=0.0)
    state = StreamState.empty(torch.zeros(0).double(), 1, 2, 3, 1)
    path, targets = 0.3 * uniform(steps, 2, seed=1), uniform(steps, seed=2)
    mean, learned, identity = torch.zeros(3).double(), torch.zeros(3, 3).double(), torch.eye(3).double()
    for k in range(steps):
        filter_.learn(state, path[k : k + 1], targets[k : k + 1, None])
        x = path[k, :, None]
        if k:
            transfer, factor = functions.transfer(path[k - 1, :, None], x - path[k - 1, :, None])
            move = transfer[..., 0]
            mean = move @ mean * (1.0 if factor is None else factor[0])
            learned = move @ learned @ move.mT
        psi = functions.local(x, torch.zeros_like(x))[0][:, 0]
        left = functions.prior(x, torch.zeros_like(x)) - psi @ psi  # variance that no weight explains
        covariance = identity - forgetting * learned
        spread = psi @ covariance @ psi + left + ratio
        gain = covariance @ psi / spread
        mean = mean + gain * (targets[k] - psi @ mean)
        learned = identity - (identity - torch.outer(gain, psi)) @ covariance
        found = state.parts(state.table)
        torch.testing.assert_close(found.mean[0, :, 0], mean, rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(found.learned[..., 0], learned, rtol=1e-9, atol=1e-10)
