"""Somebody else's Hydra application: our groups on its search path, our launcher or Hydra's own."""

from __future__ import annotations

import importlib.resources
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import ROOT
from hydra import compose, initialize
from hydra.utils import instantiate

from staf_torch import Kernel, systems
from staf_torch.settings.chase import make_centers

APP = ROOT / "tests" / "examples" / "own_app.py"


def test_the_settings_are_a_package() -> None:
    names = {entry.name for entry in importlib.resources.files("staf_torch.conf").iterdir()}
    assert {"__init__.py", "config.yaml", "kernel", "centers"} <= names


@pytest.mark.parametrize("launcher", ["basic", "batched"])
def test_an_application_of_ones_own_sweeps_our_groups_without_a_warning(
    launcher: str, tmp_path: Path
) -> None:
    path = os.pathsep.join([str(ROOT), str(ROOT / "staf_torch" / "plugins")])
    line = [sys.executable, "-W", "error", str(APP), "-m", f"hydra/launcher={launcher}", "steps=60"]
    ended = subprocess.run(
        [*line, "kernel=gaussian,matern", "centers.count=3,6"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert "not available" not in ended.stdout + ended.stderr
    losses = [float(found) for found in re.findall(r"loss=(\S+)", ended.stdout)]
    assert len(losses) == 4
    assert max(losses) < 1


def test_groups_instantiate_on_their_own() -> None:
    with initialize(version_base="1.3", config_path=None):
        search = "hydra.searchpath=[pkg://staf_torch.conf]"
        cfg = compose(
            overrides=[search, "+kernel=matern", "+system=pendulum", "+target=paper", "+centers=rings"]
        )
    assert isinstance(instantiate(cfg.kernel), Kernel)
    assert isinstance(instantiate(cfg.system), systems.Pendulum)
    assert callable(instantiate(cfg.target))
    assert make_centers(cfg.centers, dim=2).count == 3
