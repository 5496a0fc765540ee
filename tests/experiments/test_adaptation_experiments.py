"""The experiments on learning while running, short."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from composing import settings
from omegaconf import OmegaConf

from staf_torch.experiments import faults, icl


def test_integral_and_derivative_see_the_same_plant_and_gains(tmp_path: Path) -> None:
    short = ("trajectories=3", "dt=0.005", "duration=0.3", "settle_time=0.1", "icl.length=[0.02,0.04]")
    metrics = icl.run(settings("experiment=icl", "figures=false", *short), tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert metrics["integral_diverged"] == metrics["derivative_diverged"] == 0
    assert metrics["integral_error_median"] != metrics["derivative_error_median"]
    with pytest.raises(ValueError, match="settle_time"):
        icl.run(settings("experiment=icl", *short, "settle_time=1.0"), tmp_path)


def test_the_published_reference_has_the_rate_that_is_stated() -> None:
    time = torch.tensor([0.0, 0.7, 12.3], dtype=torch.float64, requires_grad=True)
    z = torch.stack((time * 0, time * 0, (-0.1 * time).exp(), time.sin(), time.cos()), dim=-1)
    wanted, rate = icl.reference(z)
    stated = 10 * (1 - (-0.1 * time).exp())
    torch.testing.assert_close(wanted[:, 0], stated * (2 * time).sin())
    torch.testing.assert_close(wanted[:, 1], stated * 0.4 * (3 * time).cos())
    for k in range(2):
        (slope,) = torch.autograd.grad(wanted[:, k].sum(), time, retain_graph=True)
        torch.testing.assert_close(rate[:, k], slope)


def test_gains_are_drawn_for_every_row_within_their_ranges() -> None:
    cfg = settings("experiment=icl", "icl.gain=[0.5,0.5]", "icl.rate=[1,2]")
    for rows in (1, 3):
        cfg.trajectories = rows
        gains = icl._gains(cfg)
        assert gains["gain"].tolist() == [0.5] * rows
        assert bool(((gains["rate"] >= 1) & (gains["rate"] <= 2)).all())
    for name, wrong in (("trajectories", 0), ("icl.rate", [2, 1]), ("icl.rate", [0, 1])):
        bad = cfg.copy()
        OmegaConf.update(bad, name, wrong)
        with pytest.raises(ValueError, match=name):
            icl._gains(bad)


def test_the_plant_is_the_published_one() -> None:
    x1, x2, time = 0.3, -1.2, 0.7
    decay, sine, cosine = math.exp(-0.1 * time), math.sin(time), math.cos(time)
    z, u = torch.tensor([[x1, x2, decay, sine, cosine]]).double(), torch.tensor([[0.4, -0.9]]).double()
    wanted = [
        5 * x1**2 + 10 * math.sin(x2) + 0.4,
        10 * x2 * sine + 15 * x1 + 20 * x1 * x2 - 0.9,
        -0.1 * decay,
        cosine,
        -sine,
    ]
    torch.testing.assert_close(icl.published().velocity(z, u), torch.tensor([wanted]).double())


def test_first_estimates_are_drawn_on_both_sides_of_zero_and_a_run_takes_its_time() -> None:
    case = faults.short_period(400, torch.Generator().manual_seed(3))
    drawn = case.adaptive.theta[:, :4]
    assert -5 <= float(drawn.min()) < -4.9
    assert 4.9 < float(drawn.max()) <= 5
    assert abs(float(drawn.mean())) < 0.3
    assert bool((case.adaptive.theta[:, 4:] == 1).all())
    assert case.after[7].tolist() == [-1.175, 0.9871, -8.458, -0.8776, 0.7, 0.0]
    few = faults.short_period(2, torch.Generator().manual_seed(3))
    result = faults._simulated(few, faults._controllers(few)["adaptive"], 0.1)
    assert float(result.time[-1]) == pytest.approx(0.1)


def test_a_picture_of_the_first_row_shows_its_own_change() -> None:
    case = faults.unstable(3, torch.Generator().manual_seed(0))
    case = case._replace(at=torch.tensor([0.3, 0.1, 0.5], dtype=torch.float64))
    results = {"adaptive": faults._simulated(case, faults._controllers(case)["adaptive"], 0.6)}
    picture = faults._picture(case, results)
    for time, truth in zip(picture.time.tolist(), picture.truth.tolist(), strict=True):
        assert truth == pytest.approx([1.0, 1.0] if time < 0.3 - 1e-9 else [0.5, 1.0])


def test_the_masses_are_half_and_twice_that_of_the_design_in_turn() -> None:
    case = faults.mass(6, torch.Generator().manual_seed(0))
    assert case.after[:, 0].tolist() == [2.0, 0.5] * 3  # 1 / mass
    assert torch.equal(case.before, case.after)
    assert bool((case.x0[:, 0].abs() >= 0.5).all())
    assert bool((case.x0[:, 1].abs() <= 1).all())
