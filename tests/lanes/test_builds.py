"""How C++ becomes a library in the cache: words, files and faults, with a stub in place of the compiler."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from staf_torch.lanes import build, compiler


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache in a folder that is not there yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "new" / "home"))
    build._pruned.cache_clear()
    return tmp_path / "new" / "home" / "staf_torch"


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[list[str]]]:
    """What the compiler is called with; it writes what it was given into its output."""
    seen: list[list[str]] = []

    def run(command: list[str]) -> str:
        if "--version" in command:
            return "a compiler 1.0\nmore of it"
        seen.append(command)
        output = Path(command[command.index("-o") + 1])
        source = next(Path(word) for word in command if word.endswith(".cpp"))
        output.write_bytes(b"built of " + source.read_bytes())
        return ""

    for module in (build, compiler):
        monkeypatch.setattr(module, "_run", run)
        monkeypatch.setattr(module.shutil, "which", lambda name: f"/bin/{name}" if name == "g++" else None)
    kept = compiler._version, compiler._surroundings, build.compiler
    for each in kept:
        each.cache_clear()
    yield seen
    for each in kept:
        each.cache_clear()


def whole(library: Path) -> bytes:
    """What a library holds before its digest."""
    content = library.read_bytes()
    assert content[-32:] == hashlib.sha256(content[:-32]).digest()
    return content[:-32]


def test_a_source_of_the_package_is_built_once_with_its_words_and_sealed(
    cache: Path, commands: list[list[str]], tmp_path: Path
) -> None:
    source = tmp_path / "_seven.cpp"
    source.write_text("seven")
    path = build._library(source, ("N=3", "M=4"))
    assert path.parent == cache
    assert path.name.startswith("seven-")
    assert len(path.stem.removeprefix("seven-")) == 16
    assert whole(path) == b"built of seven"
    (command,) = commands
    place = Path(build.__file__).parent
    assert command[:-2] == ["/bin/g++", *build._FLAGS, f"-I{place}", "-DN=3", "-DM=4", str(source)]
    assert Path(command[-1]).parent.parent == cache  # of the same disk, so that it can be moved
    assert build._library(source, ("N=3", "M=4")) == path
    assert len(commands) == 1
    assert [each.name for each in cache.iterdir()] == [path.name]
    assert build._library(source, ("N=3",)) != path
    assert len(commands) == 2
    assert build.compiler() == "a compiler 1.0"


@pytest.mark.parametrize(
    ("lines", "long", "warned"),
    [(1500, False, False), (1501, True, False), (6000, True, False), (6001, True, True)],
)
def test_a_program_is_built_with_fewer_passes_where_it_is_long_and_with_a_word_where_it_is_slow(
    lines: int,
    long: bool,
    warned: bool,
    cache: Path,
    commands: list[list[str]],
    caplog: pytest.LogCaptureFixture,
) -> None:
    cache.mkdir(parents=True)
    text, path = "x\n" * lines, cache / "lanes-1.so"
    compiler._build(text, path)
    (command,) = commands
    flags = [*compiler._FLAGS, *(compiler._FLAGS_OF_LONG if long else ())]
    assert command[: len(flags) + 3] == ["/bin/g++", *flags, "-I", str(Path(compiler.__file__).parent)]
    assert whole(path) == b"built of " + text.encode()
    assert [each.name for each in cache.iterdir()] == [path.name]
    assert ("a program of 6001 lines is compiled, once: some 4 s" in caplog.text) is warned
    assert len(compiler._key(text)) == 24
    assert compiler._key(text) != compiler._key(text + "y")


def test_clang_is_given_no_words_of_gcc(
    cache: Path, commands: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    cache.mkdir(parents=True)
    monkeypatch.setattr(compiler, "_version", lambda _: "Ubuntu CLANG 14")
    compiler._build("x\n" * 2000, cache / "lanes-1.so")
    assert not set(compiler._FLAGS_OF_LONG) & set(commands[0])


def test_flags_keep_rounding_as_it_is_written_down() -> None:
    assert {"-ffp-contract=off", "-fno-math-errno", "-march=native"} <= set(compiler._FLAGS)
    assert not {"-ffast-math", "-Ofast"} & {*compiler._FLAGS, *build._FLAGS}


def test_without_a_compiler_its_names_are_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    for call in (compiler._compiler, lambda: build._library(tmp_path / "_x.cpp", ())):
        with pytest.raises(FileNotFoundError, match=r"none of g\+\+, c\+\+, clang\+\+ is on the path"):
            call()
    build.compiler.cache_clear()
    assert build.compiler() == ""
    build.compiler.cache_clear()
    own = tmp_path / "mine"
    own.write_text("#!/bin/sh\n")
    own.chmod(0o755)
    monkeypatch.setenv("CXX", str(own))
    assert compiler._compiler() == build._program() == str(own)


def test_a_command_says_what_it_wrote_and_why_it_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    python = sys.executable
    assert build._run([python, "-c", "print('fine')"]) == "fine\n"
    with pytest.raises(OSError, match=r"failed: why$"):
        build._run([python, "-c", "import sys; print('why', file=sys.stderr); sys.exit(1)"])
    with pytest.raises(OSError, match=r"failed: 3$"):
        build._run([python, "-c", "import sys; sys.exit(3)"])
    asked: list[Any] = []

    def slow(command: list[str], **options: Any) -> Any:
        asked.append(options.get("timeout"))
        raise subprocess.TimeoutExpired(command, 1.0)

    monkeypatch.setattr(build.subprocess, "run", slow)
    with pytest.raises(OSError, match="x took more than 120 s"):
        build._run(["x"])
    assert asked == [120]


def test_what_cannot_be_built_is_none_and_said_once_in_three_hundred_letters(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> Path:
        raise OSError("no\n  room " + "x" * 400)

    monkeypatch.setattr(build, "_said", set())
    monkeypatch.setattr(build, "_library", fail)
    for name in ("_one.cpp", "_one.cpp", "_two.cpp"):
        assert build.compiled.__wrapped__(Path(name)) is None
    told = "no room " + "x" * 292
    assert caplog.messages == [
        f"the {name} of a chase runs in plain torch, slower: nothing compiled ({told})"
        for name in ("one", "two")
    ]


def test_a_library_that_ends_otherwise_than_with_its_digest_is_not_whole(tmp_path: Path) -> None:
    path = tmp_path / "x.so"
    assert not build.is_whole(path)
    path.write_bytes(b"some code")
    build.seal(path)
    assert whole(path) == b"some code"
    os.utime(path, (1.0, 1.0))
    assert build.is_whole(path)
    assert path.stat().st_mtime > time.time() - 1000  # in use
    content = path.read_bytes()
    for damaged in (content[:-1], content[1:], content + b"x", b"", content[:-32]):
        path.write_bytes(damaged)
        assert not build.is_whole(path)
    build.used(tmp_path / "absent")  # nothing to note


def test_a_cache_that_cannot_be_written_is_replaced_until_the_end_of_the_process(
    cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pruned: list[Path] = []
    monkeypatch.setattr(build, "prune", pruned.append)
    assert build._cache() == build._cache() == cache
    assert cache.is_dir()
    assert pruned == [cache]  # once
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "me")
    assert build._cache() == tmp_path / "me" / ".cache" / "staf_torch"
    ended: list[Callable[..., Any]] = []
    monkeypatch.setattr(build.atexit, "register", lambda f, *a, **k: ended.append(lambda: f(*a, **k)))
    monkeypatch.setattr(build.os, "access", lambda *_: False)
    monkeypatch.setattr(build, "_temporary", {})  # not that of this process
    other = build._cache()
    assert build._cache() == other  # what one program left there another one finds
    assert other.name.startswith("staf_torch-")
    assert other.is_dir()
    (other / "file").write_text("x")
    (end,) = ended
    with monkeypatch.context() as fork:
        fork.setattr(build.os, "getpid", lambda: -1)
        end()
        assert other.exists()  # a fork leaves it to the process
    end()
    assert not other.exists()
    end()  # nor does it mind that somebody was first
    another = build._cache()  # nor are later programs lost
    assert another.is_dir()
    ended[-1]()


def test_a_cache_that_cannot_be_pruned_serves_all_the_same(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(folder: Path) -> None:
        raise OSError("no")

    monkeypatch.setattr(build, "prune", fail)
    assert build._cache() == cache


def test_the_cache_forgets_to_the_second_and_to_the_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, day = 1e9, 86_400

    def put(name: str, age: float, size: int = 10) -> None:
        (tmp_path / name).write_bytes(b"0" * size)
        os.utime(tmp_path / name, (now - age,) * 2)

    def left() -> list[str]:
        build.prune(tmp_path, now=now)
        return sorted(path.name for path in tmp_path.iterdir())

    (
        put("a.so", 60 * day),
        put("b.so", 60 * day + 1),
        put("tmp1", day),
        put("tmp2", day + 1),
        put("other", 99 * day),
    )
    assert left() == ["a.so", "other", "tmp1"]
    assert build._MOST_BYTES == 1024**3
    monkeypatch.setattr(build, "_MOST_BYTES", 30)
    put("a.so", 3 * day), put("trace-b", 2 * day), put("tmp1", 0.5 * day)
    assert left() == ["a.so", "other", "tmp1", "trace-b"]  # 30 bytes, that of another not counted
    put("c.so", 4 * day, 1)
    assert left() == ["a.so", "other", "tmp1", "trace-b"]  # the oldest goes, and that is enough
    put("c.so", 1.5 * day, 15)
    assert left() == ["c.so", "other", "tmp1"]
    folder = tmp_path / "tmpfolder"
    folder.mkdir()
    (folder / "file").write_text("x")
    os.utime(folder, (now - 2 * day,) * 2)
    assert left() == ["c.so", "other", "tmp1"]
    put("new.so", 0.0)
    build.prune(tmp_path)  # by the clock of the machine all of it is old
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other"]
