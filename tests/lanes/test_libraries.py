"""C++ files of the package in the user's cache."""

from __future__ import annotations

import ctypes
import shutil
from pathlib import Path

import pytest
import torch

from staf_torch.lanes import Program, build, compiler


@pytest.mark.needs_compiler
@pytest.mark.parametrize("damage", ["half", "nothing left", "a byte changed", "no digest"])
def test_damaged_library_in_the_cache_is_built_anew(
    damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = tmp_path / "_seven.cpp"
    source.write_text('extern "C" int staf_seven() { return 7; }\n', encoding="utf-8")
    path = build._library(source, ())
    content = path.read_bytes()
    other = bytes([content[100] ^ 1])
    damaged = {
        "half": content[: len(content) // 2],
        "nothing left": b"",
        "a byte changed": content[:100] + other + content[101:],
        "no digest": content[:-32],
    }[damage]
    path.write_bytes(damaged)
    assert build._library(source, ()) == path
    assert path.read_bytes() == content
    assert ctypes.CDLL(str(path)).staf_seven() == 7


@pytest.mark.needs_compiler
def test_checkouts_of_one_version_share_what_is_built_and_others_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = build._program()
    assert program is not None
    for place in ("one", "two", "three"):
        (tmp_path / place).mkdir()
        (tmp_path / place / "_seven.cpp").write_text('#include "_number.hpp"\n')
        (tmp_path / place / "_number.hpp").write_text("9" if place == "three" else "7")
    one, two, three = (tmp_path / place / "_seven.cpp" for place in ("one", "two", "three"))
    key = build._key(program, one, ("N=3",))
    assert build._key(program, two, ("N=3",)) == key
    assert build._key(program, three, ("N=3",)) != key  # a header of it
    assert build._key(program, one, ("N=4",)) != key
    monkeypatch.setattr(build, "_FLAGS", (*build._FLAGS, "-O0"))
    assert build._key(program, one, ("N=3",)) != key


@pytest.mark.parametrize("name", ["g++", "clang++"])
def test_a_long_program_is_built_by_every_compiler(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Options that spare one compiler half of its time are errors to another."""
    if shutil.which(name) is None:
        pytest.skip(f"there is no {name} here")
    monkeypatch.setenv("CXX", name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    short = Program(lambda x, *_: (x + 1, x)).text(torch.zeros(1), steps=1)
    compiler.function(short + f"// {name}\n" * (compiler._LONG + 1))
    assert len(list((tmp_path / "staf_torch").glob("lanes-*.so"))) == 1
