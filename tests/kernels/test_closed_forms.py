"""What a kernel says in closed form is what autograd finds."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from helpers import tensor, uniform
from variants import KERNELS, over

import staf_torch as st
from staf_torch.kernels import base

ONE_AN_ENTRY: dict[str, Callable[[torch.Tensor], st.Kernel]] = {
    "gaussian": lambda width: st.GaussianKernel(width),
    "matern12": lambda length: st.MaternKernel(0.5, length),
    "matern32": lambda length: st.MaternKernel(1.5, length),
    "matern52": lambda length: st.MaternKernel(2.5, length),
    "inverse": lambda length: st.InverseMultiquadricKernel(length),
    "rational_quadratic": lambda length: st.RationalQuadraticKernel(1.3, length),
    "rational_quadratic_alpha": lambda alpha: st.RationalQuadraticKernel(alpha, 0.9),
    "polynomial": lambda bias: st.PolynomialKernel(3, bias),
}
QUESTIONS: dict[str, Callable[..., torch.Tensor | None]] = {
    "value": lambda k, x, z, d, b: k(z, d),
    "gradient": lambda k, x, z, d, b: k.gradient(z, d, b),
    "core": lambda k, x, z, d, b: k.core(x, z, d),
    "core_gradient": lambda k, x, z, d, b: k.core_gradient(x, z, d, b),
    "log_gain": lambda k, x, z, d, b: k.log_gain(x),
    "log_scale": lambda k, x, z, d, b: k.log_scale(x, z),
    "log_scale_gradient": lambda k, x, z, d, b: k.log_scale_gradient(x, z),
    "anchored": lambda k, x, z, d, b: st.AnchoredKernel(k)(z, d),
    "anchored_gradient": lambda k, x, z, d, b: st.AnchoredKernel(k).gradient(z, d, b),
    "shift": lambda k, x, z, d, b: (k.follow(z, d[..., :1, :].expand_as(z)) or (None,))[0],
}


def by_autograd(kernel: st.Kernel, y: torch.Tensor, c: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    y = y.clone().requires_grad_()
    (slope,) = torch.autograd.grad((kernel(y, c) @ b.unsqueeze(-1)).sum(), y)
    return slope


@over(KERNELS)
def test_the_gradient_in_closed_form_is_that_of_autograd(name: str) -> None:
    kernels = [KERNELS[name].make()]
    if not name.startswith("anchored"):
        kernels.append(st.AnchoredKernel(kernels[0]))
    y, c, b = uniform(2, 5, 2, seed=1), uniform(2, 4, 2, seed=2), uniform(2, 4, seed=3)
    for kernel in kernels:
        found = kernel.gradient(y, c, b)
        if found is None:
            assert name == "user_defined"  # which says nothing
        else:
            torch.testing.assert_close(found, by_autograd(kernel, y, c, b), rtol=1e-10, atol=1e-11)


@over(KERNELS)
def test_the_gradient_of_the_core_is_that_of_autograd(name: str) -> None:
    kernel, x = KERNELS[name].make(), uniform(2, 2, seed=4)
    z, d, b = 0.3 * uniform(2, 5, 2, seed=1), 0.3 * uniform(2, 4, 2, seed=2), uniform(2, 4, seed=3)
    found = kernel.core_gradient(x, z, d, b)
    if found is None:
        return
    z = z.requires_grad_()
    (slope,) = torch.autograd.grad((kernel.core(x, z, d) @ b.unsqueeze(-1)).sum(), z)
    torch.testing.assert_close(found, slope, rtol=1e-11, atol=1e-12)


@over(KERNELS)
def test_the_gradient_of_the_scale_is_that_of_autograd(name: str) -> None:
    kernel, x, z = KERNELS[name].make(), uniform(2, 2, seed=4), 0.3 * uniform(2, 5, 2, seed=1)
    scale = kernel.log_scale(x, z)
    found = kernel.log_scale_gradient(x, z)
    assert (scale is None) == (found is None)
    if found is not None:
        z = z.requires_grad_()
        (slope,) = torch.autograd.grad(kernel.log_scale(x, z).sum(), z)
        torch.testing.assert_close(found.expand(z.shape), slope, rtol=1e-12, atol=1e-12)


@over(ONE_AN_ENTRY)
def test_hyperparameters_of_an_entry_each_are_kernels_one_by_one(name: str) -> None:
    """Sizes of batch, points, centers and states all differ, so that none can stand in for another."""
    make = ONE_AN_ENTRY[name]
    many = torch.tensor([0.6, 0.9, 1.7], dtype=torch.float64)
    x, z, d, b = (
        uniform(3, 2, seed=1),
        uniform(3, 5, 2, seed=2),
        uniform(3, 4, 2, seed=3),
        uniform(3, 4, seed=4),
    )
    for question, ask in QUESTIONS.items():
        found = ask(make(many), x, z, d, b)
        alone = [ask(make(each), *given) for each, *given in zip(many, x, z, d, b, strict=True)]
        if found is None:
            assert all(each is None for each in alone), question
        else:
            together = found.expand(3, *alone[0].shape)
            torch.testing.assert_close(together, torch.stack(alone), rtol=1e-13, atol=1e-14, msg=question)


def test_products_and_differences_are_those_of_all_pairs() -> None:
    x1, x2, w = uniform(3, 4, 2, seed=4), uniform(3, 5, 2, seed=5), uniform(3, 4, 5, seed=6)
    torch.testing.assert_close(base.inner(x1, x2), torch.einsum("bpn,bmn->bpm", x1, x2))
    apart = x1.unsqueeze(-2) - x2.unsqueeze(-3)
    torch.testing.assert_close(base.squared_distance(x1, x2), apart.square().sum(-1))
    torch.testing.assert_close(base.weighted_differences(w, x2, x1), -(w.unsqueeze(-1) * apart).sum(-2))
    far = base.squared_distance(tensor([[1e8, 0.0]]), tensor([[1e8 + 1e-7, 0.0]]))
    assert float(far) == pytest.approx(float((torch.tensor(1e8).double() + 1e-7 - 1e8) ** 2), rel=1e-12)
