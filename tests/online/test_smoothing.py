"""Smoothing a recorded stream, against conditioning all samples at once."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor
from variants import by_turns

import staf_torch as st
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
        values = functions.local(anchor[:, None], (point - anchor)[:, None])[0][:, 0]
        moves.append(move)
        psi.append(values)
        rest.append(1 - float(values.square().sum()))
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


@pytest.mark.parametrize(("follow", "missing"), by_turns([100.0, 1.0, 0.0], [[7], [0, 1, 2, 8, 9], [1, 2]]))
def test_smoothing_is_conditioning_on_all_samples(follow: float, missing: list[int]) -> None:
    x, y = path(16), uniform(16, seed=3)
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
