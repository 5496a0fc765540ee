"""Derivatives of the ideal weights against differences, automatic differentiation and high precision."""

from __future__ import annotations

import mpmath as mp
import pytest
import torch
from helpers import basis_of, tensor, uniform
from torch import Tensor, nn
from variants import KERNELS, RADII, by_turns

import staf_torch as st
from staf_torch.approximation.sensitivity import state_jacobian, weight_jacobian


def smooth_target(x: Tensor) -> Tensor:
    return 2 + (x.sum(-1) + 0.25).cos()


def dense_weights(basis: st.StaFBasis, centers: Tensor) -> Tensor:
    """K(c)^-1 V(c) by plain elimination, for any centers."""
    return torch.linalg.solve(basis.kernel(centers, centers), smooth_target(centers))


def central_differences(basis: st.StaFBasis, centers: Tensor, step: float) -> Tensor:
    """dW/dc of one state to fourth order: (M, n) -> (M, M, n)."""
    found = torch.zeros(len(centers), *centers.shape, dtype=torch.float64)
    for i, coordinate in [(i, k) for i in range(centers.shape[0]) for k in range(centers.shape[1])]:
        move = torch.zeros_like(centers)
        move[i, coordinate] = step
        one, two = (
            dense_weights(basis, centers + k * move) - dense_weights(basis, centers - k * move)
            for k in (1, 2)
        )
        found[:, i, coordinate] = (8 * one - two) / (12 * step)
    return found


def assert_close(found: Tensor, expected: Tensor, tolerance: float) -> None:
    assert float((found - expected).abs().max()) <= tolerance * float(expected.abs().max())


@pytest.mark.parametrize(("kernel", "count"), by_turns(KERNELS, [3, 6]))
def test_weight_jacobian_is_what_differences_of_the_dense_solution_give(kernel: str, count: int) -> None:
    basis = basis_of(kernel, count, radius=0.6)
    x = uniform(2, 2, seed=count) + 0.4
    found = weight_jacobian(basis, x, smooth_target)
    assert found.shape == (2, count, count, 2)
    for row, at in zip(found, x, strict=True):
        assert_close(row, central_differences(basis, basis.centers(at), 1e-3), 1e-6)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # torch's own, in jacfwd
@pytest.mark.parametrize(("kernel", "radius"), by_turns(KERNELS, list(RADII)))
def test_state_jacobian_is_that_of_the_ideal_weights(kernel: str, radius: str) -> None:
    basis = basis_of(kernel, 3, RADII[radius][0]())
    x = uniform(3, 2, seed=5) + tensor([0.9, 0.2])
    found = state_jacobian(basis, x, smooth_target)
    assert found.shape == (3, 3, 2)
    weights = lambda y: basis.ideal_weights(y, smooth_target)  # noqa: E731
    for row, at in zip(found, x, strict=True):
        assert_close(row, torch.func.jacrev(weights)(at), 1e-7)
    assert_close(torch.vmap(torch.func.jacfwd(weights))(x), found, 1e-7)


def test_state_jacobian_is_the_weight_jacobian_along_the_moving_centers() -> None:
    basis = basis_of("gaussian", 6, st.StateRadius(0.7, 0.1, gain=2.0))
    x = uniform(4, 2, seed=2)
    along = torch.vmap(torch.func.jacrev(basis.centers))(x)  # (4, M, n, n)
    expected = torch.einsum("bkil,bilp->bkp", weight_jacobian(basis, x, smooth_target), along)
    assert_close(state_jacobian(basis, x, smooth_target), expected, 1e-11)


@pytest.mark.parametrize("kernel", ["gaussian", "polynomial"])
def test_batch_and_vmap_are_one_state_at_a_time(kernel: str) -> None:
    basis = basis_of(kernel, 3, st.StateRadius(0.7, 0.3))
    x = uniform(2, 2, 2, seed=1)
    for function in (weight_jacobian, state_jacobian):
        together = function(basis, x, smooth_target)
        alone = torch.stack([function(basis, at, smooth_target) for at in x.flatten(0, 1)])
        mapped = torch.vmap(torch.vmap(lambda at, f=function: f(basis, at, smooth_target)))(x)
        assert_close(together.flatten(0, 1), alone, 1e-9)
        assert_close(mapped, together, 1e-9)


@pytest.mark.parametrize("kernel", ["exponential", "matern52", "polynomial"])
def test_jacobians_can_be_differentiated_again(kernel: str) -> None:
    basis = basis_of(kernel, 3, st.StateRadius(0.7, 0.5))
    x = (uniform(2, 2, seed=3) + 0.7).requires_grad_()
    scale = float(state_jacobian(basis, x, smooth_target).detach().abs().max())
    for function in (weight_jacobian, state_jacobian):
        scaled = lambda at, f=function: f(basis, at, smooth_target) / scale  # noqa: E731
        assert torch.autograd.gradcheck(scaled, (x,), eps=1e-5, atol=1e-5, rtol=1e-4, fast_mode=True)
    second = torch.func.jacrev(lambda at: state_jacobian(basis, at, smooth_target))(x[0].detach())
    weights = lambda at: basis.ideal_weights(at, smooth_target)  # noqa: E731
    expected = torch.func.jacrev(torch.func.jacrev(weights))(x[0].detach())
    assert_close(second, expected, 1e-6)


def test_small_radius_is_as_accurate_as_its_weights_allow() -> None:
    r = 0.01
    basis = basis_of("exponential", 3, r)
    x = tensor([0.6, -0.3])
    found = weight_jacobian(basis, x, smooth_target)
    with mp.workdps(60):
        exact = _exact_jacobian(basis.centers(x))
        gap = max(abs(mp.mpf(float(f)) - e) for f, e in zip(found.flatten(), exact, strict=True))
        # W ~ 1/r here and dW/dc ~ 1/r^2: rounding of V, of size eps, is amplified by another 1/r^2.
        assert gap <= 1e-15 / r**2 * max(map(abs, exact))


def _exact_jacobian(centers: Tensor) -> list[mp.mpf]:
    """dW_k / dc_{i,l} of the exponential kernel in mpmath, flat in the order k, i, l."""
    points = [[mp.mpf(float(e)) for e in c] for c in centers]

    def weights(at: list[list[mp.mpf]]) -> mp.matrix:
        gram = mp.matrix(
            [[mp.exp(mp.fsum(a * b for a, b in zip(p, q, strict=True))) for q in at] for p in at]
        )
        return mp.lu_solve(gram, mp.matrix([2 + mp.cos(mp.fsum(p) + mp.mpf(1) / 4) for p in at]))

    step, columns = mp.mpf(10) ** -20, {}
    for i in range(len(points)):
        for k in range(2):
            ends = []
            for sign in (1, -1):
                moved = [list(p) for p in points]
                moved[i][k] += sign * step
                ends.append(weights(moved))
            columns[i, k] = (ends[0] - ends[1]) / (2 * step)
    return [columns[i, k][row] for row in range(len(points)) for i in range(len(points)) for k in range(2)]


def test_weights_that_cannot_be_represented_spoil_their_row_only() -> None:
    basis = basis_of("exponential", 3, 0.01)
    x = tensor([[0.5, 0.1], [60.0, 0.0]])
    for function in (weight_jacobian, state_jacobian):
        found = function(basis, x, smooth_target)
        assert torch.isfinite(found[0]).all()
        assert torch.isnan(found[1]).all()
        # Rounding, amplified by the 1 / r^2 of the weights' own cancellation.
        assert_close(found[0], function(basis, x[0], smooth_target), 1e-15 / 0.01**2)


def test_wrong_arguments_are_named() -> None:
    basis = basis_of("gaussian", 3)
    with pytest.raises(ValueError, match=r"`weight_jacobian\(x=...\)` must have 2 entries"):
        weight_jacobian(basis, uniform(4, 3), smooth_target)
    with pytest.raises(ValueError, match=r"`state_jacobian\(x=...\)` must be a tensor"):
        state_jacobian(basis, [0.0, 1.0], smooth_target)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="must map points"):
        weight_jacobian(basis, uniform(4, 2), nn.Identity())
