"""What tuning is made of: densities, candidates around the best, widths of what hardly moves, its words."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import tensor

import staf_torch as st
from staf_torch.online import tuning
from staf_torch.online.tuning import Tuning, _around, _Candidates, _choose, _log_density, _warn, _widened


def test_the_density_is_a_gaussian_and_a_twentieth_of_a_broad_one() -> None:
    cases = [(0.3, 0.1, 0.5), (1.0, 0.0, 0.1), (-9.0, 0.0, 0.2), (0.0, 0.0, 3.0)]
    y, mean, deviation = (tensor(column) for column in zip(*cases, strict=True))
    found = _log_density(y, mean, deviation).tolist()
    for value, (a, b, c) in zip(found, cases, strict=True):
        own = math.exp(-0.5 * ((a - b) / c) ** 2) / c
        broad = (1 + (a / 3) ** 2 / 4) ** -2.5 / 3
        assert value == pytest.approx(math.log(0.95 * own + 0.05 * broad), rel=1e-12)


@pytest.mark.parametrize("wide", [0.6, 0.3])
def test_candidates_around_the_best_keep_to_their_bounds_and_are_the_same_for_all_streams(
    wide: float,
) -> None:
    best = _Candidates(
        tensor([[[1.0, 2.0]], [[0.5, 8.0]], [[1.0, 1.0]]]),
        tensor([[0.1], [1e-5], [0.01]]),
        tensor([[0.99], [1.0], [0.8]]),
    )
    found = _around(best, wide, torch.Generator().manual_seed(3))
    draw = torch.Generator().manual_seed(3)
    lost, noise = ((wide * torch.randn(48, generator=draw, dtype=torch.float64)).exp() for _ in range(2))
    width = (wide * torch.randn(48, 2, generator=draw, dtype=torch.float64)).exp()
    torch.testing.assert_close(found.width, best.width * width)
    torch.testing.assert_close(found.noise, (best.noise * noise**2).clamp(min=1e-5), rtol=1e-12, atol=0)
    wanted = torch.stack([(least * lost).clamp(max=0.2) for least in (0.01, 1e-4, 0.2)])
    torch.testing.assert_close(1 - found.forgetting, wanted, rtol=1e-9, atol=1e-15)
    assert float(found.noise.min()) == 1e-5
    assert float(found.forgetting.min()) == pytest.approx(0.8)


def test_a_width_that_nothing_is_known_of_is_that_of_the_others() -> None:
    width = tensor([[1.0, 4.0, 3.0], [1.0, 4.0, 3.0], [2.0, 2.0, 2.0], [2.0, 8.0, 5.0]])
    spread = tensor([[2.0, 0.5, 1.0], [2.0, 0.5, 1e-3], [1.0, 1.0, 1.0], [1.0, 1.0, 1e-3]])
    typical = math.sqrt(2.0 * 2.0)  # of the known widths in units of x
    extent = tensor([[5.0, 5.0, 0.021 * typical], [5.0, 5.0, 0.019 * typical], [1.0] * 3, [5.0, 5.0, 0.0]])
    unknown = torch.tensor([[0, 0, 1], [0, 0, 1], [1, 1, 1], [0, 0, 0]]).bool()
    found, stretch, wider = _widened(width, spread, extent, unknown)
    assert wider.tolist() == [[False] * 3, [False, False, True], [False] * 3, [False] * 3]
    wanted = [[2.0, 2.0, 3.0], [2.0, 2.0, typical], [2.0] * 3, [2.0, 8.0, 5e-3]]
    torch.testing.assert_close(found, tensor(wanted))
    torch.testing.assert_close(
        stretch, tensor([[1.0, 4.0, 2.0], [1.0, 4.0, 2.0], [2.0] * 3, [2.0, 8.0, 5.0]])
    )


@pytest.mark.parametrize("wider", [False, True])
def test_a_coordinate_that_covers_little_of_its_width_is_logged_once(
    wider: bool, caplog: pytest.LogCaptureFixture
) -> None:
    least = 0.35 / math.sqrt(2)
    width = tensor([[1.0, 2.0], [3.0, 4.0]])
    none = torch.zeros(2, 2, dtype=torch.bool)
    _warn(torch.full((2, 2), least, dtype=torch.float64), width, none)
    assert not caplog.records
    mark = none.clone()
    mark[1, 0] = wider
    _warn(tensor([[1.0, 0.2], [0.1, 0.9]]), width, mark)
    (told,) = caplog.messages
    ending = ", which is that of the others: it says nothing of its own" if wider else ""
    assert told == (
        "`StaFRegressor.tune`: coordinate 0 of stream 1 covers 0.1 of a width (3) in this stretch"
        f"{ending}; 2 coordinate(s) in all cover less than 0.25. Tune where they move, if they ever do"
    )


def some_tuning(streams: int) -> Tuning:
    row = torch.arange(1.0, streams + 1, dtype=torch.float64)
    wide = row[:, None] + tensor([0.0, 0.1, 0.2])
    return Tuning(
        wide, 2 * wide, 0.1 * row, 1 - 0.01 * row, row, -row, wide[:, :2], (row > 2)[:, None].double()
    )


def test_streams_that_come_are_typical_and_those_that_stay_keep_the_radius_of_the_first() -> None:
    found = some_tuning(4)
    kept = found.keep(torch.tensor([3, 1]))
    for name, part in kept._asdict().items():
        wanted = tensor([1.0, 1.0]) if name == "radius" else getattr(found, name)[[3, 1]]
        assert torch.equal(part, wanted), name
    more = found.add(2)
    for name, part in more._asdict().items():
        own = getattr(found, name)
        assert torch.equal(part[:4], own)
        new = torch.full_like(own[1], torch.nan) if name in ("center", "spread") else own.sort(0).values[1]
        torch.testing.assert_close(part[4:], new.expand(2, *own.shape[1:]), rtol=0, atol=0, equal_nan=True)


def test_one_of_two_is_chosen_row_by_row() -> None:
    mask = torch.tensor([True, False])
    for tail in ((), (3,), (3, 2)):
        new, old = torch.ones(2, *tail), torch.zeros(2, *tail)
        assert torch.equal(_choose(mask, new, old), torch.stack((new[0], old[1])))


def test_units_of_a_stretch_are_those_of_what_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, few in (("WIDTHS", (1.0,)), ("NOISES", (0.1,)), ("FORGETTING", (1.0,)), ("ROUNDS", ())):
        monkeypatch.setattr(tuning, name, few)
    steps = 24
    time = torch.arange(steps, dtype=torch.float64)
    x = torch.stack((100 + 3 * (0.5 * time).sin(), torch.full((steps,), 7.0).double()), -1)[:, None]
    y = (5 + 2 * (0.5 * time).sin())[:, None, None].clone()
    x[3, 0, 0], y[5, 0, 0], y[9, 0, 0] = torch.nan, torch.inf, torch.nan
    told: list[tuple[torch.Tensor, ...]] = []
    monkeypatch.setattr(tuning, "_warn", lambda *given: told.append(given))
    found = tuning.tuning(x, y, st.rings(6))
    ((covered, width, wider),) = told
    assert torch.equal(width, found.spread[:, :2])
    assert wider.tolist() == [[False, True]]
    extent = float(x[:, 0, 0].nan_to_num(nan=100.0).max() - x[:, 0, 0].nan_to_num(nan=100.0).min())
    torch.testing.assert_close(covered, torch.tensor([[extent, 0.0]]).double() / width)
    both = torch.cat((x, y), -1)[:, 0]
    for column, center in enumerate(found.center[0].tolist()):
        seen = both[:, column][both[:, column].isfinite()]
        assert center == pytest.approx(float(seen.mean()))
    seen = y[y.isfinite()]
    assert float(found.spread[0, 2]) == pytest.approx(float(seen.std(correction=0)))
    moving = x[:, 0, 0][x[:, 0, 0].isfinite()]
    assert float(found.spread[0, 0]) == pytest.approx(float(moving.std(correction=0) * found.width[0, 0]))
    assert found.unknown[0].tolist() == [0.0, 1.0]  # a constant says nothing of its width
    assert float(found.spread[0, 1]) == pytest.approx(float(found.spread[0, 0]))
    first = torch.cat((found.spread[:, :2] / found.width, found.spread[:, 2:]), 1)
    first[0, 1] = 1.0
    best = _Candidates(found.width[:, None], found.ratio.sqrt()[:, None], found.forgetting[:, None])
    samples = (torch.cat((x, y), -1) - found.center) / first
    score = tuning._scores(best, samples, 2, found.radius[0] * st.rings(6))
    assert float(found.likelihood) == pytest.approx(float(score) / 16, rel=1e-6)  # of 24 samples


def test_the_later_two_thirds_are_scored_each_before_it_is_learned() -> None:
    time = torch.arange(10, dtype=torch.float64)
    samples = torch.stack((time.sin(), (0.7 * time).cos(), (2 * time).cos()), -1)[:, None]
    one = torch.ones(1, 1, dtype=torch.float64)
    candidates = _Candidates(torch.full((1, 1, 2), 2.0).double(), 0.3 * one, 0.9 * one)
    found = tuning._scores(candidates, samples, 2, 0.5 * st.rings(6))
    model, wanted = st.StaFRegressor(st.GaussianKernel(1.0), 0.5, noise=0.3, forgetting=0.9), 0.0
    for k in range(10):
        x, y = samples[k, 0, :2] / 2, samples[k, 0, 2]
        if k > 3:
            mean, deviation = model.predict(x, return_std=True)
            wanted += float(_log_density(y, mean, deviation))
        model.partial_fit(x, y)
    assert found.tolist() == [[pytest.approx(wanted, rel=1e-9)]]


def test_a_coordinate_that_is_constant_says_nothing_whatever_the_constant(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, few in (("WIDTHS", (1.0,)), ("NOISES", (0.1,)), ("FORGETTING", (1.0,)), ("ROUNDS", ())):
        monkeypatch.setattr(tuning, name, few)
    time = 0.5 * torch.arange(24, dtype=torch.float64)
    found = []
    for constant in (0.0, 7.0, 1000.1, -1e-9):
        x = torch.stack((3 * time.sin(), torch.full_like(time, constant)), -1)[:, None]
        found.append(tuning.tuning(x, (2 * time).cos()[:, None, None], st.rings(6)))
    for one, other in zip(found[0][1:], found[2][1:], strict=True):  # all but the center
        torch.testing.assert_close(one, other)
        assert bool(one.isfinite().all())
    for each, constant in zip(found, (0.0, 7.0, 1000.1, -1e-9), strict=True):
        torch.testing.assert_close(each.center[0, 1], tensor(constant))
        torch.testing.assert_close(each.spread, found[0].spread)
        assert each.unknown.tolist() == [[0.0, 1.0]]


def test_a_coordinate_that_was_measured_once_is_where_it_was_seen() -> None:
    x, y = torch.zeros(30, 2, 2).double(), torch.linspace(0, 1, 30).double().expand(2, 30).mT.unsqueeze(-1)
    x[..., 0] = 3.0 + y.squeeze(-1).sin()
    x[..., 1] = math.nan
    x[7, :, 1] = tensor([5.0, -2.0])
    found = tuning.tuning(x, y, st.ball(6, 2))
    torch.testing.assert_close(found.center[:, 1], tensor([5.0, -2.0]))
    torch.testing.assert_close(found.center[:, 0], x[..., 0].mean(0))
