"""Hyperparameters from a stretch, against those that it was drawn with."""

from __future__ import annotations

import pickle

import pytest
import torch
from helpers import tensor
from torch import Tensor

import staf_torch as st


def drawn(width: Tensor, noise: float, steps: int = 220, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A path (T, 2) and a sample (T,) of the Gaussian process with these widths along it, with noise."""
    draw = torch.Generator().manual_seed(seed)
    time = 0.12 * torch.arange(steps, dtype=torch.float64)
    x = torch.stack((time.sin() + 0.4 * (2.3 * time).cos(), (1.37 * time).cos()), -1)
    apart = ((x[:, None] - x[None]) / width).square().sum(-1)
    gram = (-0.5 * apart).exp() + 1e-9 * torch.eye(steps, dtype=torch.float64)
    clean = torch.linalg.cholesky(gram) @ torch.randn(steps, generator=draw, dtype=torch.float64)
    return x, clean + noise * torch.randn(steps, generator=draw, dtype=torch.float64)


def errors(model: st.StaFRegressor, x: Tensor, y: Tensor) -> Tensor:
    """Root mean square, of every stream."""
    found = []
    for k in range(len(x)):
        if k > 20:
            found.append(model.predict(x[k]) - y[k])
        model.partial_fit(x[k], y[k])
    return torch.stack(found).square().mean(0).sqrt()


def test_tuned_regressor_predicts_as_one_that_knows_what_the_stream_was_drawn_with() -> None:
    """The width itself need not be found: on a slow path many predict alike."""
    x, y = drawn(torch.tensor([0.7, 0.7]).double(), 0.1, steps=300)
    tuned = st.StaFRegressor().tune(x[:150], y[:150])
    knowing = st.StaFRegressor(st.GaussianKernel(0.7), 0.35, noise=0.1, forgetting=1.0)
    wrong = st.StaFRegressor(st.GaussianKernel(0.1), 0.05, noise=0.1, forgetting=1.0)
    found = [errors(model, x[150:], y[150:]) for model in (tuned, knowing, wrong)]
    assert found[0] < 1.07 * found[1]
    assert found[0] < 0.8 * found[2]


def test_each_coordinate_and_each_stream_has_its_own_width() -> None:
    along = [drawn(torch.tensor(w).double(), 0.05, steps=120) for w in ([0.5, 50.0], [50.0, 0.5])]
    x, y = (torch.stack([pair[k] for pair in along], 1) for k in range(2))
    found = st.StaFRegressor().tune(x, y).tuning
    assert found is not None
    table = repr(found).splitlines()
    assert table[0].startswith("Tuning of 2 stream(s), n = 2, 1 output(s)")
    assert [line.split("  ")[0] for line in table[2:5]] == ["width of x[0]", "width of x[1]", "noise of y"]
    assert len(table) == 8
    assert bool((found.likelihood > found.untuned).all())
    assert float(found.spread[0, 1]) > 1.5 * float(found.spread[0, 0])
    assert float(found.spread[1, 0]) > 1.5 * float(found.spread[1, 1])


def test_streams_that_drift_are_followed_and_others_predicted_as_by_one_that_never_forgets() -> None:
    """By their errors: forgetting, noise and width predict nearly alike along a ridge of values."""
    x, y = drawn(torch.tensor([0.7, 0.7]).double(), 0.05, steps=150, seed=1)
    drift = y + (0.15 * torch.arange(len(y), dtype=torch.float64)).sin() * x[:, 0]
    both = x[:, None].expand(-1, 2, -1), torch.stack((y, drift), 1)
    resting, drifting = errors(st.StaFRegressor().tune(*both), *both)
    never = st.StaFRegressor(st.GaussianKernel(0.7), 0.35, noise=0.05, forgetting=1.0)
    assert drifting < 0.9 * errors(never, x, drift)
    assert resting < 1.1 * errors(never, x, y)


def test_tuning_knows_no_units_and_is_saved_with_what_was_learned() -> None:
    plain, told = drawn(torch.tensor([0.4, 0.4]).double(), 0.05, steps=120)
    x, y = 300 * plain + 1e4, 1e-3 * told - 5
    tuned = st.StaFRegressor().tune(x[:80], y[:80])
    standard = st.StaFRegressor().tune(plain[:80], told[:80])
    found, expected = errors(tuned, x[80:], y[80:]), 1e-3 * errors(standard, plain[80:], told[80:])
    assert abs(found / expected - 1) < 1e-6
    point = x[7] + 1
    again = pickle.loads(pickle.dumps(tuned))
    assert torch.equal(again.predict(point), tuned.predict(point))
    other = st.StaFRegressor().load_state_dict(tuned.state_dict())
    assert torch.equal(
        other.partial_fit(x[3], y[3]).predict(point), tuned.partial_fit(x[3], y[3]).predict(point)
    )


@pytest.mark.needs_compiler
def test_the_gradient_finds_what_is_at_least_as_likely_as_the_best_of_the_search() -> None:
    pairs = [drawn(torch.tensor([0.7, 0.7]).double(), 0.1, steps=60, seed=seed) for seed in range(2)]
    x, y = torch.stack([path[:, :1] for path, _ in pairs], 1), torch.stack([told for _, told in pairs], 1)
    found = [st.StaFRegressor(count=2).tune(x, y, method=how).tuning for how in ("search", "gradient")]
    assert all(each is not None for each in found)
    searched, ascended = (each.likelihood for each in found if each is not None)
    assert bool((ascended > searched - 0.01).all())
    with pytest.raises(ValueError, match=r"tune\(method=...\)` must be one of .*; got 'newton'"):
        st.StaFRegressor().tune(x, y, method="newton")
    wide = torch.randn(50, 7, dtype=torch.float64)
    with pytest.raises(ValueError, match="'search' for more than 15 centers, of which 7 coordinates take 36"):
        st.StaFRegressor().tune(wide, wide[:, 0], method="gradient")


@pytest.mark.needs_compiler
def test_tuned_streams_keep_their_hyperparameters_when_others_go_and_come() -> None:
    pairs = [drawn(torch.tensor([0.7, 0.7]).double(), 0.1, steps=60, seed=seed) for seed in range(3)]
    x, y = (torch.stack([3.0 * pair[k] + 5 for pair in pairs], 1) for k in range(2))
    tuned = st.StaFRegressor().tune(x, y)
    again = pickle.loads(pickle.dumps(tuned))  # before the first sample too
    for model in (tuned, again):
        model.fit(x, y).drop([1]).add(1).reset(streams=[0])
    assert torch.equal(tuned.predict(x[3]), again.predict(x[3]))
    other = st.StaFRegressor().load_state_dict(tuned.state_dict())
    order, alone = [0, 2, 1], st.StaFRegressor().tune(x[:, :1], y[:, :1])
    for k in range(60):
        for model in (tuned, other):
            model.partial_fit(x[k, order], y[k, order])
        alone.partial_fit(x[k, :1], y[k, :1])
    assert torch.equal(tuned.predict(x[9, order]), other.predict(x[9, order]))
    assert torch.equal(tuned.predict(x[9, order])[0], alone.predict(x[9, :1])[0])  # begun anew, still tuned
    assert float((tuned.predict(x[59, order]) - y[59, order])[2].abs()) < 1.0  # one that nobody tuned


def test_stretch_in_which_a_coordinate_hardly_moves_says_so_and_nothing_about_its_width(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The coordinate stands still, or in another stream jitters, for 120 samples, and moves after these."""
    path, _ = drawn(torch.tensor([0.9, 0.9]).double(), 0.1, steps=300)
    later = torch.cat((path[:1, 1].expand(120), path[:180, 1]))
    draw = torch.Generator().manual_seed(int(torch.randint(2**31, ())))
    x = torch.stack((path[:, 0], later), -1).unsqueeze(1).repeat(1, 2, 1)
    x[:120, 1, 1] += 1e-3 * torch.randn(120, generator=draw, dtype=torch.float64)
    y = (2 * x).sin().sum(-1) + 0.1 * torch.randn(300, 2, generator=draw, dtype=torch.float64)
    tuned = st.StaFRegressor().tune(x[:120], y[:120])
    knowing = st.StaFRegressor(st.GaussianKernel(0.9), 0.45, noise=0.1)
    assert len(caplog.records) == 1
    assert "coordinate 1 of stream 0 covers" in caplog.text
    assert "2 coordinate(s) in all cover" in caplog.text
    assert bool((errors(tuned, x[120:], y[120:]) < 1.6 * errors(knowing, x[120:], y[120:])).all())


def test_tuning_of_a_stream_is_the_same_whoever_is_beside() -> None:
    pairs = [drawn(torch.tensor([0.7, 0.7]).double(), 0.1, steps=40, seed=seed) for seed in range(2)]
    x, y = (torch.stack([pair[k] for pair in pairs], 1) for k in range(2))
    together = st.StaFRegressor().tune(x, y).tuning
    alone = st.StaFRegressor().tune(x[:, 1], y[:, 1]).tuning
    assert together is not None
    assert alone is not None
    assert all(torch.equal(a[1], b[0]) for a, b in zip(together, alone, strict=True))


def test_samples_that_no_candidate_explains_do_not_choose() -> None:
    """A sensor that fails three times in the stretch: what is tuned there predicts the rest as before."""
    x, y = drawn(torch.tensor([0.7, 0.7]).double(), 0.1, steps=300, seed=40)
    broken = y.clone()
    broken[torch.tensor([70, 71, 110])] += torch.tensor([40.0, -30.0, 40.0]).double()
    x, told = x[:, None].expand(-1, 2, -1), torch.stack((y, broken), 1)
    found = errors(st.StaFRegressor().tune(x[:150], told[:150]), x, y[:, None].expand(-1, 2))
    assert found[1] < 1.7 * found[0]  # 4.4 to 6.5 with a Gaussian density alone


@pytest.mark.parametrize("tunes", [True, False])
def test_units_grow_with_a_coordinate_that_jittered_while_they_were_learned(tunes: bool) -> None:
    """Jitter of 3 % for 120 samples, then movement of 1: 8 times the error of one that knows without."""
    path, _ = drawn(torch.tensor([0.9, 0.9]).double(), 0.1, steps=300)
    draw = torch.Generator().manual_seed(int(torch.randint(2**31, ())))
    x = torch.stack((path[:, 0], torch.cat((path[:1, 1].expand(120), path[:180, 1]))), -1)
    x[:120, 1] += 0.03 * torch.randn(120, generator=draw, dtype=torch.float64)
    y = (2 * x).sin().sum(-1) + 0.1 * torch.randn(300, generator=draw, dtype=torch.float64)
    found = st.StaFRegressor().tune(x[:120], y[:120]) if tunes else st.StaFRegressor(scaling=True)
    knowing = st.StaFRegressor(st.GaussianKernel(0.9), 0.45, noise=0.1)
    for model in (found, knowing):
        for k in range(0 if tunes else 120):
            model.partial_fit(x[k], y[k])
    assert errors(found, x[120:], y[120:]) < 2.2 * errors(knowing, x[120:], y[120:])
    again = type(found)(**found.get_params()).load_state_dict(found.state_dict())
    assert torch.equal(again.predict(x[7]), found.predict(x[7]))


def test_units_are_those_of_what_was_measured_of_each_coordinate() -> None:
    """No sample is complete: coordinates take turns, and the same units come out."""
    x, y = drawn(torch.tensor([0.7, 0.7]).double(), 0.1, steps=60)
    x = 1e3 * x + 5e4
    for k in range(2):
        x[k::3, k] = torch.nan  # of three samples one is complete
    model = st.StaFRegressor(scaling=True).fit(x, y)
    center, spread = model.state_dict()["units"][0].chunk(2)
    for k in range(2):
        seen = x[:40, k][~x[:40, k].isnan()]
        assert float((center[k] - seen.mean()).abs()) < 1e-9 * float(center[k])
        assert float((spread[k] / seen.std(correction=0) - 1).abs()) < 1e-9
    held, gaps = x.clone(), y.clone()
    held[1:, 0], gaps[0] = torch.nan, torch.nan  # what is held was measured with a sample without target
    plain = st.StaFRegressor().fit(held, gaps)
    assert int(plain.n_skipped_) == int(st.StaFRegressor(scaling=True).fit(held, gaps).n_skipped_)
    never = st.StaFRegressor(scaling=True).fit(x.where(torch.tensor([True, False]), torch.nan), y)
    assert (
        int(never.n_samples_seen_) == 0
    )  # as without scaling: a coordinate is held, and there is nothing to hold


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
