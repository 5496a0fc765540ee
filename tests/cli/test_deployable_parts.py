"""What `staf-export` builds of a run: its row and time, points of its region, how near is near enough."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from composing import settings
from omegaconf import OmegaConf

from staf_torch.adp import simulate
from staf_torch.cli import deployable as exported
from staf_torch.cli.deployable import Deployable, deployable, learning
from staf_torch.deploy.sheet import Port
from staf_torch.experiments.registry import experiment
from staf_torch.settings.adp import adp_problem

LOOPS = {
    "learner": ["experiment=adp", "duration=0.05", "dt=0.005", "trajectories=2", "adp.record_every=2"],
    "quadrature": [
        "experiment=adp",
        "duration=0.05",
        "dt=0.005",
        "adp/extrapolation=quadrature",
        "adp.integrator=euler",
    ],
    "lqr": ["experiment=adp", "duration=0.1", "dt=0.01", "adp/policy=lqr", "system=pendulum"],
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for name, overrides in {"chase": ["centers.count=6", "duration=0.1", "trajectories=2"], **LOOPS}.items():
        cfg = settings("figures=false", *overrides)
        (folder / name / ".hydra").mkdir(parents=True)
        OmegaConf.save(cfg, folder / name / ".hydra" / "config.yaml")
        if name == "chase":
            experiment(cfg.task)(cfg, folder / name)
            continue
        problem = adp_problem(cfg)
        loop = (problem.controller, problem.system, problem.cost, problem.initial_states)
        more = {"dt": problem.dt, "steps": problem.steps, "every": problem.every, "seed": problem.seed}
        found = simulate(*loop, **more, integrator=problem.integrator, compile=False)
        arrays = {each: getattr(found, each).numpy() for each in ("state", "control", "actor_weights")}
        np.savez(folder / name / "history.npz", **arrays)
    return folder


@pytest.fixture
def copy(runs: Path, tmp_path: Path) -> Callable[..., Path]:
    """Copy a run, with settings, or arrays of its history, that a test changes."""

    def made(name: str, arrays: dict[str, np.ndarray] | None = None, **changes: object) -> Path:
        run = Path(shutil.copytree(runs / name, tmp_path / name, dirs_exist_ok=True))
        cfg = OmegaConf.load(runs / name / ".hydra" / "config.yaml")
        cfg.update(changes)
        OmegaConf.save(cfg, run / ".hydra" / "config.yaml")
        np.savez(run / "history.npz", **{**history(runs / name), **(arrays or {})})
        return run

    return made


def history(run: Path) -> dict[str, np.ndarray]:
    with np.load(run / "history.npz") as found:
        return dict(found)


def test_points_of_an_approximator_fill_the_ball_around_the_last_state(runs: Path) -> None:
    for row in (0, 1):
        found, x = deployable(runs / "chase", row), history(runs / "chase")["state"][row, -1]
        away = (found.points.numpy() - x) / 0.1
        lengths = np.linalg.norm(away, axis=1)
        assert found.points.shape == (1000, 2)
        assert found.points.dtype == torch.float64
        assert lengths.max() < 1 + 1e-9
        # Shares of the area within a radius, and within each quarter, are those of points spread evenly.
        for radius in (0.25, 0.5, 0.75):
            assert abs((lengths < radius).mean() - radius**2) < 0.06
        for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            assert abs((away * signs > 0).all(1).mean() - 0.25) < 0.06
        where = ", ".join(f"{each:.6g}" for each in x)
        assert found.input == Port("state", 2, "1", f"the ball of radius 0.1 around ({where})")
        value, gradient = found.module(torch.float64)(torch.from_numpy(x)[None])
        assert float(value) == pytest.approx(history(runs / "chase")["estimate"][row, -1], rel=1e-9)
        assert gradient.shape == (1, 2)
    assert [port.size for port in found.outputs] == [None, 2]
    assert found.kind == "approximator"
    assert "6 centers of ExponentialKernel" in found.what


def test_points_of_a_controller_fill_the_box_that_its_run_visited(runs: Path) -> None:
    for name, row in (("learner", 1), ("lqr", 0)):
        found, states = deployable(runs / name, row), history(runs / name)["state"][row]
        low, high = states.min(0), states.max(0)
        share = (found.points.numpy() - low) / (high - low)
        assert found.points.shape == (1000, 2)
        assert share.min() >= 0
        assert share.max() <= 1
        for limit in (0.25, 0.5, 0.75):
            np.testing.assert_allclose((share < limit).mean(0), limit, atol=0.06)
        box = " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(low, high, strict=True))
        assert found.input.region == f"visited: {box}"
        assert (found.kind, found.input.size, found.outputs[0].size) == ("controller", 2, 1)
    assert found.input.unit == "rad, rad/s"
    learned = deployable(runs / "learner").what
    assert learned.endswith(", 3 actor weights as they were at the end.")
    assert "weights" not in found.what
    assert found.outputs[0].region == "to be held for 0.01 s"


@pytest.mark.parametrize("name", ["chase", "learner"])
def test_points_are_drawn_alike_every_time_and_row_zero_is_the_default(name: str, runs: Path) -> None:
    first = deployable(runs / name, 0)
    torch.manual_seed(5)
    state = torch.get_rng_state()
    assert torch.equal(deployable(runs / name).points, first.points)
    assert torch.equal(torch.get_rng_state(), state)


def test_a_controller_has_the_weights_of_the_last_time(copy: Callable[..., Path]) -> None:
    weights = history(copy("learner"))["actor_weights"]
    weights[:, -1] = 0.0
    run = copy("learner", {"actor_weights": weights})
    found = deployable(run)
    assert torch.equal(found.module(torch.float64)(found.points), torch.zeros(1000, 1, dtype=torch.float64))
    weights[:, -2] += 1e-3  # with which the last control that was recorded was computed
    with pytest.raises(ValueError, match="The recorded control of this run cannot be reproduced"):
        deployable(copy("learner", {"actor_weights": weights}))


@pytest.mark.parametrize("row", [0, 1])
def test_a_learner_follows_the_first_steps_of_its_run(
    row: int, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for most, steps in ((7, 6), (1, 2)):
        monkeypatch.setattr(exported, "_FOLLOWED", most)
        found = learning(runs / "learner", row)
        assert found.states.shape == (steps, 2)
        np.testing.assert_allclose(
            found.states[::2], history(runs / "learner")["state"][row, : steps // 2], 1e-9
        )
        generator = torch.Generator().manual_seed(row)
        drawn = torch.empty(steps, 1, 2, dtype=torch.float64).uniform_(-1, 1, generator=generator)
        assert torch.equal(found.uniform, drawn)
    assert found.inputs[0] == Port("x", 2, "1", "as the weights have learned it")
    assert found.inputs[1].size == 2
    assert found.outputs == (Port("u", 1, "1", "to be held for 0.005 s"),)
    assert (found.dt, found.written_by) == (0.005, None)
    assert torch.equal(learning(runs / "learner").states, learning(runs / "learner", 0).states)


def test_a_learner_without_random_numbers_asks_for_none(runs: Path) -> None:
    found = learning(runs / "quadrature")
    assert [port.name for port in found.inputs] == ["x"]
    assert found.uniform.shape == (10, 0, 2)
    np.testing.assert_allclose(found.states, history(runs / "quadrature")["state"][0, :10], 1e-9)


def test_what_does_not_learn_or_is_no_such_run_is_refused(copy: Callable[..., Path], runs: Path) -> None:
    with pytest.raises(ValueError, match=r"`staf-export\(learning=...\)` must be left away.*'Feedback'"):
        learning(runs / "lqr")
    with pytest.raises(ValueError, match="must be a run of adp; got 'gradient_chase'"):
        learning(runs / "chase")
    with pytest.raises(ValueError, match="must be a run of gradient_chase or adp; got 'laws'"):
        deployable(copy("chase", task="laws"))
    foreign = copy("learner", kernel={"_target_": "os.getcwd"})
    for read in (deployable, learning):
        with pytest.raises(ValueError, match="add --trust"):
            read(foreign)
        with pytest.raises(ValueError, match="must be a Kernel; got '/"):
            read(foreign, trust=True)  # called, and none


@pytest.mark.parametrize("name", ["chase", "learner"])
def test_a_history_that_differs_from_its_settings_is_refused(name: str, copy: Callable[..., Path]) -> None:
    key = "estimate" if name == "chase" else "control"
    whole = history(copy(name))[key]
    change = 1e-5 * float(np.nanmax(abs(whole)))
    changed = copy(name, {key: whole + change})
    reads = [deployable] if name == "chase" else [deployable, learning]
    for read in reads:
        with pytest.raises(ValueError, match=f"The recorded {key} of this run cannot be reproduced"):
            read(changed)
    changed = copy(name, {key: whole + change}, dtype="float32")
    for read in reads:
        assert read(changed).written_by is None  # a run in single precision has no more digits


@pytest.mark.parametrize("record", [None, {}, {"version": "0.0.1"}])
def test_who_wrote_a_run_is_said_where_it_is_known(record: object, copy: Callable[..., Path]) -> None:
    run = copy("learner")
    if record is not None:
        (run / "run.json").write_text(json.dumps(record))
    wanted = "0.0.1" if record else None
    assert deployable(run).written_by == wanted
    assert learning(run).written_by == wanted


@pytest.mark.parametrize(("precise", "least"), [(True, 1e-8), (False, 1e-3)])
def test_numbers_are_compared_with_the_largest_of_them(precise: bool, least: float) -> None:
    for recorded, size in (([2.0, -4.0], 4.0), ([1e-5, 0.0], 1e-3)):
        wanted = np.array(recorded)
        for sign in (1, -1):
            off = sign * least * size * np.array([0.0, 1.0])
            exported._reproduced("value", torch.from_numpy(wanted + 0.9 * off), wanted, precise)
            with pytest.raises(ValueError, match=r"differs by (1\.1e-|0\.0011)"):
                exported._reproduced("value", torch.from_numpy(wanted + 1.1 * off), wanted, precise)


def test_a_history_has_times_and_states_and_so_many_numbers(
    copy: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = copy("chase")
    monkeypatch.setattr(exported, "_MOST_NUMBERS", 11 * 6)  # weights of all times
    assert isinstance(deployable(run), Deployable)
    monkeypatch.setattr(exported, "_MOST_NUMBERS", 11 * 6 - 1)
    with pytest.raises(ValueError, match=r"has \(2, 11, 6\) numbers of weights"):
        deployable(run)
    monkeypatch.undo()
    with pytest.raises(ValueError, match=r"has \(2,\) numbers of estimate"):
        deployable(copy("chase", {"estimate": np.zeros(2)}))
    with pytest.raises(ValueError, match=r"has \(\) numbers of state"):
        deployable(copy("chase", {"state": np.zeros(())}))
    np.savez(run / "history.npz", weights=np.zeros((2, 11, 6)))
    with pytest.raises(ValueError, match="has no states"):
        deployable(run)
