"""Run directories of every age and in every state, read back."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from sweep_runs import BAD_COUNT, typed, write_run, write_sweep

from staf_torch import __version__
from staf_torch.results.files import parse_overrides
from staf_torch.results.reader import collect


def test_a_sweep_has_a_row_a_job_in_the_order_of_the_jobs(tmp_path: Path) -> None:
    found = collect(write_sweep(tmp_path / "sweep"))
    assert [run.directory.name for run in found.rows] == [str(num) for num in range(36)]
    assert found.swept == ("kernel", "centers.radius", "centers.count", "seed")
    first = found.rows[0]
    assert first.overrides == {"kernel": "exponential", "centers.radius": 0.05, "centers.count": 3, "seed": 0}
    assert first.settings["initial_state"] == [1.0, 0.0]
    assert first.metrics["ball_error"] == 5.0 * 0.05**2
    assert (first.status, first.reason, first.version) == ("completed", None, __version__)
    assert (found.skipped, found.remarks) == ((), ())


def test_failed_jobs_keep_their_row_and_their_reason(tmp_path: Path) -> None:
    found = collect(write_sweep(tmp_path))
    failed = [run for run in found.rows if run.status == "failed"]
    assert len(failed) == 12
    assert {run.reason for run in failed} == {BAD_COUNT}
    assert all(run.metrics == {} and run.setting("centers.count") == 7 for run in failed)


def test_a_sweep_that_goes_on_has_rows_for_what_began_and_names_what_did_not(tmp_path: Path) -> None:
    jobs = [{"num": num, "overrides": typed({"seed": num})} for num in range(4)]
    (tmp_path / "sweep.json").write_text(json.dumps({"version": __version__, "jobs": jobs}))
    write_run(tmp_path / "0", {"seed": 0}, {"ball_error": 1.0})
    write_run(tmp_path / "1", {"seed": 1}, None, status="running")
    found = collect(tmp_path)
    assert [run.status for run in found.rows] == ["completed", "running"]
    assert "killed" in str(found.rows[1].reason)
    (waiting,) = found.skipped
    assert waiting.path == tmp_path
    assert waiting.reason == "2 of 4 jobs have not started: 2, 3"


def test_a_run_from_before_the_record_is_read_from_what_hydra_left(tmp_path: Path) -> None:
    hydra = tmp_path / "old" / ".hydra"
    hydra.mkdir(parents=True)
    (hydra / "overrides.yaml").write_text("- kernel=gaussian\n- '+seed=3'\n- hydra.job.num=1\n")
    (hydra / "config.yaml").write_text("task: gradient_chase\nkernel: {width: 1.0}\ncenters:\n  count: 3\n")
    (hydra / "hydra.yaml").write_text(
        "hydra:\n  runtime:\n    choices: {kernel: gaussian, hydra/help: staf}\n"
    )
    (unfinished,) = collect(tmp_path).rows
    assert unfinished.status == "unfinished"
    assert "has no metrics.json" in str(unfinished.reason)
    (tmp_path / "old" / "metrics.json").write_text('{"ball_error": 0.5}')
    (run,) = collect(tmp_path).rows
    assert (run.status, run.reason) == ("completed", None)
    assert run.overrides == {"kernel": "gaussian", "seed": 3}
    assert run.settings == {
        "task": "gradient_chase",
        "kernel": "gaussian",
        "kernel.width": 1.0,
        "centers.count": 3,
    }
    assert run.metrics == {"ball_error": 0.5}


def test_members_are_rows_like_those_of_jobs(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", {"members": "[...]", "kernel": "gaussian"}, None)
    members = [
        {
            "num": 0,
            "overrides": ["seed=0"],
            "status": "completed",
            "reason": None,
            "metrics": {"ball_error": 1.0},
        },
        {"num": 1, "overrides": ["seed=1"], "status": "failed", "reason": "why", "metrics": {}},
    ]
    (run / "members.json").write_text(json.dumps({"version": __version__, "members": members}))
    (run / "metrics.json").write_text('{"ball_error": 7.0}')
    found = collect(run)
    assert [row.member for row in found.rows] == [0, 1]
    assert [dict(row.overrides) for row in found.rows] == [
        {"kernel": "gaussian", "seed": 0},
        {"kernel": "gaussian", "seed": 1},
    ]
    assert found.rows[1].setting("seed") == 1
    assert found.rows[0].metrics == {"ball_error": 1.0}
    assert (found.rows[1].status, found.rows[1].reason) == ("failed", "why")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("metrics.json", '{"ball_error": 1', "metrics.json is not JSON"),
        ("metrics.json", "[]", "metrics.json holds no object"),
        ("run.json", '{"status": ', "run.json is not JSON"),
        ("run.json", '{"version": "9.9", "status": "superposed"}', "written by staf_torch 9.9"),
        ("members.json", '{"members": 3}', "members.json has no list of members"),
    ],
)
def test_a_damaged_run_is_named_and_spares_the_others(
    name: str, text: str, said: str, tmp_path: Path
) -> None:
    write_run(tmp_path / "0", {"seed": 0}, {"ball_error": 1.0})
    (write_run(tmp_path / "1", {"seed": 1}, {"ball_error": 2.0}) / name).write_text(text)
    found = collect(tmp_path)
    assert found.rows[0].metrics == {"ball_error": 1.0}
    told = [run.reason for run in found.rows[1:]] + [skipped.reason for skipped in found.skipped]
    assert said in str(told)


def test_a_folder_with_half_of_hydras_files_is_skipped_with_the_reason(tmp_path: Path) -> None:
    write_run(tmp_path / "0", {}, {"ball_error": 1.0})
    (tmp_path / "1").mkdir()
    (tmp_path / "1" / "metrics.json").write_text("{}")
    found = collect(tmp_path)
    assert len(found.rows) == 1
    (skipped,) = found.skipped
    assert skipped.path == tmp_path / "1"
    assert "overrides.yaml cannot be read" in skipped.reason
    (tmp_path / "1" / ".hydra").mkdir()
    for text in ("a: 1", "'ab'", "3", ""):
        (tmp_path / "1" / ".hydra" / "overrides.yaml").write_text(text)
        (skipped,) = collect(tmp_path).skipped
        assert skipped.reason.endswith("overrides.yaml holds no list")


def test_runs_of_another_version_are_read_and_named(tmp_path: Path) -> None:
    write_run(tmp_path / "0", {"seed": 0}, {"ball_error": 1.0}, version="0.0.9")
    write_run(tmp_path / "1", {"seed": 1}, {"ball_error": 1.0})
    found = collect(tmp_path)
    assert len(found.rows) == 2
    (remark,) = found.remarks
    assert "1 of 2 runs were written by staf_torch 0.0.9" in remark
    assert str(tmp_path / "0") in remark


@pytest.mark.parametrize("kind", ["missing", "empty", "a file", "other folders"])
def test_a_path_without_runs_is_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "path"
    if kind == "a file":
        path.write_text("")
    elif kind != "missing":
        (path / "figures" / "more").mkdir(parents=True) if kind == "other folders" else path.mkdir()
    with pytest.raises(ValueError, match=r"`collect\(path=...\)` must (be a directory|hold a run)"):
        collect(path)


def test_numbers_that_are_none_of_json_are_missing_with_what_they_were(tmp_path: Path) -> None:
    run = write_run(tmp_path / "0", {}, None)
    (run / "metrics.json").write_text(
        '{"a": NaN, "b": -Infinity, "c": 1e999, "d": 2, "e": "word", "f": true}'
    )
    (found,) = collect(tmp_path).rows
    assert found.metrics == {"a": None, "b": None, "c": None, "d": 2}
    assert found.absence("b") == "was -inf, which is not a number"


def test_several_paths_are_one_collection(tmp_path: Path) -> None:
    one = write_run(tmp_path / "a", {"seed": 0}, {"ball_error": 1.0})
    two = write_run(tmp_path / "b", {"dt": 0.1}, {"ball_error": 2.0})
    found = collect([one, two])
    assert found.swept == ("dt",)  # the seed that one states is the default of the other
    assert [run.setting("dt") for run in found.rows] == [0.01, 0.1]


def test_a_result_that_follows_a_link_in_a_circle_ends(tmp_path: Path) -> None:
    write_run(tmp_path / "0", {}, {"ball_error": 1.0})
    (tmp_path / "again").symlink_to(tmp_path)
    assert len(collect(tmp_path).rows) == 1


def test_overrides_are_read_as_hydra_would() -> None:
    lines = [
        "a=1",
        "+b=2.5",
        "++c=true",
        "d=null",
        "e='1'",
        "f=[1,2]",
        "g=x=y",
        "h=inf",
        "~i",
        "hydra.verbose=true",
    ]
    assert parse_overrides(lines) == {
        "a": 1,
        "b": 2.5,
        "c": True,
        "d": None,
        "e": "1",
        "f": [1, 2],
        "g": "x=y",
        "h": "inf",
    }


def test_a_tensor_is_still_shown_in_a_sentence() -> None:
    from staf_torch.numerics import show

    assert show(torch.tensor([1.0, 2.0])) == "[1.0, 2.0]"
    assert show(torch.zeros(3, 4)) == "a tensor (3, 4)"
