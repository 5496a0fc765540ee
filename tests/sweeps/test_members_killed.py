"""A job of many members that is killed, and taken up again."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from command_line import one

from staf_torch.results import build
from staf_torch.results.reader import collect
from staf_torch.sweeps import members

SHORT = ("duration=0.05", "settle_time=0", "figures=false")
GRID = ["members=['kernel=own,gaussian', 'seed=range(4)']", "trajectories=2", *SHORT]
OWN = ["--config-dir", "conf"]
PARTIAL, SUMS = ".members.json.partial", ".members.json.sums"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of eight members, one that was killed after six, and a kernel's settings."""
    place = tmp_path_factory.mktemp("members")
    (place / "conf" / "kernel").mkdir(parents=True)
    (place / "conf" / "kernel" / "own.yaml").write_text(
        "_target_: staf_torch.kernels.GaussianKernel\nwidth: 1.5\n"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(members, "_PIECE", 2)
        code, _, err = one(str(place), [*OWN, *GRID, "history=true", "hydra.run.dir=whole"])
        assert code == 0, err
        compute = members.compute

        def killed(cfgs: Any, places: Any, *rest: Any, **more: Any) -> Any:
            if places[0].name == "6":
                raise KeyboardInterrupt
            return compute(cfgs, places, *rest, **more)

        patch.setattr(members, "compute", killed)
        code, _, err = one(str(place), [*OWN, *GRID, "history=true", "hydra.run.dir=killed"])
        assert code == 130
        (place / "said").write_text(err)
    return place


@pytest.fixture
def place(runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it."""
    monkeypatch.setattr(members, "_PIECE", 2)
    monkeypatch.chdir(tmp_path)  # comes back here from wherever the command goes
    return Path(shutil.copytree(runs, tmp_path / "copy"))


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The members whose outcome was asked for, as the test goes on."""
    asked: list[int] = []
    compute = members.compute

    def noted(cfgs: Any, places: Any, *rest: Any, **more: Any) -> Any:
        for found in compute(cfgs, places, *rest, **more):
            asked.append(int(places[found[0]].name))
            yield found

    monkeypatch.setattr(members, "compute", noted)
    return asked


def resume(place: Path, *more: str) -> tuple[int, str, str]:
    return one(str(place), [*OWN, "sweep.resume=killed", *more])


def test_ctrl_c_says_how_many_members_are_complete_and_how_to_resume(runs: Path) -> None:
    said = "staf: interrupted; 6 of 8 members are complete. Resume with:\n  staf sweep.resume=killed\n"
    assert (runs / "said").read_text().endswith(said)


def cut_in_a_row(killed: Path) -> None:
    """The third row ends in its middle, and what comes after is gone."""
    lines = (killed / PARTIAL).read_bytes().splitlines(keepends=True)
    (killed / PARTIAL).write_bytes(b"".join(lines[:3]) + lines[3][:40])


def flip_a_digit(killed: Path) -> None:
    lines = (killed / PARTIAL).read_text().splitlines(keepends=True)
    at = max(n for n, letter in enumerate(lines[3]) if letter.isdigit())
    lines[3] = f"{lines[3][:at]}{(int(lines[3][at]) + 1) % 10}{lines[3][at + 1 :]}"
    (killed / PARTIAL).write_text("".join(lines))


def spoil_a_history(killed: Path) -> None:
    path = killed / "members" / "2" / "history.npz"
    path.write_bytes(path.read_bytes()[:-9])


def lose_a_checksum(killed: Path) -> None:
    """The row was on the disk, and its checksum was not yet."""
    lines = (killed / SUMS).read_bytes().splitlines(keepends=True)
    (killed / SUMS).write_bytes(b"".join(lines[:3]) + lines[3][:20])


def lose_a_row(killed: Path) -> None:
    lines = (killed / SUMS).read_bytes().splitlines(keepends=True)
    (killed / SUMS).write_bytes(b"".join(lines[:6]))


def lose_everything(killed: Path) -> None:
    (killed / PARTIAL).unlink()


def leave(killed: Path) -> None:
    """Everything stays as it is."""


DAMAGE = {
    "none": (leave, [6, 7]),
    "a cut row": (cut_in_a_row, [2, 3, 4, 5, 6, 7]),
    "another digit": (flip_a_digit, [2, 3, 4, 5, 6, 7]),
    "a cut history": (spoil_a_history, [2, 3, 4, 5, 6, 7]),
    "a cut checksum": (lose_a_checksum, [2, 3, 4, 5, 6, 7]),
    "no checksum, in the middle of a piece": (lose_a_row, [5, 6, 7]),
    "everything": (lose_everything, [0, 1, 2, 3, 4, 5, 6, 7]),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_resumed_job_computes_what_is_missing_and_ends_with_the_same_bytes(
    name: str, place: Path, computed: list[int]
) -> None:
    spoil, missing = DAMAGE[name]
    spoil(place / "killed")
    code, _, err = resume(place)
    assert code == 0, err
    assert sorted(computed) == missing
    for file in ("members.json", "metrics.json"):
        assert (place / "killed" / file).read_bytes() == (place / "whole" / file).read_bytes()
    assert not list((place / "killed").glob(".members*"))
    made = [json.loads((place / each / "run.json").read_text())["files"] for each in ("killed", "whole")]
    assert made[0].keys() == made[1].keys()


def test_a_row_of_other_settings_is_refused_and_stays(
    place: Path, computed: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = place / "conf" / "kernel" / "own.yaml"
    rows = (place / "killed" / PARTIAL).read_bytes()
    path.write_text(path.read_text().replace("1.5", "2.5"))
    code, _, err = resume(place)
    assert code == 1
    assert "member 0 (kernel=own seed=0) was not made as it would be now" in err
    path.write_text(path.read_text().replace("2.5", "1.5"))
    with monkeypatch.context() as patch:
        patch.setattr(build, "source", lambda: "0" * 12)
        code, _, err = resume(place)
    assert code == 1
    assert "the source of staf_torch was" in err
    assert not computed
    assert (place / "killed" / PARTIAL).read_bytes() == rows
    assert resume(place)[0] == 0
    assert sorted(computed) == [6, 7]


def test_a_job_begins_anew_where_a_person_means_it(
    place: Path, computed: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "source", lambda: "0" * 12)
    code, _, err = resume(place, "sweep.resume_anyway=true")
    assert code == 0, err
    assert sorted(computed) == list(range(8))


def test_one_run_is_not_resumed_as_a_sweep(place: Path) -> None:
    code, _, err = one(str(place), ["-m", "sweep.resume=killed"])
    assert code == 1
    assert "is one run, of many members: resume it without -m" in err


def test_a_killed_job_keeps_the_members_that_it_finished(runs: Path) -> None:
    whole, left = collect(runs / "whole").rows, collect(runs / "killed").rows
    assert [run.metrics for run in left[:6]] == [run.metrics for run in whole[:6]]
    assert [run.status for run in left] == ["completed"] * 6 + ["failed"]


def test_a_sweep_of_such_jobs_goes_on_within_the_job(
    tmp_path: Path, computed: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(members, "_PIECE", 2)
    monkeypatch.chdir(tmp_path)
    lines = ["-m", "members=['seed=range(3)']", "centers.radius=0.1,0.2", *SHORT]
    with monkeypatch.context() as patch:
        compute = members.compute  # type: ignore[attr-defined]

        def killed(cfgs: Any, places: Any, *rest: Any, **more: Any) -> Any:
            if places[0].parts[-3:] == ("1", "members", "2"):
                raise KeyboardInterrupt
            return compute(cfgs, places, *rest, **more)

        patch.setattr(members, "compute", killed)
        code, _, err = one(str(tmp_path), [*lines, "hydra.sweep.dir=killed"])
        assert code == 130, err
    assert computed == [0, 1, 2, 0, 1]
    assert one(str(tmp_path), ["-m", "sweep.resume=killed"])[0] == 0
    assert computed == [0, 1, 2, 0, 1, 2]
    assert one(str(tmp_path), [*lines, "hydra.sweep.dir=whole"])[0] == 0
    for job in ("0", "1"):
        rows = [(tmp_path / each / job / "members.json").read_bytes() for each in ("killed", "whole")]
        assert rows[0] == rows[1]
