"""A stream survives whatever finite number comes, and says so in its counts."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import tensor
from helpers_streams import REGRESSORS, mixture
from hypothesis import given, settings
from hypothesis import strategies as some
from torch import Tensor
from variants import over

import staf_torch as st

MAGNITUDES = some.floats(-1e300, 1e300) | some.sampled_from([math.nan, math.inf, -math.inf, 5e-324, 0.0])


def path(steps: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    time = 0.1 * torch.arange(steps, dtype=torch.float64)
    x = torch.stack((time.sin(), (1.3 * time).cos()), -1)
    return x.to(dtype), (2 * x).sin().sum(-1).to(dtype)


def error_after(model: st.StaFRegressor, x: Tensor, y: Tensor) -> float:
    """Prequential error over the later half."""
    found = []
    for state, value in zip(x, y, strict=True):
        found.append(float(model.predict(state) - value))
        model.partial_fit(state, value)
    late = found[len(found) // 2 :]
    return math.sqrt(sum(e * e for e in late) / len(late))


@pytest.mark.parametrize(
    ("kernel", "dtype"),
    [("exponential", torch.float64), ("matern", torch.float64), ("gaussian", torch.float32)],
)
def test_filter_recovers_from_far_inputs(kernel: str, dtype: torch.dtype) -> None:
    """Four streams side by side, each with another one."""
    far = torch.tensor([1e3, 9999.0, 1e20, 1e37], dtype=dtype)
    x, y = (each.unsqueeze(1).expand(-1, 4, *each.shape[1:]) for each in path(60, dtype))
    bad = x.clone()
    bad[20] = far.unsqueeze(-1)
    bad[21] = -far.unsqueeze(-1)
    model = st.StaFRegressor(kernel, 0.4, noise=0.05).fit(bad, y)
    deviation = model.predict(x[-1], return_std=True)[1]
    assert ((deviation > 0) & (deviation < 1.0)).all()
    found = []
    for state, value in zip(x, y, strict=True):
        found.append(model.predict(state) - value)
        model.partial_fit(state, value)
    assert (torch.stack(found[30:]).square().mean(0).sqrt() < 0.3).all()


@over(REGRESSORS, "kind")
def test_stream_that_moves_away_for_good_starts_afresh_there(kind: str) -> None:
    x, y = path(120)
    model = REGRESSORS[kind]().fit(x, y)
    assert error_after(model, x + 1e7, y * 1e9) < 0.3e9
    assert error_after(model, x, y) < 0.3


@settings(max_examples=15, deadline=None)
@given(some.lists(some.tuples(MAGNITUDES, MAGNITUDES, MAGNITUDES), min_size=1, max_size=25), some.booleans())
def test_filter_is_alive_after_anything(samples: list[tuple[float, float, float]], single: bool) -> None:
    dtype = torch.float32 if single else torch.float64
    model = st.StaFRegressor(radius=0.4, noise=0.05)
    for first, second, value in samples:
        model.partial_fit(
            torch.tensor([first, second], dtype=torch.float64).to(dtype), torch.tensor(value).to(dtype)
        )
    x, y = path(80, dtype)
    for state, value in zip(x, y, strict=True):
        model.partial_fit(state, value)
    assert error_after(model, x, y) < 0.3


@settings(max_examples=10, deadline=None)
@given(some.lists(some.tuples(MAGNITUDES, MAGNITUDES, MAGNITUDES), min_size=1, max_size=25))
def test_bank_is_alive_after_anything(samples: list[tuple[float, float, float]]) -> None:
    model = mixture()
    for first, second, value in samples:
        model.partial_fit(
            torch.tensor([first, second], dtype=torch.float64), torch.tensor(value, dtype=torch.float64)
        )
    x, y = path(40)
    for state, value in zip(x, y, strict=True):
        model.partial_fit(state, value)
        assert torch.isfinite(model.predict(state))


@over(REGRESSORS, "kind")
def test_coordinate_that_was_not_measured_is_held_and_a_target_is_not_learned(kind: str) -> None:
    x, y = path(100)
    holed, told = x.clone(), y.clone()
    holed[20::9, 0], told[25::10] = torch.nan, torch.nan
    model = REGRESSORS[kind]().fit(holed, told)
    assert int(model.n_skipped_) == len(told[25::10])
    assert math.isfinite(float(model.predict(torch.tensor([math.nan, 0.3], dtype=torch.float64))))
    assert error_after(model, x, y) < 0.2


@pytest.mark.parametrize(("kind", "robusts"), [("filter", (None, 4.0)), ("mixture", (1e30, None))])
def test_outliers_count_less_in_the_bank_and_where_asked(
    kind: str, robusts: tuple[float | None, float | None]
) -> None:
    x, y = path(300)
    draw = torch.Generator().manual_seed(0)
    noisy = y + 0.05 * torch.randn(300, generator=draw, dtype=torch.float64)
    noisy[20::25] += 20.0
    models = [REGRESSORS[kind](robust=robust) for robust in robusts]
    errors = [error_after(model.fit(x[:1], noisy[:1]), x[1:], noisy[1:]) for model in models]
    late = [float((model.predict(x[-4:]) - y[-4:]).abs().max()) for model in models]
    assert late[1] < 0.5 * late[0]
    assert errors[1] < 1.05 * errors[0]  # outliers themselves included
    assert kind == "filter" or int(models[1].n_skipped_) == len(noisy[20::25])


def test_spikes_that_are_not_rare_are_learned() -> None:
    angle = torch.arange(300, dtype=torch.float64) % 8
    x, y = torch.stack((angle.sin(), angle.cos()), -1), torch.where(angle == 3, 50.0, 0.0)
    model = mixture().fit(x, y)
    assert abs(float(model.predict(x[3])) - 50) < 1.0


def test_change_that_stays_is_learned_at_once_by_a_robust_bank() -> None:
    x, y = path(300)
    changed = torch.where(torch.arange(300) < 150, y, y + 30)
    model = mixture(robust=5.0).fit(x[:180], changed[:180])
    assert int(model.n_samples_seen_) == 180
    assert abs(float(model.predict(x[180]) - changed[180])) < 1.0


MAGNIFIED = tensor([[1e-300, 1e160], [1e200, 1.0], [1e-300, 1e-300], [1e140, 1e-140]])


@pytest.mark.parametrize(
    ("kind", "settings"), [("mixture", {}), ("filter", {"scaling": True}), ("filter", {})]
)
def test_stream_is_alive_after_many_samples_of_another_magnitude(
    kind: str, settings: dict[str, bool]
) -> None:
    """Four streams side by side."""
    x, y = (part.unsqueeze(1).expand(-1, 4, *part.shape[1:]) for part in path(60))
    model = REGRESSORS[kind](**settings).fit(MAGNIFIED[:, :1] * x, MAGNIFIED[:, 1] * y)
    for _ in range(2):
        found = []
        for state, value in zip(x, y, strict=True):
            found.append(model.predict(state) - value)
            model.partial_fit(state, value)
    assert bool((torch.stack(found[30:]).square().mean(0).sqrt() < 0.3).all())


def test_units_are_learned_at_any_magnitude() -> None:
    of_x, of_y = tensor([[1.0, 1e-300, 1e300, 1.0], [1.0, 1e-300, 1e160, 1e300]])
    x, y = (part.unsqueeze(1).expand(-1, 4, *part.shape[1:]) for part in path(80))
    model = st.StaFRegressor(radius=0.4, noise=0.05, scaling=True).fit(of_x[:, None] * x, of_y * y)
    for part in model.predict(of_x[:, None, None] * x[:9].transpose(0, 1), return_std=True):
        plain = part / of_y[:, None]
        torch.testing.assert_close(plain, plain[:1].expand(4, 9), rtol=1e-3, atol=1e-3)


@over(REGRESSORS, "kind")
def test_time_passes_while_nothing_is_learned(kind: str) -> None:
    x, y = path(60)
    settings = {"forgetting": 0.9} if kind == "filter" else {}
    waited, told = (REGRESSORS[kind](**settings).fit(x, y) for _ in range(2))
    for _ in range(30):
        waited.partial_fit(x[-1], torch.tensor(math.nan))
    waited.partial_fit(x[20], y[20])
    told.partial_fit(x[20], y[20], lapse=31.0)
    for one, other in zip(*(m.predict(x[25], return_std=True) for m in (waited, told)), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)
