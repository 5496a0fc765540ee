"""The local space: coefficients that stay finite, and the paper's weights derived from them."""

from __future__ import annotations

import pytest
import torch
from helpers import basis_of, tensor, uniform
from variants import KERNELS, RADII, over

import staf_torch as st
from staf_torch.engine.quantities import _paper_weights
from staf_torch.local_basis.base import from_scaled
from staf_torch.local_basis.newton import newton_space
from staf_torch.targets import Paper

NEWTON = {name: KERNELS[name] for name in KERNELS if name not in ("exponential", "gaussian", "polynomial")}


@over(KERNELS)
@over(RADII, "radius")
def test_weights_and_coefficients_are_two_names_of_one_function(name: str, radius: str) -> None:
    basis = basis_of(name, 3, RADII[radius][0]())
    space = basis.local(uniform(4, 2, low=0.3, high=1.2))
    beta = uniform(4, 3)
    torch.testing.assert_close(space.coefficients(space.weights(beta)), beta, rtol=1e-8, atol=1e-8)


@over(NEWTON)
def test_squared_length_in_the_newton_basis_is_the_squared_native_norm(name: str) -> None:
    basis, x = basis_of(name, 6, 0.8), uniform(4, 2, low=0.4)
    space = basis.local(x)
    beta = space.factor.solve_lower(space.fit(basis.values(x, Paper())))
    gain = basis.kernel.log_gain(x)
    native = (basis.ideal_weights(x, Paper()) * basis.values(x, Paper())).sum(-1)  # w'K w = w'V
    scaled = beta.square().sum(-1) * (1.0 if gain is None else (-gain).exp())
    torch.testing.assert_close(scaled, native, rtol=1e-8, atol=1e-10)


@over(KERNELS)
def test_rank_is_full_for_well_separated_centers(name: str) -> None:
    assert (basis_of(name, 6, 0.8).local(uniform(4, 2, low=0.4)).rank == 6).all()


def test_rank_says_where_the_gram_matrix_is_numerically_singular() -> None:
    basis = basis_of("matern52", 15, 1e-4)
    space = basis.local(uniform(4, 2))
    assert int(space.rank) < 15
    beta = space.fit(basis.values(space.state, Paper()))
    assert torch.isfinite(beta).all()
    here = torch.zeros(4, 1, 2).double()
    estimate = space.evaluate(here, beta).squeeze(-1)
    torch.testing.assert_close(estimate, Paper()(space.state), rtol=0, atol=1e-5)


def test_centers_that_meet_leave_one_of_them() -> None:
    basis = basis_of("rational_quadratic", 6, st.StateRadius(0.5, 0.0))
    space = basis.local(tensor([[0.0, 0.0], [1.0, 0.5]]))
    assert space.rank.tolist() == [1, 6]
    values = space.evaluate(torch.zeros(2, 1, 2).double(), space.fit(basis.values(space.state, Paper())))
    torch.testing.assert_close(values.squeeze(-1), Paper()(space.state), rtol=0, atol=2e-3)


def test_one_factor_serves_all_states() -> None:
    assert basis_of("matern32").local(uniform(5, 4, 2)).factor.factor.shape == (6, 6)


@pytest.mark.parametrize("kernel", ["exponential", "gaussian"])
@pytest.mark.parametrize("count", [3, 6])
@pytest.mark.parametrize("bound", [0.05, 0.4, 1.2, 2.5, 5.0])  # above 1 or so no series serves all states
def test_a_radius_that_moves_gives_what_the_constant_one_of_its_size_gives(
    kernel: str, count: int, bound: float
) -> None:
    moving = st.StateRadius(bound, 0.05)
    x = uniform(6, 2, low=-2.0, high=2.0)
    together = basis_of(kernel, count, moving)
    space = together.local(x)
    found = space.fit(together.values(x, Paper()))
    for row, at in enumerate(x):
        alone = basis_of(kernel, count, float(moving(at)))
        expected = alone.local(at).fit(alone.values(at, Paper()))
        assert found[row].isfinite().all()
        share = 1e-7 if bound < 5.0 else 1e-5  # of a Gram matrix that is all but singular there
        torch.testing.assert_close(
            found[row], expected, rtol=0, atol=share * max(1.0, float(expected.abs().max()))
        )


def test_weights_whose_factor_underflows_are_lost_unless_they_are_zero() -> None:
    kernel = st.ExponentialKernel()
    x = torch.tensor([[30.0, 0.0], [1.0, 0.0]], dtype=torch.float64)  # e^-900 and e^-1
    some = torch.tensor([[2.0, 0.0], [2.0, 0.0]], dtype=torch.float64)
    found = from_scaled(kernel, x, some)
    assert bool(found[0].isnan().all())
    assert bool(torch.isfinite(found[1]).all())
    assert from_scaled(kernel, x, 0 * some).tolist() == [[0.0, 0.0], [0.0, 0.0]]


@pytest.mark.parametrize("kernel", [st.ExponentialKernel(), st.GaussianKernel(0.7), st.MaternKernel(1.5)])
def test_weights_of_a_newton_space_of_any_kernel_interpolate(kernel: st.Kernel) -> None:
    x, offsets = uniform(5, 2, seed=1), 0.6 * st.rings(6)
    space, centers = newton_space(kernel, x, offsets), x.unsqueeze(-2) + offsets
    values = Paper()(centers)
    weights = space.weights(space.fit(values))
    found = (kernel(centers, centers) * weights.unsqueeze(-2)).sum(-1)
    torch.testing.assert_close(found, values, rtol=1e-8, atol=1e-8)


def test_weights_of_the_paper_that_are_zero_stay_so_where_their_factor_underflows() -> None:
    scaled, units = tensor([[0.0, 2.0], [0.0, 2.0]]), tensor([[0.0], [0.5]])
    found = _paper_weights(scaled, units)
    assert found[:, 0].tolist() == [0.0, 0.0]
    assert bool(found[0, 1].isnan())
    assert float(found[1, 1]) == 1.0
