"""The command `staf`: every option runs, run directories hold what is promised, errors are a sentence."""

from __future__ import annotations

import csv
import functools
import json
import math
import statistics
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import Outcome, run_all
from composing import settings
from experiments.test_reference_metrics import CASES
from hydra.utils import instantiate
from omegaconf import OmegaConf

import staf_torch
from staf_torch.experiments.registry import experiment
from staf_torch.settings import config_directory

KEYS = {
    "ultimate_error",
    "ultimate_error_before",
    "floor_error",
    "ultimate_excess",
    "ultimate_excess_before",
    "ball_error",
    "ball_floor_error",
    "rounding_floor",
    "gradient_error",
    "condition_number",
    "settling_time",
    "contraction_violations",
    "diverged_fraction",
    "products_per_second",
}
SHORT = ["duration=0.05", "settle_time=0", "figures=false"]
NEEDS = {  # what some options cannot do without, or that makes them small
    "centers=directions": ["centers.directions=[[0,1],[1,0],[-1,0]]"],
    "system=cart_pole": ["centers=simplex", "target=quadratic", "initial_state=[0.1,0,0,0]"],
    "system=planar_quadrotor": ["centers=simplex", "target=quadratic", "initial_state=[0.1,0,0,0,0,0]"],
    "experiment=adp_policy_iteration": ["duration=0.01"],
    "system=two_link_robot": ["centers=simplex", "target=quadratic", "initial_state=[0.1,0,0,0]"],
    "system=three_state": ["centers=simplex", "target=quadratic", "initial_state=[0.1,0,0]"],
}
CUSTOM = {  # a user's own of every group, in one line
    "kernel": "plants.Cauchy",
    "metric": "plants.Largest",
    "optimizer": "plants.Shrinking",
    "predictor": "plants.Still",
    "system": "plants.Escape",
    "target": "plants.bowl",
    "tracker": "plants.Lines",
}
ELSEWHERE = {word for case in CASES.values() for word in case.split()}  # what runs there, figures and all
ELSEWHERE |= {
    f"experiment={name}" for name in ("adp_as_printed", "adp_three_state", "rivals")
}  # tests/experiments has them end to end
LAWS = {path.stem: OmegaConf.load(path) for path in Path(config_directory(), "optimizer").glob("*.yaml")}
UNRATED = {  # laws that promise no rate of contraction
    f"optimizer={name}"
    for name, node in LAWS.items()
    if name != "custom" and instantiate(node).contraction(torch.ones(())) is None
}
ABLATION = [
    *("kernel=exponential", "centers.radius=0.1", "figures=false"),
]  # of the sweep, what MATH.md has numbers for


def _options() -> dict[str, list[str]]:
    """Every file of every group of conf/, so that a new one is covered by being there.

    But closed loops, which have tests of their own, and experiments whose metrics are recorded.
    """
    lines = {}
    for path in sorted(Path(config_directory()).glob("*/*.yaml")):
        group, option = path.parent.name, path.stem
        name = f"{group}={option}"
        elsewhere = group in ("adp", "tracker") or option in ("ablation", "custom", "mujoco")
        if not elsewhere and name not in ELSEWHERE:
            lines[name] = [name, *NEEDS.get(name, [])]
    return lines


def _together(options: dict[str, list[str]]) -> dict[str, tuple[str, ...]]:
    """The line that an option runs in: one of every group in a line, where they need no other group."""
    groups: dict[str, list[str]] = {}
    for name in options:
        group = name.partition("=")[0]
        if group in {*CUSTOM, "centers"} and name not in NEEDS:
            groups.setdefault(group, []).append(name)
    lines = {name: (*SHORT, *words) for name, words in options.items()}
    for number in range(max(map(len, groups.values()))):
        names = [members[number % len(members)] for members in groups.values()]
        line = (*SHORT, *names)
        lines |= {members[number]: line for members in groups.values() if number < len(members)}
    return lines


OPTIONS = _options()
TOGETHER = _together(OPTIONS)
RUNS = {
    "custom": [*(f"{g}=custom" for g in CUSTOM), *(f"{g}.path={own}" for g, own in CUSTOM.items()), *SHORT],
    "ablation": ["experiment=ablation", *ABLATION],
    "five": ["trajectories=5", *SHORT[:2]],
    "help": ["--help"],
}


# What a user gets wrong
BAD: dict[str, tuple[str, tuple[str, ...]]] = {
    "key of another choice": (
        "kernel.width=0.5",
        ("`kernel.width` with these choices; ", "kernel=gaussian have it."),
    ),
    "swept choices of which one has a key": (
        "-m kernel=gaussian,custom kernel.path=a.B",
        ("`kernel.path` with these choices; kernel=custom has it.",),
    ),
    "unknown command": ("doctro", ("there is no command `doctro`; did you mean `doctor`?",)),
    "no experiment": (
        "task=math.pi",
        ("`staf task=...` must be an experiment, which can be called; got 'math.pi'.",),
    ),
    "negative radius": ("centers.radius=-0.1", ("must be positive; got -0.1.",)),
    "run directory under a file": ("hydra.run.dir=blocked/run", ("cannot write", "blocked")),
}
REFUSED = {name: [*line.split(), *SHORT] for name, (line, _) in BAD.items()}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Outcome]:
    return run_all(RUNS | REFUSED, tmp_path_factory.mktemp("runs"))


def run_directory(outcome: Outcome) -> Path:
    assert outcome.code == 0, f"{outcome}"  # in full, for absent_extras.py
    assert "Traceback" not in outcome.err
    assert outcome.left == {"runs"}
    (run,) = (outcome.folder / "runs").iterdir()
    return run


def metrics(run: Path) -> dict[str, float | None]:
    found = json.loads((run / "metrics.json").read_text(), parse_constant=pytest.fail)
    assert isinstance(found, dict)
    return found


def history(run: Path) -> dict[str, np.ndarray]:
    with np.load(run / "history.npz") as archive:
        return dict(archive)


@functools.cache
def found_by(line: tuple[str, ...]) -> dict[str, float | None]:
    """The metrics of a line whose experiment is called as the command calls it."""
    cfg = settings(*line)
    with tempfile.TemporaryDirectory() as folder:
        return experiment(cfg.task)(cfg, Path(folder))


@pytest.mark.parametrize("name", OPTIONS)
def test_every_option_of_every_group_runs(name: str) -> None:
    line = TOGETHER[name]
    found = found_by(line)
    if name.startswith("experiment="):
        assert found
        return
    assert set(found) == KEYS
    rated = KEYS if UNRATED.isdisjoint(line) else KEYS - {"contraction_violations"}
    assert (found["contraction_violations"] is None) == (rated != KEYS)
    assert all(found[key] is not None and math.isfinite(found[key]) for key in rated)
    assert found["diverged_fraction"] == 0


def test_a_users_own_option_of_every_group_runs(outcomes: dict[str, Outcome]) -> None:
    run = run_directory(outcomes["custom"])
    found = metrics(run)
    assert set(found) == KEYS | {"largest_state"}  # of the user's own metric
    assert found["contraction_violations"] is None
    assert all(math.isfinite(found[key]) for key in found.keys() - {"contraction_violations"})
    assert f"tracked custom {found['ball_error']}" in (run / "staf.log").read_text()
    files = {path.name for path in run.iterdir()}
    assert files == {".hydra", "run.json", "staf.log", "metrics.json", "history.npz"}


def test_a_run_directory_holds_exactly_what_is_promised(outcomes: dict[str, Outcome]) -> None:
    outcome = outcomes["five"]
    run = run_directory(outcome)
    for words in ("Gradient chase", "ExponentialKernel", "error at the state", run.name):
        assert words in outcome.out
        assert words in (run / "staf.log").read_text()
    assert outcome.err == ""
    files = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
    stems = {
        name.removeprefix("figures/").rpartition(".")[0] for name in files if name.startswith("figures/")
    }
    assert files == {
        ".hydra/config.yaml",
        ".hydra/hydra.yaml",
        ".hydra/overrides.yaml",
        "run.json",
        "staf.log",
        "metrics.json",
        "history.npz",
        *(f"figures/{stem}.{kind}" for stem in stems for kind in ("png", "pdf")),
    }
    assert len(stems) == 1
    (stem,) = stems
    assert (run / f"figures/{stem}.png").read_bytes().startswith(b"\x89PNG")
    assert (run / f"figures/{stem}.pdf").read_bytes().startswith(b"%PDF")


def test_history_has_the_fields_and_shapes_of_the_contract(outcomes: dict[str, Outcome]) -> None:
    found = history(run_directory(outcomes["five"]))
    assert {name: array.shape for name, array in found.items()} == {
        "time": (6,),
        "state": (5, 6, 2),
        "value": (5, 6),
        "estimate": (5, 6),
        "weights": (5, 6, 3),
        "ideal_weights": (5, 6, 3),
        "excess": (5, 6),
    }
    np.testing.assert_allclose(found["time"], np.arange(6) * 0.01, rtol=1e-15)
    assert all(array.dtype == np.float64 for array in found.values())
    x1, x2 = found["state"][..., 0], found["state"][..., 1]
    np.testing.assert_allclose(found["value"], x1**2 + 5 * x2**2 + np.tanh(x1 * x2), rtol=1e-13)
    measured = metrics(run_directory(outcomes["five"]))
    worst = np.abs(found["value"] - found["estimate"]).max()
    assert measured["ultimate_error"] == pytest.approx(worst, rel=1e-12)
    assert measured["ultimate_excess"] == pytest.approx(found["excess"].max(), rel=1e-12)


def test_the_ablation_ends_with_the_errors_of_the_layouts(outcomes: dict[str, Outcome]) -> None:
    """MATH.md, section 1: worst of six states (not stated: hence 10 %), exponential kernel, r = 0.1."""
    outcome = outcomes["ablation"]
    sweep = run_directory(outcome)
    with (sweep / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12
    for count, reference in {3: 5.2e-2, 6: 2.4e-3, 10: 7.1e-5, 15: 1.1e-6}.items():
        seeds = [row for row in rows if int(row["centers.count"]) == count]
        for name in ("ball_error", "ball_floor_error"):
            found = statistics.mean(float(row[name]) for row in seeds)
            assert found == pytest.approx(reference, rel=0.1), (count, name)
    assert (sweep / "table.md").read_text() in outcome.out
    assert "<table" in (sweep / "report.html").read_text()


def test_help_is_one_screen_of_commands_groups_and_settings(outcomes: dict[str, Outcome]) -> None:
    outcome = outcomes["help"]
    assert outcome.code == 0
    assert outcome.left == set()
    for words in ("State Following", "kernel:", "exponential", "initial_state", "duration", "staf-table"):
        assert words in outcome.out
    assert all(word in outcome.out for word in ("doctor", "schema", "docs", "staf-export", "--cfg job"))
    lines = outcome.out.splitlines()
    assert len(lines) <= 42
    assert max(map(len, lines)) <= 110


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
    if name == "negative radius":  # what the library refuses is all that the command says
        assert (found.err, found.out) == (f"staf: `ConstantRadius(radius=...)` {BAD[name][1][0]}\n", "")


def test_a_wrong_setting_is_an_error_in_the_same_words_and_leaves_nothing(tmp_path: Path) -> None:
    wrong = ("kernel=polynomial", "kernel.degree=1", "centers.count=6")
    with pytest.raises(ValueError, match=r"has 6 centers.* has 3 dimensions: use at most 3 centers"):
        staf_torch.run(*SHORT, *wrong, directory=tmp_path / "run")
    assert not list(tmp_path.glob("run/*"))
