"""Variants from outside the package, one class and one YAML each: those of conf/README.md."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from command_line import ROOT, in_a_child, one

from staf_torch import envs, lanes
from staf_torch.cli import export, table
from staf_torch.tables import collect

PAGE = (ROOT / "conf" / "README.md").read_text(encoding="utf-8")
OWN = ROOT / "tests" / "examples" / "own"
FILES = {
    str(p.relative_to(OWN)): p.read_text(encoding="utf-8")
    for p in OWN.rglob("*.*")
    if "__pycache__" not in str(p)
}
SHOWN = dict(re.findall(r"^`([\w./]+)`\n\n```(?:python|yaml)\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE))
COMMANDS = re.search(r"^## Run them\n\n```\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)[1].splitlines()
TABLE, SHEET = 3, 5  # which of the commands


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's working directory, in which all commands have run."""
    folder = tmp_path_factory.mktemp("outside")
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    with lanes.compiling("never"):
        in_a_child(lambda: ran(folder), folder)
    return folder


def ran(folder: Path) -> list[tuple[int, str]]:
    """Run the command lines of the three programs in a folder: exit code, and output and errors together.

    As from a shell: nothing leads to the folder, and no command has imported anything for the next one.
    """
    found = []
    for line in COMMANDS:
        program, *arguments = shlex.split(line)
        for name in [n for n, m in sys.modules.items() if str(folder) in str(getattr(m, "__file__", ""))]:
            del sys.modules[name]
        if program == "staf":
            code, out, err = one(str(folder), arguments)
            found.append((code, out + err))
            continue
        main = {"staf-table": table.main, "staf-export": export.main}[program]
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            try:
                found.append((int(main(arguments) or 0), said.getvalue()))
            except SystemExit as end:
                found.append((1, said.getvalue() + str(end)))
    return found


@pytest.fixture(scope="module")
def said(place: Path) -> list[str]:
    """What each command wrote to the terminal."""
    results = json.loads((place / "results.json").read_text())
    for command, (code, text) in zip(COMMANDS, results, strict=True):
        assert code == 0, f"{command}\n{text}"
    return [text for _, text in results]


def test_a_variant_is_one_class_and_one_yaml() -> None:
    modules = [name for name in FILES if name.endswith(".py")]
    groups = [Path(name).parent.name for name in FILES if name.endswith(".yaml")]
    assert sorted(groups) == ["experiment", "kernel", "metric", "optimizer", "system", "target"]
    assert len(modules) == len(groups)
    assert set(SHOWN) == {"cauchy.py", "my_conf/kernel/cauchy.yaml"}
    assert SHOWN.items() <= FILES.items()


def test_own_variants_run_and_their_metric_is_declared_in_the_record(place: Path, said: list[str]) -> None:
    metrics = json.loads((place / "runs/own/metrics.json").read_text())
    record = json.loads((place / "runs/own/run.json").read_text())
    assert metrics["digits"] > 1
    assert metrics["products_per_second"] == pytest.approx(1100)
    assert record["metrics"] == {"digits": {"unit": "digits", "larger_is_better": True, "headline": True}}
    assert {key: record["settings"][key] for key in ("kernel", "optimizer", "system", "target")} == {
        "kernel": "cauchy",
        "optimizer": "cautious",
        "system": "trolley",
        "target": "valley",
    }


def test_own_variants_are_swept_and_a_table_and_a_sheet_say_what_they_declare(
    place: Path, said: list[str]
) -> None:
    runs = collect(place / "runs/sweep").rows
    points = {(run.setting("kernel.width"), run.setting("optimizer.share")) for run in runs}
    assert points == {(width, share) for width in (0.7, 1.0) for share in (0.5, 1.0)}
    best = max(run.metrics["digits"] for run in runs)
    rows = [line for line in said[TABLE].splitlines() if line.startswith("|")][2:]
    assert f"**{best:.3g}**" in rows[0]  # sorted and marked, as larger is better
    near, far = (run.metrics["distance"] for run in collect(place / "runs/closeness").rows)
    assert 0 < near < far
    assert "m, m/s" in said[SHEET]


def test_an_own_plant_is_an_environment_by_its_dotted_path(
    place: Path, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(place))
    plants = gymnasium.make_vec(envs.OWN_PLANT, num_envs=8, plant="trolley.Trolley")
    seen, _ = plants.reset(seed=0)
    assert seen.shape == (8, 2)
    assert 0.1 < np.abs(seen).max() <= 0.25  # the plant's own spread
    with pytest.raises(ValueError, match=r"`PlantEnv\(plant=...\)` cannot be imported"):
        gymnasium.make_vec(envs.OWN_PLANT, num_envs=2, plant="trolley.Rocket")
