"""The covariance of a filter whose frame moves, against a recursion in dense matrices."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform
from variants import over

import staf_torch as st
from staf_torch.online.kalman_filter import LocalFilter, StreamState
from staf_torch.online.local_functions import LocalFunctions

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
        at = functions.local(x, torch.zeros_like(x))
        psi = at.psi[:, 0]
        left = functions.prior(x, torch.zeros_like(x)) - psi @ psi  # variance that no weight explains
        covariance = identity - forgetting * learned
        spread = psi @ covariance @ psi + left + ratio
        gain = covariance @ psi / spread
        mean = mean + gain * (targets[k] - psi @ mean)
        learned = identity - (identity - torch.outer(gain, psi)) @ covariance
        torch.testing.assert_close(state.mean[0, :, 0], mean, rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(state.learned[..., 0], learned, rtol=1e-9, atol=1e-10)
