"""The local space: coefficients that stay finite, and the paper's weights derived from them."""

from __future__ import annotations

import pytest
import torch
from helpers import basis_of, tensor, uniform
from variants import KERNELS, RADII, by_turns, over

import staf_torch as st
from staf_torch.local_basis.elimination import degrees_of, eliminate, functionals_of, homogeneous
from staf_torch.targets import Paper

NEWTON = {name: KERNELS[name] for name in KERNELS if name not in ("exponential", "gaussian", "polynomial")}


@pytest.mark.parametrize(("name", "radius"), by_turns([*KERNELS] * 2, list(RADII)))
def test_weights_and_coefficients_are_two_names_of_one_function(name: str, radius: str) -> None:
    basis = basis_of(name, 3, RADII[radius][0]())
    space = basis.local(uniform(4, 2, low=0.3, high=1.2))
    beta = uniform(4, 3)
    torch.testing.assert_close(space.coefficients(space.weights(beta)), beta, rtol=1e-8, atol=1e-8)
    assert (space.rank == 3).all()


@over(NEWTON)
def test_squared_length_in_the_newton_basis_is_the_squared_native_norm(name: str) -> None:
    basis, x = basis_of(name, 6, 0.8), uniform(4, 2, low=0.4)
    space = basis.local(x)
    beta = space.factor.solve_lower(space.fit(basis.values(x, Paper())))
    gain = basis.kernel.log_gain(x)
    native = (basis.ideal_weights(x, Paper()) * basis.values(x, Paper())).sum(-1)  # w'K w = w'V
    scaled = beta.square().sum(-1) * (1.0 if gain is None else (-gain).exp())
    torch.testing.assert_close(scaled, native, rtol=1e-8, atol=1e-10)


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


@pytest.mark.parametrize(("kernel", "count"), [("exponential", 6), ("gaussian", 3), ("gaussian", 6)])
@pytest.mark.parametrize("bound", [0.4, 1.2, 5.0])  # above 1 or so no series serves all states
def test_a_radius_that_moves_gives_what_the_constant_one_of_its_size_gives(
    kernel: str, count: int, bound: float
) -> None:
    moving = st.StateRadius(bound, 0.05)
    x = uniform(6, 2, low=-2.0, high=2.0)
    together = basis_of(kernel, count, moving)
    space = together.local(x)
    found = space.fit(together.values(x, Paper()))
    for row, at in enumerate(x[:3]):
        alone = basis_of(kernel, count, float(moving(at)))
        expected = alone.local(at).fit(alone.values(at, Paper()))
        assert found[row].isfinite().all()
        share = 1e-7 if bound < 5.0 else 1e-5  # of a Gram matrix that is all but singular there
        torch.testing.assert_close(
            found[row], expected, rtol=0, atol=share * max(1.0, float(expected.abs().max()))
        )


@pytest.mark.parametrize(
    ("kernel", "lead"), by_turns(["exponential", "gaussian", "polynomial"], [(4097,), (2, 2, 2049)])
)
def test_a_large_batch_that_goes_in_blocks_is_what_its_rows_are(kernel: str, lead: tuple[int, ...]) -> None:
    basis, x = basis_of(kernel, 3, st.StateRadius(0.4, 0.1)), uniform(*lead, 2, low=0.3, seed=1)
    values = basis.values(x, Paper())
    found = basis.local(x).fit(values).reshape(-1, 3)
    for row in (0, 4095, 4096, len(found) - 1):
        alone = basis.local(x.reshape(-1, 2)[row]).fit(values.reshape(-1, 3)[row])
        torch.testing.assert_close(found[row], alone, rtol=1e-10, atol=1e-12)


# What fixes a basis.


def test_functionals_that_have_one_value_span_the_same_and_see_their_own_monomial_with_a_plus() -> None:
    for points in (st.rings(10), st.ball(7, 3), uniform(4, 1, low=-1.0, seed=14)):
        degrees = degrees_of(points)
        found = functionals_of(points / degrees.reach, degrees)
        assert found.degrees == degrees.each()
        q = found.functionals
        torch.testing.assert_close(q.mT @ q, torch.eye(len(points)).double(), rtol=0, atol=1e-12)
        whole = eliminate(points / degrees.reach)
        alphas = [row for block in degrees.monomials for row in block]
        for j, (degree, alpha) in enumerate(zip(found.degrees, alphas, strict=True)):
            for k in range(degree):
                assert float((q[:, j] @ homogeneous(points, k)).abs().max()) < 1e-11
            monomial = (points ** torch.tensor(alpha)).prod(-1)
            assert float(q[:, j] @ monomial) > 0
            assert float((q[:, j] @ homogeneous(points / degrees.reach, degree)).norm()) > 1e-6
        for k in set(found.degrees):
            ours, theirs = (
                each.functionals[:, [j for j, degree in enumerate(each.degrees) if degree == k]]
                for each in (found, whole)
            )
            torch.testing.assert_close(ours @ ours.mT, theirs @ theirs.mT, rtol=0, atol=1e-10)
