"""Runs as they are read back: their names, why a number is absent, which settings differ, and odd records."""

from __future__ import annotations

import dataclasses
import json
from collections import ChainMap
from pathlib import Path
from typing import Any

import pytest
from sweep_runs import write_run

from staf_torch import __version__
from staf_torch.results import reader, remarks
from staf_torch.results.metric_info import HEADLINES, OWN, MetricInfo, read_infos
from staf_torch.results.reader import Collection, Run, Skipped, collect, read_run
from staf_torch.results.run import identity, layers
from staf_torch.results.untrusted import UnreadableError


def run(name: str = "a", overrides: Any = None, settings: Any = None, **more: Any) -> Run:
    return Run(Path(name), overrides or {}, settings or {}, more.pop("metrics", {}), "completed", **more)


def found(*rows: Run) -> Collection:
    return Collection(rows, ())


# One run


def test_a_run_is_shown_by_its_overrides_and_first_headline() -> None:
    overrides = {"kernel": "gaussian", "figures": False, "members": None, "dt": 0.5}
    metrics = {"gradient_error": 2.0, "ball_error": 0.123456, "ball_floor_error": None, "own": 1.0}
    shown = repr(run(overrides=overrides, metrics=metrics))
    assert shown == "<Run completed: kernel=gaussian figures=false members=null dt=0.5, ball_error=0.123>"
    assert repr(run(metrics={"ball_error": None, "cost": 3.0})) == "<Run completed: no overrides, cost=3>"
    assert repr(run()) == "<Run completed: no overrides>"


def test_anything_about_a_run_has_a_value_by_its_name() -> None:
    one = run(
        "a\x1b[2Jb", {"dt": 1, "typed": 2}, {"dt": 3, "seconds": 4}, metrics={"ball": None}, seconds=5.0
    )
    assert [one.setting(key) for key in ("dt", "typed", "no")] == [3, 2, None]
    assert [one.value(key) for key in ("dt", "ball", "seconds", "status", "no")] == [
        3,
        None,
        5.0,
        "completed",
        None,
    ]
    assert "\x1b" not in str(one.value("directory"))
    assert isinstance(one.value("directory"), str)


def test_why_there_is_no_number() -> None:
    lost = run(metrics={"ball": None}, lost={"ball": "nan"}, reason="why")
    assert lost.absence("ball") == "was nan, which is not a number"
    assert lost.absence("cost") == "why"
    assert run(metrics={"ball": None}).absence("ball") == "not finite, or nothing to report"
    assert run().absence("ball") == "this run has no such metric"


def test_equal_values_have_equal_identities() -> None:
    values: list[Any] = [1, 1.0, True, "1", None, [1], [1.0], "None", 0.5]
    assert len({identity(value) for value in values}) == len(values) - 1
    assert identity(1) == identity(1.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        run().status = "failed"  # type: ignore[misc]
    for frozen in (Skipped(Path(), ""), found()):
        with pytest.raises(dataclasses.FrozenInstanceError):
            frozen.path = frozen.rows = None  # type: ignore[union-attr]


# Several runs


def test_metrics_are_those_of_all_runs_with_what_is_declared_of_them() -> None:
    own = MetricInfo("mine", unit="m", larger_is_better=True)
    one = run(
        metrics={"b": 1.0, "mine": 2.0}, declared={"mine": own, "ball_error": MetricInfo("ball_error", "V")}
    )
    both = found(one, run(metrics={"ball_error": 1.0, "b": 2.0, "cost": 1.0}))
    assert both.metrics == ("b", "mine", "ball_error", "cost")
    assert both.infos == {
        "b": MetricInfo("b"),
        "mine": own,
        "ball_error": MetricInfo("ball_error", "V"),
        "cost": next(info for info in OWN if info.name == "cost"),
    }


def test_columns_are_overrides_then_settings_then_what_is_about_the_run() -> None:
    both = found(
        run(overrides={"z": 1}, settings={"a": 1, "z": 1}), run(overrides={"b": 1}, settings={"c": 1})
    )
    about = ("task", "status", "reason", "seconds", "version", "build", "directory", "member")
    assert both.keys == ("z", "b", "a", "c", *about)


def test_what_was_swept_is_what_was_overridden_and_differs() -> None:
    assert found(run(overrides={"a": 1, "b": 2})).swept == ("a", "b")
    both = found(run(overrides={"a": 1, "b": 2, "c": 1}), run(overrides={"a": 1.0, "b": 3, "c": "1"}))
    assert both.swept == ("b", "c")
    assert found().swept == ()


def test_settings_that_differ_unasked_are_named() -> None:
    def pair(
        one: dict[str, Any], two: dict[str, Any], first: Any = None, second: Any = None, **more: Any
    ) -> Any:
        return found(run("a", first, one), run("b", second, two, **more)).unswept

    assert pair({"dt": 1, "x": 2}, {"dt": 1, "x": 3}) == ("x",)
    assert pair({"dt": 1}, {"dt": 1, "x": 3}) == ("x",)
    assert pair({"dt": 1, "x": 3}, {"dt": 2}) == ("dt", "x")
    assert pair({"dt": 1}, {}) == ()  # nothing is known of that one
    assert pair({"a": 1}, {"a": 2}, {"a": 1}, {"a": 2}) == ()
    assert pair({"a": 1, "a.b": 1, "a/c": 1, "ab": 1}, {"a": 2, "a.b": 2, "a/c": 2, "ab": 2}, {"a": 5}) == (
        "ab",
    )
    assert pair({"a": 1}, {"a": 2}, {"a.b": 5}) == ()
    assert pair({"x": 5, "y": 1}, {"x": 6, "y": 2}, {"r": 5}, {"r": 6}) == ("y",)  # x follows r
    assert pair({"x": [1, 5]}, {"x": [1, 6]}, {"r": 5}, {"r": 6}) == ()
    assert pair({"x": [1, 5]}, {"x": [2, 6]}, {"r": 5}, {"r": 6}) == ("x",)
    assert pair({"x": [1]}, {"x": [1, 2]}) == ("x",)
    assert pair({"x": 5}, {"x": 7}, {"r": 5}, {"r": 6}) == ()
    kernels = {"k": "m", "x": 1}, {"k": "g", "x": 2}
    assert pair(*kernels, {"k": "m"}, {"k": "g"}) == ()  # of another kernel
    assert pair({"a": 1}, {"a": 1}, build="other") == ("build",)


def test_members_share_the_settings_of_their_run() -> None:
    shared = {"dt": 7, "seed": 0}
    one, two = (run(overrides={"seed": n}, settings=ChainMap({"seed": n}, shared)) for n in (1, 2))
    assert [dict(part) for part in layers(one.settings)] == [{"seed": 1}, shared]
    assert layers(shared) == [shared]
    both = found(one, two)
    assert (both.unswept, both.swept) == ((), ("seed",))
    assert len(both._settings) == 3
    assert found(one, two, run(settings={"dt": 9, "seed": 0})).unswept == ("dt",)


def test_remarks_name_other_versions_and_settings_that_nobody_swept() -> None:
    rows = [
        run(name, version=version)
        for name, version in zip("abcd", ("0.1", None, __version__, "0.1"), strict=True)
    ]
    start = f"2 of 4 runs were written by staf_torch 0.1, and this is {__version__}: "
    assert list(remarks.versions(rows)) == [f"{start}their numbers may mean something else (the first is a)"]
    values = [1, 1, "two", [3], 4.5]
    mixed = found(*(run(f"{n}", settings={"x": value}) for n, value in enumerate(values)))
    said = (
        "`x` differs between runs although nobody swept it: 1 in 2 (as 0), two in 1 (as 2), [3] in 1 (as 3)"
    )
    assert list(remarks.mixed(mixed)) == [f"{said} and 1 others"]
    three = found(*(run(f"{n}", settings={"x": value}) for n, value in enumerate(values[1:4])))
    assert next(remarks.mixed(three)).endswith("[3] in 1 (as 2)")


def test_metrics_of_a_record_are_read_and_what_is_malformed_is_passed_over() -> None:
    assert read_infos(None) == read_infos([1]) == {}
    recorded = {"a": {"unit": "s", "larger_is_better": True, "headline": True}, "b": {"headline": 1}, "c": 3}
    assert read_infos(recorded) == {"a": MetricInfo("a", "s", True, True), "b": MetricInfo("b")}
    info = MetricInfo("a", "s", True, True)
    assert info.record() == {"unit": "s", "larger_is_better": True, "headline": True}
    assert MetricInfo("a") == ("a", "", False, False)
    assert HEADLINES[:2] == ("ball_error", "ball_floor_error")
    assert [each.name for each in OWN if each.larger_is_better] == ["regulated_fraction"]
    units = {each.name: each.unit for each in OWN if each.unit}
    assert (units["settling_time"], units["condition_number"], units["products_per_second"]) == (
        "s",
        "1",
        "1/s",
    )


# Folders


def named(path: Path) -> list[str]:
    return [row.directory.name for row in collect(path).rows]


def test_folders_are_looked_at_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for name in ("run10", "run9", "run", "a/b/c", ".hidden", "figures", "run9/inner"):
        write_run(tmp_path / name, {"kernel": name}, {"ball_error": 1.0})
    assert named(tmp_path) == ["c", "run", "run9", "run10"]
    assert reader._natural("a12b003") == [
        (False, 0, "a"),
        (True, 12, "12"),
        (False, 0, "b"),
        (True, 3, "003"),
        (False, 0, ""),
    ]


@pytest.mark.parametrize(("depth", "seen"), [(16, True), (17, False)])
def test_sixteen_levels_of_folders_are_looked_at(depth: int, seen: bool, tmp_path: Path) -> None:
    write_run(tmp_path / "/".join(["a"] * depth), {}, {"ball_error": 1.0})
    all_found = collect(tmp_path)
    assert len(all_found.rows) == seen
    said = "has folders 16 levels down, which are not looked at"
    assert [each.reason for each in all_found.skipped] == ([] if seen else [said])


@pytest.mark.parametrize("count", [9, 10])
def test_a_table_has_so_many_columns_at_most(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "_COLUMNS", 20)
    own = {f"m{n}": 1.0 for n in range(count)}
    place = write_run(tmp_path / "0", {}, own)
    record = json.loads((place / "run.json").read_text())
    (place / "run.json").write_text(json.dumps(record | {"settings": {f"s{n}": 1 for n in range(11)}}))
    both = collect(tmp_path)
    if count + 11 <= 20:
        assert len(both.rows) == 1
    else:
        assert both.rows == ()
        assert both.skipped[0].reason == f"brings settings and metrics of {count + 11} more names"
    assert reader._further_names({f"m{n}" for n in range(30)}, [run(metrics=own)]) == set()


@pytest.mark.parametrize("waiting", [1, 8, 9])
def test_jobs_that_have_not_started_are_listed_up_to_eight(waiting: int, tmp_path: Path) -> None:
    jobs = [{"num": n, "overrides": [f"seed={n}"]} for n in range(waiting + 1)]
    (tmp_path / "sweep.json").write_text(json.dumps({"jobs": jobs}))
    write_run(tmp_path / "0", {"seed": 0.0}, {"ball_error": 1.0})
    (skipped,) = collect(tmp_path).skipped
    listed = ", ".join(str(n) for n in range(1, min(waiting, 8) + 1)) + ", ..." * (waiting > 8)
    assert skipped.reason == f"{waiting} of {waiting + 1} jobs have not started: {listed}"
    for odd in ("[]", '{"jobs": [1]}', '{"jobs": {}}'):
        (tmp_path / "sweep.json").write_text(odd)
        assert collect(tmp_path).skipped[0].path == tmp_path
    (tmp_path / "sweep.json").write_text(json.dumps({"jobs": jobs[:1]}))
    assert collect(tmp_path).skipped == ()


def edited(place: Path, **more: Any) -> Run:
    record = json.loads((place / "run.json").read_text())
    (place / "run.json").write_text(json.dumps(record | more))
    (found,) = read_run(place)
    return found


def test_odd_values_of_a_record_are_what_they_can_be(tmp_path: Path) -> None:
    place = write_run(tmp_path / "run", {"seed": 1}, {"ball_error": 1.0}, reason="told")
    one = edited(
        place, seconds=True, version=3, task=["a"], build="b", overrides=["seed=1", 7], metrics={"m": {}}
    )
    assert (one.seconds, one.version, one.task, one.build) == (None, None, None, None)
    assert dict(one.overrides) == {"seed": 1}
    assert dict(one.declared) == {"m": MetricInfo("m")}
    assert (one.status, one.reason) == ("completed", "told")
    assert edited(place, seconds=2).seconds == 2
    assert edited(place, build={"version": "1"}).build is not None
    assert dict(edited(place, overrides="seed=1").overrides) == {}
    one = edited(place, settings={"a": {"b": 1}, "c": [1, [2]], "d": None, "e": True})
    assert dict(one.settings) == {"a": '{"b": 1}', "c": [1, [2]], "d": None, "e": True}
    (place / "run.json").write_text((place / "run.json").read_text().replace('"d": null', '"d": NaN'))
    assert read_run(place)[0].settings["d"] == "nan"
    assert dict(edited(place, settings=[1]).settings) == {}


@pytest.mark.parametrize(
    ("status", "reason", "said"),
    [
        ("running", None, "has not ended: it goes on, or was killed"),
        ("running", "waits", "waits"),
        ("failed", None, "no reason was left"),
        ("failed", "why", "why"),
        ("completed", None, None),
    ],
)
def test_a_run_says_why_it_has_no_result(
    status: str, reason: str | None, said: str | None, tmp_path: Path
) -> None:
    place = write_run(tmp_path / "run", {}, {"ball_error": 1.0}, status=status, reason=reason)
    (one,) = read_run(place)
    assert (one.status, one.reason) == (status, said)
    assert dict(one.metrics) == ({"ball_error": 1.0} if status == "completed" else {})


def test_a_file_that_is_not_as_it_was_written_is_told(tmp_path: Path) -> None:
    place = write_run(tmp_path / "run", {}, {"ball_error": 1.0})
    one = edited(place, files={"metrics.json": [3, "0"]})
    assert (one.status, dict(one.metrics)) == ("unfinished", {})
    assert "metrics.json is damaged: it has 19 bytes in place of 3" in str(one.reason)
    one = edited(place, files={"metrics.json": [19, "0"]})
    assert "metrics.json is damaged: its checksum is another one" in str(one.reason)
    assert (one.status, dict(one.metrics)) == ("unfinished", {})
    one = edited(place, files={"figure.png": [3, "0"]})  # which is gone, and holds no number
    assert one.status == "completed"
    one = edited(place, checksum="0")
    assert one.reason == "run.json is damaged: its checksum is another one"


def rows_of(place: Path, *lines: str, name: str = "members.json", end: str = "]}\n") -> list[Run]:
    (place / name).write_text(f'{{"version": "1", "members": [\n{"".join(lines)}{end}')
    return read_run(place)


def member(num: Any, **more: Any) -> dict[str, Any]:
    return {"num": num, "overrides": [f"seed={num}"], "status": "completed", "metrics": {"ball": 1.0}} | more


def test_members_are_read_line_by_line(tmp_path: Path) -> None:
    overrides = {"members": "x", "members.own": 1, "kernel": "a"}
    place = write_run(tmp_path / "run", overrides, {"members": 2})
    one, two = rows_of(place, json.dumps(member(5)) + ",\n", json.dumps(member(True, status="failed")) + "\n")
    assert (one.member, two.member) == (5, 1)
    assert dict(one.overrides) == {"kernel": "a", "seed": 5}
    assert (one.seconds, one.settings["seed"], one.settings["dt"]) == (None, 5, 0.01)
    assert "members" not in one.settings
    assert "members.own" not in one.settings
    assert (dict(one.metrics), dict(two.metrics)) == ({"ball": 1.0}, {})
    assert (two.status, two.reason) == ("failed", "no reason was left")
    stated = member(0, settings={"dt": 3, "members": "x"})
    assert dict(rows_of(place, json.dumps(stated) + "\n")[0].settings) == {"dt": 3}
    with pytest.raises(UnreadableError, match=r"members.json ends before its last row"):
        rows_of(place, json.dumps(member(5)) + ",\n", end="")
    for odd in ('{"members": [1]}', '{"members": 1}', "[]"):
        (place / "members.json").write_text(odd)
        with pytest.raises(UnreadableError):
            read_run(place)
    (place / "members.json").write_text(json.dumps({"members": [member(1), member(2)]}))
    assert [each.member for each in read_run(place)] == [1, 2]


def test_members_of_a_run_that_goes_on_come_with_it(tmp_path: Path) -> None:
    place = write_run(tmp_path / "run", {"members": "x"}, None, status="running")
    line = json.dumps(member(0)) + ",\n"
    found = rows_of(place, line, line.replace("0", "1"), line[:20], name=".members.json.partial", end="")
    assert [(each.member, each.status) for each in found] == [
        (0, "completed"),
        (1, "completed"),
        (None, "running"),
    ]
    (place / "metrics.json").write_text('{"members": 2}')
    done = json.loads((place / "run.json").read_text())
    (place / "run.json").write_text(json.dumps(done | {"status": "completed"}))
    assert len(read_run(place)) == 1
