"""What kernels share: differences, anchoring, the parts of an exponent; profiles in high precision."""

from __future__ import annotations

import math

import mpmath as mp
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor
from variants import KERNELS, over

import staf_torch as st
from staf_torch.kernels import base
from staf_torch.kernels.matern import _profile


class Cauchy(st.Kernel):
    """A kernel of the user's, with its value alone."""

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        return 1 / (1 + base.squared_distance(x1, x2))


class Steep(Cauchy):
    """One with a scale of its own, of which it tells no gradient."""

    def log_scale(self, x: Tensor, z: Tensor) -> Tensor:
        return (z * x.unsqueeze(-2)).sum(-1) + z[..., 0] ** 2


def test_a_kernel_promises_nothing_that_it_does_not_say() -> None:
    kernel, x = Cauchy(), uniform(3, 2)
    z, d, b = uniform(3, 4, 2, seed=1), uniform(3, 5, 2, seed=2), uniform(3, 5, seed=3)
    torch.testing.assert_close(kernel.core(x, z, d), kernel(x.unsqueeze(-2) + z, x.unsqueeze(-2) + d))
    assert (kernel.state_free, kernel.scale_slope) == (False, None)
    nothing = [kernel.gradient(z, d, b), kernel.core_gradient(x, z, d, b), kernel.log_gain(x)]
    nothing += [kernel.log_scale(x, z), kernel.log_scale_gradient(x, z), kernel.exponent_rate()]
    nothing += [kernel.follow(z, z), kernel.anchored_gradient(z, d, b)]  # type: ignore[list-item]
    assert nothing == [None] * 8
    assert kernel.polynomial_degree() is kernel.rank(3) is None
    assert kernel.extra_repr() == ""


def test_the_gradient_of_a_scale_is_found_where_it_is_not_told() -> None:
    x, z = uniform(3, 2), uniform(3, 4, 2, seed=1)
    found = Steep().log_scale_gradient(x, z)
    assert found is not None
    wanted = x.unsqueeze(-2) + torch.stack((2 * z[..., 0], 0 * z[..., 0]), -1)
    torch.testing.assert_close(found, wanted)


def test_a_hyperparameter_has_as_many_dimensions_as_what_it_meets() -> None:
    number = tensor(2.0)
    assert base.per_entry(number, 3) is number
    assert base.per_entry(uniform(4, 5), 2).shape == (4, 5, 1, 1)
    assert base.per_entry(uniform(4), 0).shape == (4,)


def test_products_and_differences_are_those_of_all_pairs() -> None:
    x1, x2, w = uniform(3, 4, 2, seed=4), uniform(3, 5, 2, seed=5), uniform(3, 4, 5, seed=6)
    torch.testing.assert_close(base.inner(x1, x2), torch.einsum("bpn,bmn->bpm", x1, x2))
    apart = x1.unsqueeze(-2) - x2.unsqueeze(-3)
    torch.testing.assert_close(base.squared_distance(x1, x2), apart.square().sum(-1))
    torch.testing.assert_close(base.weighted_differences(w, x2, x1), -(w.unsqueeze(-1) * apart).sum(-2))
    far = base.squared_distance(tensor([[1e8, 0.0]]), tensor([[1e8 + 1e-7, 0.0]]))
    assert float(far) == pytest.approx(float((torch.tensor(1e8).double() + 1e-7 - 1e8) ** 2), rel=1e-12)


PLAIN = {name: case for name, case in KERNELS.items() if not isinstance(case.make(), st.AnchoredKernel)}


@over(PLAIN)
def test_an_anchored_kernel_vanishes_at_the_origin_and_is_the_formula(name: str) -> None:
    kernel = KERNELS[name].make()
    x1, x2, b = uniform(3, 4, 2, low=0.2, seed=7), uniform(3, 5, 2, low=0.2, seed=8), uniform(3, 5, seed=9)
    zero = torch.zeros(1, 2).double()
    wanted = kernel(x1, x2) - kernel(x1, zero) * kernel(zero, x2) / kernel(zero, zero)
    torch.testing.assert_close(kernel.anchored(x1, x2), wanted, rtol=1e-9, atol=1e-12)
    at_origin = kernel.anchored(zero, x2)
    torch.testing.assert_close(at_origin, torch.zeros(3, 1, 5).double(), rtol=0, atol=1e-12)
    for whole, gradient in ((kernel, kernel.gradient), (kernel.anchored, kernel.anchored_gradient)):
        found = gradient(x1, x2, b)
        if found is None:
            continue
        at = x1.clone().requires_grad_()
        (slope,) = torch.autograd.grad((whole(at, x2) * b.unsqueeze(-2)).sum(), at)
        torch.testing.assert_close(found, slope, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("smoothness", [0.5, 1.5, 2.5])
def test_a_matern_kernel_is_exact_at_every_distance(smoothness: float) -> None:
    distances = [0.0, 1e-12, 1e-6, 1e-3, 0.1, 0.2, 0.2236, 0.2237, 0.35, 0.4, 0.5, 1.0, 3.0, 20.0]
    kernel = st.MaternKernel(smoothness, 1.3)
    for r in distances:
        t = mp.sqrt(2 * mp.mpf(smoothness)) * mp.mpf(r) / mp.mpf(1.3)
        poly = {0.5: 1, 1.5: 1 + t, 2.5: 1 + t + t**2 / 3}[smoothness]
        found = float(kernel(tensor([[0.0, 0.0]]), tensor([[0.6 * r, 0.8 * r]])))
        assert found == pytest.approx(float(poly * mp.exp(-t)), rel=1e-14)
        square = tensor(r * r / 1.69)
        if smoothness == 0.5 and r == 0:
            assert float(kernel.slope(square)) == 0.0
            continue
        # d/ds of p(t) e^{-t} with t^2 = 2 nu s
        s = mp.mpf(float(square))
        t = mp.sqrt(2 * mp.mpf(smoothness) * s)
        factor = -1 / (2 * t) if smoothness == 0.5 else -1.5 if smoothness == 1.5 else -5 * (1 + t) / 6
        assert float(kernel.slope(square)) == pytest.approx(float(factor * mp.exp(-t)), rel=1e-13)


@pytest.mark.parametrize("smoothness", [0.5, 1.5, 2.5])
def test_a_profile_has_derivatives_on_both_sides_of_its_series(smoothness: float) -> None:
    t2 = tensor([0.0, 1e-8, 0.2499, 0.2501, 4.0]).requires_grad_()
    (slope,) = torch.autograd.grad(_profile(smoothness, t2).sum(), t2)
    t = t2.detach().sqrt()
    wanted = {0.5: -(-t).exp() / (2 * t), 1.5: -(-t).exp() / 2, 2.5: -(1 + t) * (-t).exp() / 6}[smoothness]
    start = 1 if smoothness == 0.5 else 0
    torch.testing.assert_close(slope[start:], wanted[start:], rtol=1e-10, atol=0)
    assert math.isfinite(float(slope[0]))
