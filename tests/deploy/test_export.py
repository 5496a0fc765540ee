"""`staf-export`: a run as a file for a device that computes what the run recorded, or a sentence why not."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from omegaconf import OmegaConf

from staf_torch import __version__, deploy, lanes
from staf_torch.cli.deployable import deployable, learning
from staf_torch.cli.export import export, export_learning, main
from staf_torch.deploy.c_header import runner_c
from staf_torch.experiments.registry import experiment
from staf_torch.lanes.trace import philox

needs_cc = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "g++", "clang"))), reason="no C compiler"
)
RUNS = {
    "chase": ["centers.count=6", "duration=0.1", "trajectories=2"],
    "actor": [
        *("experiment=adp", "duration=0.1", "dt=0.005", "trajectories=2", "adp.trust=0.5"),
        "adp.record_every=2",
    ],
    "lqr": [
        *("experiment=adp", "duration=0.1", "dt=0.01", "adp/policy=lqr", "system=pendulum"),
        "adp.optimum.shooting=false",
    ],
    "guarded": [
        *("experiment=adp", "adp/basis=quadratic", "duration=0.1", "dt=0.01", "initial_state=[-1.0,0.0]"),
        "adp.walls.high=[null,0.05]",
    ],
    "rollout": ["experiment=adp", "duration=0.1", "dt=0.01", "adp/policy=rollout", "adp.rollout.steps=1"],
    "quadrature": ["experiment=adp", "duration=0.05", "dt=0.005", "adp/extrapolation=quadrature"],
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for name, overrides in RUNS.items():
        cfg = settings("figures=false", *overrides)
        (folder / name / ".hydra").mkdir(parents=True)
        OmegaConf.save(cfg, folder / name / ".hydra" / "config.yaml")
        with lanes.compiling("never"):
            experiment(cfg.task)(cfg, folder / name)
    return folder


@pytest.fixture
def changed(runs: Path, tmp_path: Path) -> Callable[..., Path]:
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


@pytest.mark.parametrize(
    ("name", "row", "to"),
    [
        ("chase", 1, "pt2"),
        *(pytest.param(name, row, "c", marks=needs_cc) for name, row in (("lqr", 0), ("actor", 1))),
    ],
)
def test_an_exported_file_computes_what_the_run_recorded(
    name: str, row: int, to: str, runs: Path, tmp_path: Path
) -> None:
    path = tmp_path / "it"
    page = export(runs / name, to, output=path, row=row, calls=20)
    assert list(page["equality"]) == (["value", "gradient"] if name == "chase" else ["control"])
    assert max(page["equality"].values()) <= (1e-12 if to == "pt2" else 1e-9)
    assert max(page["float32_error"].values()) <= 1e-5
    late = page["latency"]
    assert 0 < late["median_us"] <= late["p99_us"] <= late["worst_us"]
    assert (page["version"], page["row"], page["latency"]["calls"]) == (__version__, row, 20)
    assert page["inputs"][0]["unit"] == ("rad, rad/s" if name == "lqr" else "1")
    assert json.loads((tmp_path / "it.json").read_text()) == page
    assert f"| flops | {page['work']['flops']}," in (tmp_path / "it.md").read_text()
    if to == "pt2":
        program, note = deploy.load_program(path)
        assert note["version"] == __version__
        out = program.module()(torch.from_numpy(history(runs / name)["state"][row, -2:]))
        np.testing.assert_allclose(float(out[0][-1]), history(runs / name)["estimate"][row, -1], rtol=1e-10)


@needs_cc
def test_a_controller_that_learns_follows_its_run_in_c(runs: Path, tmp_path: Path) -> None:
    dtype = "float64"
    page = export_learning(runs / "actor", dtype=dtype, output=tmp_path / "learner.h", row=1, calls=20)
    assert page["equality"]["u"] < 1e-12
    assert [port["name"] for port in page["inputs"]] == ["x", "uniform"]
    assert (page["to"], page["dtype"], page["batch"]) == ("c", dtype, 1)
    assert (tmp_path / "learner.h.md").exists()
    assert "actor_1_learner_start(actor_1_learner_state *" in (tmp_path / "learner.h").read_text()


@needs_cc
def test_a_filter_around_a_learned_policy_is_the_same_in_c(runs: Path, tmp_path: Path) -> None:
    page = export(runs / "guarded", "c", output=tmp_path / "guarded.h", calls=20)
    assert page["equality"]["control"] < 1e-9
    guard = deployable(runs / "guarded").module(torch.float64)
    low, high = torch.tensor([-1.0, -0.5]), torch.tensor([1.0, 0.1])  # beyond the wall, too
    generator = torch.Generator().manual_seed(0)
    x = low + (high - low) * torch.rand(500, 2, dtype=torch.float64, generator=generator)
    (control,) = runner_c(tmp_path / "guarded.h", [1], torch.float64)(x)
    torch.testing.assert_close(control, guard(x), rtol=0, atol=1e-9)
    other = (control - guard.policy(x)).abs().amax(-1) > 1e-3
    assert 0.01 < float(other.double().mean()) < 0.9  # the filter acts, and not everywhere
    metrics = json.loads((runs / "guarded" / "metrics.json").read_text())
    assert metrics["wall_constraint_violations"] == 0
    assert metrics["wall_minimum_margin"] > 0


@pytest.mark.parametrize("name", list(RUNS))
def test_a_run_of_every_policy_is_rebuilt_and_compared_over_the_region_that_it_visited(
    name: str, runs: Path
) -> None:
    found, states = deployable(runs / name), history(runs / name)["state"][0]
    points = found.points.numpy()
    assert points.shape == (1000, 2)
    if name == "chase":
        share = np.linalg.norm((points - states[-1]) / 0.1, axis=1) ** 2  # of the disc
        assert found.input.region.startswith("the ball of radius 0.1 around (")
    else:
        share = (points - states.min(0)) / (states.max(0) - states.min(0))
        assert found.input.region.startswith("visited: [")
    assert 0 <= share.min() <= share.max() <= 1 + 1e-9
    for limit in (0.25, 0.5, 0.75):  # evenly spread
        np.testing.assert_allclose((share < limit).mean(0), limit, atol=0.06)
    out = found.module(torch.float64)(found.points[:4])
    assert all(torch.isfinite(part).all() for part in (out if isinstance(out, tuple) else (out,)))
    learns = name in ("actor", "guarded", "quadrature")
    assert found.what.endswith(", 3 actor weights as they were at the end.") == learns


def test_a_learner_sees_the_states_and_random_numbers_of_its_run(runs: Path) -> None:
    row, found = 1, learning(runs / "actor", 1)
    np.testing.assert_allclose(found.states[::2], history(runs / "actor")["state"][row, :-1], rtol=1e-9)
    step = torch.arange(20, dtype=torch.float64)
    drawn = philox.uniform(philox.seed_parts([row], step).expand(20, 4), step, 2)
    assert torch.equal(found.uniform[:, 0], drawn)
    assert (found.dt, found.written_by) == (0.005, None)


@needs_cc
def test_near_optimal_with_bounds_is_exported_with_its_plan_or_as_a_function_of_x(tmp_path: Path) -> None:
    chosen = [
        "adp/policy=near_optimal",
        "adp.policy.reach=local",
        "adp.policy.horizon=0.2",
        "system=pendulum",
    ]
    size = ["+adp.cost.low=-3", "+adp.cost.high=3", "initial_state=[0.02,0.0]", "dt=0.05", "duration=0.1"]
    cfg, run = settings("experiment=adp", "figures=false", *chosen, *size), tmp_path / "class"
    (run / ".hydra").mkdir(parents=True)
    OmegaConf.save(cfg, run / ".hydra" / "config.yaml")
    with lanes.compiling("never"):
        experiment(cfg.task)(cfg, run)
        with pytest.raises(ValueError, match=r"carries a plan .*`--to c` writes it .*`--function`"):
            export(run, "pt2")
        plans = learning(run)  # what `--to c` writes: tests/deploy/test_plans_in_c.py has a header of it
        page = export(run, "c", function=True, calls=20)
    assert not plans.learns
    assert plans.what.endswith("and the plan from there on.")
    assert "without the plans" in page["what"]
    assert page["name"] == "class_run"  # class is no name in C++
    assert "void class_run(const double state[2], double" in (run / "export" / "controller.h").read_text()


# Refusals


@pytest.mark.parametrize(("name", "key"), [("chase", "estimate"), ("actor", "control")])
def test_a_history_that_its_settings_do_not_reproduce_is_refused(
    name: str, key: str, changed: Callable[..., Path], runs: Path
) -> None:
    whole = history(runs / name)[key]
    off = {key: whole + 1e-5 * float(np.nanmax(abs(whole)))}
    reads: list[Callable[[Path], Any]] = [deployable] if name == "chase" else [deployable, learning]
    for read in reads:
        with pytest.raises(ValueError, match=rf"recorded {key} .* cannot be reproduced.*Another version"):
            read(changed(name, off))
        assert read(changed(name, off, dtype="float32")).written_by is None  # it has no more digits
    run = changed(name, {key: whole * np.nan})
    with pytest.raises(ValueError, match="must be a trajectory that did not diverge"):
        export(run, "pt2")
    assert not (run / "export").exists()


def test_settings_of_another_version_are_refused_and_say_which(
    changed: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OC_CAUSE", "1")  # OmegaConf then chains errors in a ring, as in a debugger
    run = changed("chase")
    cfg = OmegaConf.load(run / ".hydra" / "config.yaml")
    del cfg["settle_time"]
    OmegaConf.save(cfg, run / ".hydra" / "config.yaml")
    (run / "run.json").write_text('{"version": "0.0.1"}')
    with pytest.raises(ValueError, match=r"by staf_torch 0\.0\.1, whose settings .* does not understand"):
        export(run, "pt2")


def test_what_is_no_run_of_a_controller_is_refused(changed: Callable[..., Path], runs: Path) -> None:
    weights = history(runs / "chase")["weights"]
    weights[0, -1] = np.nan
    cases: list[tuple[Callable[[], Any], str]] = [
        (lambda: learning(runs / "lqr"), r"`staf-export\(learning=...\)` must be omitted.*'Feedback'"),
        (lambda: learning(runs / "chase"), "must be a run of adp; got 'gradient_chase'"),
        (lambda: deployable(changed("chase", task="laws")), "must be a run of gradient_chase or adp; got"),
        (lambda: deployable(changed("chase", {"weights": weights})), "weights can be represented"),
        (lambda: export(runs / "chase", "no"), r"`staf-export\(to=...\)` must be one of"),
        (lambda: export(runs / "chase", "pt2", dtype="no"), r"`staf-export\(dtype=...\)` must be one of"),
        (lambda: export(runs / "chase", "pt2", row=2), "must be below the run's 2 trajectories; got 2"),
    ]
    for call, said in cases:
        with pytest.raises(ValueError, match=said):
            call()


@needs_cc
def test_a_file_that_differs_from_the_library_is_removed(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "broken-cc"  # a compiler whose exponential is another function
    cc = next(filter(None, map(shutil.which, ("cc", "gcc", "g++", "clang"))))
    broken.write_text(f'#!/bin/sh\nexec {cc} -Dexp=cosh "$@"\n')
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    with pytest.raises(ValueError, match=r"it\.h differs from the library by .* and was removed"):
        export(runs / "chase", "c", output=tmp_path / "new" / "it.h", calls=10)
    assert not list((tmp_path / "new").iterdir())


def test_the_command_ends_with_a_page_or_one_sentence(
    changed: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    run = changed("lqr")
    main([str(run), "--to", "pt2", "--batch", "3", "--calls", "5"])
    assert capsys.readouterr().out == (run / "export" / "controller.pt2.md").read_text()
    assert json.loads((run / "export" / "controller.pt2.json").read_text())["batch"] == 3
    for words, said in (
        ([str(run.parent), "--to", "pt2"], "must be a run directory"),
        ([str(run), "--to", "pt2", "--learning"], "must go with --to c"),
        ([str(run), "--to", "c", "--learning", "--batch", "2"], "must be 1 for a controller that learns"),
    ):
        with pytest.raises(SystemExit, match=said) as ended:
            main(words)
        assert str(ended.value).startswith("staf-export: ")
    (run / "history.npz").unlink()
    with pytest.raises(SystemExit, match="history=false"):
        main([str(run), "--to", "pt2"])
    with pytest.raises(SystemExit, match="2"):
        main(["b", "--to", "no"])
    assert capsys.readouterr().err.startswith("usage: staf-export ")


@pytest.mark.parametrize("linked", ["export", "export/controller.pt2"])
def test_nothing_is_written_through_a_link(linked: str, changed: Callable[..., Path], tmp_path: Path) -> None:
    run, victim = changed("lqr"), tmp_path / "victim"
    victim.mkdir()
    (run / linked).parent.mkdir(exist_ok=True)
    (run / linked).symlink_to(victim if linked == "export" else victim / "file")
    with pytest.raises(ValueError, match="is a link"):
        export(run, "pt2")
    assert list(victim.iterdir()) == []
