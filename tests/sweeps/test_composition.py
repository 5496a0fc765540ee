"""Configurations composed once per choice of groups are Hydra's own."""

from __future__ import annotations

import pickle

import pytest
from composing import compose
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import OmegaConf

from staf_torch.results.run_record import flat
from staf_torch.sweeps.hydra_compat import Composer, config_loader

JOBS = [
    [],
    ["seed=3"],
    ["kernel=matern", "kernel.length_scale=0.5"],
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


@pytest.mark.parametrize("job", JOBS, ids=" ".join)
def test_a_configuration_is_the_one_that_hydra_composes(job: list[str]) -> None:
    loader = config_loader()
    expected = loader.load_configuration("config", ["dt=0.02", *job], RunMode.RUN)
    composer = Composer(loader)
    first, again = (composer(["dt=0.02", *job]) for _ in range(2))
    for found in (first, again):
        assert OmegaConf.to_yaml(found) == OmegaConf.to_yaml(expected)
        assert pickle.dumps(OmegaConf.to_container(found)) == pickle.dumps(OmegaConf.to_container(expected))
        assert OmegaConf.is_struct(found)
        assert not OmegaConf.is_readonly(found)
        assert found.hydra.runtime._metadata.flags == expected.hydra.runtime._metadata.flags
    first.seed = 99
    assert again.seed == expected.seed


def test_only_the_choices_of_groups_are_composed(monkeypatch: pytest.MonkeyPatch) -> None:
    composer = Composer(config_loader(), hydra_node=False)
    loaded: list[object] = []
    load = composer.anew
    monkeypatch.setattr(composer, "anew", lambda lines: loaded.append(lines) or load(lines))
    found = [composer([f"kernel={k}", f"seed={s}"]) for k in ("gaussian", "matern") for s in range(3)]
    assert loaded == [("kernel=gaussian",), ("kernel=matern",)]
    assert [cfg.seed for cfg in found] == [0, 1, 2, 0, 1, 2]
    assert "hydra" not in found[0]


@pytest.mark.parametrize(
    "line",
    ["kernle=gaussian", "centers.raduis=1", "kernel=nope", "seed=1,2", "~nothing", "+seed=1", "seed=[1"],
)
def test_what_hydra_refuses_is_refused_in_its_words(line: str) -> None:
    loader = config_loader()
    with pytest.raises(HydraException) as expected:
        loader.load_configuration("config", [line], RunMode.RUN)
    composer = Composer(loader)
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
