"""What made a run: which changes are told, in which words, and what of a damaged folder is seen."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from omegaconf import OmegaConf

from staf_torch import __version__
from staf_torch.results import build, run_record
from staf_torch.results.build import checksums, damage, damaged, differences, record_checksum, short
from staf_torch.results.metric_info import MetricInfo
from staf_torch.results.run_record import RunRecord

BUILD = {"source": "s", "torch": "t", "compiler": "c", "modules": {"own": "1"}, "imported": {}}


def record(settings: Any = None, **more: Any) -> dict[str, Any]:
    return {"settings": {"dt": 1} if settings is None else settings, "build": BUILD | more}


def told(then: dict[str, Any], now: dict[str, Any]) -> list[str]:
    return list(differences(then, now))


def test_every_change_is_told_in_its_words(monkeypatch: pytest.MonkeyPatch) -> None:
    now = record()
    assert told(record(), now) == told(record({"dt": 1.0}), now) == []
    assert told(record({"dt": 2, "b": "x"}), record({"dt": 1, "a": [1]})) == [
        "a was nothing and is now [1]",
        "b was x and is now nothing",
        "dt was 2 and is now 1",
    ]
    assert told(record({}), record({"a": 1})) == []  # of a version that recorded none
    assert told(record({"a": (1, 2)}), record({"a": [1, 2]})) == []
    assert told(record(source="z", torch="z", compiler="z"), now) == [
        "the source of staf_torch was z and is now s",
        "torch was z and is now t",
        "compiler was z and is now c",
    ]
    assert told({"settings": {"dt": 1}}, now) == ["the module own has changed"]
    assert told(record(modules={"own": "2", "gone": "1"}), now) == [
        "the module gone has changed",
        "the module own has changed",
    ]
    hashes = {"same": "1", "other": "2"}
    monkeypatch.setattr(build, "_hash", hashes.get)
    assert told(record(imported={"same": "1", "other": "1", "gone": "1", "own": "9"}), now) == [
        "the module gone has changed",
        "the module other has changed",
    ]


def test_a_build_is_named_in_a_line() -> None:
    about = {"version": "1", "source": "s", "torch": "t", "compiler": "c", "modules": {"b": "2", "a": "1"}}
    text = json.dumps(["c", {"a": "1", "b": "2"}])
    assert short(about) == f"1 source s torch t other {hashlib.sha256(text.encode()).hexdigest()[:6]}"
    assert short(about | {"compiler": "d"}) != short(about)


def test_the_build_of_a_run_says_what_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    found = build.build({"dt": 1}, "compiler 1")
    assert {key: found[key] for key in ("version", "compiler", "modules")} == {
        "version": __version__,
        "compiler": "compiler 1",
        "modules": {},
    }
    assert found["torch"] == importlib.metadata.version("torch")
    assert found["source"] == build.source()
    assert len(found["source"]) == 12

    def absent(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError

    monkeypatch.setattr(importlib.metadata, "version", absent)
    assert build._torch.__wrapped__() == "of unknown version"


def test_the_source_is_that_of_the_package_wherever_it_lies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = {"a.py": "1", "b/c.cpp": "2", "b/d.hpp": "3", "e.html": "4"}
    others = {"plugins/f.py": "5", "g.txt": "6", "h.pyc": "7"}
    for name, text in (files | others).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "folder.py").mkdir()
    monkeypatch.setattr(build, "_PACKAGE", tmp_path)
    source = build.source.__wrapped__
    first = source()
    for name in others:
        (tmp_path / name).write_text("changed")
        assert source() == first
    seen = {first}
    for name in files:
        (tmp_path / name).write_text("0")
        seen.add(source())
    os.rename(tmp_path / "a.py", tmp_path / "z.py")
    assert len(seen | {source()}) == 6


@pytest.mark.parametrize(
    ("name", "other", "package", "absolute"),
    [
        ("a.b.c", "x.y", False, "x.y"),
        ("a.b.c", ".x", False, "a.b.x"),
        ("a.b.c", "..x.y", False, "a.x.y"),
        ("a.b.c", ".x", True, "a.b.c.x"),
        ("a.b.c", "..x", True, "a.b.x"),
        ("a.b.c", ".", False, "a.b"),
        ("a.b.c", "..", False, "a"),
    ],
)
def test_a_name_of_an_import_is_meant_from_its_module(
    name: str, other: str, package: bool, absolute: str
) -> None:
    assert build._absolute(name, other, package) == absolute


def test_the_imports_of_a_file_are_read(tmp_path: Path) -> None:
    text = "import a, b.c\nfrom d import e, f\nfrom . import g\nfrom ..h import i\nif 1:\n    import j\n"
    (tmp_path / "own.py").write_text(text)
    digest, names = build._module(tmp_path / "own.py", 1, len(text))
    assert sorted(names) == sorted(["a", "b.c", "d.e", "d.f", ".g", "..h.i", "j"])
    assert digest == hashlib.sha256(text.encode()).hexdigest()[:12]
    (tmp_path / "own.py").write_text("no python (")
    assert build._module(tmp_path / "own.py", 2, 1)[1] == ()


def test_settings_name_modules_by_their_task_their_targets_and_their_paths() -> None:
    loader = "staf_torch.settings.chase.load"
    settings = {
        "task": "mine.task",
        "kernel._target_": "theirs.kernels.Own",
        "target._target_": loader,
        "target.path": "mine.target",
        "system.path": "no.such",
        "system._target_": "staf_torch.systems.Own",
        "metric._target_": 3,
        "centers._target_": "undotted",
    }
    assert list(build._named(settings)) == ["mine.task", "theirs.kernels.Own", "mine.target"]


def test_modules_that_lie_beside_the_users_own_are_found_where_they_were_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def module(name: str, place: Path) -> None:
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(f"# {name}")
        made = ModuleType(name)
        made.__file__ = str(place)
        monkeypatch.setitem(sys.modules, name, made)

    for name in ("sw_own", "sw_near", "sw_installed"):
        folder = tmp_path / ("site-packages" if name == "sw_installed" else "")
        module(name, folder / f"{name}.py")
    module("sw_far", tmp_path.parent / f"{tmp_path.name}_far" / "sw_far.py")
    monkeypatch.setitem(sys.modules, "sw_no_file", ModuleType("sw_no_file"))
    monkeypatch.syspath_prepend(str(tmp_path / "site-packages"))
    monkeypatch.syspath_prepend(str(tmp_path))
    found = build.imported({"sw_own": "1"})
    assert found == {"sw_near": hashlib.sha256(b"# sw_near").hexdigest()[:12]}
    assert build.imported({}) == build.imported({"sw_nowhere": "1"}) == {}
    assert build.imported({"sw_installed": "1"}) == {}


# The files of a run


def test_damage_is_told_of_the_first_file_that_has_some(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"content")
    right = [7, hashlib.sha256(b"content").hexdigest()]
    assert damage(tmp_path, {"a": right}, thorough=True) is None
    for odd in (3, [], [7], [*right, 1]):
        assert damage(tmp_path, {"a": odd}, thorough=False) == "a has no checksum"
    for name in ("/a", "../a", "b/../a"):
        assert damage(tmp_path, {name: right}, thorough=False) == f"{name} has no checksum"
    said = "a is damaged: it has 7 bytes in place of 8"
    assert damage(tmp_path, {"a": [8, right[1]]}, thorough=False) == said
    wrong = {"a": [7, "0"]}
    assert damage(tmp_path, wrong, thorough=False) is None
    assert damage(tmp_path, wrong, thorough=True) == "a is damaged: its checksum is another one"
    (tmp_path / "link").symlink_to("a")
    about = [(tmp_path / "link").lstat().st_size, right[1]]
    assert damage(tmp_path, {"link": about}, thorough=True) is not None
    whole = {"files": wrong, "x": 1}
    assert damaged(tmp_path, whole, thorough=False) is None
    assert damaged(tmp_path, whole, thorough=True) == "a is damaged: its checksum is another one"
    assert damaged(tmp_path, {"files": [1]}, thorough=True) is None
    assert (
        damaged(tmp_path, {"checksum": "0"}, thorough=True)
        == "run.json is damaged: its checksum is another one"
    )
    assert damaged(tmp_path, {"a": 1, "checksum": record_checksum({"a": 1})}, thorough=True) is None


def test_a_checksum_of_a_record_is_of_all_but_itself() -> None:
    assert record_checksum({"a": 1, "b": 2, "checksum": "x"}) == record_checksum({"b": 2, "a": 1})
    assert record_checksum({"a": 1}) != record_checksum({"a": 2})


def test_result_files_have_checksums_and_logs_and_hidden_ones_none(tmp_path: Path) -> None:
    for name in (
        "metrics.json",
        "run.json",
        "staf.log",
        ".hidden",
        ".hydra/config.yaml",
        "figures/a.png",
        "b/.c",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    (tmp_path / "link").symlink_to("metrics.json")
    found = checksums(tmp_path, frozenset({"run.json"}))
    assert found == {
        name: [len(name), hashlib.sha256(name.encode()).hexdigest()]
        for name in ("figures/a.png", "metrics.json")
    }


# The record of a run


def begun(overrides: list[str] | None = None, **settings: Any) -> RunRecord:
    cfg = OmegaConf.create({"task": "laws", "dt": 1} | settings)
    return RunRecord(
        cfg, {"kernel": "own", "hydra/launcher": "x"}, overrides or ["dt=1", "sweep.resume=null"]
    )


def test_a_record_holds_what_a_run_is(tmp_path: Path) -> None:
    one = begun()
    one.declare([])
    one.write(tmp_path, "running")
    about = run_record.read(tmp_path / "run.json")
    assert about is not None
    assert (about["status"], about["reason"], about["task"], about["overrides"]) == (
        "running",
        None,
        "laws",
        ["dt=1"],
    )
    assert about["settings"] == {"task": "laws", "dt": 1, "kernel": "own"}
    assert "files" not in about
    assert "metrics" not in about
    assert about["checksum"] == record_checksum(about)
    before = one.made_by
    one.declare([MetricInfo("m", "s")])
    assert one.made_by == before
    assert begun(dt=2).made_by != before
    (tmp_path / "metrics.json").write_text('{"ball": 1.0}')
    one.write(tmp_path, "completed")
    about = run_record.read(tmp_path / "run.json")
    assert about is not None
    assert list(about["files"]) == ["metrics.json"]
    assert list(about["metrics"]) == ["m"]
    assert (tmp_path / "run.json").read_text().startswith('{\n "version"')


def test_a_run_that_was_completed_before_is_found_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    one = begun()
    assert one.finished(tmp_path) is None
    one.write(tmp_path, "failed", "why")
    assert one.finished(tmp_path) is None
    (tmp_path / "metrics.json").write_text('{"ball": 1.0}')
    one.write(tmp_path, "completed")
    assert one.finished(tmp_path) == {"ball": 1.0}
    with pytest.raises(
        ValueError, match=rf"^{tmp_path} was not made as it would be now: spread was nothing and"
    ):
        begun(spread=2).finished(tmp_path)
    assert begun(spread=2).finished(tmp_path, anyway=True) == {"ball": 1.0}
    then = begun(spread=2)
    then._about["version"] = "0.0.1"
    told = one._differences(then._about)  # which version first: the others follow from it
    assert told.startswith("it was written by staf_torch 0.0.1, and this is ")
    assert "; spread was 2 and is now " in told
    with pytest.raises(ValueError, match="holds the run 'dt=1', where this sweep has 'dt=1 seed=2'"):
        begun(["dt=1", "seed=2"]).finished(tmp_path, anyway=True)
    (tmp_path / "metrics.json").write_text('{"ball": 2.0}')
    assert one.finished(tmp_path) is None
    assert caplog.messages == [
        f"{tmp_path}: metrics.json is damaged: its checksum is another one; it is run again"
    ]


@pytest.mark.parametrize(("length", "shown"), [(1000, 1000), (1001, 1000)])
def test_a_long_command_line_is_cut(length: int, shown: int, tmp_path: Path) -> None:
    begun([f"a={'x' * (length - 2)}"]).write(tmp_path, "completed")
    with pytest.raises(ValueError, match="holds the run") as said:
        begun().finished(tmp_path)
    line = str(said.value).split("'")[1]
    assert len(line) == shown
    assert line.endswith("...") == (length > 1000)


@pytest.mark.parametrize("count", [4, 5])
def test_four_differences_are_told_and_how_many_more(count: int, tmp_path: Path) -> None:
    one = begun()
    (tmp_path / "metrics.json").write_text("{}")
    one.write(tmp_path, "completed")
    with pytest.raises(ValueError, match="was nothing and is now") as said:
        begun(**{f"x{n}": n for n in range(count)}).finished(tmp_path)
    assert str(said.value).count("was nothing") == 4
    assert ("; and 1 more. Numbers" in str(said.value)) == (count == 5)
    with pytest.raises(ValueError, match=r"not made as they would be now: its overrides were others\. One"):
        one.refuse_rows(tmp_path)
    about = run_record.read(tmp_path / "run.json") or {}
    (tmp_path / "run.json").write_text(json.dumps(about | {"version": "0" * 100}))
    with pytest.raises(ValueError, match=rf"it was written by staf_torch 0{{80}}, and this is {__version__}"):
        one.refuse_rows(tmp_path)


def test_jobs_are_added_to_what_was_noted_of_the_sweep(tmp_path: Path) -> None:
    run_record.begin_sweep(tmp_path, ["seed=1,2", "sweep.objective=a"], ["hydra.verbose=true"])
    run_record.list_jobs(tmp_path, {3: ["seed=1", "sweep.objective=a"], 1: ["seed=2"]})
    run_record.list_jobs(tmp_path, {2: ["seed=3"]})
    assert run_record.read(tmp_path / "sweep.json") == {
        "version": __version__,
        "overrides": ["seed=1,2"],
        "hydra": ["hydra.verbose=true", "sweep.objective=a"],
        "jobs": [{"num": num, "overrides": [f"seed={seed}"]} for num, seed in ((1, 2), (2, 3), (3, 1))],
    }
    (tmp_path / "sweep.json").unlink()
    run_record.list_jobs(tmp_path, {0: ["seed=1"]})
    assert (run_record.read(tmp_path / "sweep.json") or {})["version"] == __version__


@pytest.mark.parametrize(
    "value",
    [
        *("plain", "a b", "it's", "a/b@c+d.e-f_1", "", "ü", "'", "''", "a'b'"),
        *("back\\slash", "\\", "\\\\", "\\'", "\\\\'x\\\\y\\", "'\\'", "\\ "),
        *("1e3", "007", "1_000", "-5", ".5", "+1", "null", "True", "false", "NaN", "inf", "nullable", "1a"),
    ],
)
def test_a_text_is_quoted_for_the_grammar_of_hydra(value: str) -> None:
    from staf_torch.sweeps.hydra_compat import parse_override

    assert parse_override(f"key={run_record.quoted(value)}").value() == value
    assert (run_record.quoted(value) == value) == (value in ("plain", "a/b@c+d.e-f_1", "nullable", "1a"))


def test_what_refers_to_nothing_is_recorded_as_it_is_written() -> None:
    cfg = OmegaConf.create({"a": "${b}", "b": 1, "hydra": {"c": 1}, "sweep": {"d": 1}})
    assert run_record.flat(cfg) == {"a": 1, "b": 1}
    assert run_record.flat(OmegaConf.create({"a": "${no}", "b": 1})) == {"a": "${no}", "b": 1}
    assert run_record.flat(OmegaConf.create({"a": float("inf")})) == {"a": "inf"}
