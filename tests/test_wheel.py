"""The wheel: built, installed into a clean environment, run from another directory. No network."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest
from command_line import ROOT


def _run(*line: str | Path, cwd: Path) -> str:
    clean = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PIP_", "COV"))
    }
    ended = subprocess.run(
        [str(word) for word in line], cwd=cwd, env=clean, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    _run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder, cwd=ROOT)
    (built,) = folder.glob("*.whl")
    return built


def test_wheel_holds_the_package_its_settings_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    packages = {"staf_torch", "hydra_plugins"}  # Hydra 1.3 looks into the second
    assert {name.partition("/")[0] for name in names} == packages | {"staf_torch-0.1.0.dist-info"}
    assert {name for name in names if name.startswith("hydra_plugins")} == {"hydra_plugins/staf_batched.py"}
    sources = {
        f"staf_torch/{p.relative_to(ROOT / 'staf_torch')}" for p in (ROOT / "staf_torch").rglob("*.py")
    }
    settings = {f"staf_torch/{p.relative_to(ROOT)}" for p in (ROOT / "conf").rglob("*.yaml")}
    assert sources | settings | {"staf_torch/py.typed"} <= names
    assert any(name.endswith("LICENSE") for name in names)


def test_wheel_runs_in_a_clean_environment_from_any_directory(wheel: Path, tmp_path: Path) -> None:
    home = tmp_path / "venv"
    _run(sys.executable, "-m", "venv", home, cwd=tmp_path)
    python = home / "bin" / "python"
    site = Path(
        _run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=tmp_path).strip()
    )
    # A path in a .pth file brings the packages there, but not their own .pth files: an editable install
    # of this checkout in the present environment stays out of sight.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    _run(python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", wheel, cwd=tmp_path)
    work = tmp_path / "elsewhere"
    work.mkdir()
    where = _run(python, "-c", "import staf_torch; print(staf_torch.__file__)", cwd=work).strip()
    assert Path(where).resolve().is_relative_to(home.resolve())
    said = _run(home / "bin" / "staf", "duration=0.1", "settle_time=0", "figures=false", cwd=work)
    assert "Gradient chase" in said
    (run,) = (work / "runs").iterdir()
    assert {path.name for path in run.iterdir()} == {
        ".hydra",
        "run.json",
        "staf.log",
        "metrics.json",
        "history.npz",
    }
    assert json.loads((run / "metrics.json").read_text())["diverged_fraction"] == 0
    table = _run(home / "bin" / "staf-table", "runs", "--format", "csv", cwd=work)
    assert "ball_error" in table.splitlines()[0]
