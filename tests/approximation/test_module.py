"""`StaF`, the module that users import."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

import pytest
import torch
from helpers import basis_of, centers_of, tensor, uniform
from variants import KERNELS, RADII, SMOOTH_KERNELS, by_turns, over

import staf_torch as st
from staf_torch.targets import Cosine, Paper

BATCHES = ((), (2, 3))
STEP = 1e-5
# A radius that stays and one that follows the state, with every kernel.
TWO_RADII_EACH = [(name, radius) for k, name in enumerate(KERNELS) for radius in [*RADII][k % 2 :: 2]]


def fitted(kernel: str, batch: tuple[int, ...] = (), radius: object = 0.5) -> st.StaF:
    x = uniform(*batch, 2, low=0.3, high=1.2, seed=5)
    return st.StaF(basis_of(kernel, radius=radius), batch).fit_(x, Paper())


def differences(function: Callable[[torch.Tensor], torch.Tensor], y: torch.Tensor) -> torch.Tensor:
    """Central differences in every coordinate: (..., n)."""
    steps = STEP * torch.eye(y.shape[-1], dtype=y.dtype)
    return torch.stack([(function(y + h) - function(y - h)) / (2 * STEP) for h in steps], dim=-1)


@pytest.mark.parametrize(("name", "batch"), by_turns(KERNELS, BATCHES))
def test_fit_interpolates_the_target_at_the_centers(name: str, batch: tuple[int, ...]) -> None:
    staf = fitted(name, batch)
    centers = staf.basis.centers(staf.state)
    torch.testing.assert_close(staf(centers), Paper()(centers), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("name", "radius"), TWO_RADII_EACH)
def test_estimate_is_the_weighted_sum_of_the_kernels(name: str, radius: str) -> None:
    staf = fitted(name, (4,), RADII[radius][0]())
    y = staf.state.unsqueeze(-2) + uniform(4, 5, 2, low=-0.2, high=0.2)
    weights = staf.weights
    assert weights.shape == (4, 6)
    terms = staf.basis(y, staf.state) * weights.unsqueeze(-2)
    scale = float(terms.detach().abs().sum(-1).max())
    torch.testing.assert_close(staf(y), terms.sum(-1), rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize(("name", "radius"), TWO_RADII_EACH)
def test_total_gradient_with_frozen_weights_moves_the_centers_with_the_point(name: str, radius: str) -> None:
    staf = fitted(name, radius=0.3 if radius == "number" else RADII[radius][0]())
    y = staf.state + uniform(3, 2, low=-0.1, high=0.1)
    weights = staf.weights.detach()

    def moving(at: torch.Tensor) -> torch.Tensor:
        x = staf.state + (at - y)  # the state of every point, as far from it as before
        return (staf.basis(at.unsqueeze(-2), x) * weights).sum(-1).squeeze(-1)

    scale = float((staf.basis(y, staf.state) * weights).abs().sum(-1).max())
    torch.testing.assert_close(
        staf.gradient(y, mode="total_frozen_weights"), differences(moving, y), rtol=1e-6, atol=1e-9 * scale
    )


@pytest.mark.parametrize("batch", BATCHES)
def test_frozen_total_gradient_of_the_exponential_kernel_is_the_partial_one_plus_y_times_the_estimate(
    batch: tuple[int, ...],
) -> None:
    staf = fitted("exponential", batch)
    x = staf.state.unsqueeze(-2)  # at the state itself: partial + x V^(x)
    expected = staf.gradient(x) + x * staf(x).unsqueeze(-1)
    torch.testing.assert_close(staf.gradient(x, mode="total_frozen_weights"), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("name", "batch"), by_turns(KERNELS, BATCHES))
def test_total_gradient_is_that_of_refitting_at_every_state(name: str, batch: tuple[int, ...]) -> None:
    staf = fitted(name, batch)
    shift = uniform(*batch, 3, 2, low=-0.1, high=0.1)
    y = staf.state.unsqueeze(-2) + shift

    def refitted(at: torch.Tensor) -> torch.Tensor:
        fresh = st.StaF(staf.basis, tuple(at.shape[:-1]))
        return fresh.fit_(at - shift, Paper())(at.unsqueeze(-2)).squeeze(-1)

    torch.testing.assert_close(
        staf.gradient(y, mode="total"), differences(refitted, y).detach(), rtol=1e-5, atol=1e-5
    )
    assert torch.equal(staf.gradient(y, "total"), staf.gradient(y, "total", target=Paper()))


@over(KERNELS)
def test_batch_entries_are_as_they_would_be_alone(name: str) -> None:
    staf = fitted(name, (4,))
    y = staf.state.unsqueeze(-2) + uniform(4, 3, 2, low=-0.2, high=0.2)
    alone = st.StaF(staf.basis).fit_(staf.state[3], Paper())
    torch.testing.assert_close(staf(y)[3], alone(y[3]), rtol=1e-9, atol=1e-10)
    for mode in ("partial", "total_frozen_weights", "total"):
        together = staf.gradient(y, mode)[3]
        torch.testing.assert_close(together, alone.gradient(y[3], mode), rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("norm", [30.0, 100.0, 1000.0])
def test_exponential_kernel_does_not_overflow_far_from_the_origin(norm: float) -> None:
    """The scaled form: V^(x + z) = e^{x'z} sum_i b_i e^{z'd_i}, b = K0^-1 [V(c_i) e^{-x'd_i}]."""
    radius = 0.1 / norm
    basis = st.StaFBasis(st.ExponentialKernel(), centers_of(3, radius))
    x = norm * tensor([0.6, 0.8])
    staf = st.StaF(basis).fit_(x, Cosine(0.5))
    d = radius * st.rings(3)
    z = radius * uniform(8, 2, low=-0.7, high=0.7)
    b = torch.linalg.solve((d @ d.mT).exp(), Cosine(0.5)(x + d) * (-(d @ x)).exp())
    expected = (z @ x).exp() * ((z @ d.mT).exp() @ b)
    found = staf(x + z)
    assert torch.isfinite(found).all()
    assert torch.isfinite(staf.gradient(x + z)).all()
    # x + z - x rounds z to eps |x|, and V^ has slopes of the size of b / radius there.
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(found, Cosine(0.5)(x + z), rtol=0, atol=1e-2)


def test_a_module_that_does_not_learn_or_is_asked_to_begins_at_zero() -> None:
    for given in ({"init": "zeros"}, {"learnable": False}):
        assert torch.equal(st.StaF(basis_of("gaussian"), **given)(uniform(5, 2)), torch.zeros(5).double())
    with pytest.raises(ValueError, match=r"`StaF\(init=...\)` must be one of 'random', 'zeros'; got 'ones'"):
        st.StaF(basis_of("gaussian"), init="ones")


@pytest.mark.parametrize(("name", "radius"), TWO_RADII_EACH)
def test_a_layer_begins_near_linear_functions_of_the_size_of_a_linear_layer(name: str, radius: str) -> None:
    staf = st.StaF(basis_of(name, 6, RADII[radius][0]()), (3,), 40)
    ball = staf.basis.centers(staf.state[0])
    slopes = staf.gradient(ball)  # (3, 6, 40, 2)
    assert 0.2 < float(slopes.detach().square().mean().sqrt()) < 0.8  # 1 / sqrt(6) for exact ones
    anchored = float(staf(torch.zeros(1, 2).double()).detach().abs().max()) < 1e-9
    assert anchored == name.startswith("anchored")
    assert float(staf(ball).detach().abs().max()) < 3


def test_a_mode_is_one_of_three_and_the_total_gradient_needs_a_target() -> None:
    staf = st.StaF(basis_of("gaussian"))
    for mode, message in (("frozen", "must be one of 'partial'"), ("total", "needs a target")):
        with pytest.raises(ValueError, match=message):
            staf.gradient(uniform(1, 2), mode)


def test_a_failed_fit_leaves_the_module_as_it_was() -> None:
    staf = fitted("gaussian")
    before = {key: value.clone() for key, value in staf.state_dict().items()}
    with pytest.raises(ValueError, match="as a tensor; got None"):
        staf.fit_(tensor([5.0, 5.0]), lambda y: None)
    for key, value in staf.state_dict().items():
        assert torch.equal(value, before[key]), key


# --- one point a batch entry --------------------------------------------------------------------------------


@pytest.mark.parametrize("outputs", [None, 3])
def test_rowwise_is_every_entry_at_its_own_point(outputs: int | None) -> None:
    basis = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.rings(6), radius=0.1))
    x = torch.rand(5, 2, dtype=torch.float64)
    staf = st.StaF(basis, (5,), outputs)
    with torch.no_grad():
        staf.coefficients.copy_(torch.randn_like(staf.coefficients))
        staf.state.copy_(x)
    values = staf.rowwise(x + 0.02)
    assert values.shape == (5,) if outputs is None else (5, 3)
    for row in range(5):
        torch.testing.assert_close(values[row], staf(x[:, None] + 0.02)[row, 0], rtol=1e-12, atol=1e-13)
    several = staf.rowwise(torch.stack((x, x + 0.02)))
    torch.testing.assert_close(several[1], values, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(("name", "assign"), by_turns(KERNELS, [True, False]))
def test_a_model_built_on_the_meta_device_is_filled_by_a_state_dict(name: str, assign: bool) -> None:
    def made() -> st.StaF:
        return st.StaF(basis_of(name), (4,))

    x = torch.rand(4, 2, dtype=torch.float64)
    known = made().fit_(x, Paper())
    with torch.device("meta"):
        empty = made()
    if not assign:
        empty.to_empty(device="cpu")
    empty.load_state_dict(known.state_dict(), assign=assign)
    assert torch.equal(empty.rowwise(x + 0.01), known.rowwise(x + 0.01))
    for key, value in empty.state_dict().items():  # nothing is left without numbers
        assert torch.equal(value, known.state_dict()[key]), key


def test_a_model_without_values_says_how_it_gets_them() -> None:
    centers = st.StateFollowingCenters(st.rings(6).to("meta"), radius=0.1)
    empty = st.StaF(st.StaFBasis(st.ExponentialKernel(), centers))
    empty.to_empty(device="cpu")
    with pytest.raises(ValueError, match=r"built on the meta device must be given its values first"):
        empty(torch.zeros(1, 2, dtype=torch.float64))


def test_what_is_reset_is_as_new() -> None:
    staf = fitted("gaussian", (3,))
    torch.manual_seed(1)
    staf.reset_parameters()
    torch.manual_seed(1)
    for name, held in st.StaF(staf.basis, (3,)).state_dict().items():
        assert torch.equal(staf.state_dict()[name], held), name


@pytest.mark.parametrize("batch", [(3,), (2, 3)])
def test_points_that_could_be_of_one_entry_each_or_of_all_are_refused(batch: tuple[int, ...]) -> None:
    staf = st.StaF(basis_of("gaussian"), batch).fit_(uniform(*batch, 2, seed=1), Paper())
    y = uniform(*batch, 2, seed=2)
    for call in (staf, staf.gradient):
        with pytest.raises(ValueError, match="must say which points are meant: one of each batch entry"):
            call(y)
    ones = [1] * len(batch)
    said = "y.unsqueeze(0)" if len(batch) == 1 else "y.reshape(1, 1, -1, 2)"
    with pytest.raises(ValueError, match=re.escape(said)):
        staf(y)
    all_of_them = staf(y.reshape(*ones, -1, 2))  # as it says
    assert all_of_them.shape == (*batch, math.prod(batch))
    torch.testing.assert_close(all_of_them[(0,) * len(batch)][0], staf(y.unsqueeze(-2))[(0,) * len(batch)][0])
    for points in (y.unsqueeze(-2), uniform(4, 2, seed=4), uniform(*batch, 4, 2, seed=3)):
        assert staf(points).shape[-1] == points.shape[-2]


# Second derivatives.


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


@pytest.mark.parametrize(
    ("name", "mode"), by_turns(SMOOTH_KERNELS, ["partial", "total_frozen_weights", "total"])
)
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
