"""The C++ is compiled where it is first used; whatever prevents that, the reference computes the same."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers_chase import BASES, LAW, circles

from staf_torch import chase, chase_weights, targets
from staf_torch.engine import row_program
from staf_torch.lanes import compiler, program


@pytest.mark.compiled
def test_without_a_compiler_the_reference_runs_and_the_log_says_so_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    states, basis = circles(4, 20), BASES["exponential, moving radius"]
    want = chase_weights(states, basis, targets.Paper(), LAW).weights
    for module, name, empty in (
        (row_program._kept, "_models", {}),
        (compiler, "_loaded", {}),
        (program, "_said", set()),
    ):
        monkeypatch.setattr(module, name, empty)
    monkeypatch.setattr(compiler.shutil, "which", lambda _: None)
    with caplog.at_level(logging.INFO):
        got = chase_weights(states, basis, targets.Paper(), LAW).weights
        chase(states.float(), basis, targets.Paper(), LAW)
    torch.testing.assert_close(got, want, rtol=0, atol=1e-8 * float(want.abs().max()))
    assert len([r for r in caplog.records if r.name.startswith("staf_torch")]) == 1


FAULTS = {
    "no compiler": {"PATH": "/nonexistent"},
    "failing build": {"CXX": "/bin/false"},
    "nowhere to write": {"HOME": "/proc", "TMPDIR": "/proc"},
}


@pytest.mark.parametrize("fault", FAULTS)
def test_no_fault_of_a_build_is_more_than_one_line_of_the_log(fault: str, tmp_path: Path) -> None:
    program = """
import sys, tempfile, torch, staf_torch as st
tempfile.tempdir = __import__("os").environ.get("TMPDIR")
basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(3), 0.1))
for dtype in (torch.float64, torch.float32):
    for run in (st.chase, st.chase_weights):
        states = torch.ones(2, 17, 2, dtype=dtype)
        weights = run(states, basis, st.targets.Paper(), st.optim.SteepestDescent())
        assert weights.weights.isfinite().all()
"""
    unset = ("CXX", "XDG_CACHE_HOME")
    environment = {name: value for name, value in os.environ.items() if name not in unset}
    if "HOME" not in FAULTS[fault]:
        environment["XDG_CACHE_HOME"] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        env=environment | FAULTS[fault],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert "runs in plain torch" in done.stderr
