"""`staf-export`, called in process."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from composing import settings
from omegaconf import OmegaConf

from staf_torch import deploy
from staf_torch.cli.deployable import deployable
from staf_torch.cli.export import export, export_learning, main
from staf_torch.deploy.c_header import runner_c
from staf_torch.experiments.registry import experiment

needs_cc = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "g++", "clang"))), reason="no C compiler"
)
RUNS = {
    "chase": ["centers.count=6", "duration=0.1", "trajectories=2"],
    "actor": ["experiment=adp", "duration=0.1", "dt=0.005", "trajectories=2", "adp.trust=0.5"],
    "lqr": ["experiment=adp", "duration=0.1", "dt=0.01", "adp/policy=lqr", "system=pendulum"],
    "guarded": [
        *("experiment=adp", "adp/basis=quadratic", "duration=0.1", "dt=0.01", "initial_state=[-1.0,0.0]"),
        "adp.walls.high=[null,0.05]",
    ],
    "rollout": ["experiment=adp", "duration=0.1", "dt=0.01", "adp/policy=rollout", "adp.rollout.steps=1"],
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for name, overrides in RUNS.items():
        cfg = settings("figures=false", *overrides)
        (folder / name / ".hydra").mkdir(parents=True)
        OmegaConf.save(cfg, folder / name / ".hydra" / "config.yaml")
        experiment(cfg.task)(cfg, folder / name)
    return folder


@pytest.fixture
def chase(runs: Path, tmp_path: Path) -> Path:
    """A copy of the chase that a test may spoil."""
    return Path(shutil.copytree(runs / "chase", tmp_path / "chase"))


@needs_cc
def test_a_learner_as_c_follows_its_run_and_what_does_not_learn_is_refused(
    runs: Path, tmp_path: Path
) -> None:
    page = export_learning(runs / "actor", output=tmp_path / "learner.h", row=1, calls=20)
    assert page["equality"]["u"] < 1e-12
    assert [port["name"] for port in page["inputs"]] == ["x", "uniform"]
    text = (tmp_path / "learner.h").read_text()
    assert "staf_start(staf_state *" in text
    assert (tmp_path / "learner.h.md").exists()
    with pytest.raises(ValueError, match=r"`staf-export\(learning=...\)` must be left away"):
        export_learning(runs / "lqr", calls=20)
    with pytest.raises(SystemExit, match="must go with --to c"):
        main([str(runs / "actor"), "--to", "pt2", "--learning"])
    with pytest.raises(SystemExit, match="must be 1 for a controller that learns"):
        main([str(runs / "actor"), "--to", "c", "--learning", "--batch", "2"])


@pytest.mark.parametrize(("name", "row"), [("chase", 1), ("actor", 1), ("lqr", 0)])
def test_exported_program_computes_what_the_run_recorded(
    name: str, row: int, runs: Path, tmp_path: Path
) -> None:
    path = tmp_path / "it.pt2"
    page = export(runs / name, "pt2", output=path, row=row, calls=20)
    program, note = deploy.load_program(path)
    with np.load(runs / name / "history.npz") as history:
        state, names = torch.from_numpy(history["state"][row]), ("value", "gradient")
        wanted = history["estimate"][row, -1] if name == "chase" else None
    found = program.module()(state[-1:])
    if wanted is not None:
        np.testing.assert_allclose(float(found[0]), wanted, rtol=1e-10)
    assert note["version"] == page["version"]
    assert list(page["equality"]) == (list(names) if name == "chase" else ["control"])
    assert max(page["equality"].values()) <= 1e-12
    assert max(page["float32_error"].values()) <= 1e-5
    late = page["latency"]
    assert 0 < late["median_us"] <= late["p99_us"] <= late["worst_us"]
    assert page["inputs"][0]["unit"] == ("rad, rad/s" if name == "lqr" else "1")
    assert json.loads((tmp_path / "it.pt2.json").read_text()) == page
    assert f"| flops | {page['work']['flops']}," in (tmp_path / "it.pt2.md").read_text()


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
def test_controller_of_every_policy_is_rebuilt_and_reproduces_its_run(name: str, runs: Path) -> None:
    found = deployable(runs / name)
    out = found.module(torch.float64)(found.points[:4])
    assert all(torch.isfinite(part).all() for part in (out if isinstance(out, tuple) else (out,)))


def test_run_that_this_version_does_not_reproduce_is_refused(chase: Path) -> None:
    with np.load(chase / "history.npz") as history:
        arrays = dict(history)
    arrays["estimate"] = arrays["estimate"] + 1e-3
    np.savez(chase / "history.npz", **arrays)
    with pytest.raises(ValueError, match=r"cannot be reproduced.*Another version of staf_torch wrote it"):
        export(chase, "pt2")
    arrays["estimate"] = arrays["estimate"] * np.nan
    np.savez(chase / "history.npz", **arrays)
    with pytest.raises(ValueError, match="must be a trajectory that did not diverge"):
        export(chase, "pt2")
    assert not (chase / "export").exists()


def test_settings_of_another_version_are_refused_and_say_which(chase: Path) -> None:
    cfg = OmegaConf.load(chase / ".hydra" / "config.yaml")
    del cfg["settle_time"]
    OmegaConf.save(cfg, chase / ".hydra" / "config.yaml")
    (chase / "run.json").write_text('{"version": "0.0.1"}')
    with pytest.raises(
        ValueError, match=r"written by staf_torch 0\.0\.1, whose settings .* does not understand"
    ):
        export(chase, "pt2")


@pytest.mark.parametrize(
    "target", ["os.system", "staf_torch.cli.staf.os.system", "staf_torch.settings.chase.load"]
)
def test_foreign_code_in_the_settings_is_not_run(target: str, chase: Path) -> None:
    cfg = OmegaConf.load(chase / ".hydra" / "config.yaml")
    cfg.target = {"_target_": target, "path": "os.getcwd"}
    OmegaConf.save(cfg, chase / ".hydra" / "config.yaml")
    with pytest.raises(ValueError, match=r"which may run code of somebody else: add --trust"):
        export(chase, "pt2")


def test_pickled_history_is_refused(chase: Path) -> None:
    np.savez(chase / "history.npz", state=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ValueError, match="cannot be read: state holds no numbers"):
        export(chase, "pt2")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"to": "no"}, r"`staf-export\(to=...\)` must be one of"),
        ({"dtype": "no"}, r"`staf-export\(dtype=...\)` must be one of"),
        ({"row": -1}, r"`staf-export\(row=...\)` must be at least 0; got -1"),
    ],
)
def test_arguments_of_the_function_are_refused_by_name(
    given: dict[str, object], words: str, chase: Path
) -> None:
    with pytest.raises(ValueError, match=words):
        export(chase, **{"to": "pt2", **given})  # type: ignore[arg-type]
    if "dtype" in given:
        with pytest.raises(ValueError, match=words):
            export_learning(chase, **given)  # type: ignore[arg-type]


def test_weights_and_settings_that_are_none_are_refused(chase: Path) -> None:
    with np.load(chase / "history.npz") as archive:
        history = dict(archive)
    history["weights"][0, -1] = np.nan
    np.savez(chase / "history.npz", **history)
    with pytest.raises(ValueError, match="must be a trajectory whose weights can be represented"):
        export(chase, "pt2")
    (chase / ".hydra" / "config.yaml").write_text("[]")
    with pytest.raises(ValueError, match="must be settings by name"):
        export(chase, "pt2")
    with pytest.raises(ValueError, match=r"must hold settings in \.hydra/config.yaml"):
        export(chase, "pt2", trust=True)


def test_bad_arguments_end_as_one_sentence(chase: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        ([str(chase), "--row", "2"], "must be below the run's 2 trajectories; got 2"),
        ([str(chase.parent)], "must be a run directory"),
    ):
        with pytest.raises(SystemExit, match=message) as ended:
            main([*arguments, "--to", "pt2"])
        assert str(ended.value).startswith("staf-export: ")
    (chase / "history.npz").unlink()
    with pytest.raises(SystemExit, match="history=false"):
        main([str(chase), "--to", "pt2"])
    assert capsys.readouterr().out == ""
