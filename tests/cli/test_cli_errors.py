"""What a user gets wrong on the command line: one sentence, exit code 1, and nothing left behind."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from command_line import Outcome, environment, run_all

SHORT = ("duration=0.05", "figures=false")

BAD: dict[str, tuple[str, tuple[str, ...]]] = {
    "unknown kernel": (
        "kernel=nope",
        ("there is no `kernel/nope`; there are anchored, anchored_gaussian, custom, exponential, ",),
    ),
    "launcher of an extra": (
        "hydra/launcher=nope",
        (
            "there is no `hydra/launcher/nope`; there are basic, batched",
            "extras joblib, slurm, ray and optuna.",
        ),
    ),
    "unknown layout": ("centers=nope", ("centers/nope", "rings")),
    "unknown key": ("nonsense=1", ("nonsense",)),
    "unknown key of a group": ("kernel=gaussian kernel.wdth=2", ("wdth",)),
    "unknown argument": ("kernel=gaussian +kernel.wdth=2", ("wdth",)),
    "unknown task": ("task=nope", ("`staf task=...` must be one of", "'nope'")),
    "broken syntax": ("initial_state=[1.0", ("[1.0",)),
    "no centers": ("centers.count=0", ("`rings(count=...)` must be at least 1; got 0.",)),
    "no count of rings": (
        "centers.count=4",
        ("`rings(count=...)` must be one of 3, 6, 10, 15, 21, 28; got 4.",),
    ),
    "negative radius": ("centers.radius=-0.1", ("(radius=...)` must be positive; got -0.1.",)),
    "negative width": ("kernel=gaussian kernel.width=-1", ("(width=...)` must be positive; got -1.",)),
    "too many polynomial centers": (
        "kernel=polynomial kernel.degree=1 centers.count=6",
        ("has 6 centers", "has 3 dimensions: use at most 3 centers"),
    ),
    "short initial state": ("initial_state=[1.0]", ("initial_state=...` must have 2 entries", "got [1.0]")),
    "NaN in the initial state": ("initial_state=[nan,0.0]", ("initial_state=...` must be finite", "nan")),
    "zero dt": ("dt=0", ("`staf dt=...` must be positive; got 0.",)),
    "dt is a word": ("dt=abc", ("`staf dt=...` must be a number; got 'abc'.",)),
    "duration under dt": ("duration=0.001", ("`staf duration=...` must be at least one step", "0.001")),
    "no trajectories": ("trajectories=0", ("`staf trajectories=...` must be at least 1; got 0.",)),
    "device that is not there": ("device=cuda:7", ("`staf device=...` cannot be used here", "cuda:7")),
    "figures is a word": ("figures=maybe", ("figures", "maybe")),
    "history is a word": ("history=maybe", ("history", "maybe")),
    "custom without a path": ("kernel=custom", ("path",)),
    "path to nothing": (
        "target=custom target.path=nowhere.at_all",
        ("`custom(path=...)` cannot be imported",),
    ),
    "target of a wrong shape": (
        "target=custom target.path=plants.wrong",
        ("The target `wrong` must map points of shape (..., n) to values of shape (...)",),
    ),
    "drift of a wrong shape": (
        "system=custom system.path=plants.Wrong",
        ("`Wrong.drift` must map (..., n) to (..., n)",),
    ),
    "run directory under a file": ("hydra.run.dir=blocked/run", ("cannot write", "blocked")),
}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Outcome]:
    jobs = {}
    for name, (line, _) in BAD.items():
        given = {word.partition("=")[0] for word in line.split()}
        jobs[name] = [*line.split(), *(word for word in SHORT if word.partition("=")[0] not in given)]
    return run_all(jobs, tmp_path_factory.mktemp("errors"))


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gets_a_sentence_and_leaves_nothing(name: str, outcomes: dict[str, Outcome]) -> None:
    found = outcomes[name]
    assert found.code == 1, found
    assert "Traceback" not in found.out + found.err
    sentence = found.err[found.err.index("staf: ") :]  # Hydra may put a line of its own before it
    for words in BAD[name][1]:
        assert words in sentence
    runs = found.folder / "runs"
    assert found.left <= {"runs"}
    assert not runs.exists() or list(runs.iterdir()) == []


def test_the_command_itself_ends_with_code_one_and_no_traceback(tmp_path: Path) -> None:
    line = [sys.executable, "-m", "staf_torch", "centers.radius=-0.1"]
    ended = subprocess.run(line, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.endswith("staf: `ConstantRadius(radius=...)` must be positive; got -0.1.\n")
    assert "Traceback" not in ended.stderr
    assert "Error executing job" not in ended.stderr  # Hydra's own words
    assert ended.stdout == ""
