"""A forecast is what `predict` says before each sample, and its gradients are right by all that it reads."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor, nn
from variants import learned

import staf_torch as st
from staf_torch import rows

TIMES, STREAMS = 14, 3


def record() -> tuple[Tensor, Tensor, Tensor]:
    """Streams on which a coordinate, a target are missing, one jumps and one has a value that is none."""
    time = 0.5 * torch.arange(TIMES).double()[:, None] + torch.arange(STREAMS).double()
    x = time.sin().unsqueeze(-1)
    y = (2 * x).sin().sum(-1) + 0.1 * uniform(TIMES, STREAMS)
    x[3, 1, 0], y[5, 2], y[6, 1], x[9:, 2] = math.nan, math.nan, math.inf, x[9:, 2] + 3.0
    return x, y, torch.cumsum(0.5 + uniform(TIMES).abs(), 0)


def replayed(model: st.StaFRegressor, x: Tensor, y: Tensor) -> list[Tensor]:
    found = []
    for k in range(len(x)):
        if k:
            found.append(torch.stack(model.predict(x[k], return_std=True)))
        model.partial_fit(x[k], y[k])
    return [*torch.stack(found).unbind(1)]


@pytest.mark.needs_compiler
def test_a_forecast_is_what_predict_says_before_each_sample() -> None:
    x, y, time = record()
    numbers = {"radius": 0.4, "noise": 0.1, "forgetting": 0.98, "robust": 2.0}
    model = st.StaFRegressor(st.GaussianKernel(0.8), count=2, **numbers)
    found, (mean, deviation) = model.forecast(x, y), replayed(model, x, y)
    torch.testing.assert_close(found.mean[1:], mean)
    torch.testing.assert_close(found.deviation[1:], deviation)
    normal = torch.distributions.Normal(found.mean, found.deviation)
    seen = y.isfinite()
    torch.testing.assert_close(found.log_density[seen], normal.log_prob(y.nan_to_num())[seen])
    assert not found.log_density[~seen].any()
    late = model.forecast(x, y, time).deviation
    assert bool((late[2:] != found.deviation[2:]).any())
    assert isinstance(model.forecast(x.numpy(), y.numpy()).mean, type(x.numpy()))
    tuned = st.StaFRegressor(count=2).tune(x[:9], y[:9])
    torch.testing.assert_close(tuned.forecast(x[:9], y[:9]).mean[1:], replayed(tuned, x[:9], y[:9])[0])


def gaussian(stated: Tensor) -> st.Kernel:
    return st.GaussianKernel(stated)


def anchored(stated: Tensor) -> st.Kernel:
    return st.AnchoredKernel(st.GaussianKernel(stated))


@pytest.mark.needs_compiler
@pytest.mark.parametrize(("kernel", "own"), [(gaussian, True), (anchored, False)])
def test_gradients_of_a_likelihood_are_those_of_differences(
    kernel: Callable[[Tensor], st.Kernel], own: bool
) -> None:
    x, y, _ = record()
    stated = {"width": 0.8, "radius": 0.4, "noise": 0.1, "amplitude": 1.2, "forgetting": 0.97}
    by = {name: learned([value] * STREAMS if own else value) for name, value in stated.items()}

    def likelihood() -> Tensor:
        numbers = {name: rows(part) if own else part for name, part in by.items()}
        model = st.StaFRegressor(kernel(numbers.pop("width")), count=2, robust=2.5, **numbers)
        return model.forecast(x, y).log_density[3:].sum()

    found, ends = torch.autograd.grad(likelihood(), list(by.values())), list[Tensor]()
    along = [uniform(part.numel()).view(part.shape) for part in by.values()]
    slope = sum((one * way).sum() for one, way in zip(found, along, strict=True))
    assert all(bool(one.all()) for one in found)
    for size in (1e-6, -2e-6):
        with torch.no_grad():
            for part, way in zip(by.values(), along, strict=True):
                part.add_(size * way)
            ends.append(likelihood())
    torch.testing.assert_close(slope, (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-5)


@pytest.mark.needs_compiler
def test_samples_have_gradients_and_those_that_are_missing_have_none_and_spoil_none() -> None:
    x, y, time = record()
    at, of = (part.clone().requires_grad_() for part in (x, y))
    model = st.StaFRegressor(st.GaussianKernel(0.8), 0.4, 2, noise=0.1)
    by_x, by_y = torch.autograd.grad(model.forecast(at, of, time).log_density[2:].sum(), (at, of))
    assert bool(by_x.isfinite().all() and by_y.isfinite().all())
    assert not by_x[x.isnan()].any()
    assert not by_y[~y.isfinite()].any()
    apart = torch.zeros_like(x)
    apart[4, 0] = 1e-6
    ends = [model.forecast(x + s * apart, y + s * apart[..., 0], time).log_density[2:].sum() for s in (1, -1)]
    slope = float(ends[0] - ends[1]) / 2e-6
    assert float(by_x[4, 0, 0] + by_y[4, 0]) == pytest.approx(slope, rel=1e-5)


def test_what_learns_takes_numbers_of_tensors_and_computes_no_gradient() -> None:
    x, y, _ = record()
    noise = nn.Parameter(tensor(0.1))
    with pytest.raises(ValueError, match="`StaFRegressor` computes no gradient, and `noise` requires one"):
        st.StaFRegressor(noise=noise).fit(x, y)
    with torch.no_grad():
        model = st.StaFRegressor(noise=noise).fit(x, y)
    same = st.StaFRegressor(noise=0.1).load_state_dict(model.state_dict())
    assert torch.equal(same.predict(x[7]), model.predict(x[7]))
    with pytest.raises(ValueError, match=r"StaFRegressor\(noise=...\)` must be positive; got -0.1"):
        st.StaFRegressor(noise=tensor(-0.1)).forecast(x, y)
    with pytest.raises(ValueError, match=r"StaFRegressor.forecast\(x=...\)` must have the shape"):
        model.forecast(x, y[1:])
