"""The command `staf`: every option runs, and a run directory holds what DESIGN.md section 5 promises."""

from __future__ import annotations

import csv
import importlib.util
import json
import math
import statistics
from pathlib import Path

import numpy as np
import pytest
from command_line import Outcome, run_all
from experiments.test_reference_metrics import CASES

from staf_torch.cli.staf import config_directory

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
CUSTOM = {
    "kernel": "plants.Cauchy",
    "metric": "plants.Largest",
    "optimizer": "plants.Shrinking",
    "predictor": "plants.Still",
    "system": "plants.Escape",
    "target": "plants.bowl",
    "tracker": "plants.Lines",
}
ELSEWHERE = {word for case in CASES.values() for word in case.split()}  # what runs there, figures and all
ELSEWHERE |= {"experiment=adp_three_state", "experiment=rivals"}  # tests/experiments has them end to end
UNRATED = {  # laws that promise no rate of contraction
    f"optimizer={law}"
    for law in (
        *("barzilai_borwein", "custom", "heavy_ball", "jacobi", "nesterov"),
        *("normalised_lms", "preconditioned_descent", "recursive_least_squares"),
    )
}
ABLATION = ["kernel=exponential", "centers.radius=0.1"]  # of the sweep, what MATH.md has numbers for


def _options() -> dict[str, list[str]]:
    """Every file of every group of conf/, so that a new one is covered by being there.

    But closed loops, which have tests of their own, and experiments whose metrics are recorded.
    """
    lines = {}
    for path in sorted(Path(config_directory()).glob("*/*.yaml")):
        group, option = path.parent.name, path.stem
        more = [f"{group}.path={CUSTOM[group]}"] if option == "custom" else []
        more += NEEDS.get(f"{group}={option}", [])
        if option == "ablation":
            lines[f"{group}={option}"] = [f"{group}={option}", *ABLATION]
        elif group != "adp" and option != "mujoco" and f"{group}={option}" not in ELSEWHERE:
            lines[f"{group}={option}"] = [f"{group}={option}", *more]
    return lines


def _together(options: dict[str, list[str]]) -> dict[str, list[str]]:
    """The line that an option runs in: one of every group in a line, where they need no other group."""
    groups: dict[str, list[str]] = {}
    for name in options:
        group = name.partition("=")[0]
        alone = group in ("experiment", "hydra") or name in NEEDS or group not in {*CUSTOM, "centers"}
        if not alone:
            groups.setdefault(group, []).append(name)
    lines = {name: [*SHORT, *words] for name, words in options.items() if name != "experiment=ablation"}
    for number in range(max(map(len, groups.values()))):
        names = [members[number % len(members)] for members in groups.values()]
        line = [word for name in names for word in options[name]] + SHORT
        lines |= {members[number]: line for members in groups.values() if number < len(members)}
    return lines | {name: options[name] for name in options if name == "experiment=ablation"}


OPTIONS = _options()
if importlib.util.find_spec("tensorboard") is None:  # an extra: test_tracking.py says so
    del OPTIONS["tracker=tensorboard"]
TOGETHER = _together(OPTIONS)
RUNS = {
    **{" ".join(line): line for line in TOGETHER.values()},
    "figures": ["duration=0.3", "settle_time=0.1"],
    "no history": ["history=false", *SHORT],
    "three": ["trajectories=3", *SHORT],
    "five": ["trajectories=5", *SHORT],
    "five again": ["trajectories=5", *SHORT],
    "five of another seed": ["trajectories=5", "seed=1", *SHORT],
    "polygon of five": ["centers=polygon", "centers.count=5", *SHORT],
    "no window": ["duration=0.05", "settle_time=100", "figures=false"],
    "single precision": ["dtype=float32", *SHORT],
    "diverging": [
        "system=custom",
        "system.path=plants.Escape",
        "initial_state=[0.3,-0.2]",
        "trajectories=8",
        "dt=0.02",
        "duration=3",
        "settle_time=0",
        "figures=false",
    ],
    "sweep": ["-m", "centers.count=3,6", "centers.radius=0.1,-1", *SHORT],
    "help": ["--help"],
    "gaussian": ["kernel=gaussian", *SHORT],
}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Outcome]:
    return run_all(RUNS, tmp_path_factory.mktemp("runs"))


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


@pytest.mark.parametrize("name", [name for name in OPTIONS if not name.startswith(("experiment", "hydra"))])
def test_every_option_of_every_group_runs(name: str, outcomes: dict[str, Outcome]) -> None:
    line = TOGETHER[name]
    run = run_directory(outcomes[" ".join(line)])
    found = metrics(run)
    own = {"largest_state"} if "metric=custom" in line else set()  # of the user's own metric in these tests
    assert set(found) == KEYS | own
    rated = KEYS if UNRATED.isdisjoint(line) else KEYS - {"contraction_violations"}
    assert (found["contraction_violations"] is None) == (rated != KEYS)
    assert all(found[key] is not None and math.isfinite(found[key]) for key in rated)
    assert found["diverged_fraction"] == 0
    assert {path.name for path in run.iterdir()} - {"tensorboard"} == {
        ".hydra",
        "run.json",
        "staf.log",
        "metrics.json",
        "history.npz",
    }


@pytest.mark.parametrize(
    "name", [name for name in OPTIONS if name.startswith("experiment") and name != "experiment=ablation"]
)
def test_every_other_experiment_runs(name: str, outcomes: dict[str, Outcome]) -> None:
    assert {".hydra", "run.json", "staf.log", "metrics.json"} <= {
        path.name for path in run_directory(outcomes[" ".join(TOGETHER[name])]).iterdir()
    }


def test_a_run_directory_holds_exactly_what_is_promised(outcomes: dict[str, Outcome]) -> None:
    run = run_directory(outcomes["figures"])
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


def test_metrics_are_those_of_the_history(outcomes: dict[str, Outcome]) -> None:
    run = run_directory(outcomes["five"])
    found, past = metrics(run), history(run)
    assert found["ultimate_error"] == pytest.approx(np.abs(past["value"] - past["estimate"]).max(), rel=1e-12)
    assert found["ultimate_excess"] == pytest.approx(past["excess"].max(), rel=1e-12)


def test_the_summary_is_printed_and_logged(outcomes: dict[str, Outcome]) -> None:
    outcome = outcomes["gaussian"]
    run = run_directory(outcome)
    for words in ("Gradient chase", "GaussianKernel", "error at the state", run.name):
        assert words in outcome.out
        assert words in (run / "staf.log").read_text()
    assert outcome.err == ""


def test_more_trajectories_are_reproducible_by_seed_and_keep_the_first_ones(
    outcomes: dict[str, Outcome],
) -> None:
    three, five, again, other = (
        history(run_directory(outcomes[name]))
        for name in ("three", "five", "five again", "five of another seed")
    )
    for name, array in five.items():
        np.testing.assert_array_equal(array, again[name])
        if name != "time":
            np.testing.assert_allclose(three[name], array[:3], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(three["state"], five["state"][:3])
    np.testing.assert_array_equal(other["state"][0], five["state"][0])
    assert (other["state"][1:] != five["state"][1:]).all()


def test_figures_false_draws_nothing_and_history_false_keeps_nothing(outcomes: dict[str, Outcome]) -> None:
    run = run_directory(outcomes["no history"])
    assert {path.name for path in run.iterdir()} == {".hydra", "run.json", "staf.log", "metrics.json"}


def test_a_polygon_of_five_warns_in_the_log(outcomes: dict[str, Outcome]) -> None:
    outcome = outcomes["polygon of five"]
    log = (run_directory(outcome) / "staf.log").read_text()
    assert "[WARNING]" in log
    assert "lie on a conic" in log
    assert "lie on a conic" in outcome.out + outcome.err


def test_a_window_after_the_end_is_null_and_said_so(outcomes: dict[str, Outcome]) -> None:
    outcome = outcomes["no window"]
    found = metrics(run_directory(outcome))
    assert set(found) == KEYS
    assert found["ultimate_error"] is None
    assert (
        "nothing to report: the run ends at 0.05 s, and metrics begin at settle_time = 100 s" in outcome.out
    )


def test_single_precision_runs_and_is_stored_so(outcomes: dict[str, Outcome]) -> None:
    found = history(run_directory(outcomes["single precision"]))
    assert {array.dtype for name, array in found.items() if name != "time"} == {np.dtype("float32")}


def test_diverging_trajectories_are_counted_and_named_and_spare_the_others(
    outcomes: dict[str, Outcome],
) -> None:
    run = run_directory(outcomes["diverging"])
    found, past, log = metrics(run), history(run), (run / "staf.log").read_text()
    escaped = {row for row, start in enumerate(past["state"][:, 0]) if start.max() > 1 / 3 + 0.02}
    stayed = set(range(8)) - {
        row for row, start in enumerate(past["state"][:, 0]) if start.max() > 1 / 3 - 0.02
    }
    lost = {row for row in range(8) if not np.isfinite(past["excess"][row]).all()}
    assert escaped <= lost
    assert stayed.isdisjoint(lost)
    assert escaped
    assert stayed
    assert found["diverged_fraction"] == len(lost) / 8
    named = {
        int(line.split("trajectory ")[1].split()[0]) for line in log.splitlines() if "diverged at t" in line
    }
    assert named == lost
    assert found["ultimate_error"] is not None
    for row in lost:
        first = int(np.argmin(np.isfinite(past["excess"][row])))
        assert first > 0
        assert np.isnan(past["estimate"][row, first:]).all()
        np.testing.assert_array_equal(
            past["weights"][row, first:],
            np.broadcast_to(past["weights"][row, first - 1], past["weights"][row, first:].shape),
        )
    for row in stayed:
        assert np.isfinite(past["weights"][row]).all()


def test_a_bad_member_of_a_sweep_is_named_and_the_good_one_before_it_is_kept(
    outcomes: dict[str, Outcome],
) -> None:
    outcome = outcomes["sweep"]
    assert outcome.code == 1
    assert "Traceback" not in outcome.err
    assert "(radius=...)` must be positive; got -1." in outcome.err
    (sweep,) = (outcome.folder / "runs").iterdir()
    assert set(metrics(sweep / "0")) == KEYS
    table = (sweep / "table.md").read_text()
    assert table in outcome.out
    assert len(table.splitlines()) >= 6  # two lines of heading and four jobs
    assert not (sweep / "figures").exists()  # figures=false


def test_the_ablation_ends_with_the_errors_of_the_layouts(outcomes: dict[str, Outcome]) -> None:
    """MATH.md, section 1: worst of six states (not stated: hence 10 %), exponential kernel, r = 0.1."""
    outcome = outcomes[" ".join(TOGETHER["experiment=ablation"])]
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


def test_help_lists_the_groups_and_the_settings(outcomes: dict[str, Outcome]) -> None:
    outcome = outcomes["help"]
    assert outcome.code == 0
    assert outcome.left == set()
    for words in ("State Following", "kernel:", "exponential", "initial_state", "duration"):
        assert words in outcome.out
