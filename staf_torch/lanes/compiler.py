"""C++ text to a function that can be called, kept in the user's cache."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import os
import shutil
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

from .build import _COMPILERS, _cache, _processor, _run, flags, is_whole, seal

_FOLDER = Path(__file__).parent
_HEADERS = ("_lanes.hpp", "_lanes_functions.hpp", "_driver.hpp")
_FLAGS: tuple[str, ...] = ("-O2", "-march=native", "-std=c++17", "-shared", "-fPIC", "-w")
_FLAGS += ("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fno-signaling-nans")
# A long program takes GCC half the time without what looks at all of its loops and branches together.
_LONG, _FLAGS_OF_LONG = 1500, ("-fira-region=one", "-fno-tree-pre", "-fno-gcse")  # lines
_SLOW = 6000  # lines from which a user hears of it: some seconds
_log = logging.getLogger(__name__)
_one_at_a_time = threading.Lock()
_loaded: dict[str, Callable[..., None]] = {}


def function(source: str) -> Callable[..., None]:
    """The entry ``lanes_run`` of a program.

    Args:
        source: of `emission.emit`.

    Raises:
        OSError: if there is no compiler, or it refuses the text.
    """
    with _one_at_a_time:
        found = _loaded.get(source)
        if found is None:
            found = _loaded[source] = _open(source)
        return found


def _open(source: str) -> Callable[..., None]:
    path = _cache() / f"lanes-{_key(source)}.so"
    if not is_whole(path):
        _build(source, path)
    call: Callable[..., None] = ctypes.CDLL(str(path)).lanes_run
    call.restype = None  # type: ignore[attr-defined]
    call.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)  # type: ignore[attr-defined]
    return call


def _build(source: str, path: Path) -> None:
    # Under a name of its own first: another process may be building the same.
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        text, built = Path(scratch) / "program.cpp", Path(scratch) / path.name
        text.write_text(source, encoding="utf-8")
        compiler = _compiler()
        # Clang, which also answers to the name of g++, knows none of these.
        lines = source.count("\n")
        if lines > _SLOW:
            _log.warning("a program of %d lines is compiled, once: some %.0f s", lines, lines / 1600)
        long = lines > _LONG and "clang" not in _version(compiler).lower()
        more = _FLAGS_OF_LONG if long else ()
        _run([compiler, *flags(_FLAGS), *more, "-I", str(_FOLDER), str(text), "-o", str(built)])
        seal(built)
        os.replace(built, path)


def _compiler() -> str:
    compiler = next(filter(None, map(shutil.which, (os.environ.get("CXX", ""), *_COMPILERS))), None)
    if compiler is None:
        raise FileNotFoundError(f"none of {', '.join(_COMPILERS)} is on the path")
    return compiler


def _key(source: str) -> str:
    return hashlib.sha256("\0".join((source, *flags(()), *_surroundings(_compiler()))).encode()).hexdigest()[
        :24
    ]


@functools.cache
def _surroundings(compiler: str) -> tuple[str, ...]:
    """What the machine code depends on beside the text."""
    headers = (_FOLDER.joinpath(name).read_text(encoding="utf-8") for name in _HEADERS)
    return (*headers, *_FLAGS, *_FLAGS_OF_LONG, _version(compiler), _processor())


@functools.cache
def _version(compiler: str) -> str:
    return _run([compiler, "--version"])
