"""A place that vanishes, fills up or cannot be written while a sweep goes on: told at once, exit code 1."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from command_line import one

from staf_torch.results import files
from staf_torch.results.reader import collect
from staf_torch.sweeps import launcher

SWEEP = ["-m", "seed=range(3)", "duration=0.05", "settle_time=0", "figures=false", "hydra.sweep.dir=sweep"]


@pytest.fixture(autouse=True)
def _come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def after_the_first(monkeypatch: pytest.MonkeyPatch, harm: Any) -> None:
    """Do harm before the second job gets its directory."""
    replay = launcher.Launch._replay

    def spoilt(self: launcher.Launch, job: launcher.Job, *rest: Any) -> Any:
        found = replay(self, job, *rest)
        if job.num == 0:
            harm()
        return found

    monkeypatch.setattr(launcher.Launch, "_replay", spoilt)


def test_a_directory_that_is_removed_ends_its_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    after_the_first(monkeypatch, lambda: shutil.rmtree(tmp_path / "sweep"))
    code, out, err = one(str(tmp_path), SWEEP)
    assert code == 1
    assert "sweep was removed or replaced while its sweep went on" in err
    assert "completed" not in out
    assert not (tmp_path / "sweep").exists()


def test_a_job_that_is_removed_is_no_completed_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    after_the_first(monkeypatch, lambda: shutil.rmtree(tmp_path / "sweep" / "0"))
    code, out, err = one(str(tmp_path), SWEEP)
    assert code == 1
    assert "are not in sweep/0 any more" in err
    assert "2 of 3 jobs completed, 1 failed" in out


def test_a_full_disk_fails_what_it_hits_and_resume_ends_the_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = files.write_bytes

    def full(path: Path, content: bytes) -> None:
        if path.name == "metrics.json" and path.parent.name == "1":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        write(path, content)

    monkeypatch.setattr(files, "write_bytes", full)
    code, _, err = one(str(tmp_path), SWEEP)
    assert code == 1
    assert "job 1 (seed=1 " in err
    assert "failed: cannot write" in err
    assert "No space left on device" in err
    assert [run.status for run in collect(tmp_path / "sweep").rows] == ["completed", "failed", "completed"]
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    assert one(str(tmp_path), ["-m", "sweep.resume=sweep"])[0] == 0
    assert [run.status for run in collect(tmp_path / "sweep").rows] == ["completed"] * 3


def test_a_place_that_cannot_be_written_is_said_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    code, _, err = one(str(tmp_path), [*SWEEP[:-1], "hydra.sweep.dir=file/sweep"])
    assert code == 1
    assert err.startswith("staf: cannot write file")
