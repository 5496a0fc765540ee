"""Smoothing a recorded stream, against conditioning all samples at once."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

import staf_torch as st
from staf_torch.online.kalman_filter import LocalFilter, StreamState
from staf_torch.online.local_functions import LocalFunctions

RADIUS, NOISE = 0.4, 0.2


def path(steps: int) -> Tensor:
    time = 0.25 * torch.arange(steps, dtype=torch.float64)
    return torch.stack((time.sin(), (1.4 * time).cos()), -1)


def dense(x: Tensor, y: Tensor, follow: float) -> tuple[Tensor, Tensor]:
    """Mean and variance of V at every x (T, 2) from all y (T,) that are numbers: one Gaussian of all weights.

    The weights around one anchor are N(0, I); around the next they are T u + w, w ~ N(0, I - T T').
    """
    functions = LocalFunctions.of(st.GaussianKernel(0.9), RADIUS * st.rings(3))
    anchor, moves, psi, rest = x[~torch.isnan(y)][0], [], [], []
    for point, value in zip(x, y, strict=True):
        move = torch.eye(3, dtype=torch.float64)
        if not torch.isnan(value) and float((point - anchor).norm()) > follow * RADIUS:
            move = functions.transfer(anchor[:, None], (point - anchor)[:, None])[0][..., 0]
            anchor = point
        at = functions.local(anchor[:, None], (point - anchor)[:, None])
        moves.append(move)
        psi.append(at.psi[:, 0])
        rest.append(1 - float(at.psi[:, 0].square().sum()))
    steps = len(x)
    weights = torch.zeros(steps, steps, 3, 3, dtype=torch.float64)  # covariance of u_j and u_k
    for k in range(steps):
        weights[k, k] = torch.eye(3)
        for j in range(k + 1, steps):
            weights[j, k] = moves[j] @ weights[j - 1, k]
            weights[k, j] = weights[j, k].mT
    design = torch.stack(psi)
    covariance = torch.einsum("ja,jkab,kb->jk", design, weights, design)
    seen = ~torch.isnan(y)
    noise = torch.diag(tensor(rest) + NOISE**2)[seen][:, seen]
    gain = torch.linalg.solve(covariance[seen][:, seen] + noise, covariance[seen]).mT
    variance = covariance.diagonal() - (gain * covariance[:, seen]).sum(1) + tensor(rest)
    return gain @ y[seen], variance


@pytest.mark.parametrize("missing", [[7], [0, 1, 2, 8, 9], [1, 2]])
@pytest.mark.parametrize("follow", [100.0, 1.0, 0.0])
def test_smoothing_is_conditioning_on_all_samples(follow: float, missing: list[int]) -> None:
    x, y = path(24), uniform(24, seed=3)
    y[missing] = torch.nan
    model = st.StaFRegressor(
        st.GaussianKernel(0.9), RADIUS, 3, noise=NOISE, forgetting=1.0, follow=follow, scaling=False
    )
    mean, std = model.smooth(x, y)
    expected, variance = dense(x, y, follow)
    torch.testing.assert_close(mean, expected, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(std.square(), variance, rtol=1e-6, atol=1e-8)


def test_smoothing_errs_less_than_filtering_and_leaves_the_regressor_alone() -> None:
    x = path(150)
    truth = (2 * x).sin().sum(-1)
    y = truth + 0.2 * torch.randn(150, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    model = st.StaFRegressor(radius=0.4, noise=0.2).fit(x[:20], y[:20])
    before = model.predict(x[20])
    mean, std = model.smooth(x, y)
    assert torch.equal(model.predict(x[20]), before)
    filtered = []
    again = st.StaFRegressor(radius=0.4, noise=0.2)
    for state, value in zip(x, y, strict=True):
        filtered.append(again.partial_fit(state, value).predict(state))
    late = slice(20, None)
    errors = [float((found - truth)[late].square().mean().sqrt()) for found in (mean, torch.stack(filtered))]
    assert errors[0] < 0.85 * errors[1]
    assert 0.7 < float(((mean - truth) / std)[late].square().mean().sqrt()) < 1.4


def test_coordinates_that_were_not_measured_are_held_and_before_the_first_time_as_then() -> None:
    x, y = path(40), uniform(40, seed=4)
    held, holed = x.clone(), x.clone()
    for k, column in ((0, 0), (1, 1), (20, 0), (21, 0), (30, 1)):
        holed[k, column] = torch.nan
        held[k, column] = x[1, 0] if k == 0 else held[k - 1, column]
    model = st.StaFRegressor(radius=0.4, noise=0.2)
    found, expected = (
        model.smooth(holed, y),
        model.smooth(held, torch.where(torch.arange(40) == 0, torch.nan, y)),
    )
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


def test_a_stream_that_started_afresh_says_nothing_about_what_was_before() -> None:
    x, y = path(60), uniform(60, seed=5)
    gone = torch.where(torch.arange(60) < 30, y, 1e12 * y)
    model = st.StaFRegressor(radius=0.4, noise=0.2)
    whole, part = model.smooth(x, gone), model.smooth(x[:30], y[:30])
    for one, other in zip(whole, part, strict=True):
        torch.testing.assert_close(one[:30], other, rtol=1e-9, atol=1e-9)


def test_streams_outputs_units_and_times_are_smoothed_as_alone() -> None:
    x = torch.stack((path(40), 3 + 2 * path(40).flip(0)), 1)
    y = torch.stack(((2 * x).sin().sum(-1), 50 + 7 * x[..., 0]), -1)
    model = st.StaFRegressor(radius=0.5, noise=0.1, scaling=True)
    time = torch.arange(40, dtype=torch.float64).square()
    mean, std = model.smooth(x.numpy(), y.numpy(), time)
    assert mean.shape == std.shape == (40, 2, 2)
    for i in range(2):
        alone, _ = model.smooth(x[:, i], y[:, i], time)
        torch.testing.assert_close(torch.from_numpy(mean[:, i]), alone, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match=r"memory.*must be None to smooth"):
        st.StaFRegressor(memory=128).smooth(x, y)


def joint(law: LocalFilter, x: Tensor, y: Tensor, lapse: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance of V at every x (T, n) from all y (T,): the weights of all times as one Gaussian.

    From one time to the next u' = A u + w, where A moves the centers, and the covariance of w is what is then
    left of the filter's own I - lambda^lapse T D T'.
    """
    count, eye = len(law.functions.offsets), torch.eye(len(law.functions.offsets), dtype=torch.float64)
    state = StreamState.empty(torch.zeros(0).double(), 1, x.shape[1], count, 1)
    moves, rows, rest = [], [], []
    last = eye  # covariance of the weights a time before, from what was seen until then
    joined = torch.zeros(0, 0, dtype=torch.float64)
    for k in range(len(x)):
        old, known = state.anchor.clone(), state.learned[..., 0].clone()
        law.learn(state, x[k : k + 1], y[k : k + 1, None], lapse[k : k + 1])
        transfer, scaled = eye, eye
        if not bool(old.isnan().any()) and not torch.equal(old, state.anchor):
            move, factor = law.functions.transfer(old, state.anchor - old)
            transfer = move[..., 0]
            scaled = transfer if factor is None else transfer * factor
        predicted = eye - law.forgetting ** lapse[k] * transfer @ known @ transfer.mT
        z = x[k, :, None] - state.anchor
        local = law.functions.local(state.anchor, z)
        by = torch.ones(1).double() if local.log_factor is None else local.log_factor.exp()
        psi = local.psi[:, 0]
        left = law.functions.prior(state.anchor, z) - psi.square().sum()
        moves.append((scaled, predicted - scaled @ last @ scaled.mT))
        rows.append(by * psi)
        rest.append(by.square() * left)
        last = eye - state.learned[..., 0]
    for k, (scaled, noise) in enumerate(moves):
        cross = scaled @ joined[-count:] if k else joined.new_zeros(count, 0)
        own = cross[:, -count:] @ scaled.mT + noise if k else eye
        joined = torch.cat((torch.cat((joined, cross.mT), 1), torch.cat((cross, own), 1)))
    design = torch.block_diag(*rows)
    covariance = design @ joined @ design.mT
    seen = ~y.isnan()
    others = torch.diag(torch.cat(rest) + law.ratio)[seen][:, seen]
    gain = torch.linalg.solve(covariance[seen][:, seen] + others, covariance[seen]).mT
    variance = covariance.diagonal() - (gain * covariance[:, seen]).sum(1) + torch.cat(rest)
    return gain @ y[seen], variance


@pytest.mark.parametrize("dim", [1, 2])
@pytest.mark.parametrize("kernel", [st.ExponentialKernel(), st.MaternKernel(2.5, 0.9)])
def test_smoothing_is_conditioning_with_any_kernel_forgetting_times_and_amplitude(
    kernel: st.Kernel, dim: int
) -> None:
    x, y = 0.5 * path(9)[:, :dim].contiguous(), uniform(9, seed=3)
    y[[3, 6]] = torch.nan
    time = tensor([0.0, 0.5, 1.0, 3.0, 3.5, 4.0, 6.0, 7.0, 7.25])
    model = st.StaFRegressor(kernel, RADIUS, 3, noise=0.6, amplitude=2.0, forgetting=0.7, follow=0.5)
    found = model.smooth(x, y, time)
    lapse = torch.cat((tensor([1.0]), time.diff()))
    offsets = RADIUS * (st.rings(3) if dim == 2 else st.ball(3, 1))
    functions = LocalFunctions.of(kernel, offsets)
    law = LocalFilter(functions, tensor([0.09]), tensor([0.7]), 0.5 * RADIUS, base=4.0)
    mean, variance = joint(law, x, y, lapse)
    torch.testing.assert_close(found[0], mean, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(found[1].square(), 4.0 * variance, rtol=1e-5, atol=1e-7)
