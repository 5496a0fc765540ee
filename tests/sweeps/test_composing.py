"""Configurations composed once per choice of groups are Hydra's own."""

from __future__ import annotations

import json
import math
import os
import pickle
import sys
from pathlib import Path

import pytest
from composing import settings as composed
from hydra.core.config_loader import ConfigLoader
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from staf_torch.results.run_record import flat
from staf_torch.settings import config_directory
from staf_torch.settings.plain import PlainSettings
from staf_torch.sweeps.hydra_compat import (
    Composer,
    config_loader,
    find_launcher,
    is_about_settings,
    named_packages,
    parse_override,
    sweep_size,
)
from staf_torch.sweeps.hydra_compat.inside import HAS_WHITELIST

JOBS = [
    ["kernel.length_scale=0.5", "kernel=matern"],
    ["experiment=adp_three_state", "adp=two_state"],
    [
        "+note.of=me",
        "++seed=4",
        "+tags=[a,b]",
        "~target",
        "spread=${centers.radius}",
        "settle_time=${eval:1}",
    ],
    ["kernel={width: 2}", "kernel=gaussian", "hydra.job.name=other", "figures='no, thanks'", "dt=1e-3"],
]


@pytest.fixture(scope="module")
def loader() -> ConfigLoader:
    find_launcher()  # also where the package is on the path and not installed
    return config_loader()


@pytest.fixture(scope="module")
def composer(loader: ConfigLoader) -> Composer:
    """One for all tests: what it keeps of one configuration is no part of another."""
    return Composer(loader)


def written(cfg: DictConfig) -> str:
    """All of a configuration, in order, types and what refers to another as they are."""
    return repr(OmegaConf.to_container(cfg))


@pytest.mark.parametrize("job", JOBS, ids=" ".join)
def test_a_configuration_is_the_one_that_hydra_composes(
    job: list[str], loader: ConfigLoader, composer: Composer
) -> None:
    expected = loader.load_configuration("config", job, RunMode.RUN)
    first, again = (composer.whole(job) for _ in range(2))
    for found in (first, again):
        assert written(found) == written(expected)
        for flag in (OmegaConf.is_struct, OmegaConf.is_readonly):
            assert [flag(one) for one in (found, found.hydra, found.hydra.runtime)] == [
                flag(one) for one in (expected, expected.hydra, expected.hydra.runtime)
            ]
    first.seed = 99
    assert again.seed == composer(job).seed == expected.seed


SWEEPS = [
    ("kernel=matern,gaussian centers.radius=0.1,0.2 target=cosine seed=1,2", RunMode.MULTIRUN),
    ("experiment=ablation hydra.mode=MULTIRUN hydra/launcher=basic +hydra.job.env_set.A=7", RunMode.RUN),
]


@pytest.mark.parametrize(("line", "mode"), SWEEPS)
def test_the_configuration_of_a_sweep_is_the_one_that_hydra_composes(
    line: str, mode: RunMode, loader: ConfigLoader, composer: Composer
) -> None:
    expected = loader.load_configuration("config", line.split(), mode)
    for _ in range(2):
        found = composer.load_configuration("config", line.split(), mode)
        assert written(found) == written(expected)
        assert found.hydra.mode == expected.hydra.mode
        assert OmegaConf.is_readonly(found.hydra) == OmegaConf.is_readonly(expected.hydra)


def test_jobs_of_other_launchers_have_the_configuration_that_hydra_composes(
    loader: ConfigLoader, composer: Composer
) -> None:
    lines = ["seed=1,2", "kernel=matern,gaussian", "hydra.sweep.dir=here", "hydra/launcher=basic"]
    master = loader.load_configuration("config", lines, RunMode.MULTIRUN)
    expected, found = (
        each.load_sweep_config(master, ["seed=1", "kernel=matern"]) for each in (loader, composer)
    )
    assert written(found) == written(expected)


SAME_KEYS = [
    ["kernel=matern", "kernel.length_scale=0.5", "seed=3", "initial_state=[1,2]"],
    ["kernel=matern", "kernel.length_scale=0.7", "seed=null", "initial_state=none"],
    ["seed=3", "++seed=4", "spread=2"],
    ["centers.shrink={offset: 1}", "seed=1"],
    ["centers.shrink.offset=3", "seed=1"],
    ["spread=${seed}", "centers.radius=0.1"],
]


def test_a_configuration_holds_nothing_of_those_composed_before(
    loader: ConfigLoader, composer: Composer
) -> None:
    for job in SAME_KEYS:
        expected = OmegaConf.to_container(loader.load_configuration("config", job, RunMode.RUN))
        found = composer.whole(job)
        assert pickle.dumps(OmegaConf.to_container(found)) == pickle.dumps(expected), job
        del expected["hydra"]
        found = composer(job)
        assert pickle.dumps(OmegaConf.to_container(found)) == pickle.dumps(expected), job
        OmegaConf.update(found, "seed", 77, force_add=True)


@pytest.mark.parametrize(
    ("line", "mode"),
    [
        ("kernle=gaussian", RunMode.RUN),
        ("kernel=nope", RunMode.RUN),
        ("seed=1,2", RunMode.RUN),  # a sweep where a run was asked for
        ("hydra.launcher.batch=1,2", RunMode.MULTIRUN),
        ("seed=[1", RunMode.RUN),
    ],
)
def test_what_hydra_refuses_is_refused_in_its_words(
    line: str, mode: RunMode, loader: ConfigLoader, composer: Composer
) -> None:
    with pytest.raises(HydraException) as expected:
        loader.load_configuration("config", [line], mode)
    with pytest.raises(type(expected.value)) as found:
        composer.load_configuration("config", [line], mode)
    assert str(found.value) == str(expected.value)


def test_settings_are_flat_and_resolved() -> None:
    settings = flat(composed("spread=${centers.radius}", "centers.radius=0.3"))
    assert settings["spread"] == settings["centers.radius"] == 0.3
    assert settings["centers.shrink.offset"] is None
    assert settings["initial_state"] == [1.0, 0.0]
    assert not any(name.startswith("hydra") for name in settings)


@pytest.mark.parametrize(
    ("lines", "size"),
    [
        ([], 1),
        (["a=1,2,3", "b=x", "c=range(2,7)"], 15),
        (["a=range(0,1,0.3)", "b=choice(x,y)"], 8),
        (["a=range(5,0,-2)", "b=interval(0,1)"], 3),
        (["a=range(0,5,-1)"], 0),
        (["a=range(1,2,0)"], math.inf),
        (["a=shuffle(range(0,1e12))"], 1e12),
    ],
)
def test_the_size_of_a_sweep_is_counted_and_not_written_out(lines: list[str], size: float) -> None:
    assert sweep_size([parse_override(line) for line in lines]) == size


def test_plain_settings_are_those_of_hydra_and_nothing_that_refers_to_another_is_plain(
    composer: Composer,
) -> None:
    lines = [*SAME_KEYS, *JOBS[:-1], ["seed=5", "spread=2.0"]]
    many, flats = composer.many(lines)
    plain = []
    for line, found, by_key, cfg in zip(lines, many.read(), flats, many, strict=True):
        expected = composer(line)
        assert json.dumps(by_key) == json.dumps(flat(expected)), line
        assert cfg == expected
        assert OmegaConf.is_struct(cfg)
        if isinstance(found, PlainSettings):
            plain.append(line)
            assert json.dumps(found) == json.dumps(OmegaConf.to_container(expected)), line
    assert [job for job in SAME_KEYS if job not in plain] == [SAME_KEYS[2], SAME_KEYS[5]]
    assert many[-1] == composer(lines[-1])
    assert many.of([2, 0])[1] == composer(lines[0])
    with pytest.raises(HydraException):
        composer.many([["seed=1"], ["sead=1"]])


# What a command line means to Hydra 1.3 and to 1.4


def test_packages_are_those_that_a_command_line_or_its_folder_names(tmp_path: Path) -> None:
    (tmp_path / "kernel.yaml").write_text("_target_: größe.kernels.Narrow\nwidth: 1.0\npath: ./a.b\n")
    own = "target._target_=mine.targets.Wave"
    line = [own, "kernel.path=other.thing", "dt=0.1", "--config-dir", str(tmp_path)]
    found = named_packages(line), named_packages(line[:3]), named_packages(["dt=0.1", "-m"])
    if HAS_WHITELIST:
        assert found == (["größe", "mine", "other"], ["mine", "other"], [])
    else:
        assert found == ([], [], [])  # Hydra 1.3 trusts all


def test_what_only_shows_something_and_what_is_wrong_is_left_to_hydra() -> None:
    for line in ("", "-m seed=1,2", "--config-dir here"):
        assert not is_about_settings(line.split())
    for line in ("--cfg job", "--help", "--run --multirun", "--nope"):
        assert is_about_settings(line.split())


def test_files_of_experiments_alone_set_the_mode_and_none_includes_another() -> None:
    for file in Path(config_directory()).rglob("*.yaml"):
        settings = OmegaConf.load(file)
        if file.parent.name == "experiment":
            for entry in settings.get("defaults", []):
                assert "experiment" not in str(entry), file
        else:
            assert OmegaConf.select(settings, "hydra.mode") is None, file
            assert "mode" not in settings or "hydra" not in file.parts, file


def test_the_plugin_of_the_package_goes_before_any_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.environ.get("PYTHONPATH", ""))
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if Path(entry).name != "plugins"])
    for _ in range(2):
        find_launcher()
        assert Path(sys.path[0], "hydra_plugins", "staf_batched.py").is_file()
        assert [Path(entry).name for entry in sys.path].count("plugins") == 1
