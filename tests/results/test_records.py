"""`run.json` and `sweep.json`: what made a run, which changes are named, which files are damaged."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from staf_torch import __version__
from staf_torch.results import build, run_record
from staf_torch.results.build import checksums, damage, differences, record_checksum
from staf_torch.results.run import MetricInfo
from staf_torch.results.run_directory import HistoryWriter
from staf_torch.results.run_record import RunRecord
from staf_torch.sweeps.hydra_compat import parse_override

BUILD = {"source": "s", "torch": "t", "compiler": "c", "modules": {"own": "1"}, "imported": {}}


def record(settings: Any = None, **more: Any) -> dict[str, Any]:
    return {"settings": {"dt": 1} if settings is None else settings, "build": BUILD | more}


CHANGES: list[tuple[dict[str, Any], dict[str, Any], list[str]]] = [
    (
        record({"dt": 2, "b": "x"}),
        record({"dt": 1, "a": [1]}),
        ["a was nothing and is now [1]", "b was x and is now nothing", "dt was 2 and is now 1"],
    ),
    (record({"a": (1, 2), "dt": 1.0}), record({"a": [1, 2], "dt": 1}), []),
    (
        record(source="z", torch="z", compiler="z"),
        record(),
        [
            *("the source of staf_torch was z and is now s", "torch was z and is now t"),
            "compiler was z and is now c",
        ],
    ),
    (
        record(modules={"own": "2", "gone": "1"}),
        record(),
        ["the module gone has changed", "the module own has changed"],
    ),
]


@pytest.mark.parametrize(("then", "now", "said"), CHANGES)
def test_a_change_between_two_runs_is_named(
    then: dict[str, Any], now: dict[str, Any], said: list[str]
) -> None:
    assert list(differences(then, now)) == said


OWN_FILES = {
    "plants/__init__.py": "",
    "plants/own.py": "import other, plants.absent\nfrom . import near\nfrom plants.sub.far import x\n",
    "plants/near.py": "no python (",
    "plants/sub/__init__.py": "from .. import own\n",  # in a circle
    "plants/sub/far.py": "import torch\nif 1:\n    from ..deep import y\nx = 1\n",
    "plants/deep.py": "",
    "other.py": "import further\n",
    "further.py": "",
}


@pytest.mark.parametrize("folder", ["mine", "site-packages"])
def test_a_module_is_recorded_with_what_it_imports_and_an_installed_one_with_its_package_alone(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = tmp_path / folder
    for name, text in OWN_FILES.items():
        (base / name).parent.mkdir(parents=True, exist_ok=True)
        (base / name).write_text(text)
    monkeypatch.syspath_prepend(str(base))
    made = build.modules({"target._target_": "plants.own.x"})
    package = {name for name in made if name.partition(".")[0] == "plants"}
    assert package >= {"plants.own", "plants.near", "plants.sub.far", "plants.deep"}
    assert set(made) - package == ({"other", "further"} if folder == "mine" else set())
    assert made["plants.near"] == hashlib.sha256(b"no python (").hexdigest()[:12]


def test_modules_imported_by_names_that_code_makes_are_recorded_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("rec_own", "rec_near"):
        (tmp_path / f"{name}.py").write_text(f"# {name}")
    monkeypatch.syspath_prepend(str(tmp_path))
    __import__("rec_near")
    try:
        assert build.imported({"rec_own": "1"}) == {
            "rec_near": hashlib.sha256(b"# rec_near").hexdigest()[:12]
        }
        assert build.imported({}) == build.imported({"rec_nowhere": "1"}) == {}
    finally:
        del sys.modules["rec_near"]


# The files of a run


def test_result_files_have_checksums_and_logs_links_and_hidden_ones_none(tmp_path: Path) -> None:
    for name in ("metrics.json", "run.json", "staf.log", ".hidden", ".hydra/c.yaml", "figures/a.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    (tmp_path / "link").symlink_to("metrics.json")
    assert checksums(tmp_path, frozenset({"run.json"})) == {
        name: [len(name), hashlib.sha256(name.encode()).hexdigest()]
        for name in ("figures/a.png", "metrics.json")
    }


@pytest.mark.parametrize("how", ["a history", "compressed", "of earlier"])
def test_any_byte_of_a_history_that_changes_is_found(how: str, tmp_path: Path) -> None:
    path, rng = tmp_path / "history.npz", np.random.default_rng(0)
    first, second = rng.normal(size=(2, 3, 2)), np.ones((2, 3))
    if how == "a history":
        with HistoryWriter(path, 2, 3) as writer:
            for row in range(2):
                writer.add({"first": first[row : row + 1], "second": second[row : row + 1]}, row)
            writer.close(time=np.arange(3))
    else:
        (np.savez_compressed if how == "compressed" else np.savez)(path, first=first, second=second)
    content = path.read_bytes()
    written = checksums(tmp_path)
    if how == "of earlier":
        written = {path.name: [len(content), hashlib.sha256(content).hexdigest()]}
    assert damage(tmp_path, written, thorough=True) is None
    for place in range(0, len(content), 7):
        changed = bytearray(content)
        changed[place] ^= 1 << place % 8
        path.write_bytes(changed)
        said = damage(tmp_path, written, thorough=True)
        assert said == "history.npz is damaged: its checksum does not match", place


# The record of a run, and of a sweep


def begun(overrides: list[str] | None = None, **settings: Any) -> RunRecord:
    cfg = OmegaConf.create({"task": "laws", "dt": 1} | settings)
    return RunRecord(
        cfg, {"kernel": "own", "hydra/launcher": "x"}, overrides or ["dt=1", "sweep.resume=null"]
    )


def test_a_record_holds_what_a_run_is(tmp_path: Path) -> None:
    one = begun()
    one.write(tmp_path, "running")
    about = run_record.read(tmp_path / "run.json")
    assert about is not None
    assert (about["status"], about["reason"], about["task"]) == ("running", None, "laws")
    assert (about["overrides"], about["settings"]) == (["dt=1"], {"task": "laws", "dt": 1, "kernel": "own"})
    assert not {"files", "metrics"} & set(about)
    assert about["checksum"] == record_checksum(about)
    before = one.made_by
    one.declare([MetricInfo("m", "s")])
    assert one.made_by == before != begun(dt=2).made_by
    (tmp_path / "metrics.json").write_text('{"ball": 1.0}')
    one.write(tmp_path, "completed")
    about = run_record.read(tmp_path / "run.json")
    assert about is not None
    assert (list(about["files"]), list(about["metrics"])) == (["metrics.json"], ["m"])


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
    many = dict.fromkeys("abcde", 2)
    with pytest.raises(
        ValueError, match=rf"^{tmp_path} was made with other settings or source: a was.* and 1 more"
    ):
        begun(**many).finished(tmp_path)
    assert begun(**many).finished(tmp_path, anyway=True) == {"ball": 1.0}
    with pytest.raises(ValueError, match="holds the run 'dt=1', where this sweep has 'dt=1 seed=2'"):
        begun(["dt=1", "seed=2"]).finished(tmp_path, anyway=True)
    (tmp_path / "metrics.json").write_text('{"ball": 2.0}')
    assert one.finished(tmp_path) is None
    assert "metrics.json is damaged: its checksum does not match; it is run again" in caplog.text


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


@pytest.mark.parametrize("value", ["it's", "", "ü", "a'b'", "\\'x\\y\\", "1e3", "1_000", "null", "inf", "1a"])
def test_a_text_is_quoted_for_the_grammar_of_hydra(value: str) -> None:
    assert parse_override(f"key={run_record.quoted(value)}").value() == value
