"""Kernels: each against its own formula, and the properties that hold for all of them."""

from __future__ import annotations

import math
import re

import pytest
import torch
from helpers import tensor, uniform
from torch.autograd import gradcheck, gradgradcheck
from variants import KERNELS, SMOOTH_KERNELS, by_turns, over

import staf_torch as st


@pytest.mark.parametrize(("name", "dim"), by_turns(KERNELS, [1, 2, 5]))
def test_kernel_equals_its_formula(name: str, dim: int) -> None:
    case = KERNELS[name]
    y, c = uniform(6, dim), uniform(5, dim)
    expected = tensor([[case.formula(a.tolist(), b.tolist()) for b in c] for a in y])
    torch.testing.assert_close(case.make()(y, c), expected, rtol=1e-13, atol=1e-14)


@over(KERNELS)
def test_kernel_is_symmetric(name: str) -> None:
    kernel = KERNELS[name].make()
    y, c = uniform(4, 6, 3), uniform(4, 5, 3)
    torch.testing.assert_close(kernel(y, c), kernel(c, y).mT, rtol=1e-14, atol=0)


@pytest.mark.parametrize(("name", "dim"), by_turns(KERNELS, [2, 4]))
def test_gram_matrix_of_distinct_points_is_positive_definite(name: str, dim: int) -> None:
    points = uniform(20, 6, dim, low=-1.5, high=1.5)
    gram = KERNELS[name].make()(points, points)
    eigenvalues = torch.linalg.eigvalsh(gram)
    assert (eigenvalues[:, 0] > 1e-12 * eigenvalues[:, -1]).all()


@pytest.mark.parametrize(("name", "batch"), by_turns(KERNELS, [(), (2, 3)]))
def test_batch_equals_loop(name: str, batch: tuple[int, ...]) -> None:
    kernel = KERNELS[name].make()
    y, c = uniform(*batch, 4, 2), uniform(*batch, 3, 2)
    together = kernel(y, c)
    assert together.shape == (*batch, 4, 3)
    flat = [kernel(a, b) for a, b in zip(y.reshape(-1, 4, 2), c.reshape(-1, 3, 2), strict=True)]
    torch.testing.assert_close(together.reshape(-1, 4, 3), torch.stack(flat), rtol=1e-14, atol=1e-15)


@over(KERNELS)
def test_dtype_of_the_points_is_the_dtype_of_the_values(name: str) -> None:
    kernel = KERNELS[name].make()
    y, c = uniform(4, 2), uniform(3, 2)
    exact, y, c = kernel(y, c), y.float(), c.float()
    got, tolerance = kernel(y, c), 30 * torch.finfo(torch.float32).eps
    torch.testing.assert_close(got.double(), exact, rtol=tolerance, atol=tolerance)
    for part in (got, kernel.core(y[0], y, c), kernel.log_scale(y[0], y), kernel.log_gain(y[0])):
        assert part is None or part.dtype == torch.float32


@over(KERNELS)
def test_factors_near_a_state_multiply_to_the_kernel(name: str) -> None:
    kernel = KERNELS[name].make()
    x, z, d = uniform(7, 3, low=-2, high=2), uniform(7, 4, 3), uniform(7, 5, 3)
    zero = x.new_zeros(())
    gain = kernel.log_gain(x)
    left, right = kernel.log_scale(x, z), kernel.log_scale(x, d)
    exponent = (
        (zero if gain is None else gain[:, None, None])
        + (zero if left is None else left[:, :, None])
        + (zero if right is None else right[:, None, :])
    )
    near = kernel.core(x, z, d) * exponent.exp()
    at = x.unsqueeze(-2)
    torch.testing.assert_close(near, kernel(at + z, at + d), rtol=1e-12, atol=1e-13)


@over(KERNELS)
def test_exponent_rate_is_that_of_the_core(name: str) -> None:
    kernel = KERNELS[name].make()
    rate = kernel.exponent_rate()
    z, d = uniform(4, 2), uniform(3, 2)
    if rate is not None:
        torch.testing.assert_close(kernel.core(z[0], z, d), (rate * z @ d.mT).exp(), rtol=1e-14, atol=0)


@over(KERNELS)
def test_gradients_are_right_for_a_rough_kernel_away_from_its_center(name: str) -> None:
    kernel, away = KERNELS[name].make(), 0.0 if name in SMOOTH_KERNELS else 4.0
    y, c = uniform(3, 2).requires_grad_(), (uniform(2, 2) + away).requires_grad_()
    assert gradcheck(kernel, (y, c), fast_mode=True)
    assert gradgradcheck(kernel, (y, c), fast_mode=True)


@over(KERNELS)
def test_gradient_at_coincident_points_is_finite(name: str) -> None:
    kernel = KERNELS[name].make()
    y = uniform(3, 2)
    gradient = torch.func.grad(lambda at: kernel(at, y).sum())(y.clone())
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("smoothness", [1.5, 2.5])
def test_hessian_of_a_matern_kernel_at_its_center_is_minus_nu_over_nu_minus_one(smoothness: float) -> None:
    length = 0.7
    kernel = st.MaternKernel(smoothness, length)
    c = uniform(3)
    # Reverse mode twice: forward mode runs into a deprecation warning of torch itself.
    hessian = torch.func.jacrev(torch.func.jacrev(lambda at: kernel(at[None], c[None]).sum()))(c.clone())
    expected = -smoothness / (smoothness - 1) / length**2 * torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(hessian, expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("smoothness", [0.5, 1.5, 2.5])
def test_matern_kernel_has_all_its_digits_across_the_change_of_branch(smoothness: float) -> None:
    mpmath = pytest.importorskip("mpmath")
    length = 0.7
    kernel = st.MaternKernel(smoothness, length)
    threshold = 0.5 * length / math.sqrt(2 * smoothness)  # where t = 1/2
    r = tensor([1e-12, 1e-6, 1e-3, threshold * (1 - 1e-9), threshold * (1 + 1e-9), 1.0, 5.0, 40.0])

    def profile(at: float) -> list[float]:
        def function(x):  # type: ignore[no-untyped-def]
            t = mpmath.sqrt(2 * mpmath.mpf(smoothness)) * x / mpmath.mpf(length)
            return {0.5: 1, 1.5: 1 + t, 2.5: 1 + t + t**2 / 3}[smoothness] * mpmath.exp(-t)

        with mpmath.workdps(50):
            return [float(mpmath.diff(function, mpmath.mpf(at), k)) for k in (0, 1, 2)]

    def value(at: torch.Tensor) -> torch.Tensor:
        return kernel(at.reshape(1, 1), torch.zeros(1, 1, dtype=torch.float64)).sum()

    first, second = torch.func.grad(value), torch.func.grad(torch.func.grad(value))
    got = torch.stack([torch.stack([f(at) for f in (value, first, second)]) for at in r])
    expected = tensor([profile(float(at)) for at in r])
    if smoothness == 0.5:  # its second derivative is one of |r| through r^2: lost below r = sqrt(eps)
        got[r < 1e-3, 2] = expected[r < 1e-3, 2]
    torch.testing.assert_close(got, expected, rtol=2e-12, atol=1e-14)


@over(KERNELS)
def test_vmap_and_jacrev_go_through(name: str) -> None:
    kernel = KERNELS[name].make()
    y, c = uniform(5, 3, 2), uniform(5, 4, 2)
    torch.testing.assert_close(torch.func.vmap(kernel)(y, c), kernel(y, c), rtol=1e-13, atol=1e-14)
    jacobian = torch.func.jacrev(kernel)(y[0], c[0])
    reference = torch.autograd.functional.jacobian(lambda at: kernel(at, c[0]), y[0])
    torch.testing.assert_close(jacobian, reference, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", [name for name in KERNELS if not name.startswith("anchored")])
def test_anchored_kernel_is_the_kernel_less_its_part_at_the_origin(name: str) -> None:
    kernel = KERNELS[name].make()
    anchored = st.AnchoredKernel(kernel)
    y, c, zero = uniform(3, 4, 2), uniform(3, 5, 2), torch.zeros(1, 2, dtype=torch.float64)
    expected = kernel(y, c) - kernel(y, zero) * kernel(zero, c) / kernel(zero, zero)
    torch.testing.assert_close(anchored(y, c), expected, rtol=1e-12, atol=1e-14)
    assert anchored(zero, c).abs().max() <= 1e-16
    assert anchored(y, zero).abs().max() <= 1e-16


def test_anchored_exponential_keeps_its_digits_near_the_origin() -> None:
    kernel = st.AnchoredKernel(st.ExponentialKernel())
    y = tensor([[1e-9, 2e-9]])
    torch.testing.assert_close(kernel(y, y), tensor([[5e-18]]), rtol=1e-14, atol=0)


def test_radial_kernels_keep_a_small_distance_far_from_the_origin() -> None:
    far, step = tensor([[1e6, -1e6]]), 2.0**-20
    exact = math.exp(-(step**2) / 2)
    assert st.GaussianKernel()(far, far + tensor([step, 0.0])).item() == pytest.approx(exact, rel=1e-15)


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize(("bias", "anchored"), [(1.0, False), (0.0, False), (1.0, True)])
def test_rank_of_a_polynomial_kernel_is_the_rank_of_its_gram_matrix(
    degree: int, bias: float, anchored: bool
) -> None:
    kernel: st.Kernel = st.PolynomialKernel(degree, bias)
    kernel = st.AnchoredKernel(kernel) if anchored else kernel
    points = uniform(40, 3)
    assert kernel.rank(3) == int(torch.linalg.matrix_rank(kernel(points, points), rtol=1e-10))


def test_rational_quadratic_kernel_tends_to_the_gaussian() -> None:
    y, c = uniform(4, 2), uniform(3, 2)
    limit = st.RationalQuadraticKernel(alpha=1e9, length_scale=0.8)(y, c)
    torch.testing.assert_close(limit, st.GaussianKernel(0.8)(y, c), rtol=1e-7, atol=0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: st.GaussianKernel(width=tensor([1.0, 0.0])), "must be positive; got [1.0, 0.0]."),
        (lambda: st.GaussianKernel(width=torch.tensor([1])), "must be a floating-point tensor; got [1]."),
        (lambda: st.AnchoredKernel(st.PolynomialKernel(2, 0.0)), "must have k(0, 0) > 0; got [0.0]"),
    ],
)
def test_a_bad_argument_is_named_with_its_value(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=re.escape(message)):
        make()
