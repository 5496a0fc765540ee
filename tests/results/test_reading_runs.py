"""Runs, tables and sweeps in every state, read back: one bad run never costs the others."""

from __future__ import annotations

import json
from collections import ChainMap
from pathlib import Path
from typing import Any

import pytest
from sweep_runs import BAD_COUNT, typed, write_run, write_sweep

from staf_torch import __version__
from staf_torch.results.files import UnreadableError
from staf_torch.results.reader import Collection, RecordedRun, collect, read_run
from staf_torch.results.run import OWN, MetricInfo, read_infos


def run(name: str = "a", overrides: Any = None, settings: Any = None, **more: Any) -> RecordedRun:
    return RecordedRun(
        Path(name), overrides or {}, settings or {}, more.pop("metrics", {}), "completed", **more
    )


def found(*rows: RecordedRun) -> Collection:
    return Collection(rows, ())


def test_a_sweep_has_a_row_a_job_in_the_order_of_the_jobs(tmp_path: Path) -> None:
    rows = collect(write_sweep(tmp_path / "sweep"))
    assert [each.directory.name for each in rows.rows] == [str(num) for num in range(36)]
    assert rows.swept == ("kernel", "centers.radius", "centers.count", "seed")
    first = rows.rows[0]
    assert first.overrides == {"kernel": "exponential", "centers.radius": 0.05, "centers.count": 3, "seed": 0}
    assert first.settings["initial_state"] == [1.0, 0.0]
    assert first.metrics["ball_error"] == 5.0 * 0.05**2
    assert (first.status, first.reason, first.version) == ("completed", None, __version__)
    assert (rows.skipped, rows.remarks) == ((), ())
    failed = [each for each in rows.rows if each.status == "failed"]
    assert len(failed) == 12
    assert {each.reason for each in failed} == {BAD_COUNT}
    assert all(each.metrics == {} and each.setting("centers.count") == 7 for each in failed)


def test_a_sweep_that_goes_on_has_rows_for_what_began_and_names_what_did_not(tmp_path: Path) -> None:
    jobs = [{"num": num, "overrides": typed({"seed": num})} for num in range(12)]
    (tmp_path / "sweep.json").write_text(json.dumps({"version": __version__, "jobs": jobs}))
    write_run(tmp_path / "0", {"seed": 0}, {"ball_error": 1.0})
    write_run(tmp_path / "1", {"seed": 1}, None, status="running")
    rows = collect(tmp_path)
    assert [each.status for each in rows.rows] == ["completed", "running"]
    assert "killed" in str(rows.rows[1].reason)
    (waiting,) = rows.skipped
    assert waiting.path == tmp_path
    told = "10 of 12 jobs have not started: 2, 3, 4, 5, 6, 7, 8, 9, ...; 1 completed; 1 running. `staf"
    assert waiting.reason.startswith(told)


@pytest.mark.parametrize("kind", ["missing", "a file", "other folders"])
def test_a_path_without_runs_is_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "path"
    if kind == "a file":
        path.write_text("")
    elif kind == "other folders":
        (path / "figures" / "more").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"`collect\(path=...\)` must (be a directory|hold a run)"):
        collect(path)


def test_folders_are_read_in_the_order_of_their_numbers_and_no_link_is_followed(tmp_path: Path) -> None:
    for name in ("run10", "run9", "run", "a/b/c", ".hidden", "figures", "run9/inner"):
        write_run(tmp_path / name, {"kernel": name}, {"ball_error": 1.0})
    (tmp_path / "again").symlink_to(tmp_path)
    assert [row.directory.name for row in collect(tmp_path).rows] == ["c", "run", "run9", "run10"]
    both = collect([tmp_path / "run9", tmp_path / "run10"])
    assert [each.setting("kernel") for each in both.rows] == ["run9", "run10"]


def edited(place: Path, **more: Any) -> RecordedRun:
    record = json.loads((place / "run.json").read_text())
    (place / "run.json").write_text(json.dumps(record | more))
    (one,) = read_run(place)
    return one


# Rows of a table


def rows_of(place: Path, *lines: str, name: str = "rows.json", end: str = "]}\n") -> list[RecordedRun]:
    (place / name).write_text(f'{{"version": "1", "rows": [\n{"".join(lines)}{end}')
    return read_run(place)


def row(num: Any, **more: Any) -> dict[str, Any]:
    return {"num": num, "overrides": [f"seed={num}"], "status": "completed", "metrics": {"ball": 1.0}} | more


def test_rows_are_runs_like_those_of_jobs(tmp_path: Path) -> None:
    place = write_run(tmp_path / "run", {"seed": "1,2", "kernel": "a"}, None)
    one, two = rows_of(place, json.dumps(row(5)) + ",\n", json.dumps(row(True, status="failed")) + "\n")
    assert (one.row, two.row) == (5, 1)
    assert dict(one.overrides) == {"kernel": "a", "seed": 5}
    assert (one.seconds, one.settings["seed"], one.settings["dt"]) == (None, 5, 0.01)
    assert (dict(one.metrics), dict(two.metrics)) == ({"ball": 1.0}, {})
    assert (two.status, two.reason) == ("failed", "no reason was left")
    with pytest.raises(UnreadableError, match=r"rows.json ends before its last row"):
        rows_of(place, json.dumps(row(5)) + ",\n", end="")


def test_rows_of_a_sweep_that_goes_on_come_with_it(tmp_path: Path) -> None:
    place = write_run(tmp_path / "run", {"seed": "0,1"}, None, status="running")
    line = json.dumps(row(0)) + ",\n"
    rows = rows_of(place, line, line.replace("0", "1"), line[:20], name=".rows.json.partial", end="")
    assert [(each.row, each.status) for each in rows] == [
        *((0, "completed"), (1, "completed"), (None, "running"))
    ]


# What a run and a collection say


def test_a_run_is_shown_by_its_overrides_and_first_headline() -> None:
    overrides = {"kernel": "gaussian", "figures": False, "metric": None, "dt": 0.5}
    metrics = {"gradient_error": 2.0, "ball_error": 0.123456, "ball_floor_error": None, "own": 1.0}
    shown = repr(run(overrides=overrides, metrics=metrics))
    assert shown == "<Run completed: kernel=gaussian figures=false metric=null dt=0.5, ball_error=0.123>"
    assert repr(run()) == "<Run completed: no overrides>"


def test_anything_about_a_run_has_a_value_by_its_name_or_a_reason_why_not() -> None:
    one = run(
        "a\x1b[2Jb", {"dt": 1, "typed": 2}, {"dt": 3, "seconds": 4}, metrics={"ball": None}, seconds=5.0
    )
    assert [one.setting(key) for key in ("dt", "typed", "no")] == [3, 2, None]
    assert [one.value(key) for key in ("dt", "ball", "seconds", "status")] == [3, None, 5.0, "completed"]
    assert "\x1b" not in str(one.value("directory"))
    assert one.absence("ball") == "not finite, or nothing to report"
    assert one.absence("cost") == "this run has no such metric"
    assert run(metrics={"ball": None}, reason="why").absence("ball") == "why"


def test_metrics_have_the_units_that_the_library_or_the_runs_declare() -> None:
    own = MetricInfo("mine", unit="m", larger_is_better=True)
    one = run(metrics={"b": 1.0, "mine": 2.0}, declared={"mine": own})
    both = found(one, run(metrics={"ball_error": 1.0, "b": 2.0, "cost": 1.0}))
    known = {info.name: info for info in OWN}
    assert both.infos == {
        **{"b": MetricInfo("b"), "mine": own},
        **{name: known[name] for name in ("ball_error", "cost")},
    }
    assert read_infos({"mine": own.record(), "b": {"headline": 1}, "c": 3}) == {
        **{"mine": own, "b": MetricInfo("b")}
    }
    assert read_infos(None) == read_infos([1]) == {}


def test_what_was_swept_is_what_was_overridden_and_differs() -> None:
    assert found(run(overrides={"a": 1, "b": 2})).swept == ("a", "b")
    both = found(run(overrides={"a": 1, "b": 2, "c": 1}), run(overrides={"a": 1.0, "b": 3, "c": "1"}))
    assert both.swept == ("b", "c")


UNASKED: list[tuple[dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any], tuple[str, ...]]] = [
    ({"dt": 1}, {"dt": 1, "x": 3}, {}, {}, ("x",)),
    ({"dt": 1}, {}, {}, {}, ()),  # nothing is known of that one
    ({"a": 1}, {"a": 2}, {"a": 1}, {"a": 2}, ()),
    ({"a": 1, "a.b": 1, "a/c": 1, "ab": 1}, {"a": 2, "a.b": 2, "a/c": 2, "ab": 2}, {"a": 5}, {}, ("ab",)),
    ({"x": 5, "y": 1}, {"x": 6, "y": 2}, {"r": 5}, {"r": 6}, ("y",)),  # x follows r
    ({"x": [1, 5]}, {"x": [2, 6]}, {"r": 5}, {"r": 6}, ("x",)),
    ({"k": "m", "x": 1}, {"k": "g", "x": 2}, {"k": "m"}, {"k": "g"}, ()),  # of another kernel
]


@pytest.mark.parametrize(("one", "two", "first", "second", "named"), UNASKED)
def test_settings_that_differ_although_nobody_swept_them_are_named(
    one: dict[str, Any],
    two: dict[str, Any],
    first: dict[str, Any],
    second: dict[str, Any],
    named: tuple[str, ...],
) -> None:
    assert found(run("a", first, one), run("b", second, two)).unswept == named
    assert found(run("a", first, one), run("b", second, two, build="other")).unswept == (*named, "build")


def test_an_own_module_that_only_some_runs_need_is_no_other_build() -> None:
    plain, mine = run("a", build="b"), run("b", build="b", modules={"mine": "1", "helper": "1"})
    other = run("c", build="b", modules={"mine": "1", "third": "1"})
    assert found(plain, mine, other).unswept == ()
    edited = run("d", build="b", modules={"mine": "2", "helper": "1"})
    assert found(plain, mine, edited).unswept == found(plain, run("e", build="c")).unswept == ("build",)
    assert len({each.value("build") for each in (plain, mine, edited)}) == 3


def test_rows_share_the_settings_of_their_sweep() -> None:
    shared = {"dt": 7, "seed": 0}
    one, two = (run(overrides={"seed": n}, settings=ChainMap({"seed": n}, shared)) for n in (1, 2))
    both = found(one, two)
    assert (both.unswept, both.swept) == ((), ("seed",))
    assert found(one, two, run(settings={"dt": 9, "seed": 0})).unswept == ("dt",)


def test_a_remark_counts_the_values_of_a_setting_that_nobody_swept(tmp_path: Path) -> None:
    for number, value in enumerate([1, 1, "two", [3], 4.5]):
        write_run(tmp_path / str(number), {}, {"ball_error": 1.0})
        record = json.loads((tmp_path / str(number) / "run.json").read_text())
        record["settings"]["x"] = value
        (tmp_path / str(number) / "run.json").write_text(json.dumps(record))
    (remark,) = collect(tmp_path).remarks
    counts = f"1 in 2 (as {tmp_path}/0), two in 1 (as {tmp_path}/2), [3] in 1 (as {tmp_path}/3) and 1 others"
    assert remark == f"`x` differs between runs although nobody swept it: {counts}"
