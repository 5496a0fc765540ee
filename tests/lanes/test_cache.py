"""The user's cache of libraries: nothing is built twice, nothing damaged loaded; without it torch serves."""

from __future__ import annotations

import ctypes
import itertools
import multiprocessing
import os
import platform
import re
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch import lanes
from staf_torch.lanes.compilation import cache as folder_of
from staf_torch.lanes.compilation import compiler

pytestmark = [
    pytest.mark.needs_compiler,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # of a fork beside threads
]
SIZES = itertools.count(2)
X = torch.linspace(-1, 1, 10, dtype=torch.float64).view(5, 2)


def new_program(name: str = "program") -> lanes.Program:
    """A program whose text no other program of this process has."""
    count = next(SIZES)

    def step(x: Tensor, now: object, row: object) -> tuple[Tensor, Tensor]:
        for _ in range(count):
            x = (x * x).sin()
        return x, x.sum(-1)

    return lanes.Program(step, name=name)


def right(program: lanes.Program) -> None:
    """Fail where a program is not compiled, or computes anything but its definition."""
    assert program.compiles(X, steps=2)
    torch.testing.assert_close(program(X, steps=2), program.definition(X, steps=2))


def programs(cache: Path) -> list[Path]:
    """What a cache holds, but for the library of threads that all programs share."""
    return [path for path in cache.iterdir() if not path.name.startswith("threads-")]


def in_children(*functions: Callable[[], Any]) -> None:
    """Run functions in processes of their own, side by side: what one of them loads no other has."""
    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=function) for function in functions]
    for process in processes:
        process.start()
    for process in processes:
        process.join(120)
        assert process.exitcode == 0


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache in a folder that is not there yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "new"))
    return tmp_path / "new" / "staf_torch"


def script(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(("#!/bin/sh", *lines)) + "\n")
    path.chmod(0o755)
    return path


@pytest.fixture
def calls(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Sequence[str]]:
    """What a compiler was asked to build so far: it notes its words and hands them on."""
    log, own = tmp_path / "log", compiler.find_compiler()
    noting = script(tmp_path / "noting", f'echo "$@" >> {log}', f'exec {own} "$@"')
    monkeypatch.setenv("CXX", str(noting))
    noted = lambda: log.read_text().splitlines() if log.exists() else []  # noqa: E731
    return lambda: [line for line in noted() if " -o " in line and "/threads-" not in line]


def test_a_program_is_built_once_for_all_processes(cache: Path, calls: Callable[[], Sequence[str]]) -> None:
    """Or once by each of several that begin at once."""
    program = new_program()
    in_children(*[lambda: right(program)] * 2)
    commands = calls()
    assert 1 <= len(commands) <= 2
    assert {"-march=native", "-ffp-contract=off"} <= {*commands[0].split()}  # rounding is as it is written
    (path,) = programs(cache)  # and nothing is left beside it
    os.utime(path, (1e9, 1e9))
    right(program)
    right(lanes.Program(program.step, name="another of the same text"))
    assert calls() == commands
    assert path.stat().st_mtime > 1e9 + 1  # what is in use is noted so that it stays


def test_other_options_and_another_compiler_are_another_library(
    cache: Path, calls: Callable[[], Sequence[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = new_program()
    in_children(lambda: right(program))
    monkeypatch.setenv("CXXFLAGS", f"{os.environ['CXXFLAGS']} -DNOTHING=1")
    in_children(lambda: right(program))
    assert calls()[1].index("-O0 -DNOTHING=1") > calls()[1].index("-O2")  # the last one holds
    newer = script(tmp_path / "newer", '[ "$1" = --version ] && echo newer && exit; exit 1')
    monkeypatch.setenv("CXX", str(newer))
    assert not lanes.Program(program.step, name="by a newer one").compiles(X, steps=2)
    assert len(list(cache.glob("lanes-*.so"))) == 2


FAULTS: dict[str, tuple[dict[str, str], str]] = {
    "no compiler": ({"PATH": "/nonexistent", "CXX": ""}, "none of g++, c++, clang++ is on the path"),
    "a compiler that fails": ({"CXX": "/bin/false"}, "failed"),
    "a compiler that hangs": ({"STAF_COMPILE_SECONDS": "0.2"}, "took more than 0.2 s"),
    "a limit that is none": (
        {"STAF_COMPILE_SECONDS": "2m"},
        "`STAF_COMPILE_SECONDS` must be a positive number",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_where_nothing_can_be_built_plain_torch_serves_and_one_line_says_why(
    fault: str, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    settings, reason = FAULTS[fault]
    hanging = script(tmp_path / "hanging", '[ "$1" = --version ] && exit 0', "exec sleep 60")
    if "hangs" in fault:
        monkeypatch.setenv("CXX", str(hanging))
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    program = new_program(f"a program with {fault}")
    for _ in range(2):
        assert not program.compiles(X, steps=2)
        assert torch.equal(program(X, steps=2)[0], program.definition(X, steps=2)[0])
    (line,) = caplog.messages
    assert line.startswith(f"a program with {fault} runs in plain torch, slower: ")
    assert reason in line
    assert "\n" not in line
    assert not list(cache.glob("*.so"))


def test_what_a_compiler_that_takes_too_long_has_started_ends_with_it(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = '[ "$1" = --version ] && exit 0', f"sleep 60 & echo $! > {tmp_path / 'child'}; wait"
    monkeypatch.setenv("CXX", str(script(tmp_path / "driver", *lines)))
    monkeypatch.setenv("STAF_COMPILE_SECONDS", "0.5")
    assert not new_program("a program").compiles(X, steps=2)
    child = int((tmp_path / "child").read_text())
    state = Path(f"/proc/{child}/stat")
    deadline = time.monotonic() + 10
    while state.exists() and state.read_text().split()[2] != "Z" and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not state.exists() or state.read_text().split()[2] == "Z"
    begun = time.monotonic()
    assert not new_program("another program").compiles(X, steps=2)  # it is not waited for again
    assert time.monotonic() - begun < 0.4


def test_a_cache_serves_where_there_is_no_compiler_also_one_that_nobody_may_write(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A container to which a cache was copied, of another compiler's and with other flags, on any kernel."""
    program, never_built = new_program(), new_program("a program that was never built")
    in_children(lambda: right(program))
    (library,) = programs(cache)
    whole = library.read_bytes()
    with monkeypatch.context() as there:
        there.setenv("PATH", "/nonexistent")
        there.delenv("CXXFLAGS")
        there.setattr(os, "access", lambda *_: False)
        there.setattr(platform, "platform", lambda: "another kernel")
        in_children(lambda: right(program))
        assert not never_built.compiles(X, steps=2)
        for damaged in (whole[: len(whole) // 2], whole[:100] + bytes([whole[100] ^ 1]) + whole[101:]):
            library.write_bytes(damaged)
            assert not lanes.Program(program.step, name="a damaged one").compiles(X, steps=2)
    in_children(lambda: right(program))  # built again
    assert len(library.read_bytes()) == len(whole)


FOREIGN: dict[str, tuple[Callable[[Path], None], str]] = {
    "that others may write": (lambda path: path.chmod(0o777), r"others than its owner .*\(mode 777\)"),
    "of another user": (lambda path: os.chown(path, 4321, -1), "it belongs to user 4321"),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_nothing_is_loaded_that_somebody_else_may_have_written(
    kind: str, cache: Path, caplog: pytest.LogCaptureFixture, calls: Callable[[], Sequence[str]]
) -> None:
    """Neither a library nor a folder."""
    if "user" in kind and os.geteuid() != 0:
        pytest.skip("only root can give a file away")
    change, reason = FOREIGN[kind]
    program, path = new_program(), cache
    if "user" in kind:
        in_children(lambda: right(program))
        (path,) = programs(cache)
        assert path.stat().st_mode & 0o022 == 0
        change(path)
        right(program)  # from a library of its own
        assert len(calls()) == 2
        assert [each.stat().st_uid for each in programs(cache)] == [os.geteuid()]
    else:
        cache.mkdir(parents=True)
        change(cache)
        right(program)
        assert folder_of.cache() != cache
        assert not [*cache.iterdir()]
    (line,) = caplog.messages
    assert re.match(rf"{path} is not used, as machine code is run from there: {reason}", line)


def test_a_home_that_cannot_be_written_is_replaced_by_a_folder_of_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    folder = folder_of.cache()
    assert folder == folder_of.cache()  # what one program leaves there another one finds
    assert not folder.is_relative_to(tmp_path)
    before = set(folder.iterdir())
    right(new_program())
    assert len(set(folder.iterdir()) - before) == 1
    shutil.rmtree(folder)  # somebody tidies up
    assert folder_of.cache().is_dir()


def test_checkouts_of_one_version_share_a_library_and_others_do_not(
    calls: Callable[[], Sequence[str]], tmp_path: Path
) -> None:
    found = []
    for place, number in (("one", 7), ("two", 7), ("three", 9)):
        (tmp_path / place).mkdir()
        (tmp_path / place / "_seven.cpp").write_text(
            '#include "_number.hpp"\nextern "C" int staf_seven() { return number + N; }\n'
        )
        (tmp_path / place / "_number.hpp").write_text(f"constexpr int number = {number};")
        function: Any = compiler.compiled(tmp_path / place / "_seven.cpp", "N=3")
        function.restype = ctypes.c_int
        found.append(function())
    assert found == [10, 10, 12]
    assert len(calls()) == 2


def test_the_cache_forgets_what_nobody_has_used_and_nothing_of_today(tmp_path: Path) -> None:
    day, now = 86_400, 1e9

    def put(name: str, days: float, size: int = 100) -> None:
        (tmp_path / name).write_bytes(b"0" * size)
        os.utime(tmp_path / name, (now - days * day,) * 2)

    def left(**options: Any) -> set[str]:
        folder_of.prune(tmp_path, now=now, **options)
        return {path.name for path in tmp_path.iterdir()}

    ages = {"lanes-new.so": 0.5, "trace-old": 61, "lanes-old.so": 70, "lanes-mid.so": 20, "trace-mid": 10}
    ages |= {"tmpabc": 2, "tmpnow": 0.01, "notes.txt": 400}  # left over, being written, of somebody else
    for name, days in ages.items():
        put(name, days)
    (tmp_path / "tmpdir").mkdir()
    os.utime(tmp_path / "tmpdir", (now - 3 * day,) * 2)
    kept = {"lanes-new.so", "lanes-mid.so", "trace-mid", "tmpnow", "notes.txt"}
    assert left() == left(largest=400) == kept
    assert left(largest=399) == kept - {"lanes-mid.so"}  # the oldest, and no more than there need be
    assert left(largest=0) == {"lanes-new.so", "tmpnow", "notes.txt"}
