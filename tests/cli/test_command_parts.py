"""The commands in their parts, without a run: what they print, in which words they end, with which code."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import shutil
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from recorded import Record
from sweep_runs import write_run

from staf_torch import __version__
from staf_torch.cli import doctor, reference, schema, staf, table
from staf_torch.sweeps import signals
from staf_torch.sweeps.hydra_compat import BrokenSweep
from staf_torch.sweeps.job import Refused

# `staf`


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Runs a command line whose application does as a test says; the code and what it says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))

    def run(does: Any, *words: str) -> object:
        monkeypatch.setattr(sys, "argv", ["staf", *words])
        monkeypatch.setattr(staf, "_staf", does)
        try:
            staf.main()
        except SystemExit as ended:
            return ended.code
        finally:
            assert sys.argv == ["staf", *words]
        return None

    return run


def raises(error: BaseException) -> Any:
    def does() -> None:
        raise error

    return does


def test_a_command_finds_the_users_modules_and_takes_its_words_apart(command: Any, tmp_path: Path) -> None:
    seen: list[Any] = []
    assert (
        command(lambda: seen.append((sys.argv, sys.path[0], os.environ["HYDRA_FULL_ERROR"])), "seed=1")
        is None
    )
    assert seen == [(["staf", "seed=1"], str(tmp_path), "1")]
    assert "HYDRA_FULL_ERROR" not in os.environ


def test_errors_of_a_user_end_in_a_sentence_and_defects_with_their_trace(
    command: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert command(raises(ValueError("odd"))) == "staf: odd"
    with pytest.raises(RuntimeError, match="a defect"):
        command(raises(RuntimeError("a defect")))
    refused = Refused(ValueError("refused"))
    assert command(raises(refused)) == "staf: refused"
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(ValueError, match="odd"):
        command(raises(ValueError("odd")))
    assert command(raises(refused)) == "staf: refused"
    refused.__cause__ = ValueError("the cause")
    with pytest.raises(ValueError, match="the cause"):
        command(raises(refused))
    assert os.environ["HYDRA_FULL_ERROR"] == "1"


def test_a_sweep_that_is_broken_is_closed_and_a_signal_says_how_to_resume(
    command: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    sweep = BrokenSweep(OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path / "sweep")}}}), None)
    (tmp_path / "sweep" / "0").mkdir(parents=True)
    (tmp_path / "sweep" / "0" / "run.json").write_text('{"status": "completed"}')
    closed: list[Any] = []
    monkeypatch.setattr(staf.callbacks, "close", closed.append)
    monkeypatch.setattr(staf, "broken_sweep", lambda error: None)
    assert command(raises(ValueError("odd"))) == "staf: odd"
    assert closed == []
    assert command(raises(KeyboardInterrupt())) == 130
    assert capsys.readouterr().err == "staf: interrupted\n"
    monkeypatch.setattr(staf, "broken_sweep", lambda error: sweep)
    assert command(raises(ValueError("odd"))) == "staf: odd"
    assert closed == [sweep]
    assert command(raises(signals.Stopped(15))) == 143
    assert closed == [sweep, sweep]
    said = "staf: ended by SIGTERM; 1 jobs are complete. Resume with:\n  staf -m sweep.resume=sweep\n"
    assert capsys.readouterr().err == said
    with pytest.raises(SystemExit) as ended, staf._told_between_lines():
        raise signals.Stopped(1)
    assert ended.value.code == 129


def test_commands_that_are_no_runs_ask_hydra_nothing(
    command: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    never = raises(AssertionError())
    monkeypatch.setattr(doctor, "main", lambda: 7)
    assert command(never, "doctor") == 7
    assert command(never, "--version") is None
    assert capsys.readouterr().out == f"{doctor.version()}\n"

    def write(words: list[str]) -> str:
        if words == ["no"]:
            raise ValueError("not this one")
        return f"written {words}"

    monkeypatch.setattr(staf, "_WRITERS", {"schema": write})
    assert command(never, "schema", "a", "b") is None
    assert capsys.readouterr().out == "written ['a', 'b']\n"
    assert command(never, "schema", "no") == "staf: not this one"
    seen: list[Any] = []
    command(lambda: seen.append(sys.argv[1:]), "seed=1", "doctor")
    command(lambda: seen.append(sys.argv[1:]))
    assert seen == [["seed=1", "doctor"], []]


# `staf-table`


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for num, (kernel, error) in enumerate((("a", 0.123456), ("b", 2.5))):
        metrics = {"ball_error": error, "condition_number": 3.0}
        write_run(tmp_path / "runs" / str(num), {"kernel": kernel}, metrics)
    return tmp_path / "runs"


def test_a_table_is_what_its_options_say(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def said(*words: str, code: int = 0) -> str:
        assert table.main([str(runs), *words]) == code
        found = capsys.readouterr()
        return found.err if code else found.out

    assert "0.123 " in said()
    assert "condition_number" not in said()
    assert "**" not in said()
    assert "**0.123**" in said("--best", "bold")
    assert "0.12346" in said("--digits", "5")
    assert "condition_number" in said("--metric", " condition_number ,")
    assert said("--sort", "ball_error:desc").index("2.5") < said("--sort", "ball_error:desc").index("0.123")
    assert said("--format", "csv").count("0.123456") == 1
    assert "condition_number" in said("--format", "csv")
    assert said("--format", "tex").startswith("\\begin")
    assert len(json.loads(said("--format", "json"))["rows"]) == 2
    assert said("--digits", "1")
    assert said("--digits", "0", code=1) == "staf-table: `staf-table --digits` must be at least 1; got 0.\n"
    no_file = "staf-table: `staf-table --format parquet` needs --output FILE.\n"
    assert said("--format", "parquet", code=1) == no_file
    assert table.main([str(runs), "--output", str(runs / "out.md")]) == 0
    assert capsys.readouterr().out == ""
    assert (runs / "out.md").read_text() == said()
    assert said("--output", str(runs / "no" / "out.md"), code=1).startswith("staf-table: [Errno 2]")
    options = table._parser().parse_args(["a", "b", "--watch"])
    assert (options.path, options.watch, options.digits, options.format) == (
        [Path("a"), Path("b")],
        2.0,
        3,
        "md",
    )
    assert (options.rows, options.best, options.output) == ((), None, None)
    assert table._names("a, b,,c ,") == ("a", "b", "c")


def test_what_has_no_row_is_told_beside_the_table(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (runs / "9").mkdir()
    (runs / "9" / "run.json").write_text("damaged")
    write_run(runs / "8", {"kernel": "c"}, {"ball_error": 1.0}, version="0.0.1")
    assert table.main([str(runs)]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said[0].startswith(f"skipped {runs / '9'}: ")
    assert said[1].startswith("note: 1 of 3 runs were written by staf_torch 0.0.1")
    assert table.main([str(runs / "nowhere")]) == 1
    assert capsys.readouterr().err.startswith("staf-table: `collect(path=...)` must be a directory")


def test_a_table_is_printed_again_while_runs_go_on(
    runs: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not table._going_on([runs])
    for status in ("running", "unfinished"):
        monkeypatch.setattr(
            table,
            "collect",
            lambda path: SimpleNamespace(skipped=(), rows=[SimpleNamespace(status=status)]),  # noqa: B023
        )
        assert table._going_on([runs])
    monkeypatch.undo()
    assert not table._going_on([runs / "nowhere"])
    (runs / "empty").mkdir()
    assert table._going_on([runs / "nowhere", runs / "empty"])
    (runs / "sweep.json").write_text(json.dumps({"jobs": [{"num": 0, "overrides": ["kernel=z"]}]}))
    assert table._going_on([runs])
    left, slept = [3], []

    def going_on(paths: object) -> bool:
        left[0] -= 1
        return left[0] >= 0

    monkeypatch.setattr(table, "_going_on", going_on)
    monkeypatch.setattr(table, "time", SimpleNamespace(sleep=slept.append))
    assert table.main([str(runs), "--watch", "0.5"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("| kernel") == 4
    assert "\x1b" not in printed
    assert slept == [0.5] * 3
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    left[0] = 1
    assert table.main([str(runs), "--watch", "0.5"]) == 0
    assert capsys.readouterr().out.startswith("\x1b[H\x1b[2J|")

    def stop(seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(table.time, "sleep", stop)
    left[0] = 5
    assert table.main([str(runs), "--watch", "0.5"]) == 0
    assert capsys.readouterr().out.count("| kernel") == 2


# `staf doctor`


def test_the_doctor_says_what_there_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(doctor, "_self_test", lambda: ("fine", True))
    monkeypatch.setattr(shutil, "which", lambda name: f"/bin/{name}" if name == "mine" else None)
    monkeypatch.setenv("CXX", "mine")
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    found = {name: (said, good) for name, said, good in doctor._findings()}
    assert found["compiler"] == ("/bin/mine", True)
    assert found["threads"] == (f"{torch.get_num_threads()} of torch, 5 cores, OMP_NUM_THREADS 3", True)
    assert found["packages"][0].startswith(f"torch {importlib.metadata.version('torch')}, numpy ")
    assert found["staf_torch"][0].startswith(f"{__version__} in ")
    monkeypatch.delenv("CXX")
    monkeypatch.delenv("OMP_NUM_THREADS")
    found = {name: (said, good) for name, said, good in doctor._findings()}
    assert found["compiler"] == ("none: everything runs in plain torch, slower", True)
    assert found["threads"][0].endswith("OMP_NUM_THREADS not set")


def test_a_place_is_one_that_can_be_written_or_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor._place(tmp_path) == (str(tmp_path), True)
    assert doctor._place(tmp_path / "a" / "b") == (str(tmp_path / "a" / "b"), True)
    for name in ("a.so", "b.so", "c.txt"):
        (tmp_path / name).write_text("")
    assert doctor._place(tmp_path) == (f"{tmp_path}, 2 libraries", True)
    asked: list[Any] = []
    monkeypatch.setattr(os, "access", lambda place, how: asked.append((place, how)))
    assert doctor._place(tmp_path / "a" / "b") == (f"{tmp_path / 'a' / 'b'}, read-only", None)
    assert asked == [(tmp_path, os.W_OK)]


def test_the_doctor_ends_with_what_it_found(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    findings = [("a", "one", True), ("b", "two", False), ("c", "three", True)]
    monkeypatch.setattr(doctor, "_findings", lambda: iter(findings))
    assert doctor.main() == 1
    assert capsys.readouterr().out == "a:          one\nb:          two   <- problem\nc:          three\n"
    findings[1] = ("b", "two", True)
    assert doctor.main() == 0


@pytest.mark.parametrize(
    ("change", "good"), [(0.9e-6, True), (1.1e-6, False), (-0.9e-6, True), (-1.1e-6, False)]
)
def test_the_self_test_has_its_number_to_a_millionth(
    change: float, good: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = 6.23712254984
    clock = iter([10.0, 12.5])
    monkeypatch.setattr(doctor, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    excess = torch.tensor([[0.0, 1.0, expected * (1 + change)], [2.0] * 3], dtype=torch.float64)
    monkeypatch.setattr(doctor, "chase", lambda *given, **more: SimpleNamespace(excess=excess))
    said, found = doctor._self_test()
    assert found == good
    assert said.endswith(f", expected {expected:.12g}, in 2.5 s")
    assert said.startswith(f"{expected * (1 + change):.12g}, ")


# `staf docs`


def test_pages_are_written_into_a_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []

    def pages(*modules: str, output_directory: Path) -> None:
        warnings.warn("Error parsing type annotation of x", stacklevel=1)
        made.append((modules, output_directory))

    def configure(**options: str | bool) -> None:
        made.append(options)

    pdoc = SimpleNamespace(pdoc=pages, render=SimpleNamespace(configure=configure))
    monkeypatch.setitem(sys.modules, "pdoc", pdoc)
    monkeypatch.setattr(reference.importlib.util, "find_spec", lambda name: object())
    assert reference.main([]) == "reference pages: site/index.html"
    assert reference.main(["a/b"]) == "reference pages: a/b/index.html"
    assert made[1::2] == [(reference.MODULES, Path("site")), (reference.MODULES, Path("a/b"))]
    assert made[0] == {"docformat": "google", "footer_text": "staf_torch", "show_source": False}
    with pytest.raises(ValueError, match="`staf docs` takes one folder; got 'a b'"):
        reference.main(["a", "b"])


# `staf schema`


def test_the_schema_is_as_it_was(record: Record) -> None:
    """A hash of what each group and each key may be; `--record` where an option has changed."""
    whole = schema.schema()
    parts = {f"{kind} {name}": node for kind in ("properties", "$defs") for name, node in whole[kind].items()}
    rest = {key: value for key, value in whole.items() if key not in ("properties", "$defs", "title")}
    texts = {name: json.dumps(node) for name, node in (parts | {"rest": rest}).items()}
    record({name: hashlib.sha256(text.encode()).hexdigest()[:12] for name, text in texts.items()})


def test_the_schema_of_a_group_refers_to_it() -> None:
    one = json.loads(schema.main(["adp/law"]))
    assert one["title"] == f"Options of adp/law, staf_torch {__version__}"
    assert one["$schema"].endswith("2020-12/schema")
    assert set(one) == {"$schema", "title", "$ref", "$defs"}
    for words in ([], ["experiment"]):
        whole = json.loads(schema.main(words))
        assert whole["title"] == f"Settings of staf_torch {__version__}"
        assert whole["additionalProperties"] is False
    assert schema.main([]).startswith('{\n "$schema"')


def test_comments_are_those_behind_a_key() -> None:
    lines = [
        "a: 1 # one",
        "b:",
        "  c: 2 # two",
        "  d:",
        "    e: 3 # three",
        "f: 4",
        "# not a key",
        "  g: 5 # five",
    ]
    assert list(schema._commented(lines)) == [
        ("a", "one"),
        ("b.c", "two"),
        ("b.d.e", "three"),
        ("f.g", "five"),
    ]


@pytest.mark.parametrize(
    ("hint", "kinds"),
    [
        (float, {"number"}),
        (int | None, {"integer", "null"}),
        (list[float], {"array"}),
        (tuple[int, ...], {"array"}),
        (dict[str, int], {"object"}),
        (torch.Tensor, {"number", "array"}),
        (float | torch.nn.Module, {"number"}),
        (torch.nn.Module, None),
        (torch.nn.Module | torch.Generator, None),
    ],
)
def test_what_a_file_can_say_of_an_annotation(hint: Any, kinds: set[str] | None) -> None:
    assert schema._kinds(hint) == kinds


@pytest.mark.parametrize(
    ("values", "hint", "node"),
    [
        ([1, 2], None, {"type": ["integer"]}),
        ([1, 2.5], None, {"type": ["number"]}),
        ([1], {"number"}, {"type": ["number"]}),
        (["a", [1]], None, {"type": ["array", "string"]}),
        (["???"], None, {}),
        (["${x}", True], None, {"type": ["boolean"]}),
        ([None], None, {}),
        ([None], {"string"}, {"type": ["null", "string"]}),
        ([], {"array"}, {"type": ["array"]}),
    ],
)
def test_the_types_of_values_and_of_what_is_known_of_them(values: Any, hint: Any, node: Any) -> None:
    assert schema._value(values, "name", {}, hint) == node
