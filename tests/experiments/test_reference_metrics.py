"""Metrics of every experiment, run short, as they were: what any constant of a case changes.

    python tests/experiments/test_reference_metrics.py [case ...]  # records them anew

A change that is meant is seen in the difference of `reference_metrics.json`. What else a run leaves, columns
of its tables and of its history and what it says, is in `tests/recorded`.
"""

from __future__ import annotations

import csv
import functools
import json
import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from composing import settings
from figures.looks import looks, version
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from recorded import Record

from staf_torch.adp import DirectShooting
from staf_torch.experiments.registry import EXPERIMENTS, experiment
from staf_torch.results.progress import Progress

RECORDED = Path(__file__).with_name("reference_metrics.json")
CASES: dict[str, str] = {
    "adp": "experiment=adp duration=0.3 dt=0.005 trajectories=2",
    "adp_comparison": "experiment=adp_comparison duration=0.04 dt=0.01",
    "adp_initial_weights": "experiment=adp_initial_weights duration=0.1 dt=0.01",
    "adp_tracking": "experiment=adp_tracking duration=0.3 dt=0.01 trajectories=2",
    "avoidance": "experiment=avoidance trajectories=3 duration=2.0 dt=0.1 adp.compile=false",
    "avoidance of a unicycle": "experiment=avoidance avoidance.vehicle=unicycle trajectories=2 "
    "duration=1.0 dt=0.1 adp.compile=false",
    "exponential_bound": "experiment=exponential_bound exponential_bound.states=9 "
    "exponential_bound.radii=[0.1]",
    "faults": "experiment=faults trajectories=3 duration=0.6 faults.cases=[unstable]",
    "faults from the start": "experiment=faults trajectories=3 duration=0.05 "
    "faults.cases=[short_period,mass]",
    "feasibility": "experiment=feasibility feasibility.states=16 feasibility.radii=[0.1] "
    "feasibility.epsilons=[0.1,0.01]",
    "flat_limit": "experiment=flat_limit flat_limit.radii.per_decade=2 flat_limit.radii.smallest=1e-4",
    "gradient_chase": "dt=0.05 duration=1.0 settle_time=0.5 trajectories=3 certificate=true centers.count=6 "
    "spread=0.4",
    "icl": "experiment=icl trajectories=3 dt=0.01 duration=0.5 settle_time=0.1 icl.length=[0.02,0.04]",
    "laws": "experiment=laws dt=0.1 duration=1.0 settle_time=0.5 laws.steps=[0.2,0.1] laws.work=4",
    "layouts": "experiment=layouts layouts.states=4 layouts.radii=[0.1,0.2]",
    "memory": "experiment=memory duration=8 dt=0.02 memory.steps=30 memory.revisits=6 memory.states=40",
    "safe_box": "experiment=safe_box duration=0.1 dt=0.01 trajectories=2 safe_box.states=4 safe_box.decay=20 "
    "safe_box.substeps=2 safe_box.followed=0.03",
}


FAILING = ("cholesky_", "jitter_", "pivoted_")  # methods of `flat_limit`: how far they come is rounding


def taking(drawn: list[Figure]) -> Callable[[Figure], dict[str, bytes]]:
    """What takes the place of drawing a figure's two files, which takes a second: it is kept."""

    def images(figure: Figure) -> dict[str, bytes]:
        drawn.append(figure)
        return {"png": b"a figure"}

    return images


def metrics_of(
    name: str, directory: Path, figures: bool = False, told: list[float] | None = None
) -> dict[str, float | None]:
    """The metrics of a case."""
    cfg = settings(f"figures={figures}", *CASES[name].split())
    run = experiment(cfg.task)
    with pytest.MonkeyPatch.context() as patch:  # the optimum in a box on a mesh of its own takes 11 s
        coarse = functools.partial(DirectShooting, horizon=0.5, intervals=8)
        patch.setattr("staf_torch.experiments.safe_box.DirectShooting", coarse)
        found: dict[str, float | None] = run(
            cfg, directory, Progress([].append if told is None else told.append)
        )
    return found


def test_every_experiment_has_recorded_metrics() -> None:
    assert {name.split()[0] for name in CASES} == EXPERIMENTS.keys() - {"rivals"}  # which times others
    assert json.loads(RECORDED.read_text()).keys() == CASES.keys()


def test_what_is_recorded_of_faults_is_what_is_claimed_of_them() -> None:
    """The adaptive policy knows nothing at first, so is not the informed one; it finds a failure at once."""
    recorded = json.loads(RECORDED.read_text())["faults from the start"]
    assert recorded["mass_adaptive_cost_median"] != recorded["mass_informed_LQR_cost_median"]
    assert recorded["short_period_adaptive_parameter_error"] < 1e-4


def left_in(directory: Path) -> dict[str, object]:
    """Columns of tables and arrays of histories, without what was measured by a clock."""
    found: dict[str, object] = {}
    for path in sorted(directory.rglob("*.csv")):
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        for column in rows[0] if rows else ():
            if not re.search("second|_us|time_us", column):
                found[f"{path.name}:{column}"] = _column([row[column] for row in rows])
    for path in sorted(directory.rglob("*.npz")):
        with np.load(path) as arrays:
            found |= {
                f"{path.name}:{key}": arrays[key] for key in arrays.files if arrays[key].dtype.kind != "U"
            }
    return found


def _column(cells: list[str]) -> object:
    try:
        return np.array([float(cell or "nan") for cell in cells])
    except ValueError:
        return " | ".join(cells)


@pytest.mark.parametrize("name", CASES)
def test_metrics_are_the_recorded_ones(
    name: str,
    tmp_path: Path,
    record: Record,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    caplog.set_level("INFO")
    if name == "adp_tracking":  # its optimum is a Riccati equation's
        pytest.importorskip("scipy", reason="needs the extra adp")
    recorded = json.loads(RECORDED.read_text())[name]
    drawn: list[Figure] = []
    for module in {*EXPERIMENTS.values()}:
        monkeypatch.setattr(f"staf_torch.experiments.{module.partition('.')[0]}.images", taking(drawn))
    others = "\n" if record.known().get("looks", version()) == version() else "looks"
    told: list[float] = []
    found = metrics_of(name, tmp_path, figures=True, told=told)
    assert found.keys() == recorded.keys()
    assert json.loads((tmp_path / "metrics.json").read_text()) == found
    for metric, number in recorded.items():
        if metric.startswith(FAILING):
            continue
        least = 0.0 if metric == "rounding_floor" else 1e-9
        assert found[metric] == (None if number is None else pytest.approx(number, rel=1e-4, abs=least)), (
            metric
        )
    figures = [path.name for path in sorted(tmp_path.glob("figures/*"))]
    assert len(figures) == len(drawn)
    left = {} if name == "flat_limit" else left_in(tmp_path) | lines_of(drawn)
    record(
        left
        | {"figures": figures, "said": said(caplog), "progress": told}
        | shown_in(tmp_path)
        | pictured(drawn),
        rtol=1e-4,
        without=others,
    )
    for figure in drawn:
        figure.draw_without_rendering()  # it can be drawn


def shown_in(directory: Path) -> dict[str, object]:
    """The words of the tables that are for reading, without their numbers."""
    return {f"words:{path.name}": _words(path.read_text()) for path in sorted(directory.rglob("*.md"))}


def pictured(drawn: list[Figure]) -> dict[str, object]:
    """How figures look, without their numbers."""
    found: dict[str, object] = {"looks": version()}
    for figure in drawn:
        found |= {f"looks:{at}": _words(words) for at, words in enumerate(looks(figure))}
    return found


def lines_of(drawn: list[Figure]) -> dict[str, object]:
    """The data of the lines of figures."""
    found: dict[str, object] = {}
    for figure in drawn:
        lines = (line for axes in figure.axes for line in axes.lines)
        found |= {f"line:{at}": _data(line) for at, line in enumerate(lines)}
    return found


def _data(line: Line2D) -> np.ndarray:
    """Points of a line; where all is rounding, which an axis of powers of ten lacks at 0, x alone."""
    data = np.array(line.get_xydata())
    rounding = line.axes.get_yscale() == "log" and not (np.abs(data[:, 1]) > 1e-12).any()
    return data[:, 0] if rounding else data


def _words(text: str) -> str:
    """Without numbers; nor where a method fails, in their place."""
    return re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?|/tmp/\S+|[ -]{2,}|\bfails\b", "N", text)


def said(caplog: pytest.LogCaptureFixture) -> list[str]:
    """The words of the log, without its numbers, of the library's own."""
    lines = (each.getMessage() for each in caplog.records if each.name.startswith("staf_torch"))
    words = map(_words, lines)
    return [line for line in words if "compiled" not in line]


if __name__ == "__main__":
    known = json.loads(RECORDED.read_text()) if RECORDED.exists() else {}
    for case in sys.argv[1:] or CASES:
        with tempfile.TemporaryDirectory() as folder:
            known[case] = metrics_of(case, Path(folder))
    RECORDED.write_text(json.dumps({case: known[case] for case in CASES}, indent=1) + "\n")
