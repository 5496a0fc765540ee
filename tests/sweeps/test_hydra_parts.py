"""What stands for parts of Hydra, one by one: a job's directory, broken sweeps, the log, plugins, sizes."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import logging
import math
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobStatus
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from staf_torch.settings import config_directory
from staf_torch.sweeps.hydra_compat import (
    Composer,
    SweepContext,
    breaking_off,
    broken_sweep,
    config_loader,
    directory_of,
    parse_override,
    search_paths,
    searching,
    sweep_size,
    without_hydra_overrides,
)
from staf_torch.sweeps.hydra_compat import jobs as jobs_module
from staf_torch.sweeps.hydra_compat.log_handlers import handlers_aside

program: Any = importlib.import_module(
    "staf_torch.sweeps.hydra_compat.program"
)  # a function has that name too

# A job


class Callbacks:
    """Notes when it is told what."""

    def __init__(self) -> None:
        self.told: list[Any] = []

    def on_job_start(self, config: DictConfig, task_function: Any) -> None:
        self.told.append(("start", config.hydra.job.num, task_function))

    def on_job_end(self, config: DictConfig, job_return: Any) -> None:
        self.told.append(("end", config.hydra.job.num, job_return.status))


@functools.cache
def whole_composer() -> Composer:
    return Composer(config_loader())


def composed(place: Path, num: int, *lines: str) -> tuple[DictConfig, DictConfig]:
    whole = whole_composer()([f"hydra.sweep.dir={place}", *lines])
    with read_write(whole.hydra), open_dict(whole.hydra):
        whole.hydra.job.num, whole.hydra.job.id = num, str(num)
    own = [line for line in lines if "hydra" not in line]
    return whole, Composer(config_loader(), hydra_node=False)(own)


@pytest.mark.skipif(program.HAS_WHITELIST, reason="Hydra 1.4 runs jobs itself")
def test_a_job_leaves_what_hydra_leaves_and_hydra_knows_of_it_meanwhile(tmp_path: Path) -> None:
    jobs_module.setup_globals()
    seen: list[Any] = []
    before = HydraConfig.instance().cfg

    def task(cfg: DictConfig) -> float:
        seen.append((cfg.seed, HydraConfig.get().job.num, os.environ.get("STAF_JOB"), HydraConfig.get()))
        if cfg.seed == 9:
            raise ValueError("nine")
        return 2.0

    callbacks, kept = Callbacks(), {}  # type: ignore[var-annotated]
    for num, seed in ((3, 5), (4, 6), (5, 9), (5, 7)):  # the last one in a directory that is there
        lines = [f"seed={seed}", "+note='ü: x'", "+hydra.job.env_set.STAF_JOB=here"]
        whole, own = composed(tmp_path / "new" / "sweep", num, *lines)
        with handlers_aside():
            ended = jobs_module._run_job(callbacks, task, whole, own, kept)
        place = tmp_path / "new" / "sweep" / str(num)
        assert (place / ".hydra" / "config.yaml").read_text() == OmegaConf.to_yaml(own)
        expected = OmegaConf.to_yaml(OmegaConf.masked_copy(whole, "hydra"))
        assert (place / ".hydra" / "hydra.yaml").read_text() == expected
        assert (place / ".hydra" / "overrides.yaml").read_text() == f"- seed={seed}\n- '+note=''ü: x'''\n"
        assert (place / "staf.log").exists()
        assert whole.hydra.runtime.output_dir == str(place)
        assert ended.overrides == [f"seed={seed}", "+note='ü: x'"]
        assert (ended.cfg, ended.hydra_cfg, ended.working_dir) == (own, whole, str(Path.cwd()))
        assert OmegaConf.is_readonly(seen[-1][3])
    assert [each[:3] for each in seen] == [(5, 3, "here"), (6, 4, "here"), (9, 5, "here"), (7, 5, "here")]
    assert "STAF_JOB" not in os.environ
    assert HydraConfig.instance().cfg is before
    assert callbacks.told[:2] == [("start", 3, task), ("end", 3, JobStatus.COMPLETED)]
    assert callbacks.told[5] == ("end", 5, JobStatus.FAILED)


@pytest.mark.skipif(program.HAS_WHITELIST, reason="Hydra 1.4 runs jobs itself")
def test_a_job_without_files_of_hydra_has_none(tmp_path: Path) -> None:
    jobs_module.setup_globals()
    whole, own = composed(tmp_path, 3, "hydra.output_subdir=null")
    with handlers_aside():
        ended = jobs_module._run_job(Callbacks(), lambda cfg: 1.0, whole, own, {})
    assert ended.return_value == 1.0
    assert [path.name for path in (tmp_path / "3").iterdir()] == ["staf.log"]


def test_a_directory_of_a_job_is_below_that_of_its_sweep() -> None:
    config = OmegaConf.create({"hydra": {"sweep": {"dir": "a/b", "subdir": 7}}})
    assert directory_of(config) == Path("a/b/7")
    assert without_hydra_overrides(["seed=1", "hydra.x=1", "kernel=a"]) == ["seed=1", "kernel=a"]


def test_what_a_launcher_asks_of_a_sweep() -> None:
    def context(subdir: str, *callbacks: Any) -> SweepContext:
        master = OmegaConf.create({"hydra": {"sweep": {"subdir": subdir}}})
        hydra: Any = SimpleNamespace(callbacks=SimpleNamespace(callbacks=list(callbacks)))
        return SweepContext(hydra, master)

    from staf_torch.sweeps.callbacks import SweepReport

    assert context("${hydra.job.num}").numbered
    assert not context("x${hydra.job.num}").numbered
    assert context("x").own_callbacks
    assert context("x", SweepReport()).own_callbacks
    assert not context("x", SweepReport(), Callbacks()).own_callbacks
    assert not SweepContext(SimpleNamespace(callbacks=None), OmegaConf.create()).own_callbacks  # type: ignore[arg-type]


# Broken sweeps: Hydra's function of that name is found by it


def multirun(raises: bool, inner: Any = None) -> bool:
    cfg, callbacks = OmegaConf.create({"a": 1}), "callbacks"
    if inner is not None:
        assert (cfg.a, callbacks) == (1, "callbacks")
        return bool(inner())
    try:
        if raises:
            raise ValueError(f"{cfg.a} {callbacks}")
        return breaking_off()
    except ValueError:
        return breaking_off()


def test_a_sweep_breaks_off_where_an_exception_passes_through_it() -> None:
    assert multirun(True)
    assert not multirun(False)
    assert not breaking_off()
    try:
        raise ValueError
    except ValueError:
        assert not multirun(False)  # of somebody above
        assert not breaking_off()


def test_the_sweep_that_an_error_ended_is_found() -> None:
    def fails() -> None:
        raise ValueError("within")

    with pytest.raises(ValueError, match="within") as told:
        multirun(False, fails)
    broken = broken_sweep(told.value)
    assert broken is not None
    assert (broken.config, broken.callbacks) == ({"a": 1}, "callbacks")
    with pytest.raises(ValueError, match="within") as told:
        fails()
    assert broken_sweep(told.value) is None

    def other() -> None:
        callbacks = "of something else"
        raise ValueError(callbacks)

    with pytest.raises(ValueError, match="something else") as told:
        other()
    assert broken_sweep(told.value) is None
    space: dict[str, Any] = {}
    exec("def multirun():\n    raise ValueError('early')", space)  # before it has callbacks
    with pytest.raises(ValueError, match="early") as told:
        space["multirun"]()
    assert broken_sweep(told.value) is None


@pytest.mark.parametrize("newer", [False, True])
def test_callbacks_are_told_of_the_end_where_hydra_forgets_them(
    newer: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program, "HAS_WHITELIST", newer)
    told: list[Any] = []
    config = OmegaConf.create({"hydra": {"job": {"config_name": "mine"}}})
    callbacks = SimpleNamespace(on_multirun_end=lambda **given: told.append(given))
    program.BrokenSweep(config, callbacks).end()
    assert told == ([] if newer else [{"config": config, "config_name": "mine"}])


# The plugin


@pytest.mark.parametrize("installed", ["yes", "no", "no package"])
def test_the_plugin_of_the_package_goes_before_any_other(
    installed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def find(name: str) -> object:
        assert name == "hydra_plugins.staf_batched"
        if installed == "no package":
            raise ModuleNotFoundError
        return object() if installed == "yes" else None

    monkeypatch.setattr(program, "_PACKAGE", tmp_path / "package")
    monkeypatch.setattr(importlib.util, "find_spec", find)
    monkeypatch.setattr(sys, "path", ["first", "second"])
    monkeypatch.setenv("PYTHONPATH", "before")
    program.find_launcher()
    assert sys.path == ["first", "second"]  # there are no plugins
    plugins = tmp_path / "package" / "plugins"
    plugins.mkdir(parents=True)
    for _ in range(2):
        program.find_launcher()
        assert sys.path == [str(plugins), "first", "second"]
        path = os.environ["PYTHONPATH"].split(os.pathsep)
        assert path == ["before", *([] if installed == "yes" else [str(plugins), str(tmp_path)])]
    monkeypatch.delenv("PYTHONPATH")
    sys.path.remove(str(plugins))
    program.find_launcher()
    if installed != "yes":
        assert os.environ["PYTHONPATH"].split(os.pathsep) == [str(plugins), str(tmp_path)]


def test_the_package_is_the_one_that_holds_the_plugins() -> None:
    assert (program._PACKAGE / "plugins" / "hydra_plugins" / "staf_batched.py").is_file()


# Where settings are looked for


def test_a_worker_looks_where_the_command_looks(tmp_path: Path) -> None:
    usual = search_paths()
    assert any(place.endswith(config_directory()) for _, place in usual)
    (tmp_path / "config.yaml").write_text("own: 1\n")
    with searching((("mine", f"file://{tmp_path}"),)):
        assert search_paths() == (("mine", f"file://{tmp_path}"),)
        assert [str(each.path) for each in config_loader().get_sources()] == [str(tmp_path)]
    assert search_paths() == usual


# The log


def test_handlers_come_back_and_those_that_were_made_meanwhile_are_closed() -> None:
    root, known = logging.getLogger(), logging.getLogger("staf_torch.tests.known")
    before, level = list(root.handlers), root.level
    listed = list(logging._handlerList)  # type: ignore[attr-defined]
    mine = logging.NullHandler()
    mine.set_name("mine")
    root.addHandler(mine)
    closed: list[int] = []

    class Made(logging.NullHandler):
        def close(self) -> None:
            closed.append(1)
            super().close()

    try:
        with handlers_aside():
            assert root.handlers == []
            assert logging._handlerList == []  # type: ignore[attr-defined]
            assert "mine" not in logging._handlers  # type: ignore[attr-defined]
            root.addHandler(Made())
            root.setLevel(logging.CRITICAL)
            known.disabled = True
        assert closed == [1]
        assert root.handlers == [*before, mine]
        assert root.level == level
        assert not known.disabled
        assert logging._handlers["mine"] is mine  # type: ignore[attr-defined]
        assert logging._handlerList[: len(listed)] == listed  # type: ignore[attr-defined]
        known.disabled = True
        with handlers_aside():
            known.disabled = False
        assert known.disabled
    finally:
        known.disabled = False
        root.removeHandler(mine)
        mine.close()


# Sizes


@pytest.mark.parametrize(
    ("lines", "size"),
    [
        ([], 1),
        (["a=1"], 1),
        (["a=1,2,3", "b=x"], 3),
        (["a=1,2,3", "b=range(5)"], 15),
        (["a=range(2,7)"], 5),
        (["a=range(0,1,0.25)"], 4),
        (["a=range(0,1,0.3)"], 4),
        (["a=range(5,0,-2)"], 3),
        (["a=range(0,5,-1)"], 0),
        (["a=range(3,3)"], 0),
        (["a=range(1,2,0)"], math.inf),
        (["a=interval(0,1)"], 1),
        (["a=choice(x,y)"], 2),
        (["a=range(1000000000)", "b=1,2"], 2e9),
    ],
)
def test_the_size_of_a_sweep_is_counted(lines: list[str], size: float) -> None:
    assert sweep_size([parse_override(line) for line in lines]) == size
