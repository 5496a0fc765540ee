"""One rule for trust: reading runs no code, building runs none but the library's own unless it is trusted."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import pytest

from staf_torch.results.files import (
    UnreadableError,
    all_visible,
    open_regular,
    parse_object,
    read_bytes,
    read_lines,
    read_object,
)
from staf_torch.results.run_directory import History
from staf_torch.settings import config_directory
from staf_torch.settings.trust import constructors, foreign_settings, refusal

OWN: list[Any] = [
    {"kernel": {"_target_": "staf_torch.GaussianKernel", "width": 1.0}, "task": "gradient_chase"},
    {"kernel": {"_target_": "staf_torch.kernels.MaternKernel"}, "metric": {"_target_": None}},
    {"a": {"b": "${c}"}, "c": "${d.x}", "d": {"x": True, "y": "${.x}"}, "list": ["${c}"]},
    {"system": {"_target_": "staf_torch.systems.Pendulum"}, "dt": 1e-300, "count": 10**9},
    {"task": "adp", "text": "os.system"},
    [1, 2],
    None,
]
FOREIGN: list[tuple[Any, list[str]]] = [
    ({"kernel": {"_target_": "os.system"}}, ["kernel._target_: os.system"]),
    ({"a": [{"b": {"_target_": "torch.load"}}]}, ["a.0.b._target_: torch.load"]),
    ({"k": {"_target_": ["torch.load"]}}, ["k._target_.0: torch.load"]),
    ({"k": {"_target_": "staf_torch.kernels.gaussian.torch.load"}}, None),
    ({"k": {"_target_": "staf_torch.${x}"}, "x": "GaussianKernel"}, None),
    ({"k": {"_target_": "staf_torch.settings.chase.load", "path": "os.getcwd"}}, None),
    ({"system": {"_target_": "staf_torch.systems.MujocoPlant"}}, None),
    ({"t": {"_target_": "staf_torch.sweeps.callbacks.TensorBoardTracker"}}, None),
    ({"task": "mine.task"}, ["task: mine.task"]),
    ({"device": "${oc.env:SECRET}"}, ["device: ${oc.env:SECRET}"]),
    ({"k": "${oc.create:${oc.decode:${x}}}"}, None),
    ({"k": "\\${oc.env:HOME}"}, None),
    ({"k": "${a.${b}}"}, None),
    ({"k": "${a[0]}"}, None),
    ({"k": "${a}${a}"}, None),
    ({"k": {"_target_": "os.system"}, "task": "a.b"}, ["k._target_: os.system", "task: a.b"]),
]


def test_settings_of_the_librarys_own_parts_need_no_trust() -> None:
    assert [settings for settings in OWN if foreign_settings(settings)] == []


@pytest.mark.parametrize(("settings", "lines"), FOREIGN)
def test_settings_that_may_run_foreign_code_are_shown(settings: Any, lines: list[str] | None) -> None:
    found = foreign_settings(settings)
    assert len(found) == (1 if lines is None else len(lines))
    assert lines in (None, found)
    message = refusal(Path("runs/x"), [*found, "a: \x1b[2J"])
    assert all(line in message for line in found)
    assert "\x1b" not in message
    assert message.endswith("add --trust.")


def test_every_part_of_the_shipped_settings_may_be_built_without_trust() -> None:
    targets = {
        line.partition("_target_:")[2].split("#")[0].strip()
        for path in Path(config_directory()).rglob("*.yaml")
        for line in path.read_text().splitlines()
        if "_target_:" in line
    }
    asking = {"null", "staf_torch.settings.chase.load", "staf_torch.systems.MujocoPlant"}
    foreign = {name for name in targets if "callbacks" in name} | asking
    assert not asking & constructors()
    assert targets - foreign - constructors() == set()
    assert len(targets - foreign) > 30


# Files


def open_files() -> int:
    return len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0


def test_what_is_no_regular_file_is_refused_in_a_sentence_and_not_waited_for(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("own\nlines")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    os.mkfifo(tmp_path / "pipe")
    before = open_files()
    for path, why in (
        (tmp_path / "link", "link cannot be read: it is a link"),
        (tmp_path / "none", "none cannot be read: No such file or directory"),
        (tmp_path / "file" / "none", "none cannot be read: Not a directory"),
        (tmp_path / "pipe", "pipe is not a regular file"),
        (tmp_path, f"{tmp_path.name} is not a regular file"),
        (tmp_path / "a\0b", "cannot be read: embedded null byte"),
    ):
        for read in (open_regular, read_bytes, read_object, History):
            with pytest.raises(UnreadableError, match=why):
                read(path)
    assert read_bytes(tmp_path / "file") == b"own\nlines"
    assert list(read_lines(tmp_path / "file")) == [b"own\n", b"lines"]
    assert open_files() == before


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"[1]", "run.json holds no object"),
        (b"{", "run.json is not JSON: "),
        (b"\xff{}", "run.json is not JSON: "),
        (b'{"a": ' + b"[" * 100_000, "run.json is nested too deep"),
        (b'{"a": 1' + b"0" * 5000 + b"}", None),
    ],
)
def test_what_is_no_object_is_refused_in_a_sentence(content: bytes, why: str | None, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_bytes(content)
    if why is None:
        assert read_object(tmp_path / "run.json") == {"a": math.inf}
    else:
        with pytest.raises(UnreadableError, match=f"^{why}"):
            read_object(tmp_path / "run.json")


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ("12345678901234567890", 12345678901234567890),
        ("123456789012345678901", 123456789012345678901.0),
        (r'"\u001b[2J"', "\\u001b[2J"),
        (r'"\b\f\r\n\t"', "\\u0008\\u000c\\u000d\n\t"),
        ('"\x7f"', "\\u007f"),
        ('"\u202eabc"', "\\u202eabc"),
        (r'"\ud800"', "\\ud800"),
        ('"übër \U0001f642"', "übër \U0001f642"),
        ('[{"\u200b": ["\u200b"]}]', [{"\\u200b": ["\\u200b"]}]),
    ],
)
def test_texts_of_a_record_are_harmless_on_a_terminal(written: str, read: Any) -> None:
    assert repr(parse_object(f'{{"a": {written}}}'.encode(), "it")["a"]) == repr(read)
    assert all_visible({"a\r": ["\r", 1, None, {2: "\r"}]}) == {
        "a\\u000d": ["\\u000d", 1, None, {"2": "\\u000d"}]
    }
