"""What a command line means to Hydra 1.3 and to 1.4, which trusts nothing by itself."""

from __future__ import annotations

import importlib
import os
from pathlib import Path

import pytest
from hydra._internal import utils as hydra_utils
from hydra._internal.hydra import Hydra
from omegaconf import OmegaConf

from staf_torch.settings import config_directory
from staf_torch.sweeps.hydra_compat import in_process, mode_read_from_its_file

program = importlib.import_module("staf_torch.sweeps.hydra_compat.program")  # a function has that name too

OWN = "target._target_=mine.targets.Wave"


@pytest.fixture
def folder(tmp_path: Path) -> str:
    (tmp_path / "experiment").mkdir()
    (tmp_path / "kernel.yaml").write_text("_target_: theirs.kernels.Narrow\nwidth: 1.0\npath: ./a.b\n")
    (tmp_path / "experiment" / "swept.yaml").write_text("hydra: {mode: MULTIRUN}\n")
    (tmp_path / "experiment" / "plain.yaml").write_text("dt: 0.1\n")
    return str(tmp_path)


def test_packages_are_those_that_a_command_line_or_its_folder_names(
    folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = [OWN, "kernel.path=other.thing", "dt=0.1", "--config-dir", folder]
    monkeypatch.setattr(program, "HAS_WHITELIST", True)
    assert program.named_packages(line) == ["mine", "other", "theirs"]
    assert program.named_packages(line[:3]) == ["mine", "other"]
    assert program.named_packages(["dt=0.1", "-m"]) == []
    (Path(folder) / "kernel.yaml").write_bytes("_target_: größe.kernels.Narrow\n".encode())
    assert program.named_packages(line) == ["größe", "mine", "other"]  # files are UTF-8 wherever it runs
    (Path(folder) / "kernel.yaml").write_bytes(b"_target_: theirs.kernels.Narrow  # \xff\n")
    assert program.named_packages(line) == ["mine", "other", "theirs"]
    monkeypatch.setattr(program, "HAS_WHITELIST", False)
    assert program.named_packages(line) == []


@pytest.mark.parametrize("version", [False, True])
def test_the_mode_of_an_experiment_is_said_where_only_the_newer_hydra_needs_it(
    folder: str, version: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program, "HAS_WHITELIST", version)
    swept = ["experiment=swept", "--config-dir", folder]
    told = ["experiment=swept", "hydra.mode=MULTIRUN", "--config-dir", folder]
    assert program.with_mode(swept) == (told if version else swept)
    assert program.overrides_in(told) == told[:2]  # Hydra's own parser takes it for an override
    for line in (told, [*swept, "-m"], ["experiment=plain", "--config-dir", folder], ["dt=0.1"], []):
        assert program.with_mode(line) == line
    last = program.with_mode(["experiment=plain", *swept])  # of two experiments the last one counts
    assert last == ["experiment=plain", *(told if version else swept)]


@pytest.mark.skipif(program.HAS_WHITELIST, reason="Hydra 1.4 takes the mode from the command line")
@pytest.mark.parametrize(
    ("overrides", "composes"),
    [
        ([], False),
        (["experiment=ablation", "kernel=gaussian"], False),
        (["experiment=ablation", "experiment=adp"], False),
        (["experiment=ablation", "hydra.mode=RUN"], True),
        (["experiment=swept"], True),
        (["experiment=ablation,adp"], True),
        (["hydra.searchpath=[pkg://nothing]"], True),
    ],
)
def test_the_mode_that_is_read_from_a_file_is_the_one_that_hydra_composes(
    overrides: list[str], composes: bool, folder: str
) -> None:
    path = hydra_utils.create_config_search_path(config_directory())
    if overrides == ["experiment=swept"]:  # a folder of the user's, who may set the mode in any file
        path.prepend("command-line", f"file://{folder}")
    with in_process._singletons():
        program_of_hydra = Hydra.create_main_hydra2("staf", path)
        expected = program_of_hydra.get_mode("config", overrides)
        asked: list[object] = []
        compose = program_of_hydra.compose_config
        program_of_hydra.compose_config = lambda *a, **k: asked.append(a) or compose(*a, **k)
        with mode_read_from_its_file():
            assert program_of_hydra.get_mode("config", overrides) == expected
        assert bool(asked) == composes


def test_files_of_experiments_alone_set_the_mode_and_none_includes_another() -> None:
    for file in Path(config_directory()).rglob("*.yaml"):
        settings = OmegaConf.load(file)
        if file.parent.name == "experiment":
            for entry in settings.get("defaults", []):
                assert "experiment" not in str(entry), file
        else:
            assert OmegaConf.select(settings, "hydra.mode") is None, file
            assert "mode" not in settings or "hydra" not in file.parts, file


@pytest.mark.parametrize("before", [None, "", "0", "1"])
def test_whether_errors_are_shown_in_full_is_as_it_was_behind_a_program(
    before: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    if before is not None:
        monkeypatch.setenv("HYDRA_FULL_ERROR", before)
    with program.full_errors() as wanted:
        assert wanted == (before == "1")
        assert os.environ["HYDRA_FULL_ERROR"] == "1"
    assert os.environ.get("HYDRA_FULL_ERROR") == before


def test_variables_that_a_sweep_changes_are_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STAF_BEFORE", "1")
    monkeypatch.setenv("STAF_GONE", "1")
    monkeypatch.delenv("STAF_NEW", raising=False)
    with in_process._environment():
        os.environ["STAF_BEFORE"] = "2"
        os.environ["STAF_NEW"] = "3"
        del os.environ["STAF_GONE"]
    assert (os.environ["STAF_BEFORE"], os.environ["STAF_GONE"]) == ("1", "1")
    assert "STAF_NEW" not in os.environ
