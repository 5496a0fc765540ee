"""The C++ is compiled where it is first used; whatever prevents that, the reference computes the same."""

from __future__ import annotations

import json
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
@pytest.mark.needs_compiler
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
FAULTY = """
import json, os, sys, tempfile, torch, staf_torch as st

faults, place = json.loads(sys.argv[1]), sys.argv[2]
for name, changed in faults.items():  # each in a fork, so that torch is imported once
    child = os.fork()
    if child:
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        continue
    said = os.open(f"{place}/{name}", os.O_CREAT | os.O_WRONLY)
    os.dup2(said, 1)
    os.dup2(said, 2)
    if "HOME" not in changed:
        os.environ["XDG_CACHE_HOME"] = f"{place}/cache of {name}"
    os.environ.update(changed)
    tempfile.tempdir = os.environ.get("TMPDIR")
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(3), 0.1))
    for dtype, run in ((torch.float64, st.chase), (torch.float32, st.chase_weights)):
        states = torch.ones(2, 17, 2, dtype=dtype)
        weights = run(states, basis, st.targets.Paper(), st.optim.SteepestDescent(), inner_steps=2)
        assert weights.weights.isfinite().all()
    sys.stdout.flush()
    os._exit(0)
"""


def test_no_fault_of_a_build_is_more_than_one_line_of_the_log(tmp_path: Path) -> None:
    unset = ("CXX", "XDG_CACHE_HOME")
    ended = subprocess.run(
        [sys.executable, "-u", "-W", "error", "-c", FAULTY, json.dumps(FAULTS), str(tmp_path)],
        env={name: value for name, value in os.environ.items() if name not in unset},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    said = {fault: (tmp_path / fault).read_text() for fault in FAULTS}
    assert ended.stdout.split() == ["0"] * len(FAULTS), (said, ended.stderr)
    for fault, text in said.items():
        assert len(text.splitlines()) == 1, (fault, text)
        assert "runs in plain torch" in text
