"""What `icl` hands to the simulation, and what it makes of it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers import tensor, uniform
from helpers_experiments import made_of
from recorded import Record
from torch import Tensor

from staf_torch.adp import ControllerState
from staf_torch.experiments import icl


def cfg_of(*more: str) -> Any:
    return settings("experiment=icl", *more)


def test_gains_are_uniform_numbers_of_the_seed_in_their_ranges() -> None:
    ranges = {"feedback": [1.0, 3.0], "gain": [0.5, 0.75], "rate": [2.0, 2.0], "length": [0.1, 10.0]}
    words = [f"icl.{name}=[{low},{high}]" for name, (low, high) in ranges.items()]
    found = icl._gains(cfg_of("trajectories=5", "seed=7", *words))
    drawn = torch.rand(5, 4, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    assert list(found) == list(ranges)
    for k, (name, (low, high)) in enumerate(ranges.items()):
        torch.testing.assert_close(found[name], (1 - drawn[:, k]) * low + drawn[:, k] * high)
        assert found[name].dtype == torch.float64
    least = icl._gains(cfg_of("trajectories=2", "icl.gain=[1e-9,1e-9]"))
    assert least["gain"].tolist() == pytest.approx([1e-9] * 2)


def test_the_plant_and_its_reference_take_any_leading_axes(record: Record) -> None:
    plant = icl.published()
    z, u = uniform(2, 3, 5, seed=1), uniform(2, 3, 2, seed=2)
    wanted, rate = icl.reference(z)
    assert wanted.shape == rate.shape == (2, 3, 2)
    torch.testing.assert_close(icl.reference(z[1, 2])[0], wanted[1, 2])
    torch.testing.assert_close(icl.reference(z[1, 2])[1], rate[1, 2])
    x1, x2, _, sine, _ = z.unbind(-1)
    regressor = plant.regressor(z, u)
    assert regressor.shape == (2, 3, 5, 4)
    none = torch.zeros_like(x1)
    first, second = (x1**2, x2.sin(), none, none), (none, x2 * sine, x1, x1 * x2)
    for row, columns in enumerate((first, second, *((none,) * 4,) * 3)):
        torch.testing.assert_close(regressor[..., row, :], torch.stack(columns, -1))
    assert (plant.dim, plant.inputs, plant.rows, plant.theta.tolist()) == (
        5,
        2,
        [0, 1],
        [5.0, 10.0, 15.0, 20.0],
    )
    record({"wanted": wanted, "rate": rate, "rest": plant.rest_of(z, u)})


@pytest.mark.parametrize(
    ("duration", "dt", "every", "steps"),
    [
        (0.5, 0.005, 5, 100),  # a twentieth of the run
        (40.0, 0.01, 10, 4000),  # a tenth of a second
        (0.004, 0.005, 1, 1),
        (0.53, 0.01, 3, 54),  # 17.7 times of what is recorded
    ],
)
def test_a_source_is_simulated_with_its_gains_and_noise_and_is_paid_for_the_error(
    duration: float, dt: float, every: int, steps: int, monkeypatch: pytest.MonkeyPatch, record: Record
) -> None:
    asked: list[Any] = []

    def simulate(controller: Any, plant: Any, cost: Any, x0: Tensor, **named: Any) -> Any:
        asked.append((controller, plant, cost, x0, named))
        state = uniform(3, 4, 5, seed=3)
        identifier = controller.controller.init(x0).identifier.unsqueeze(1).expand(-1, 4, -1)
        diverged = torch.tensor([True, False, True])
        return SimpleNamespace(time=torch.arange(4), state=state, identifier=identifier, diverged=diverged)

    monkeypatch.setattr(icl, "simulate", simulate)
    cfg = cfg_of(
        "trajectories=3",
        f"duration={duration}",
        f"dt={dt}",
        "icl.noise=0.3",
        "seed=4",
        f"icl.size={7 if steps == 100 else 1}",
    )
    cfg.initial_state = [0.5, -0.25]
    plant, gains = icl.published(), icl._gains(cfg)
    found = icl._followed(cfg, plant, gains, "slope")
    ((seen, same, cost, x0, named),) = asked
    assert same is plant
    assert named == {"dt": dt, "steps": steps, "every": every, "seed": 4}
    assert x0.tolist() == [[0.5, -0.25, 1.0, 0.0, 1.0]] * 3
    assert x0.dtype == torch.float64
    assert (seen.noise.tolist(), seen.dim) == ([0.3, 0.3, 0.0, 0.0, 0.0], 5)
    z, u = uniform(6, 5, seed=5), uniform(6, 2, seed=6)
    error = z[:, :2] - icl.reference(z)[0]
    torch.testing.assert_close(cost.rate(z, u), error.square().sum(-1) + u.square().sum(-1))
    state = uniform(3, 4, 5, seed=3)
    torch.testing.assert_close(found.error, state[..., :2] - icl.reference(state)[0])
    assert found.theta.shape == (3, 4, 4)
    assert found.diverged == 2
    if steps == 100:
        record(made_of({"tracker": seen.controller}))
        assert isinstance(seen.controller.init(x0), ControllerState)


def followed(scale: float, diverged: int) -> icl.Followed:
    error = scale * uniform(3, 5, 2, seed=1)
    theta = tensor([5.0, 10.0, 15.0, 20.0]) + scale * uniform(3, 5, 4, seed=2)
    return icl.Followed(0.5 * torch.arange(5).double(), error, theta, diverged)


def test_errors_are_of_the_settled_run_and_the_better_source_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pictures: list[Any] = []
    runs = {"integral": followed(1.0, 1), "slope": followed(2.0, 0)}
    # Of one row the derivative is better in both, of one they are the same.
    runs["slope"].error[0], runs["slope"].theta[0] = 0.5 * runs["integral"].error[0], plant_near(0.5, runs)
    runs["slope"].error[1] = runs["integral"].error[1]
    monkeypatch.setattr(icl, "_followed", lambda cfg, plant, gains, source: runs[source])
    monkeypatch.setattr(icl, "draw_gain_sets", lambda picture: pictures.append(picture))
    monkeypatch.setattr(icl, "images", lambda figure: {"txt": b"drawn"})
    caplog.set_level("INFO")
    found = icl.run(cfg_of("trajectories=3", "settle_time=1.0", "figures=true"), tmp_path)

    def rms(values: Tensor) -> np.ndarray:
        return np.sqrt((values[:, 2:].numpy() ** 2).sum(-1).mean(1))  # from 1 s on

    truth = tensor([5.0, 10.0, 15.0, 20.0])
    for name, run in (("integral", runs["integral"]), ("derivative", runs["slope"])):
        for what, values in (("error", rms(run.error)), ("parameter_error", rms(run.theta - truth))):
            assert found[f"{name}_{what}_median"] == pytest.approx(float(np.median(values)))
            assert found[f"{name}_{what}_best"] == pytest.approx(float(values.min()))
            assert found[f"{name}_{what}_worst"] == pytest.approx(float(values.max()))
    assert (found["integral_diverged"], found["derivative_diverged"]) == (1.0, 0.0)
    assert found["integral_better_error"] == pytest.approx(1 / 3)
    assert found["integral_better_parameter_error"] == pytest.approx(2 / 3)
    (picture,) = pictures
    errors = rms(runs["integral"].theta - truth)
    shown = int(errors.argmin())
    np.testing.assert_array_equal(picture.time, [0.0, 0.5, 1.0, 1.5, 2.0])
    np.testing.assert_array_equal(picture.parameters, runs["integral"].theta[shown].numpy())
    assert picture.truth.tolist() == truth.tolist()
    assert list(picture.error) == list(picture.parameter_error) == ["integral", "derivative"]
    np.testing.assert_allclose(picture.parameter_error["integral"], errors)
    np.testing.assert_allclose(picture.error["derivative"], rms(runs["slope"].error))
    followed_by = np.linalg.norm(runs["slope"].error[shown].numpy(), axis=-1)
    np.testing.assert_allclose(picture.followed["derivative"], followed_by)
    assert len(caplog.messages) == 2
    assert caplog.messages[0].startswith("integral: error median ")
    lines = (tmp_path / "icl.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["method", "integral", "derivative"]
    words = (tmp_path / "icl.md").read_text().splitlines()[2].split("|")[3:-1]  # four digits of every number
    assert all(len(word.strip().strip("-0.").replace(".", "")) <= 4 for word in words)
    other = tmp_path / "other"
    other.mkdir()
    icl.run(cfg_of("trajectories=3", "settle_time=2.0", "figures=false"), other)  # the last time is enough
    assert not (other / "figures").exists()
    with pytest.raises(ValueError, match=r"`staf settle_time=...` must be before the end; got 2.1"):
        icl.run(cfg_of("trajectories=3", "settle_time=2.1"), other)


def plant_near(share: float, runs: dict[str, icl.Followed]) -> Tensor:
    truth = tensor([5.0, 10.0, 15.0, 20.0])
    return truth + share * (runs["integral"].theta[0] - truth)
