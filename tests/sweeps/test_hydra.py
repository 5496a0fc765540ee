"""What a command line means to Hydra 1.3 and to 1.4, and what of Hydra comes back behind a program."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from staf_torch.settings import config_directory
from staf_torch.sweeps.hydra_compat import (
    application,
    find_launcher,
    full_errors,
    is_about_settings,
    named_packages,
)
from staf_torch.sweeps.hydra_compat.inside import HAS_WHITELIST
from staf_torch.sweeps.hydra_compat.jobs import handlers_aside

OWN = "target._target_=mine.targets.Wave"


@pytest.fixture
def folder(tmp_path: Path) -> str:
    (tmp_path / "kernel.yaml").write_text("_target_: größe.kernels.Narrow\nwidth: 1.0\npath: ./a.b\n")
    return str(tmp_path)


def test_packages_are_those_that_a_command_line_or_its_folder_names(folder: str) -> None:
    line = [OWN, "kernel.path=other.thing", "dt=0.1", "--config-dir", folder]
    found = named_packages(line), named_packages(line[:3]), named_packages(["dt=0.1", "-m"])
    if HAS_WHITELIST:
        assert found == (["größe", "mine", "other"], ["mine", "other"], [])
    else:
        assert found == ([], [], [])  # Hydra 1.3 trusts all


@pytest.mark.parametrize(
    ("overrides", "sweeps"),
    [
        ([], False),
        (["experiment=ablation", "kernel=gaussian"], True),
        (["experiment=ablation", "experiment=adp"], False),
        (["experiment=ablation", "hydra.mode=RUN"], False),
        (["experiment=adp", "hydra.mode=MULTIRUN"], True),
    ],
)
def test_settings_ask_for_a_sweep_where_their_experiment_or_the_last_word_says_so(
    overrides: list[str], sweeps: bool
) -> None:
    with application(overrides) as app:
        assert app.is_sweep() == sweeps


@pytest.mark.parametrize(
    ("line", "shows"),
    [
        ("", False),
        ("-m seed=1,2", False),
        ("--config-dir here", False),
        ("--cfg job", True),
        ("--help", True),
        ("--run --multirun", True),
        ("--nope", True),
    ],
)
def test_what_only_shows_something_and_what_is_wrong_is_left_to_hydra(line: str, shows: bool) -> None:
    assert is_about_settings(line.split()) == shows


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
    with full_errors() as wanted:
        assert wanted == (before == "1")
        assert os.environ["HYDRA_FULL_ERROR"] == "1"
    assert os.environ.get("HYDRA_FULL_ERROR") == before


def test_the_plugin_of_the_package_goes_before_any_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.environ.get("PYTHONPATH", ""))
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if Path(entry).name != "plugins"])
    for _ in range(2):
        find_launcher()
        assert Path(sys.path[0], "hydra_plugins", "staf_batched.py").is_file()
        assert [Path(entry).name for entry in sys.path].count("plugins") == 1


def test_handlers_come_back_and_those_that_were_made_meanwhile_are_closed() -> None:
    root, known = logging.getLogger(), logging.getLogger("staf_torch.tests.known")
    mine, closed = logging.NullHandler(), []
    root.addHandler(mine)
    before, level = list(root.handlers), root.level

    class Made(logging.NullHandler):
        def close(self) -> None:
            closed.append(1)
            super().close()

    try:
        with handlers_aside():
            assert root.handlers == []
            root.addHandler(Made())
            root.setLevel(logging.CRITICAL)
            known.disabled = True
        assert closed == [1]
        assert root.handlers == before
        assert (root.level, known.disabled) == (level, False)
    finally:
        known.disabled = False
        root.removeHandler(mine)
