"""The band off the stream, after a stream has woken up, and a score of targets that were not all measured."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
import torch
from helpers_streams import mixture
from torch import Tensor
from variants import over

import staf_torch as st
from staf_torch.online import RiverRegressor

MODELS: dict[str, Callable[[], Any]] = {
    "default": st.StaFRegressor,
    "robust": lambda: st.StaFRegressor(robust=2.5),
    "scaling": lambda: st.StaFRegressor(scaling=True),
    "mixture": mixture,
}
PLAIN = MODELS | {"definition": lambda: st.StaFRegressor("matern")}
FILTERS = {name: make for name, make in MODELS.items() if name != "mixture"}


def stream(steps: int = 400) -> tuple[Tensor, Tensor]:
    k = torch.arange(steps, dtype=torch.float64)
    x = torch.stack(((0.05 * k).sin(), (0.065 * k).cos()), -1)
    noise = torch.randn(steps, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return x, (2 * x).sin().sum(-1) + 0.05 * noise


def followed(model: Any, x: Tensor, y: Tensor, asked: bool = False) -> tuple[Tensor, Tensor]:
    """Errors of the predictions, and in deviations: (T - 1, ...), or from the first on where it is asked."""
    found = []
    for k in range(len(x)):
        if k or asked:
            mean, std = model.predict(x[k], return_std=True)
            found.append(torch.stack((mean - y[k], (mean - y[k]) / std)).double())
        model.partial_fit(x[k], y[k])
    error, z = torch.stack(found, 1)
    return error, z


def rms(values: Tensor) -> Tensor:
    """Over the times."""
    return values.square().mean(0).sqrt()


@over(MODELS, "kind")
def test_the_band_far_from_the_data_is_their_spread(kind: str) -> None:
    """FIELD case 9: 300 samples without noise, and nothing known at 8, 13 and 100; a stream a unit."""
    unit, offset = torch.tensor([[1.0, 1e-12, 1e9], [5.0, 0.0, 1e10]]).double()
    x = 3 + 2 * (0.1 * torch.arange(300, dtype=torch.float64)).sin()[:, None].expand(-1, 3)
    y = unit * x.sin() + offset
    model = MODELS[kind]()
    _, z = followed(model, x[..., None], y)
    assert bool(((rms(z[100:]) - 1.05).abs() < 0.15).all())
    for far in (8.0, 13.0, 100.0):
        mean, std = model.predict(torch.full((3, 1), far, dtype=torch.float64), return_std=True)
        share = std / y.std(0)
        assert bool(((share > 0.5) & (share < 3)).all())
        assert bool(((mean - unit * math.sin(far) - offset).abs() < 2.5 * std).all())
        assert bool(((mean - y.mean(0)).abs() < 1.5 * std).all())


@over(PLAIN, "kind")
def test_a_constant_stream_says_nothing_of_other_places(kind: str) -> None:
    x = 3 + 2 * (0.1 * torch.arange(60, dtype=torch.float64)).sin()
    model = PLAIN[kind]().fit(x[:, None], torch.full((60,), 7.0).double())
    mean, std = model.predict(torch.tensor([[100.0]]).double(), return_std=True)
    assert float(mean) == pytest.approx(7, abs=1e-6)
    assert 0.5 < float(std) < 2


ASLEEP = {
    "eight zeros": (0, 8, 0.0),
    "zeros": (0, 150, 0.0),
    "sevens": (0, 150, 7.0),
    "tiny": (0, 150, 1e-300),
    "huge": (0, 150, 1e9),
    "a pause": (100, 150, 0.3),
    "an outlier": (100, 1, 1e30),
    "outliers": (100, 3, -1e30),
    "an outlier at first": (0, 1, 1e30),
}


def woken(cases: Iterable[str]) -> tuple[Tensor, Tensor]:
    """A stream a case: (T, S, 2), (T, S)."""
    (x, y), targets = stream(), []
    for first, count, value in map(ASLEEP.__getitem__, cases):
        targets.append(y.clone())
        targets[-1][first : first + count] = value
    return x[:, None].expand(-1, len(targets), -1), torch.stack(targets, 1)


@over(FILTERS, "kind")
def test_a_stream_that_wakes_up_learns_and_says_how_well(kind: str) -> None:
    """FIELD case 3: z was 1634 for ever, and with `robust` nothing was learned."""
    error, z = followed(FILTERS[kind](), *woken(ASLEEP))
    assert bool((rms(error[270:]) < 0.14).all())
    assert bool(((rms(z[270:]) - 1.025).abs() < 0.225).all())


def test_a_mixture_that_wakes_up_learns_and_says_how_well() -> None:
    error, z = followed(mixture(), *woken(("zeros", "an outlier")))
    assert bool((rms(error[270:]) < 0.1).all())
    assert bool(((rms(z[270:]) - 1.025).abs() < 0.225).all())


@over({"default": 0, "mixture": 0}, "kind")
def test_a_pause_of_thousands_of_equal_samples_leaves_the_band_as_it_was(kind: str) -> None:
    x, y = stream()
    model, times = (st.StaFRegressor(), 2500) if kind == "default" else (mixture(), 200)
    still = x[200:201].expand(times, -1), y[200:201].expand(times)
    model.fit(*(torch.cat((part[:200], rest)) for part, rest in zip((x, y), still, strict=True)))
    _, z = followed(model, x[200:], y[200:], asked=True)
    assert rms(z) < 1.5


def test_single_precision_keeps_its_band_at_any_magnitude() -> None:
    (x, y), units = stream(300), torch.tensor([1e-25, 1.0, 1e25])
    error, z = followed(st.StaFRegressor(), x.float()[:, None].expand(-1, 3, -1), y.float()[:, None] * units)
    assert bool((rms(error[200:] / units) < 0.1).all())
    assert bool(((rms(z[200:]) - 1.025).abs() < 0.225).all())


def test_a_stretch_that_says_nothing_tunes_nothing_and_says_so(caplog: Any) -> None:
    x, y = (part[:, None].expand(-1, 2, *part.shape[1:]) for part in stream(300))
    model = st.StaFRegressor().tune(x[:60], torch.tensor([[7.0, math.nan]]).double().expand(60, 2))
    assert "no two different values" in caplog.text
    error, z = followed(model, x, y)
    assert bool((rms(error[200:]) < 0.14).all())
    assert bool(((rms(z[200:]) - 1.025).abs() < 0.225).all())


def test_an_outlier_does_not_choose_what_is_tuned() -> None:
    x, y = (part[:, None].expand(-1, 2, *part.shape[1:]) for part in stream(150))
    bad = y.clone()
    bad[100] = torch.tensor([1e300, math.inf]).double()
    error, _ = followed(st.StaFRegressor().tune(x, bad), x, y)
    assert bool((rms(error[50:]) < 0.12).all())


def test_a_score_is_over_the_targets_that_were_measured() -> None:
    """FIELD case 20: one NaN made it 1.0."""
    x, y = (part.numpy() for part in stream(150))
    model, x, y = st.StaFRegressor().fit(x[:100], y[:100]), x[100:], y[100:]
    gaps, weight = y.copy(), np.linspace(0.5, 2.0, 50)
    gaps[[3, 17, 18]] = [math.nan, math.inf, math.nan]
    there = np.isfinite(gaps)
    assert model.score(x, gaps) == pytest.approx(model.score(x[there], y[there]))
    weighted = model.score(x[there], y[there], weight[there])
    assert model.score(x, gaps, weight) == pytest.approx(weighted)
    two = st.StaFRegressor().fit(x, np.stack((y, 2 * y), -1))
    half = two.score(x, np.stack((gaps, y), -1))
    alone = [two.predict(x)[:, k] for k in range(2)]
    each = [1 - ((t - f)[m] ** 2).sum() / ((t - t[m].mean())[m] ** 2).sum() for t, f, m in
            zip((y, y), alone, (there, np.ones(50, bool)), strict=True)]  # fmt: skip
    assert half == pytest.approx(np.mean(each))
    constant = st.StaFRegressor().fit(x, np.full(50, 3.0))
    assert constant.score(x, constant.predict(x)) == 1.0
    with pytest.warns(UserWarning, match="without a finite target"):
        assert math.isnan(model.score(x, np.full(50, math.nan)))
    assert model.score(x, np.full(50, 0.1)) == 0.0  # whose mean is rounded
    for weight in (np.full(50, math.nan), np.zeros(50), -np.ones(50), np.ones(3)):
        with pytest.raises(ValueError, match="sample_weight"):
            model.score(x, y, weight)
    with pytest.raises(ValueError, match="shape"):
        model.score(x, y[:, None])


@over({"filter": st.StaFRegressor, "mixture": mixture}, "kind")
def test_river_takes_none_for_what_was_not_measured(kind: str) -> None:
    make = {"filter": st.StaFRegressor, "mixture": mixture}[kind]
    model = RiverRegressor(make())
    for k in range(40):
        a = math.sin(0.2 * k)
        model.learn_one({"a": None if k % 9 == 5 else a, "b": 1.0}, None if k % 7 == 3 else 2 * a)
    assert int(model.model.n_skipped_) == 6
    assert abs(model.predict_one({"a": math.sin(8.0), "b": None}) - 2 * math.sin(8.0)) < 0.3
    with pytest.warns(UserWarning, match="'c'"):
        model.learn_one({"a": 0.0, "b": 1.0, "c": 2.0}, 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn_one({"a": 0.0, "b": 1.0, "c": 2.0}, 0.0)
