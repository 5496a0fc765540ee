"""Second derivatives of V^ in the three modes: differences of its gradients."""

from __future__ import annotations

import pytest
import torch
from helpers import basis_of, uniform
from variants import SMOOTH_KERNELS, over

import staf_torch as st
from staf_torch.targets import Paper

STEP = 1e-5


def moved(staf: st.StaF, step: torch.Tensor, mode: str) -> st.StaF:
    """The approximation at the state x + step, with what moves in this mode."""
    if mode == "partial":
        return staf
    fresh = st.StaF(staf.basis, tuple(staf.state.shape[:-1]))
    if mode == "total":
        return fresh.fit_(staf.state + step, Paper())
    weights = staf.weights.detach()
    with torch.no_grad():
        fresh.state.copy_(staf.state + step)
        fresh.coefficients.copy_(staf.basis.local(fresh.state).coefficients(weights))
    return fresh


@pytest.mark.parametrize("mode", ["partial", "total_frozen_weights", "total"])
@over(SMOOTH_KERNELS)
def test_hessian_is_the_derivative_of_the_gradient(name: str, mode: str) -> None:
    staf = st.StaF(basis_of(name, 6, 0.4), (3,)).fit_(uniform(3, 2, low=0.3), Paper())
    y = staf.state.unsqueeze(-2) + uniform(3, 4, 2, low=-0.2, high=0.2)
    found = staf.hessian(y, mode, Paper()).detach()
    assert found.shape == (3, 4, 2, 2)
    torch.testing.assert_close(found, found.mT, rtol=1e-7, atol=1e-7)
    for axis in range(2):
        step = torch.zeros(2, dtype=torch.float64)
        step[axis] = STEP
        ahead, behind = (
            moved(staf, sign * step, mode).gradient(y + sign * step, mode, Paper()) for sign in (1, -1)
        )
        difference = ((ahead - behind) / (2 * STEP)).detach()
        scale = float(difference.abs().max()) + 1
        torch.testing.assert_close(found[..., axis, :], difference, rtol=0, atol=2e-5 * scale)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # torch's own, in jacfwd
@over(SMOOTH_KERNELS)
def test_weights_have_the_same_jacobian_forward_and_backward_alone_and_in_a_batch(name: str) -> None:
    basis, x = basis_of(name, 6, 0.4), uniform(3, 2, low=0.3)

    def weights(at: torch.Tensor) -> torch.Tensor:
        return basis.ideal_weights(at, Paper())

    backward = torch.func.vmap(torch.func.jacrev(weights))(x)
    scale = float(backward.abs().max())
    for row in range(3):
        torch.testing.assert_close(
            torch.func.jacrev(weights)(x[row]), backward[row], rtol=0, atol=1e-9 * scale
        )
    forward = torch.func.vmap(torch.func.jacfwd(weights))(x)
    torch.testing.assert_close(forward, backward, rtol=0, atol=1e-8 * scale)
