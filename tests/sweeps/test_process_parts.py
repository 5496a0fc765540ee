"""Hydra in a process that goes on, with stand-ins for Hydra: what is set aside, asked for, and comes back."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from composing import register_resolver
from hydra import version
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from hydra.core.utils import JobRuntime
from hydra.types import RunMode
from omegaconf import OmegaConf
from omegaconf.basecontainer import BaseContainer

from staf_torch.sweeps import workers
from staf_torch.sweeps.hydra_compat import in_process, mode
from staf_torch.sweeps.hydra_compat.in_process import Application
from staf_torch.sweeps.hydra_compat.program import HAS_WHITELIST


class Hydra:
    """Notes what it is asked for; an experiment has the directory `place`."""

    def __init__(self, place: Path, read: RunMode | None = None) -> None:
        self.place, self.read = place, read
        self.asked: list[Any] = []

    def compose_config(self, *given: Any, **more: Any) -> Any:
        self.asked.append((given, more))
        return OmegaConf.create({"hydra": {"sweep": {"dir": given[0]}}})

    def get_mode(self, *given: Any) -> RunMode | None:
        self.asked.append(given)
        return self.read

    def run(self, *given: Any) -> Any:
        self.asked.append(given)
        return SimpleNamespace(hydra_cfg=OmegaConf.create({"hydra": {"runtime": {"output_dir": "a/b"}}}))

    def multirun(self, *given: Any) -> None:
        self.asked.append(given)


@pytest.fixture
def trusted(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The packages that were trusted, one call after another."""
    asked: list[Any] = []

    @contextmanager
    def trust(*packages: Any) -> Iterator[None]:
        asked.append(packages)
        yield

    monkeypatch.setattr(in_process, "trusted", trust)
    monkeypatch.setattr(in_process, "named_packages", lambda overrides: [f"of {overrides[0]}"])
    return asked


# Another application


def test_what_another_application_has_is_set_aside_and_comes_back() -> None:
    instances: dict[type, Any] = Singleton._instances  # type: ignore[attr-defined]
    before, resolvers = dict(instances), dict(BaseContainer._resolvers)
    instances.pop(JobRuntime, None)
    mine = instances[GlobalHydra] = object()
    try:
        with in_process._singletons():
            assert GlobalHydra not in instances
            assert instances.get(Plugins) is before.get(Plugins)
            instances[GlobalHydra] = instances[JobRuntime] = object()
            register_resolver("staf_inside", lambda: 1)
            BaseContainer._resolvers.pop("oc.env")
        assert instances[GlobalHydra] is mine
        assert JobRuntime not in instances
        assert BaseContainer._resolvers == resolvers
    finally:
        for kind in (GlobalHydra, JobRuntime):
            instances.pop(kind, None)
        instances.update(before)
        OmegaConf.clear_resolver("staf_inside")


def test_modules_of_the_working_directory_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    before = sys.path[:]
    with in_process._import_path():
        assert sys.path == [str(tmp_path), *before]
        sys.path.append("further")
    assert sys.path == before


def test_an_application_is_ours_with_our_launcher_and_remembers_what_it_composed(
    tmp_path: Path, trusted: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    hydra, done = Hydra(tmp_path), []
    monkeypatch.setattr(in_process, "find_launcher", lambda: done.append("found"))
    monkeypatch.setattr(in_process, "_register_launcher", lambda: done.append("registered"))

    def made(name: str, path: Any) -> Hydra:
        assert name == "staf"
        assert any(str(each.path).endswith("conf") for each in path.get_path())
        done.append("made")
        return hydra

    monkeypatch.setattr(in_process, "Hydra", SimpleNamespace(create_main_hydra2=made))
    place = os.getcwd()
    before = [*sys.path]
    with in_process.application() as app:
        assert done == ["found", "registered", "made"]
        assert trusted == [()]
        assert sys.path[0] == place
        os.environ["STAF_INSIDE"] = "1"
        if not HAS_WHITELIST:
            assert str(version.getbase()) == "1.3"
        for each in ("a", "b"):
            assert app.hydra.compose_config(each, x=1).hydra.sweep.dir == each  # type: ignore[call-arg]
        assert hydra.asked == [(("a",), {"x": 1}), (("b",), {"x": 1})]
        assert [cfg.hydra.sweep.dir for cfg in app.seen] == ["a", "b"]
        assert app.sweep(print, ["seed=1"]) == Path("b").absolute()  # type: ignore[arg-type]
    assert "STAF_INSIDE" not in os.environ
    assert sys.path == before


def test_a_run_and_a_sweep_are_asked_for_as_what_they_are(tmp_path: Path, trusted: list[Any]) -> None:
    hydra: Any = Hydra(tmp_path)
    seen = [OmegaConf.create({"hydra": {"sweep": {"dir": each}}}) for each in ("x", "y", "z")]
    app = Application(hydra, seen)
    assert app.run(print, ["seed=1"]) == Path("a/b")  # type: ignore[arg-type]
    assert app.sweep(print, ["seed=2"]) == Path("z").absolute()  # type: ignore[arg-type]
    assert hydra.asked == [
        ("config", print, ["seed=1", "hydra.mode=RUN"]),
        ("config", print, ["seed=2", "hydra.mode=MULTIRUN"]),
    ]
    assert trusted == [(["of seed=1"],), (["of seed=2"],)]


@pytest.mark.parametrize("newer", [False, True])
@pytest.mark.parametrize("read", [None, RunMode.RUN, RunMode.MULTIRUN])
def test_settings_ask_for_a_sweep_where_hydra_reads_so(
    read: RunMode | None, newer: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(in_process, "HAS_WHITELIST", newer)
    hydra: Any = Hydra(tmp_path, read)
    assert Application(hydra, []).is_sweep(["seed=1"]) is (read == RunMode.MULTIRUN)
    ((name, lines, *parsed),) = hydra.asked
    assert (name, lines) == ("config", ["seed=1"])
    assert [[one.input_line for one in each] for each in parsed] == ([["seed=1"]] if newer else [])


def test_the_launcher_of_the_package_is_named_to_hydra(monkeypatch: pytest.MonkeyPatch) -> None:
    named: list[Any] = []
    monkeypatch.setattr(Plugins, "instance", staticmethod(lambda: SimpleNamespace(register=named.append)))
    in_process.find_launcher()
    in_process._register_launcher()
    assert [each.__name__ for each in named] == ["BatchedLauncher"]


# The mode


@pytest.mark.parametrize(
    ("lines", "known", "read"),
    [
        ([], True, None),
        (["seed=1", "hydra.job.name=a"], True, None),
        (["experiment=adp"], True, None),
        (["experiment=ablation"], True, RunMode.MULTIRUN),
        (["++experiment=ablation", "seed=1"], True, RunMode.MULTIRUN),
        (["experiment=ablation", "experiment=laws", "experiment=adp"], True, None),
        (["experiment=adp", "experiment=laws", "experiment=ablation"], True, RunMode.MULTIRUN),
        (["experiment=nowhere"], False, None),
        (["experiment=adp,laws"], False, None),
        (["experiment="], False, None),
        (["hydra.mode=RUN"], False, None),
        (["experiment=ablation", "+hydra.mode=RUN"], False, None),
        (["hydra.searchpath=[a]"], False, None),
        (["~hydra.mode"], False, None),
        (["kernel@target=matern"], False, None),
    ],
)
def test_the_file_of_an_experiment_decides_the_mode_unless_a_line_may(
    lines: list[str], known: bool, read: RunMode | None
) -> None:
    assert mode._written(lines) == (known, read)


@pytest.mark.parametrize(
    ("newer", "name", "providers", "lines", "asks"),
    [
        (False, "config", "hydra main schema", ["experiment=ablation"], False),
        (False, "config", "hydra main", [], False),
        (False, "config", "hydra main schema", ["hydra.mode=RUN"], True),
        (False, "config", "hydra main schema command-line", ["experiment=ablation"], True),
        (False, "other", "hydra main schema", ["experiment=ablation"], True),
        (False, None, "hydra main schema", [], True),
        (True, "config", "hydra main schema", ["experiment=ablation"], True),
    ],
)
def test_hydra_composes_where_settings_of_others_may_set_the_mode(
    newer: bool, name: str | None, providers: str, lines: list[str], asks: bool, monkeypatch: Any
) -> None:
    monkeypatch.setattr(mode, "HAS_WHITELIST", newer)
    asked: list[Any] = []

    class Composing:
        def __init__(self) -> None:
            places = [SimpleNamespace(provider=each) for each in providers.split()]
            path = SimpleNamespace(get_path=lambda: places)
            self.config_loader = SimpleNamespace(get_search_path=lambda: path)

        def get_mode(self, *given: Any) -> str:
            asked.append(given)
            return "composed"

    before = Composing.get_mode
    monkeypatch.setattr(mode, "Hydra", Composing)
    with mode.mode_read_from_its_file():
        found = Composing().get_mode(name, lines)
    wanted = RunMode.MULTIRUN if "experiment=ablation" in lines else None
    assert found == ("composed" if asks else wanted)
    assert asked == ([(name, lines)] if asks else [])
    assert Composing.get_mode is before
    with pytest.raises(KeyError), mode.mode_read_from_its_file():
        raise KeyError
    assert Composing.get_mode is before


# Processes


@pytest.mark.parametrize(
    ("error", "lives"), [(None, True), (ProcessLookupError(), False), (PermissionError(), True)]
)
def test_a_process_lives_unless_there_is_none(error: Any, lives: bool, monkeypatch: Any) -> None:
    asked: list[Any] = []

    def kill(pid: int, number: int) -> None:
        asked.append((pid, number))
        if error is not None:
            raise error

    monkeypatch.setattr(os, "kill", kill)
    assert workers._lives(7) is lives
    assert asked == [(7, 0)]
