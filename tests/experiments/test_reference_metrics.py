"""Every experiment, run short, has its golden metrics, its files and its figures.

    PYTHONPATH=tests python tests/experiments/test_reference_metrics.py [CASE ...]  # records them anew

A golden metric is one of `GOLDEN` that moves by less than 1e-7 of itself while the initial state moves by
1e-12 of itself and while torch and compiled loops use AVX-512, AVX2 or neither; what moves more is bounded
by a property in another test, or left out. The test then allows 1e-4, far more than rounding and far less
than any change of a method.
"""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from helpers_experiments import CASES, ran, run, words

from staf_torch.experiments.registry import EXPERIMENTS

RECORDED = Path(__file__).with_name("reference_metrics.json")
GOLDEN: dict[str, str] = {
    "adp_comparison": "ratio_|regulated|final_state_norm|points|functions",
    "avoidance": "cost|margin|violations|infeasible",
    "avoidance of a unicycle": "cost|margin|violations|infeasible",
    "flat_limit": "graded_fails|cholesky_fails.*float32",
    "gradient_chase": "error|excess|violations|condition",
    "laws": r"ball_error|ultimate_excess|slope|a_priori|certificate|\.products",
    "rivals": "regulated|violations",
}
"""Of which metrics of a case some are recorded; all, where it is not named."""


def test_every_experiment_has_a_case() -> None:
    assert {name.split()[0] for name in CASES} == EXPERIMENTS.keys()
    assert json.loads(RECORDED.read_text()).keys() == CASES.keys()


@pytest.mark.parametrize("name", CASES)
def test_golden_metrics_are_as_recorded(name: str) -> None:
    if name in ("adp_tracking", "rivals"):  # their optimum is a Riccati equation's
        pytest.importorskip("scipy", reason="needs the extra adp")
    found, recorded = ran(name).metrics, json.loads(RECORDED.read_text())[name]
    assert recorded.keys() <= found.keys()
    moved = {
        metric: (found[metric], number)
        for metric, number in recorded.items()
        if found[metric] != (None if number is None else pytest.approx(number, rel=1e-4, abs=1e-9))
    }
    assert not moved


@pytest.mark.parametrize("name", CASES)
def test_a_run_leaves_a_figure_with_named_axes_and_tells_its_progress(name: str) -> None:
    if name in ("adp_tracking", "rivals"):
        pytest.importorskip("scipy", reason="needs the extra adp")
    result = ran(name)
    drawn = {path.stem for path in (result.directory / "figures").iterdir()} if result.figures else set()
    assert drawn == {name.split()[0]}
    for figure in result.figures:
        for axes in (axes for axes in figure.axes if axes.get_visible() and axes.get_label() != "<legend>"):
            shared = axes.get_shared_x_axes().get_siblings(axes)
            assert any(each.get_xlabel() for each in shared) or axes.get_label() == "<colorbar>"
            assert any(each.get_ylabel() for each in figure.axes)
            assert axes.get_lines() or axes.collections or axes.patches or axes.texts
    assert all(0 < share <= 1 + 1e-9 for share in result.progress)
    assert not result.progress or result.progress[-1] == pytest.approx(1)


def measured(names: list[str]) -> dict[str, dict[str, float | None]]:
    """The metrics of cases, of an initial state that is perturbed by as much as the environment says."""
    found = {}
    for name in names:
        given = words(name)
        share = float(os.environ.get("PERTURBED", 0))
        if share:
            from composing import settings

            start = settings(*given).get("initial_state")
            if start is not None:
                given.append(f"initial_state={[value * (1 + share) for value in start]}")
        with tempfile.TemporaryDirectory() as folder:
            found[name] = run(Path(folder), *given, "figures=false").metrics
    return found


def stable(all_found: list[dict[str, float | None]], names: str) -> dict[str, float | None]:
    """Those of the names that are the same, to 1e-7, in all that was found."""
    first, *others = all_found
    kept = {}
    for metric, number in first.items():
        same = pytest.approx(number, rel=1e-7, abs=1e-10) if isinstance(number, int | float) else None
        if re.search(names, metric) and all(other.get(metric, math.nan) == same for other in others):
            kept[metric] = None if number is None else float(f"{number:.7g}")
    return kept


if __name__ == "__main__":
    chosen = [word for word in sys.argv[1:] if not word.startswith("--")] or list(CASES)
    if "--print" in sys.argv:
        from staf_torch import lanes

        with lanes.compiling("auto" if "--compiled" in sys.argv else "never"):
            print(json.dumps(measured(chosen)))
    else:
        variants = [
            ({}, ()),
            ({"PERTURBED": "1e-12"}, ()),
            ({"PERTURBED": "-1e-12", "ATEN_CPU_CAPABILITY": "default"}, ()),
            ({"ATEN_CPU_CAPABILITY": "avx2", "CXXFLAGS": "-march=x86-64-v2"}, ("--compiled",)),
            ({"CXXFLAGS": "-march=x86-64-v3"}, ("--compiled",)),
        ]
        everything = []
        for environment, flags in variants:
            command = [sys.executable, __file__, "--print", *flags, *chosen]
            output = subprocess.run(command, env=os.environ | environment, stdout=subprocess.PIPE, check=True)
            everything.append(json.loads(output.stdout.splitlines()[-1]))
        text = json.loads(RECORDED.read_text())
        for name in chosen:
            text[name] = stable([found[name] for found in everything], GOLDEN.get(name, ""))
            lost = {*everything[0][name]} - {*text[name]}
            print(name, len(text[name]), "recorded; left out:", *sorted(lost)[:40])
        lines = [f" {json.dumps(name)}: {json.dumps(text[name])}" for name in CASES]
        RECORDED.write_text("{\n" + ",\n".join(lines) + "\n}\n")
