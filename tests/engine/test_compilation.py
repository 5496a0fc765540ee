"""The C++ is compiled where it is first used; whatever prevents that, the reference computes the same."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path

import pytest
import torch
from helpers_chase import BASES, LAW, circles

from staf_torch import chase, chase_weights, targets
from staf_torch.engine import row_program
from staf_torch.lanes import build, compiler, program

FAULTS = {
    "no compiler": {"PATH": "/nonexistent"},
    "failing build": {"CXX": "/bin/false"},
    "nowhere to write": {"HOME": "/proc"},
}


@pytest.mark.compiled
@pytest.mark.parametrize("fault", FAULTS)
def test_where_nothing_can_be_built_the_reference_runs_and_the_log_says_so_once(
    fault: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    states, basis = circles(4, 20), BASES["exponential, moving radius"]
    with monkeypatch.context() as definition:
        definition.setattr(row_program, "_SHORTEST", 10**9)
        want = chase_weights(states, basis, targets.Paper(), LAW).weights
    for module, name, empty in (
        (row_program._kept, "_models", {}),
        (compiler, "_loaded", {}),
        (program, "_said", set()),
        (build, "_temporary", {}),
    ):
        monkeypatch.setattr(module, name, empty)
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if "HOME" in FAULTS[fault]:
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.setattr(tempfile, "tempdir", FAULTS[fault]["HOME"])
    for name, value in FAULTS[fault].items():
        monkeypatch.setenv(name, value)
    with caplog.at_level(logging.INFO):
        got = chase_weights(states, basis, targets.Paper(), LAW).weights
        chase(states.float(), basis, targets.Paper(), LAW)
    assert torch.equal(got, want)
    (said,) = (r.getMessage() for r in caplog.records if r.name.startswith("staf_torch"))
    assert "runs in plain torch" in said
    assert len(said.splitlines()) == 1
    assert not compiler._loaded
