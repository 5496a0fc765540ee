"""`_recursion.cpp`, compiled where it is first used and kept in the user's cache."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

_log = logging.getLogger(__name__)
_SOURCE = Path(__file__).with_name("_recursion.cpp")
_FLAGS = ("-O3", "-march=native", "-std=c++17", "-shared", "-fPIC", "-pthread")
_COMPILERS = ("g++", "c++", "clang++")
_SECONDS = 120


@functools.cache
def compiled(real: str) -> Callable[[object], None] | None:
    """The recursion in the C type ``real``; None where it cannot be built, said once in the log."""
    try:
        library = ctypes.CDLL(str(_library(real)))
    except (OSError, subprocess.SubprocessError) as error:
        _say_once(" ".join(str(error).split())[:200])
        return None
    function = library.staf_recursion
    function.restype = None
    call: Callable[[object], None] = function
    return call


@functools.cache
def _say_once(reason: str) -> None:
    _log.warning("the weight recursion runs in plain torch, slower: no compiled one (%s)", reason)


def _library(real: str) -> Path:
    """The path of the shared object, built if it is not in the cache."""
    compiler = next(filter(None, map(shutil.which, (os.environ.get("CXX", ""), *_COMPILERS))), None)
    if compiler is None:
        raise FileNotFoundError(f"none of {', '.join(_COMPILERS)} is on the path")
    command = [compiler, *_FLAGS, f"-DREAL={real}", str(_SOURCE)]
    path = _cache() / f"recursion-{real}-{_key(command)}.so"
    if not path.exists():
        # Under a name of its own first: another process may be building the same.
        with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
            built = Path(scratch) / path.name
            _run([*command, "-o", str(built)])
            os.replace(built, path)
    return path


def _key(command: list[str]) -> str:
    """What the machine code depends on: the source, the command, the compiler and the processor."""
    version = _run([command[0], "--version"])
    sources = (_SOURCE.read_text(), _SOURCE.with_name("_block.hpp").read_text())
    parts = (*sources, *command, version, platform.platform(), _processor())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def _processor() -> str:
    """-march=native follows the processor: a home directory may be shared between several."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return "\n".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))


def _cache() -> Path:
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    folder = Path(home) / "staf_torch"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="staf_torch-"))


def _run(command: list[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS, check=False)
    if done.returncode != 0:
        raise OSError(f"{command[0]} failed: {done.stderr.strip() or done.returncode}")
    return done.stdout
