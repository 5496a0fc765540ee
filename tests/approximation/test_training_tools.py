"""What people wrap around a layer: autocast, averages, checkpoints, gradients a sample."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable

import pytest
import torch
from helpers import basis_of
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.checkpoint import checkpoint
from variants import KERNELS, LEARNABLE_KERNELS, by_turns, learned, over

from staf_torch import (
    GaussianKernel,
    PolynomialKernel,
    RationalQuadraticKernel,
    StaF,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    chase,
    optim,
    rings,
    targets,
)
from staf_torch.centers import Radius


class Head(nn.Module):
    """A layer of one's own around a StaF layer."""

    def __init__(self, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        self.trend = nn.Linear(2, 1, dtype=dtype)
        basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(6), radius=0.5))
        self.rest = StaF(basis, dtype=dtype)

    def forward(self, y: Tensor) -> Tensor:  # (P, 2) -> (P,)
        return self.trend(y).squeeze(-1) + self.rest(y)


@pytest.fixture
def points() -> Tensor:
    return torch.rand(32, 2) - 0.5


def wanted(y: Tensor) -> Tensor:
    return y[:, 0].sin() + y[:, 0] * y[:, 1]


def test_autocast_trains_and_its_values_are_close(points: Tensor) -> None:
    head = Head()
    with torch.no_grad():
        head.rest.coefficients.normal_()
    exact = head(points).detach()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = head(points)
        loss = (mixed.float() - wanted(points)).square().mean()
    loss.backward()
    assert (mixed.float() - exact).abs().max() < 0.05 * exact.abs().max()
    assert all(bool(p.grad.isfinite().all()) for p in head.parameters() if p.grad is not None)
    assert bool((head.rest.coefficients.grad != 0).any())


def test_an_averaged_model_is_between_what_it_averages(points: Tensor) -> None:
    head = Head()
    average = AveragedModel(head, multi_avg_fn=get_ema_multi_avg_fn(0.5))
    average.update_parameters(head)
    with torch.no_grad():
        first = average(points)
        for parameter in head.parameters():
            parameter.add_(1.0)
        average.update_parameters(head)
        torch.testing.assert_close(average(points), 0.5 * (first + head(points)))


def test_a_checkpointed_layer_has_the_same_gradient(points: Tensor) -> None:
    head = Head()
    head(points).square().sum().backward()
    plain = [parameter.grad.clone() for parameter in head.parameters()]
    head.zero_grad()
    checkpoint(head, points, use_reentrant=False).square().sum().backward()
    for one, other in zip(plain, head.parameters(), strict=True):
        torch.testing.assert_close(other.grad, one)


# Between the layers of somebody's network.


def around(kernel: str, outputs: int | None = None) -> StaF:
    return StaF(basis_of(kernel, radius=0.5), (), outputs)


@over(KERNELS)
def test_everything_learns_from_the_first_step_behind_and_before_a_layer(name: str, points: Tensor) -> None:
    net = nn.Sequential(nn.Linear(2, 2), around(name, 8), nn.ReLU(), nn.Linear(8, 1))  # without .float()
    adam, losses = torch.optim.Adam(net.parameters(), lr=0.02), []
    for step in range(60 if name == "gaussian" else 1):
        loss = (net(points).squeeze(-1) - wanted(points)).square().mean()
        adam.zero_grad()
        loss.backward()
        if step == 0:
            assert all(bool(p.grad.abs().max() > 1e-4) for p in net.parameters())
        adam.step()
        losses.append(float(loss.detach()))
    assert len(losses) == 1 or losses[-1] < 0.05 * losses[0]
    alone = around(name)
    alone(points).relu().sum().backward()
    assert bool(alone.coefficients.grad.any())


DTYPES = [
    (torch.float64, torch.float32),
    (torch.float64, torch.float16),
    (torch.float32, torch.float64),
    (torch.bfloat16, torch.bfloat16),
    (torch.float16, torch.float32),
]


@pytest.mark.parametrize(("name", "dtypes"), by_turns(KERNELS, DTYPES))
def test_values_are_of_the_dtype_of_the_points(
    name: str, dtypes: tuple[torch.dtype, torch.dtype], points: Tensor
) -> None:
    held_in, points_in = dtypes
    staf = around(name, 2)
    y = (0.5 * points).to(points_in)
    exact = staf(y.double()).detach()
    staf.to(held_in)
    least = max(torch.finfo(held_in).eps, torch.finfo(points_in).eps)
    (values, slopes), one = staf.value_and_gradient(y), staf.rowwise(y)
    assert values.dtype == slopes.dtype == one.dtype == staf(y[:0]).dtype == points_in
    torch.testing.assert_close(staf(y).double(), exact, rtol=0, atol=100 * least)
    assert staf.gradient(y, "total_frozen_weights").dtype == staf.hessian(y).dtype == points_in


def test_a_network_of_another_precision_as_target_is_refused_in_a_sentence(points: Tensor) -> None:
    net = nn.Linear(2, 1)
    with pytest.raises(ValueError, match=r"must map points .* A network in float32 needs `.double\(\)`"):
        around("gaussian").fit_(torch.zeros(2, dtype=torch.float64), lambda y: net(y).squeeze(-1))
    with pytest.raises(ValueError, match=r"must be of float32 or float64.*got torch.bfloat16"):
        around("gaussian").basis.ideal_weights(points.bfloat16(), targets.Paper())


HELD: dict[str, Callable[[nn.Parameter], StaFBasis]] = {
    **{
        name: lambda p, make=make: StaFBasis(make(p), StateFollowingCenters(rings(3), 0.3))
        for name, make in (
            ("GaussianKernel(width", GaussianKernel),
            ("MaternKernel(length_scale", lambda p: type(LEARNABLE_KERNELS["matern52"]())(2.5, p)),
            ("RationalQuadraticKernel(alpha", lambda p: RationalQuadraticKernel(p)),
            ("RationalQuadraticKernel(length_scale", lambda p: RationalQuadraticKernel(1.0, p)),
            ("PolynomialKernel(bias", lambda p: PolynomialKernel(2, p)),
        )
    },
    **{
        name: lambda p, make=make: StaFBasis(
            KERNELS["anchored_gaussian"].make(), StateFollowingCenters(rings(3), make(p))
        )
        for name, make in (
            ("ConstantRadius(radius", lambda p: p),
            ("StateRadius(radius", lambda p: StateRadius(p, 0.1)),
            ("StateRadius(offset", lambda p: StateRadius(0.5, p)),
            ("StateRadius(gain", lambda p: StateRadius(0.5, 0.1, p)),
        )
    },
}


@over(HELD)
def test_what_learning_takes_out_of_its_rule_is_refused_by_name(name: str) -> None:
    given = learned(0.8)
    dtype = torch.float32 if name.startswith(("G", "S")) else torch.float64
    staf, y, states = (
        StaF(HELD[name](given)).to(dtype),
        torch.rand(4, 2, dtype=dtype),
        torch.rand(1, 3, 2).to(dtype),
    )
    said = re.escape(f"`{name}=...)` must ")
    for wrong in (-1.2, float("nan"), float("inf")):
        given.data.fill_(wrong)  # past the version that torch counts
        for call in (
            lambda: staf(y),
            lambda: staf.value_and_gradient(y),
            lambda: staf.basis(y, y[0]),
            lambda: staf.basis.gram_structure(y),
            lambda: copy.deepcopy(staf).requires_grad_(False)(y),
            lambda: chase(states, staf.basis, targets.Paper(), optim.Exact()),
        ):
            with torch.no_grad(), pytest.raises(ValueError, match=rf"{said}.*got {wrong}"):
                call()
    given.data.fill_(0.5)
    assert bool(staf(y).isfinite().all())
    key = next(key for key, p in staf.named_parameters() if p is given)
    assert key.endswith(name.split("(")[1])
    each = vmap(lambda p: functional_call(staf, {key: p}, (y,)))
    assert each(torch.tensor([0.4, 0.5], dtype=dtype)).shape == (2, 4)
    with pytest.raises(ValueError, match=r"got -0.2"):
        each(torch.tensor([0.4, -0.2], dtype=dtype))


def test_a_learned_width_whose_square_is_nothing_is_refused(points: Tensor) -> None:
    given = nn.Parameter(torch.tensor(1e-30))  # 1e-60 is 0 in float32
    with pytest.raises(
        ValueError, match=r"`GaussianKernel\(width=...\)` must stay positive .*above 1.08e-19.* got 1e-30"
    ):
        StaF(HELD["GaussianKernel(width"](given), init="zeros")(points)


class Learned(Radius):
    """A radius of one's own: what a layer makes of the state."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(2, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.layer(x.float()).squeeze(-1).to(x)


def test_a_radius_of_ones_own_that_turns_negative_is_refused(points: Tensor) -> None:
    radius = Learned()
    nn.init.constant_(radius.layer.bias, 2.0)
    basis = copy.deepcopy(StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius)))
    nn.init.constant_(basis.centers.radius.layer.bias, -2.0)
    states = points[None, :3].double()
    for call in (
        lambda: basis(points[None], points[0]),
        lambda: StaF(basis, init="zeros")(points),
        lambda: basis.local(points),
        lambda: chase(states, basis, targets.Paper(), optim.Exact()),
    ):
        with (
            torch.no_grad(),
            pytest.raises(ValueError, match=r"`Learned` must return radii that are not .*; got -"),
        ):
            call()
