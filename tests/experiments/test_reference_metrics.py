"""Every experiment, run short, has its golden metrics, its files and its figures.

    pytest tests/experiments/test_reference_metrics.py --record  # writes those that are recorded anew

A golden metric moves by less than 1e-7 of itself while the initial state moves by 1e-12 of itself and while
torch and compiled loops use AVX-512, AVX2 or neither; what moves more is bounded by a property in another
test, or taken out of the record by hand. The test then allows 1e-4, far more than rounding and far less than
any change of a method.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers_experiments import CASES, ran

from staf_torch.experiments.registry import EXPERIMENTS

RECORDED = Path(__file__).with_name("reference_metrics.json")


def test_every_experiment_has_a_case() -> None:
    assert {name.split()[0] for name in CASES} == EXPERIMENTS.keys()
    assert json.loads(RECORDED.read_text()).keys() == CASES.keys()


@pytest.mark.parametrize("name", CASES)
def test_a_run_has_its_golden_metrics_a_figure_with_named_axes_and_its_progress(
    name: str, request: pytest.FixtureRequest
) -> None:
    if name in ("adp_tracking", "rivals"):  # their optimum is a Riccati equation's
        pytest.importorskip("scipy", reason="needs the extra adp")
    result, known = ran(name), json.loads(RECORDED.read_text())
    if request.config.getoption("--record"):  # of a new case, all
        names = known.get(name, result.metrics)
        known[name] = {metric: result.metrics[metric] for metric in names}
        lines = [f" {json.dumps(case)}: {json.dumps(known[case])}" for case in CASES if case in known]
        RECORDED.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    assert known[name].keys() <= result.metrics.keys()
    moved = {
        metric: (result.metrics[metric], number)
        for metric, number in known[name].items()
        if result.metrics[metric] != (None if number is None else pytest.approx(number, rel=1e-4, abs=1e-9))
    }
    assert not moved
    assert {path.stem for path in (result.directory / "figures").iterdir()} == {name.split()[0]}
    for figure in result.figures:
        for axes in (axes for axes in figure.axes if axes.get_visible() and axes.get_label() != "<legend>"):
            shared = axes.get_shared_x_axes().get_siblings(axes)
            assert any(each.get_xlabel() for each in shared) or axes.get_label() == "<colorbar>"
            assert any(each.get_ylabel() for each in figure.axes)
            assert axes.get_lines() or axes.collections or axes.patches or axes.texts
    assert all(0 < share <= 1 + 1e-9 for share in result.progress)
    assert not result.progress or result.progress[-1] == pytest.approx(1)
