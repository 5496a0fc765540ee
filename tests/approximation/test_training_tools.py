"""What people wrap around a layer: AdamW, autocast, half types, averages, checkpoints, gradients a sample."""

from __future__ import annotations

import io

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call, grad, vmap
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.checkpoint import checkpoint

from staf_torch import GaussianKernel, StaF, StaFBasis, StateFollowingCenters, rings


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


def test_adamw_learns_a_layer_in_place(points: Tensor) -> None:
    head = Head()
    optimizer = torch.optim.AdamW(head.parameters(), lr=0.05)
    losses = []
    for _ in range(60):
        loss = (head(points) - wanted(points)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.05 * losses[0]


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


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_a_layer_in_a_half_type_is_the_layer(dtype: torch.dtype, points: Tensor) -> None:
    head = Head()
    with torch.no_grad():
        head.rest.coefficients.normal_()
    exact = head(points).detach()
    found = head.to(dtype)(points.to(dtype))
    assert found.dtype == dtype
    assert (found.float() - exact).abs().max() < 0.05 * exact.abs().max()


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


def test_gradients_of_single_samples_sum_to_that_of_the_batch(points: Tensor) -> None:
    head = Head()
    parameters = {name: p.detach() for name, p in head.named_parameters()}
    buffers = dict(head.named_buffers())

    def loss(chosen: dict[str, Tensor], y: Tensor) -> Tensor:
        return functional_call(head, (chosen, buffers), (y[None],)).square().sum()

    singles = vmap(grad(loss), in_dims=(None, 0))(parameters, points)
    head(points).square().sum().backward()
    for name, parameter in head.named_parameters():
        assert singles[name].shape == (32, *parameter.shape)
        torch.testing.assert_close(singles[name].sum(0), parameter.grad)


def test_saved_weights_load_with_weights_only(points: Tensor) -> None:
    head, file = Head(), io.BytesIO()
    with torch.no_grad():
        head.rest.coefficients.normal_()
    torch.save(head.state_dict(), file)
    file.seek(0)
    again = Head()
    again.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(again(points), head(points))
