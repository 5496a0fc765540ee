"""From a chase to numbers."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from helpers import basis_of, uniform
from variants import KERNELS, over

import staf_torch as st
from staf_torch.approximation.conditioning import sup_error
from staf_torch.metrics.chase import StateErrorPass
from staf_torch.numerics.linalg import condition_number
from staf_torch.targets import Paper

MOVING = ("exponential", "matern52")  # a graded and a Newton space, at a moving radius


def in_kernels(basis: st.StaFBasis, x: torch.Tensor, target: Callable[..., torch.Tensor]) -> torch.Tensor:
    """b of the ideal weights in V^(x + z) = e^{s(z)} sum_i b_i k0(z, d_i)."""
    space = basis.local(x)
    scaled = space.scaled_weights(space.fit(basis.values(x, target)))
    s = basis.kernel.log_scale(x, space.offsets)
    return scaled if s is None else scaled * s.exp()


@pytest.mark.parametrize(("dim", "radius"), [(1, 0.4), (2, st.StateRadius(0.5, 0.1)), (3, 0.4)])
def test_ball_error_is_close_to_a_dense_supremum(radius: object, dim: int) -> None:
    basis = basis_of("gaussian", 3, radius, dim) if dim == 2 else basis_of("gaussian", 4, radius, dim)
    x = uniform(5, dim)

    def target(y: torch.Tensor) -> torch.Tensor:
        return (y.sum(-1) + 0.3).exp()

    coefficients = in_kernels(basis, x, target)
    found = StateErrorPass(basis, target)(x, coefficients, coefficients).ball_error
    inside = torch.randn(20_000, dim).double()
    inside /= inside.norm(dim=-1, keepdim=True).clamp(min=1.0)
    inside[::2] /= inside[::2].norm(dim=-1, keepdim=True)
    y = x.unsqueeze(-2) + basis.centers.radius(x)[..., None, None] * inside
    staf = st.StaF(basis, (5,)).fit_(x, target)
    dense = (target(y) - staf(y)).abs().amax(-1).detach()
    assert (found <= dense * 1.01).all()
    assert (found >= dense * 0.7).all()


@pytest.mark.parametrize(
    ("name", "radius"),
    [*((name, 0.2) for name in KERNELS), *((name, st.StateRadius(0.2, 0.1)) for name in MOVING)],
)
def test_errors_around_states_are_those_of_the_basis_in_pieces_of_any_size(name: str, radius: object) -> None:
    basis, x = basis_of(name, 3, radius), uniform(4, 9, 2)
    coefficients = (1 + 0.1 * uniform(4, 9, 3)) * in_kernels(basis, x, Paper())
    ideal = basis.ideal_weights(x, Paper())
    found = StateErrorPass(basis, Paper(), compile=False)(x, coefficients, ideal)
    floor = sup_error(basis, x, Paper(), 97)
    torch.testing.assert_close(found.ball_floor_error, floor, rtol=1e-9, atol=1e-12)
    kappa = condition_number(basis.gram_structure(x).scaled()).expand(4, 9)
    torch.testing.assert_close(found.condition_number, kappa, rtol=1e-12, atol=0.0)
    errors = StateErrorPass(basis, Paper(), compile=False)
    pieces = [errors(*(part[:, at] for part in (x, coefficients, ideal))) for at in (slice(4), slice(4, 9))]
    for parts, whole in zip(zip(*pieces, strict=True), found, strict=True):
        torch.testing.assert_close(torch.cat(parts, 1), whole, rtol=1e-9, atol=1e-11)


@pytest.mark.needs_compiler
@pytest.mark.parametrize(
    ("name", "radius"), [("anchored_gaussian", 0.2), ("matern52", st.StateRadius(0.2, 0.1))]
)
def test_compiled_errors_are_the_definition_and_a_state_that_is_not_finite_spoils_no_other(
    name: str, radius: object
) -> None:
    """Eigenvalues are exact to eps of the largest: the condition number to eps kappa of itself."""
    basis, x = basis_of(name, 3, radius), uniform(1, 20, 2)
    coefficients, ideal = in_kernels(basis, x, Paper()), basis.ideal_weights(x, Paper())
    errors = StateErrorPass(basis, Paper(), compile=True)
    clean = errors(x, coefficients, ideal)
    assert errors.compiled
    wanted = StateErrorPass(basis, Paper(), compile=False)(x, coefficients, ideal)
    kappa = float(wanted.condition_number.max())
    torch.testing.assert_close(clean.condition_number, wanted.condition_number, rtol=1e-14 * kappa, atol=0)
    for one, other in zip(clean, wanted, strict=True):
        if one is not clean.condition_number:
            torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11)
    x[0, 3], coefficients[0, 4] = torch.nan, torch.inf
    dirty = errors(x, coefficients, ideal)
    rest = [k for k in range(20) if k not in (3, 4)]
    for one, other in zip(clean, dirty, strict=True):
        assert torch.equal(one[:, rest], other[:, rest])
    assert not torch.isfinite(dirty.ball_error[0, 3:5]).any()
    assert not torch.isfinite(dirty.condition_number[0, 3])


@over(KERNELS)
def test_gradient_error_is_that_of_the_partial_gradient(name: str) -> None:
    basis, x = basis_of(name, 6, 0.5), uniform(4, 2, low=0.3)
    coefficients = in_kernels(basis, x, Paper())
    staf = st.StaF(basis, (4,)).fit_(x, Paper())
    exact = torch.func.grad(lambda at: Paper()(at).sum())(x)
    expected = (staf.gradient(x.unsqueeze(-2)).squeeze(-2) - exact).norm(dim=-1)
    found = StateErrorPass(basis, Paper())(x, coefficients, coefficients).gradient_error
    torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-8)
