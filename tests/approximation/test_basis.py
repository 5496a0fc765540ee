"""The basis at a state: Gram matrix, ideal weights, excess."""

from __future__ import annotations

import math
import re
import warnings

import mpmath
import pytest
import torch
from helpers import basis_of, centers_of, tensor, uniform
from variants import KERNELS, RADII, TARGETS, by_turns, directions_of, over

import staf_torch as st
from staf_torch.approximation import conditioning
from staf_torch.centers import probe_points
from staf_torch.targets import Cosine, Paper


@pytest.mark.parametrize(("name", "batch"), by_turns(KERNELS, [(), (2, 3)]))
def test_basis_is_the_kernel_at_the_centers(name: str, batch: tuple[int, ...]) -> None:
    basis = basis_of(name)
    x, y = uniform(*batch, 2), uniform(*batch, 5, 2)
    assert basis(y, x).shape == (*batch, 5, 6)
    assert torch.equal(basis(y, x), basis.kernel(y, basis.centers(x)))
    assert torch.equal(basis.gram(x), basis(basis.centers(x), x))


class Tilted(st.Kernel):
    """The Gaussian kernel, which no class or attribute says: e^{y'c} / sqrt(e^{y'y} e^{c'c})."""

    def forward(self, x1: torch.Tensor, x2: torch.Tensor) -> torch.Tensor:
        return torch.exp(
            x1 @ x2.mT - x1.square().sum(-1)[..., None] / 2 - x2.square().sum(-1)[..., None, :] / 2
        )


OWN = {**{name: case.make for name, case in KERNELS.items()}, "tilted": Tilted}


MADE = {
    **{name: make for name, (make, _) in RADII.items()},
    "as_good_as_constant": lambda: st.StateRadius(0.3, 0.5, 2.0),
}


@pytest.mark.parametrize(
    ("name", "radius", "layout"),
    [
        (name, radius, ("rings6", "polygon1", "ball_of_one")[k % 3])
        for k, (name, radius) in enumerate(by_turns([*OWN] * 2, ["as_good_as_constant", *RADII]))
    ],
)
def test_a_basis_that_is_the_same_at_every_state_says_so_once(name: str, radius: str, layout: str) -> None:
    basis = st.StaFBasis(OWN[name](), st.StateFollowingCenters(directions_of(layout), MADE[radius]()))
    x = uniform(3, basis.dim, low=0.2, seed=1)
    alone = [basis.kernel(at[None], basis.centers(at)) for at in (*x, torch.zeros_like(x[0]))]
    constant = all(torch.allclose(one, alone[0], rtol=1e-9, atol=0) for one in alone)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        basis(x.unsqueeze(-2) + 0.1, x)  # elsewhere
        assert not said
        basis(x[:1], x[0])  # a state without a batch
        basis(x.unsqueeze(-2), x)
    assert len(said) == int(constant)
    if constant:
        assert re.search(
            r"change of basis\(x, x\) between states: [0-9.e-]+\): .* is a constant", str(said[0].message)
        )
        assert said[0].filename == __file__
        assert not st.StaFBasis(st.AnchoredKernel(OWN[name]()), basis.centers).check_own_value(
            x
        )  # as it says


@over(KERNELS)
def test_gram_structure_multiplies_to_the_gram_matrix_and_one_core_serves_all_states_where_it_can(
    name: str,
) -> None:
    x = uniform(3, 4, 2)
    for radius in (0.3, st.StateRadius(0.5, 0.1)):
        basis = basis_of(name, radius=radius)
        structure = basis.gram_structure(x)
        gain = torch.zeros(3, 4).double() if structure.log_gain is None else structure.log_gain
        gram = structure.scaled() * gain.exp()[..., None, None]
        torch.testing.assert_close(gram.expand(3, 4, 6, 6), basis.gram(x), rtol=1e-12, atol=1e-14)
        shared = radius == 0.3 and basis.kernel.state_free
        assert structure.core.shape == ((6, 6) if shared else (3, 4, 6, 6))


@pytest.mark.parametrize(("name", "target"), by_turns(KERNELS, list(TARGETS)))
def test_ideal_weights_interpolate_at_the_centers(name: str, target: str) -> None:
    basis, function = basis_of(name, radius=st.StateRadius(1.5, 0.3)), TARGETS[target][0]()
    x = uniform(5, 2, low=0.4, high=1.2)
    weights = basis.ideal_weights(x, function)
    assert weights.shape == (5, 6)
    at_centers = (basis.gram(x) @ weights.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(at_centers, basis.values(x, function), rtol=1e-10, atol=1e-10)


@over(KERNELS)
def test_ideal_weights_are_those_of_fifty_digits(name: str) -> None:
    basis = basis_of(name, count=3, radius=0.2)
    x = tensor([0.8, -0.5])
    with mpmath.workdps(50):
        gram, values = mpmath.matrix(basis.gram(x).tolist()), basis.values(x, Paper())
        exact = [float(w) for w in mpmath.lu_solve(gram, mpmath.matrix(values.tolist()))]
    found, kappa = basis.ideal_weights(x, Paper()), float(torch.linalg.cond(basis.gram(x)))
    error = (found - tensor(exact)).norm() / tensor(exact).norm()
    assert error < 20 * kappa * torch.finfo(torch.float64).eps


@over(KERNELS)
def test_ideal_weights_minimise_the_native_error(name: str) -> None:
    basis = basis_of(name, radius=0.7)
    x, step = uniform(2, low=0.3), uniform(6)
    ideal = basis.ideal_weights(x, Paper())
    lengths = tensor([0.5, 1.0, 2.0, 4.0])
    excess = basis.excess(ideal + lengths[:, None] * step, x.expand(4, 2), Paper())
    floor = 1e-12 * float(basis.gram(x).abs().max() * ideal.square().sum())
    assert (excess >= -floor).all()
    assert (excess.diff() > -floor).all()  # it grows away from the ideal weights,
    torch.testing.assert_close(excess, lengths**2 * excess[1], rtol=1e-6, atol=floor)  # as a square


@over(KERNELS)
def test_excess_is_the_difference_of_the_native_errors(name: str) -> None:
    basis = basis_of(name, radius=0.8)
    x, a = uniform(5, 2, low=0.4), uniform(5, 6)
    gram, values, ideal = basis.gram(x), basis.values(x, Paper()), basis.ideal_weights(x, Paper())

    def native(w: torch.Tensor) -> torch.Tensor:
        """F(w) - |V|^2."""
        return torch.einsum("bi,bij,bj->b", w, gram, w) - 2 * (values * w).sum(-1)

    expected = native(a) - native(ideal)
    torch.testing.assert_close(basis.excess(a, x, Paper()), expected, rtol=1e-7, atol=1e-7)


def test_shifted_radial_problem_has_the_same_weights() -> None:
    basis = basis_of("gaussian")
    shift = tensor([30.0, -20.0])
    near = basis.ideal_weights(tensor([0.2, 0.3]), Cosine([1.0, 2.0]))
    far = basis.ideal_weights(tensor([0.2, 0.3]) + shift, lambda y: Cosine([1.0, 2.0])(y - shift))
    torch.testing.assert_close(far, near, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("count", [3, 6])
def test_exponential_gram_condition_follows_the_flat_limit(count: int) -> None:
    constant, power = {3: (2.0, 2), 6: (28.8, 4)}[count]
    radius = 0.03
    core = basis_of("exponential", count, radius).gram_structure(torch.zeros(2).double()).core
    assert float(torch.linalg.cond(core)) == pytest.approx(constant / radius**power, rel=0.01)


@pytest.mark.parametrize(("count", "reference"), [(6, 2.4e-3), (10, 7.1e-5)])
def test_rings_gain_an_order_each(count: int, reference: float) -> None:
    """Sup error on the ball of radius 0.1 for the paper's V, of the size that MATH.md gives."""
    basis = basis_of("exponential", count, 0.1)
    angle = torch.arange(6).double() * math.pi / 3
    x = torch.stack((angle.cos(), angle.sin()), -1)
    y = x.unsqueeze(-2) + 0.1 * torch.cat([r * st.polygon(4) for r in (0.2, 0.5, 0.8, 1.0)])
    found = st.StaF(basis, (6,)).fit_(x, Paper())(y).detach()
    error = float((found - Paper()(y)).abs().max())
    assert reference / 5 < error < reference * 1.05


@pytest.mark.parametrize(("degree", "dim"), [(1, 2), (2, 2), (3, 2), (2, 3)])
def test_a_polynomial_kernel_takes_as_many_centers_as_its_space_has_dimensions(degree: int, dim: int) -> None:
    rank = math.comb(dim + degree, degree)
    kernel = st.PolynomialKernel(degree)
    full = st.StateFollowingCenters(st.ball(rank, dim), 0.5)
    basis = st.StaFBasis(kernel, full)
    x, y = uniform(dim), uniform(7, dim)

    def polynomial(at: torch.Tensor) -> torch.Tensor:
        return (at.sum(-1) - 0.3) ** degree

    exact = st.StaF(basis).fit_(x, polynomial)(y)
    torch.testing.assert_close(exact, polynomial(y), rtol=1e-8, atol=1e-9)
    message = f"`StaFBasis(centers=...)` has {rank + 1} centers, but the space of PolynomialKernel(degree"
    with pytest.raises(ValueError, match=re.escape(message)) as found:
        st.StaFBasis(kernel, st.StateFollowingCenters(st.ball(rank + 1, dim), 0.5))
    assert f"has {rank} dimensions: use at most {rank} centers" in str(found.value)


def test_anchoring_takes_one_dimension_from_a_polynomial_space() -> None:
    kernel = st.AnchoredKernel(st.PolynomialKernel(2))
    st.StaFBasis(kernel, st.StateFollowingCenters(st.ball(5, 2), 0.5))
    with pytest.raises(ValueError, match="use at most 5 centers"):
        st.StaFBasis(kernel, centers_of(6))


class _WrongShape(torch.nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: basis_of("gaussian").ideal_weights(uniform(2), _WrongShape()),
            "The target `_WrongShape` must map points of shape (..., n) to values of shape (...): "
            "(6, 2) must give (6,); got (6, 2).",
        ),
        (
            lambda: basis_of("gaussian").ideal_weights(uniform(2), lambda y: 1.0),
            "The target `<lambda>` must return a tensor; got 1.0.",
        ),
    ],
)
def test_a_bad_argument_is_named_with_its_value(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=re.escape(message)):
        make()


# Conditioning.


@pytest.mark.parametrize("name", ["gaussian", "matern32", "exponential"])
def test_condition_numbers_are_those_of_the_matrices(name: str) -> None:
    basis, x = basis_of(name, 6, 0.8), uniform(4, 2, low=0.3)
    found = conditioning.conditioning(basis, x)
    structure = basis.gram_structure(x)
    whole, core = torch.linalg.cond(structure.scaled()).expand(4), structure.core
    torch.testing.assert_close(found.condition, whole, rtol=1e-6, atol=0)
    torch.testing.assert_close(found.core_condition, torch.linalg.cond(core), rtol=1e-6, atol=0)
    assert conditioning.conditioning(basis, uniform(2, 3, 2, low=0.3)).condition.shape == (2, 3)
    assert bool((found.rank == 6).all())
    assert bool((found.effective_rank == 6).all())


def test_cardinal_functions_are_one_at_their_own_center_and_sum_up_samples() -> None:
    basis, x = basis_of("gaussian", 6, st.StateRadius(0.8, 0.1)), uniform(4, 2, low=0.3)
    at_centers = conditioning.cardinal_functions(basis, x, basis.centers.offsets(x))
    torch.testing.assert_close(at_centers, torch.eye(6).double().expand(4, 6, 6), rtol=0, atol=1e-9)
    z = basis.centers.radius(x)[:, None, None] * probe_points(500, 2)
    functions = conditioning.cardinal_functions(basis, x, z)
    constant = functions.abs().sum(-1).amax(-1)
    torch.testing.assert_close(conditioning.lebesgue_constant(basis, x), constant)
    fewer = conditioning.lebesgue_constant(basis, x, 5)
    assert bool((fewer <= constant + 1e-12).all())
    estimate = torch.einsum("bpm,bm->bp", functions, Paper()(basis.centers(x)))
    worst = (Paper()(x.unsqueeze(1) + z) - estimate).abs().amax(-1)
    torch.testing.assert_close(conditioning.sup_error(basis, x, Paper()), worst, rtol=1e-6, atol=1e-10)
    assert float(conditioning.lebesgue_constant(basis, x[0])) == pytest.approx(float(constant[0]))
