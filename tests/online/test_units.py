"""How the units of streams are learned, left and grown, against a filter of one stream that starts over."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest
import torch
from helpers import tensor
from torch import Tensor

import staf_torch as st
from staf_torch.online.compiled_filter import CompiledFilter
from staf_torch.online.filter_streams import FilterStreams, total, units_of
from staf_torch.online.kalman_filter import LocalFilter, StreamState
from staf_torch.online.local_functions import LocalFunctions

FUNCTIONS = LocalFunctions.of(st.GaussianKernel(1.2), 0.5 * st.rings(6))
NAN, INF = math.nan, math.inf


def numpy_units(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and deviation of what is no further than 30 median deviations from the median."""
    found = []
    for column in columns.T:
        seen = np.sort(column[~np.isnan(column)])
        if not len(seen):
            found.append((0.0, 1.0))
            continue
        away = np.abs(seen - seen[(len(seen) - 1) // 2])
        typical = np.sort(away)[(len(away) - 1) // 2]
        kept = seen[away <= 30 * typical] if typical else seen
        mean, most = kept.mean(), np.abs(kept - kept.mean()).max() or 1.0
        spread = most * np.sqrt(np.square((kept - mean) / most).mean())
        found.append((mean, spread if spread > 1e-12 * abs(mean) else 1.0))
    center, spread = zip(*found, strict=True)
    return np.array(center), np.array(spread)


def test_units_are_mean_and_deviation_of_what_is_usual() -> None:
    draw = np.random.default_rng(0)
    columns = {
        "usual": 3 + 2 * draw.standard_normal(9),
        "holes": np.where(np.arange(9) % 3 == 0, NAN, draw.standard_normal(9)),
        "none": np.full(9, NAN),
        "one": np.array([NAN] * 8 + [7.0]),
        "constant": np.full(9, 1e9),
        "zeros": np.zeros(9),
        "two values": np.array([4.0] * 5 + [5.0] * 4),
        "an outlier": np.array([*draw.uniform(-1, 1, 8), 1e6]),
        "at the edge": np.array([-1.0, -1.0, -1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 30.0]),
        "beyond the edge": np.array([-1.0, -1.0, -1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 30.001]),
        "mostly the same": np.array([2.0] * 8 + [90.0]),
        "huge": 1e300 * draw.standard_normal(9),
        "tiny": 1e-300 * draw.standard_normal(9),
        "hardly": 1e6 + 1.5e-6 * np.array([1, -1, 1, -1, 1, -1, 1, -1, 0.5]),
        "too little": 1e6 + 0.5e-6 * np.array([1, -1, 1, -1, 1, -1, 1, -1, 0.5]),
    }
    for name, column in columns.items():
        center, spread = units_of(torch.from_numpy(column)[:, None])
        wanted = numpy_units(column[:, None])
        np.testing.assert_allclose((center.numpy(), spread.numpy()), wanted, rtol=1e-6, err_msg=name)
    whole = torch.from_numpy(np.stack(list(columns.values()), 1))
    for together, alone in zip(
        units_of(whole), zip(*map(units_of, whole.split(1, 1)), strict=True), strict=True
    ):
        assert torch.equal(together, torch.cat(alone))  # bits do not depend on what stands beside
    torch.testing.assert_close(total(whole[:, :1]), whole[:, 0].sum()[None])


class Alone:
    """One stream with units: its filter starts over from the samples themselves whenever units change."""

    def __init__(self, ratio: float, forgetting: float, stretch: Tensor) -> None:
        self.stretch = stretch.numpy()
        self.law = LocalFilter(FUNCTIONS, tensor([ratio]), tensor([forgetting]), 0.5)
        self.begin()
        self.learned = self.skipped = 0

    def begin(self) -> None:
        self.empty()
        self.center, self.spread = np.zeros(3), np.ones(3)
        self.young: list[tuple[np.ndarray, float]] = []
        self.latest: deque[tuple[np.ndarray, float]] = deque(maxlen=40)
        self.waited, self.far, self.turn = 0.0, 0, 0

    def empty(self) -> None:
        self.state = StreamState.empty(torch.zeros(0).double(), 1, 2, 6, 1)
        self.filter = CompiledFilter.build(self.law, self.state)

    def scaled(self, both: np.ndarray) -> Tensor:
        return torch.from_numpy((both - self.center) / self.spread)[None]

    def step(self, both: np.ndarray, lapse: float) -> int:
        """Learn by the filter: 1 where it did."""
        before = int(self.state.counts[0])
        row = self.scaled(both)
        self.filter.learn(self.state, row[:, :2].contiguous(), row[:, 2:].contiguous(), tensor([lapse]))
        return int(self.state.counts[0]) - before

    def over(self, samples: list[tuple[np.ndarray, float]]) -> int:
        self.empty()
        return [self.step(*sample) for sample in samples][-1]

    def learn(self, both: np.ndarray, lapse: float) -> None:
        seen = ~np.isnan(both)
        usable = bool(seen[:2].any() and seen[2] and not np.isinf(both).any())
        if len(self.young) == 40:
            away = bool((np.abs(both - self.center) > 1e3 * self.spread).any())
            if seen.all():
                self.far = self.far + 1 if away and np.isfinite(both[:2]).all() else 0
            if self.far == 8:
                self.begin()
        if len(self.young) < 40:
            self.waited += lapse
            if usable:
                self.young.append((both, self.waited))
                self.waited = 0.0
                if len(self.young) in (2, 5, 10, 20, 40):
                    self.center, self.spread = numpy_units(np.stack([each for each, _ in self.young]))
                    self.spread = self.spread * self.stretch
                    count = self.over(self.young)
                    self.learned, self.skipped = self.learned + count, self.skipped + 1 - count
                    self.learned = max(self.learned, int(self.state.counts[0]))
                    if len(self.young) == 40:
                        self.latest.extend(self.young)
                    return
            count = self.step(both, lapse)
        else:
            count = self.step(both, lapse)
            if usable and not self.far:
                self.latest.append((both, lapse))
                self.turn += 1
        self.learned, self.skipped = self.learned + count, self.skipped + 1 - count
        if len(self.young) == 40 and not self.far and self.turn % 10 == 0:
            self.grow()

    def grow(self) -> None:
        latest = np.stack([each for each, _ in self.latest])[:, :2]
        moves = numpy_units(latest)[1] * self.stretch[:2]
        told = (~np.isnan(latest)).sum(0) >= 20
        still = np.nanmax(latest, 0) == np.nanmin(latest, 0)
        grown = told & ~still & (moves > 3 * self.spread[:2])
        if grown.any():
            self.spread = self.spread.copy()
            self.spread[:2][grown] = moves[grown]
            self.over(list(self.latest))
            self.learned = max(self.learned, int(self.state.counts[0]))

    def predict(self, x: np.ndarray) -> tuple[float, float]:
        row = self.scaled(np.append(x, 0.0))[:, :2].contiguous()
        mean, deviation = self.filter.predict(self.state, row)
        return float(mean) * self.spread[2] + self.center[2], float(deviation) * self.spread[2]


def walks(steps: int) -> dict[str, np.ndarray]:
    """Paths and values (T, 3) in units of all sizes."""
    time = np.arange(steps, dtype=np.float64)
    smooth = np.stack((50 + 3 * np.sin(0.3 * time), 0.02 * np.cos(0.41 * time)), 1)
    y = 1e3 + 7 * np.sin(smooth[:, 0]) + 100 * smooth[:, 1]
    found = {"smooth": np.column_stack((smooth, y))}
    jitter = found["smooth"].copy()
    jitter[70:, 1] = 5 * np.sin(0.5 * time[70:])  # by far more than its unit, later
    jitter[100:, 0] = 50.0
    found["grows"] = jitter
    holes = found["grows"].copy()
    holes[::3, 1], holes[5::7, 2], holes[8::9, :2] = NAN, NAN, NAN
    holes[13::17, 0] = INF
    found["holes"] = holes
    gone = found["smooth"].copy()
    gone[60:67, 0] += 1e6  # for seven samples, and later for good
    gone[75:] *= -1e7
    found["gone"] = gone
    still = found["smooth"].copy()
    still[:, 1] = 3.0
    still[90:, 1] = 3.0 + 1e-3 * np.sin(time[90:])
    found["still"] = still
    return found


@pytest.mark.parametrize("steps", [130])
def test_units_are_learned_grown_and_left_as_by_a_stream_that_starts_over(steps: int) -> None:
    paths = walks(steps)
    both = torch.from_numpy(np.stack(list(paths.values()), 1))
    count = both.shape[1]
    ratio = torch.linspace(1e-3, 0.1, count, dtype=torch.float64)
    forgetting = torch.linspace(0.95, 1.0, count, dtype=torch.float64)
    state = StreamState.empty(torch.zeros(0).double(), count, 2, 6, 1)
    stretch = torch.linspace(0.5, 2.0, 3 * count, dtype=torch.float64).view(
        count, 3
    )  # widths that were tuned
    streams = FilterStreams(LocalFilter(FUNCTIONS, ratio, forgetting, 0.5), state, True, None, stretch)
    alone = [Alone(float(ratio[k]), float(forgetting[k]), stretch[k]) for k in range(count)]
    for k in range(steps):
        lapse = None if k % 4 else torch.linspace(0.5, 2.0, count, dtype=torch.float64)
        at = torch.stack((both[k, :, 0], both[k, :, 1]), 1)
        streams.learn(at, both[k, :, 2:], lapse)
        for stream, each in enumerate(alone):
            each.learn(both[k, stream].numpy(), 1.0 if lapse is None else float(lapse[stream]))
        wanted = np.stack([np.concatenate((each.center, each.spread)) for each in alone])
        np.testing.assert_allclose(streams.units.numpy(), wanted, rtol=1e-9, atol=1e-12, err_msg=f"{k}")
        assert streams.learned.tolist() == [each.learned for each in alone], k
        assert streams.skipped.tolist() == [each.skipped for each in alone], k
        point = np.array([49.0, 0.01])
        mean, deviation = streams.predict(torch.from_numpy(point).expand(count, -1))
        expected = np.array([each.predict(point) for each in alone])
        np.testing.assert_allclose(mean[:, 0], expected[:, 0], rtol=1e-6, atol=1e-6, err_msg=f"{k}")
        np.testing.assert_allclose(deviation[:, 0], expected[:, 1], rtol=1e-6, err_msg=f"{k}")
    spreads = streams.units[:, 4]
    assert float(spreads[1]) > 1.0 > 0.1 > float(spreads[0])
    assert float(streams.units[3, 2]) < -1e9


@pytest.mark.parametrize("at", [5, 10, 40])
@pytest.mark.parametrize("wrong", [False, True])
def test_a_sample_that_comes_when_units_are_learned_is_counted_once(at: int, wrong: bool) -> None:
    """The sample by which units are due is out of all proportion, or is not."""
    time = 0.4 * torch.arange(at, dtype=torch.float64)
    x, y = torch.stack((time.sin(), time.cos()), -1), 50 + (2 * time).sin()
    y[at - 1] = 1e30 if wrong else y[at - 1]
    model = st.StaFRegressor(scaling=True).fit(x, y)
    assert int(model.n_samples_seen_) == at - wrong
    assert int(model.n_skipped_) == int(wrong)
    model.partial_fit(x[0], torch.tensor(torch.nan).double())
    assert int(model.n_skipped_) == 1 + wrong
    assert float(model.predict(x[1])) == pytest.approx(50, abs=1.5)


def test_a_stream_that_is_reset_learns_its_units_anew_and_the_others_go_on() -> None:
    draw = torch.Generator().manual_seed(2)
    x = torch.rand(120, 2, 2, generator=draw, dtype=torch.float64).cumsum(0) * tensor([1.0, 30.0])
    y = x.sin().sum(-1)
    model, through, fresh = (st.StaFRegressor(scaling=True) for _ in range(3))
    model.fit(x[:60], y[:60]).reset([0])
    for k in range(60, 120):
        model.partial_fit(x[k], y[k])
    through.fit(x[:60], y[:60])
    for k in range(60, 120):
        through.partial_fit(x[k], y[k])
        fresh.partial_fit(x[k], y[k])
    point = x[-1]
    found = model.predict(point)
    torch.testing.assert_close(found[0], fresh.predict(point)[0])
    torch.testing.assert_close(found[1], through.predict(point)[1])
