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

from staf_torch import __version__


def _run(*line: str | Path, cwd: Path) -> str:
    clean = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PIP_", "COV"))
    }
    ended = subprocess.run(
        [str(word) for word in line], cwd=cwd, env=clean, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


PROGRAM = """
import contextlib, runpy, sys, staf_torch
print(staf_torch.__file__)
staf = sys.executable.replace("python", "staf")
sys.argv = [staf, "duration=0.1", "settle_time=0", "figures=false"]
with contextlib.suppress(SystemExit):
    runpy.run_path(staf, run_name="__main__")
sys.argv = ["own_app.py", "-m", "kernel=gaussian,matern", "steps=2", "hydra/launcher=batched"]
runpy.run_path("own_app.py", run_name="__main__")
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    _run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder, cwd=ROOT)
    (built,) = folder.glob("*.whl")
    return built


def test_wheel_holds_the_package_its_settings_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {name.partition("/")[0] for name in names} == {
        *("staf_torch", "hydra_plugins", f"staf_torch-{__version__}.dist-info")
    }
    files = [p.relative_to(ROOT / "staf_torch") for p in (ROOT / "staf_torch").rglob("*.py")]
    sources = {f"staf_torch/{p}" for p in files if p.parts[0] != "plugins"}
    assert not any(name.startswith("staf_torch/plugins") for name in names)  # one copy of each file
    settings = {f"staf_torch/{p.relative_to(ROOT)}" for p in (ROOT / "conf").rglob("*.yaml")}
    guides = (ROOT / "staf_torch" / "guides").rglob("*.*")
    pages = {p.relative_to(ROOT).as_posix() for p in guides} | {"staf_torch/guides/front/README.md"}
    assert sources | settings | pages | {"staf_torch/py.typed"} <= names
    assert any(name.endswith("LICENSE") for name in names)


def test_an_index_can_show_the_description_and_the_version_is_one(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("METADATA"))
        about, _, description = archive.read(name).decode().partition("\n\n")
    assert "Description-Content-Type: text/markdown" in about
    assert "StaFBasis" in description
    assert "](" not in description  # pictures and links of the README lead nowhere there
    exec(description.split("```python")[1].split("```")[0])
    assert f"\nVersion: {__version__}\n" in about


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual environment that has what we depend on, and not this package."""
    place = tmp_path_factory.mktemp("home")
    _run(sys.executable, "-m", "venv", "--without-pip", place / "venv", cwd=place)
    asked = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(_run(place / "venv" / "bin" / "python", "-c", asked, cwd=place).strip())
    # A path in a .pth file brings the packages there, but not their own .pth files: an editable install
    # of this checkout in the present environment stays out of sight.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return place / "venv"


def test_wheel_runs_in_a_clean_environment_from_any_directory(
    wheel: Path, home: Path, tmp_path: Path
) -> None:
    install = ("-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-compile")
    _run(home / "bin" / "python", *install, wheel, cwd=home)
    for path in (ROOT / "tests" / "examples").glob("own_app.*"):  # somebody's application
        (tmp_path / path.name).write_bytes(path.read_bytes())
    # The command, and that application swept by our launcher.
    said = _run(home / "bin" / "python", "-W", "error", "-c", PROGRAM, cwd=tmp_path)
    assert Path(said.splitlines()[0]).resolve().is_relative_to(home.resolve())
    assert "Gradient chase" in said
    (run,) = (tmp_path / "runs").iterdir()
    assert json.loads((run / "metrics.json").read_text())["diverged_fraction"] == 0
    assert said.count("loss=") == 2
    assert "not available" not in said
    table = _run(home / "bin" / "staf-table", "runs", "--format", "csv", cwd=tmp_path)
    assert "ball_error" in table.splitlines()[0]
