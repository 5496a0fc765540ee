"""`StaF` and `StaFBasis` as torch layers: shapes, parameters, gradients, function transforms."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import basis_of, tensor, uniform
from helpers_layers import MODES, RADII, as_function, evaluated, fixed, learnable, target_of
from variants import KERNELS as FIXED
from variants import LEARNABLE_KERNELS, SMOOTH_KERNELS, over
from variants import RADII as FIXED_RADII

import staf_torch as st
from staf_torch.targets import Paper

BATCHES = ((), (4,), (2, 3))


@over(FIXED)
def test_every_output_is_what_it_would_be_alone(name: str) -> None:
    batch = BATCHES[list(FIXED).index(name) % 3]
    together = fixed(name, batch, 2)
    y = together.state.unsqueeze(-2) + uniform(*batch, 4, 2, low=-0.2, high=0.2)
    assert together.coefficients.shape == (*batch, 2, 6)
    for k in range(2):
        target = lambda at, k=k: target_of(2)(at)[..., k]  # noqa: E731
        alone = st.StaF(together.basis, batch).fit_(together.state, target)
        torch.testing.assert_close(together.weights[..., k, :], alone.weights)
        torch.testing.assert_close(together(y)[..., k], alone(y))
        for mode in MODES[1:]:
            torch.testing.assert_close(together.gradient(y, mode)[..., k, :], alone.gradient(y, mode))
        if name in SMOOTH_KERNELS:
            torch.testing.assert_close(together.hessian(y)[..., k, :, :], alone.hessian(y))


@over(FIXED)
@pytest.mark.parametrize("outputs", [None, 2])
def test_points_and_approximations_broadcast(name: str, outputs: int | None) -> None:
    trailing = () if outputs is None else (outputs,)
    one, many = fixed(name, (), outputs), fixed(name, (4,), outputs)
    y = one.state + uniform(5, 3, 2, 2, low=-0.2, high=0.2)
    assert one(y).shape == (5, 3, 2, *trailing)
    torch.testing.assert_close(one(y)[3, 1], one(y[3, 1]))
    same = y[0, 0]
    for mode in MODES:
        found = evaluated(many, same, mode, target_of(outputs))
        torch.testing.assert_close(found, evaluated(many, same.expand(4, 2, 2), mode, target_of(outputs)))
        assert found.shape[0] == 4


@over(FIXED)
@over(FIXED_RADII, "radius")
def test_value_and_gradient_are_those_of_autograd(name: str, radius: str) -> None:
    x = uniform(3, 2, low=0.3)
    staf = st.StaF(basis_of(name, radius=FIXED_RADII[radius][0]()), (3,)).fit_(x, Paper())
    y = (x.unsqueeze(-2) + uniform(3, 4, 2, low=-3.0, high=3.0)).requires_grad_()  # also far outside the ball
    values, gradient = staf.value_and_gradient(y)
    torch.testing.assert_close(values, staf(y), rtol=1e-13, atol=0)
    (expected,) = torch.autograd.grad(staf(y).sum(), y)
    scale = float(expected.abs().max())
    torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-12 * scale)


ROW_BY_ROW = {
    "gaussian": st.GaussianKernel,
    "matern32": lambda v: st.MaternKernel(1.5, v),
    "rational_quadratic": lambda v: st.RationalQuadraticKernel(v, 2 * v),
    "inverse_multiquadric": st.InverseMultiquadricKernel,
    "anchored": lambda v: st.AnchoredKernel(st.GaussianKernel(v)),
}


@over(ROW_BY_ROW)
def test_a_hyperparameter_a_row_is_what_it_would_be_alone(name: str) -> None:
    widths, radii = tensor([[0.6], [0.8], [1.1]]), tensor([[0.2], [0.3], [0.4]])
    x, y = uniform(3, 4, 2, low=0.3), uniform(3, 4, 2, 2)

    def made(width: torch.Tensor, radius: torch.Tensor, batch: tuple[int, ...]) -> st.StaF:
        centers = st.StateFollowingCenters(st.rings(6), radius)
        return st.StaF(st.StaFBasis(ROW_BY_ROW[name](width), centers), batch)

    together = made(widths, radii, (3, 4)).fit_(x, Paper()).value_and_gradient(y)
    for row in range(3):
        alone = made(widths[row, 0], radii[row, 0], (4,)).fit_(x[row], Paper()).value_and_gradient(y[row])
        for found, expected in zip(together, alone, strict=True):
            torch.testing.assert_close(found[row], expected, rtol=1e-8, atol=1e-8)


@over(LEARNABLE_KERNELS)
@over(RADII, "radius")
def test_gradients_reach_everything_that_is_learned_in_every_mode(name: str, radius: str) -> None:
    outputs = 2 if name in ("exponential", "user_defined") else None
    staf, y = learnable(name, radius, outputs=outputs)
    own = MODES if name == "exponential" else MODES[1::2]
    for mode in own if radius == "shrinking" else MODES[::2]:
        function, at = as_function(staf, mode, target_of(outputs))
        inputs = (y[:1].requires_grad_(), *at)
        assert torch.autograd.gradcheck(function, inputs, atol=1e-5, rtol=1e-4, fast_mode=True), mode


@pytest.mark.parametrize("name", ["exponential", "gaussian", "matern52", "polynomial"])
def test_second_derivatives_are_right(name: str) -> None:
    staf, y = learnable(name, "shrinking")
    function, at = as_function(staf, "value", Paper())
    assert torch.autograd.gradgradcheck(
        function, (y.requires_grad_(), *at), atol=1e-4, rtol=1e-3, fast_mode=True
    )


def test_the_basis_turns_smoothly_with_its_directions() -> None:
    for count in (6, 10, 15):
        staf, y = learnable("gaussian", "constant", count=count)
        before = staf(y).detach()
        with torch.no_grad():
            staf.basis.centers.directions += 1e-9 * uniform(count, 2)
        torch.testing.assert_close(staf(y).detach(), before, rtol=1e-6, atol=1e-6)


def test_trained_hyperparameters_travel_with_the_state_dict() -> None:
    staf, y = learnable("gaussian", "shrinking", (2,))
    optimizer = torch.optim.Adam(staf.parameters(), lr=0.02)
    start = float((staf(y) - 1).square().mean().detach())
    for _ in range(20):
        optimizer.zero_grad()
        loss = (staf(y) - 1).square().mean()
        loss.backward()
        optimizer.step()
    assert float(loss.detach()) < 0.5 * start
    fresh = learnable("gaussian", "shrinking", (2,))[0]
    fresh.load_state_dict(staf.state_dict())
    assert torch.equal(fresh(y), staf(y))
    assert float(fresh.basis.kernel.width.detach()) != 0.8


def test_directions_swapped_in_are_used() -> None:
    staf = fixed("exponential")
    other = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.ball(6, 2), 0.5))
    y = staf.state + uniform(3, 2, low=-0.1, high=0.1)
    swapped = {"basis.centers.directions": st.ball(6, 2)}
    found = torch.func.functional_call(staf, swapped, (y,))
    expected = other.local(staf.state).evaluate(y - staf.state, staf.coefficients)
    # The units of length differ: 1 to rounding for both layouts.
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # torch's own, in jacfwd
@over(FIXED)
def test_function_transforms_agree_with_the_batch(name: str) -> None:
    staf = fixed(name)
    y = staf.state + uniform(5, 2, low=-0.2, high=0.2)
    alone = lambda at: staf(at.unsqueeze(0)).squeeze(0)  # noqa: E731
    torch.testing.assert_close(torch.func.vmap(alone)(y), staf(y))
    torch.testing.assert_close(torch.func.vmap(torch.func.jacrev(alone))(y), staf.gradient(y))
    if name in SMOOTH_KERNELS:
        hessian = torch.func.vmap(torch.func.hessian(alone))(y)
        torch.testing.assert_close(hessian, staf.hessian(y), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("name", ["gaussian", "matern52", "polynomial"])
def test_an_ensemble_is_called_by_vmap(name: str) -> None:
    members = [learnable(name, "constant")[0] for _ in range(3)]
    for k, member in enumerate(members):
        with torch.no_grad():
            member.basis.centers.directions *= 1 - 0.1 * k
        member.fit_(tensor([0.4 + 0.1 * k, 0.3]), Paper())
    y = uniform(4, 2)
    parameters, buffers = torch.func.stack_module_state(members)

    def call(p: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> torch.Tensor:
        return torch.func.functional_call(members[0], (p, b), (y,))

    together = torch.func.vmap(call)(parameters, buffers)
    torch.testing.assert_close(together, torch.stack([member(y) for member in members]))


def test_the_largest_reach_is_nothing_for_a_kernel_that_does_not_mind() -> None:
    x = tensor([[300.0, 0.0], [math.nan, 0.0], [3.0, 4.0]])
    assert basis_of("gaussian").largest_reach(x) == 0
    assert basis_of("exponential", radius=0.5).largest_reach(x) == pytest.approx(150)
    assert basis_of("exponential", radius=0.5).largest_reach(x[1:2]) == 0
