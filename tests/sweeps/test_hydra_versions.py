"""What a command line means to Hydra 1.3 and to 1.4, which trusts nothing by itself."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

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
