"""A job of many members that is killed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from command_line import one

from staf_torch.results.reader import collect
from staf_torch.sweeps import members

SHORT = ("duration=0.05", "settle_time=0", "figures=false")


def test_a_killed_job_keeps_the_members_that_it_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(members, "_PIECE", 2)
    grid = ["members=['seed=range(5)']", "trajectories=2", *SHORT]
    code, _, err = one(str(tmp_path), [*grid, "hydra.run.dir=whole"])
    assert code == 0, err
    compute = members.compute

    def killed(cfgs: Any, *rest: Any, **more: Any) -> Any:
        if len(cfgs) < 2:
            raise KeyboardInterrupt
        return compute(cfgs, *rest, **more)

    monkeypatch.setattr(members, "compute", killed)
    assert one(str(tmp_path), [*grid, "hydra.run.dir=killed"])[0] == 130
    whole, left = collect(tmp_path / "whole").rows, collect(tmp_path / "killed").rows
    assert [run.metrics for run in left[:4]] == [run.metrics for run in whole[:4]]
    assert [run.status for run in left] == ["completed"] * 4 + ["failed"]
