"""Configurations composed once per choice of groups are Hydra's own."""

from __future__ import annotations

import json
import math
import pickle

import pytest
from composing import compose
from hydra.core.config_loader import ConfigLoader
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from staf_torch.results.run_record import flat
from staf_torch.settings.plain import PlainSettings
from staf_torch.sweeps.hydra_compat import (
    Composer,
    config_loader,
    find_launcher,
    parse_override,
    sweep_size,
)

JOBS = [
    [],
    ["kernel.length_scale=0.5", "kernel=matern"],
    ["centers=polygon", "centers.radius=0.2", "centers.shrink.offset=0.1"],
    ["experiment=adp", "adp.critic=0.3"],
    ["experiment=adp_three_state", "adp=two_state"],
    ["+note.of=me", "++seed=4", "+tags=[a,b]"],
    ["~certificate", "initial_state=[0.5,-0.5]"],
    ["~target"],
    ["spread=${centers.radius}", "settle_time=${eval:1}"],
    ["kernel={width: 2}", "kernel=gaussian"],
    ["hydra.job.name=other", "hydra.sweep.subdir=x", "seed=1"],
    ["figures='no, thanks'", "duration=1e-3"],
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
    expected = loader.load_configuration("config", ["dt=0.02", *job], RunMode.RUN)
    first, again = (composer.whole(["dt=0.02", *job]) for _ in range(2))
    for found in (first, again):
        assert written(found) == written(expected)
        for flag in (OmegaConf.is_struct, OmegaConf.is_readonly):
            assert [flag(one) for one in (found, found.hydra, found.hydra.runtime)] == [
                flag(one) for one in (expected, expected.hydra, expected.hydra.runtime)
            ]
    first.seed = 99
    assert again.seed == composer(["dt=0.02", *job]).seed == expected.seed


@pytest.mark.parametrize(
    ("line", "mode"),
    [
        ("kernel=matern,gaussian centers.radius=0.1,0.2 target=cosine seed=1,2", RunMode.MULTIRUN),
        ("experiment=ablation hydra.mode=MULTIRUN", RunMode.MULTIRUN),
        ("experiment=ablation hydra.mode=MULTIRUN", RunMode.RUN),
        (
            "hydra.sweep.dir=here hydra.launcher.batch=3 hydra.launcher.executor=process seed=range(3)",
            RunMode.MULTIRUN,
        ),
        ("hydra/launcher=basic +hydra.job.env_set.A=7 +note=a,b", RunMode.RUN),
    ],
)
def test_the_configuration_of_a_sweep_is_the_one_that_hydra_composes(
    line: str, mode: RunMode, loader: ConfigLoader, composer: Composer
) -> None:
    words = line.split()
    if mode == RunMode.RUN:
        words = [word for word in words if "," not in word and "range" not in word]
    expected = loader.load_configuration("config", words, mode)
    for _ in range(2):
        found = composer.load_configuration("config", words, mode)
        assert written(found) == written(expected)
        assert found.hydra.mode == expected.hydra.mode
        assert OmegaConf.is_readonly(found.hydra) == OmegaConf.is_readonly(expected.hydra)


def test_jobs_of_other_launchers_have_the_configuration_that_hydra_composes(
    loader: ConfigLoader, composer: Composer
) -> None:
    lines = ["seed=1,2", "kernel=matern,gaussian", "hydra.sweep.dir=here", "hydra/launcher=basic"]
    master = loader.load_configuration("config", lines, RunMode.MULTIRUN)
    for job in (["seed=1", "kernel=matern"], ["seed=2", "kernel=gaussian"]):
        expected, found = (each.load_sweep_config(master, job) for each in (loader, composer))
        assert written(found) == written(expected)


@pytest.mark.parametrize("line", ["seed=1,2", "hydra.launcher.batch=1,2", "kernle=a"])
def test_a_sweep_is_refused_where_a_run_was_asked_for(
    line: str, loader: ConfigLoader, composer: Composer
) -> None:
    mode = RunMode.MULTIRUN if line.startswith("hydra") else RunMode.RUN
    with pytest.raises(HydraException) as expected:
        loader.load_configuration("config", [line], mode)
    with pytest.raises(type(expected.value)) as found:
        composer.load_configuration("config", [line], mode)
    assert str(found.value) == str(expected.value)


SAME_KEYS = [
    ["kernel=matern", "kernel.length_scale=0.5", "seed=3", "initial_state=[1,2]"],
    ["kernel=matern", "kernel.length_scale=0.7", "seed=3", "initial_state=[3]"],
    ["kernel=matern", "kernel.length_scale=0.7", "seed=null", "initial_state=none"],
    ["seed=3", "++seed=4", "spread=2"],
    ["seed=4", "++seed=5", "spread=2"],
    ["centers.shrink={offset: 1}", "seed=1"],
    ["centers.shrink={gain: 2}", "seed=1"],
    ["spread=${centers.radius}", "centers.radius=0.1"],
    ["spread=${seed}", "centers.radius=0.1"],
    ["centers.shrink=null", "seed=1"],
    ["centers.shrink.offset=3", "seed=1"],
]


def test_a_configuration_holds_nothing_of_those_composed_before(
    loader: ConfigLoader, composer: Composer
) -> None:
    for job in SAME_KEYS:
        line = ["dt=0.02", "trajectories=2", *job]
        expected = OmegaConf.to_container(loader.load_configuration("config", line, RunMode.RUN))
        found = composer.whole(line)
        assert pickle.dumps(OmegaConf.to_container(found)) == pickle.dumps(expected), job
        del expected["hydra"]
        found = composer(line)
        assert pickle.dumps(OmegaConf.to_container(found)) == pickle.dumps(expected), job
        OmegaConf.update(found, "seed", 77, force_add=True)


@pytest.mark.parametrize(
    "line",
    ["kernle=gaussian", "centers.raduis=1", "kernel=nope", "seed=1,2", "~nothing", "+seed=1", "seed=[1"],
)
def test_what_hydra_refuses_is_refused_in_its_words(
    line: str, loader: ConfigLoader, composer: Composer
) -> None:
    with pytest.raises(HydraException) as expected:
        loader.load_configuration("config", [line], RunMode.RUN)
    for _ in range(2):
        with pytest.raises(type(expected.value)) as found:
            composer([line])
        assert str(found.value) == str(expected.value)


def test_settings_are_flat_and_resolved() -> None:
    (cfg,) = compose([], [["spread=${centers.radius}", "centers.radius=0.3"]])
    settings = flat(cfg)
    assert settings["spread"] == settings["centers.radius"] == 0.3
    assert settings["centers.shrink.offset"] is None
    assert settings["initial_state"] == [1.0, 0.0]
    assert not any(name.startswith("hydra") for name in settings)


@pytest.mark.parametrize(
    ("lines", "size"),
    [
        ([], 1),
        (["a=1,2,3", "b=x"], 3),
        (["a=1,2,3", "b=range(2,7)"], 15),
        (["a=range(0,1,0.3)"], 4),
        (["a=range(5,0,-2)"], 3),
        (["a=range(0,5,-1)"], 0),
        (["a=range(1,2,0)"], math.inf),
        (["a=interval(0,1)"], 1),
        (["a=choice(x,y)"], 2),
        (["a=shuffle(range(0,1e12))"], 1e12),
        (["a=range(1000000000)", "b=1,2"], 2e9),
    ],
)
def test_the_size_of_a_sweep_is_counted_and_not_written_out(lines: list[str], size: float) -> None:
    assert sweep_size([parse_override(line) for line in lines]) == size


def test_plain_settings_are_those_of_hydra_and_nothing_that_refers_to_another_is_plain(
    composer: Composer,
) -> None:
    lines = [
        ["dt=0.02", "trajectories=2", *job] for job in (*SAME_KEYS, *JOBS[:-2], ["seed=5", "spread=2.0"])
    ]
    many, flats = composer.many(lines)
    plain = []
    for line, found, by_key, cfg in zip(lines, many.read(), flats, many, strict=True):
        expected = composer(line)
        assert json.dumps(by_key) == json.dumps(flat(expected)), line
        assert cfg == expected
        assert OmegaConf.is_struct(cfg)
        if isinstance(found, PlainSettings):
            plain.append(line[2:])
            assert json.dumps(found) == json.dumps(OmegaConf.to_container(expected)), line
    assert [job for job in SAME_KEYS if job not in plain] == [*SAME_KEYS[3:5], *SAME_KEYS[7:9]]
    assert many[-1] == composer(lines[-1])
    assert many.of([2, 0])[1] == composer(lines[0])
    with pytest.raises(HydraException):
        composer.many([["seed=1"], ["sead=1"]])
