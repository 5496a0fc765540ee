"""C++ of the package and of row programs, compiled where it is first used and kept in the user's cache."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import logging
import math
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

from ...signs import Sign
from ..threads import Mutex
from .cache import cache, found, keep, kept, scratch

COMPILERS = ("g++", "c++", "clang++")
"""Names that are looked for where `CXX` names none."""

REVERSED = "// Reversed"
"""First line of the adjoint of a step, number by number."""

_log = logging.getLogger(__name__)
_FOLDER = Path(__file__).parent
_SHARED = ("-march=native", "-std=c++17", "-shared", "-fPIC")
# What -O3 adds to these takes a filter twice as long to build, and makes nothing faster.
_OF_FILES = ("-O2", "-fpeel-loops", *_SHARED, "-pthread")
_ROUNDED_AS_WRITTEN = ("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fno-signaling-nans")
_OF_PROGRAMS = ("-O2", *_SHARED, "-w", *_ROUNDED_AS_WRITTEN)
# A long program takes GCC half the time without what looks at all of its loops and branches together.
_LONG, _OF_LONG = 1500, ("-fira-region=one", "-fno-tree-pre", "-fno-gcse")  # lines
# A reversed step has most numbers alive at once: in another order they fit the registers, a tenth faster.
_OF_REVERSED = ("-fschedule-insns", "-fsched-pressure")
_SLOW = 6000  # lines from which a build may take its whole time
_one_at_a_time = Mutex()  # threads of a chase ask for the same at the same time
_said: set[str] = set()  # what has been logged
_programs: dict[str, Callable[..., None]] = {}  # by their text


@functools.cache
def compiled(source: Path, *definitions: str) -> Callable[..., None] | None:
    """Return the function ``staf_<name>`` of ``_<name>.cpp``; None, logged once, where none can be built.

    It finds headers of its folder and of this one by their names. What is built for ``definitions`` of the
    preprocessor, NAME=value, is for these alone.
    """
    name = source.stem.removeprefix("_")
    options = (*_OF_FILES, *(f"-D{each}" for each in definitions))
    try:
        text = source.read_text(encoding="utf-8")
        with _one_at_a_time:
            built = ctypes.CDLL(str(library(name, text, options, source.parent)))
        call: Callable[..., None] = built[f"staf_{name}"]
        call.restype = None  # type: ignore[attr-defined]
    except Exception as error:  # whatever a machine lacks, the reference computes the same
        _say(name, " ".join(str(error).split())[:300])
        return None
    return call


def machine_code(text: str) -> Callable[..., None]:
    """Return the entry ``lanes_run`` of a program's C++, of `cpp.emit`.

    Raises:
        OSError: if there is no compiler, or it refuses the text.
    """
    with _one_at_a_time:
        found = _programs.get(text)
        if found is None:
            found = ctypes.CDLL(str(library("lanes", text, _OF_PROGRAMS, _FOLDER))).lanes_run
            found.restype = None
            found.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)
            _programs[text] = found
        return found


def library(name: str, text: str, options: tuple[str, ...], folder: Path) -> Path:
    """Return the path of a shared object, built if it is not in the cache.

    Args:
        name: with which that of the file begins.
        text: C++.
        options: of the compiler.
        folder: where headers are looked for, beside that of this file.

    Its name says what it is made of, and then by which compiler. Where there is no compiler, the machine code
    of any other serves, as in a container to which a cache was copied.
    """
    parts = (text, *options, *_surroundings(folder))
    made_of = f"{name}-{_digest(*parts)[:24]}"
    program = find_compiler()
    if program is None:
        for path in found(f"{made_of}-*.so"):
            if kept(path) is not None:
                return path
        raise FileNotFoundError(
            f"none of {', '.join(COMPILERS)} is on the path, and the cache has no compiled program"
        )
    lines, of_user = text.count("\n"), shlex.split(os.environ.get("CXXFLAGS", ""))
    # Clang, which also answers to the name of g++, knows none of these.
    if name == "lanes" and "clang" not in _version(program).lower():
        more = (_OF_LONG, lines > _LONG), (_OF_REVERSED, text.startswith(REVERSED))
        options = (*options, *(option for some, holds in more if holds for option in some))
    command = [program, *options, *of_user, *(f"-I{each}" for each in dict.fromkeys((folder, _FOLDER)))]
    file = f"{made_of}-{_digest(*options, *of_user, _version(program))[:8]}.so"
    for path in found(file):
        if kept(path) is not None:  # half of one would crash the process
            return path
    templates = name != "lanes" and '#include "' in text  # of a file, in its headers
    takes = 10 if templates else 1 + lines / 1600
    sign = Sign(f"compiling {lines} lines, once: some {takes:.0f} s of a processor")
    path = cache() / file
    with sign, scratch(path.parent) as place:
        source, built = place / f"{name}.cpp", place / path.name
        source.write_text(text, encoding="utf-8")
        run([*command, str(source), "-o", str(built)], short=lines < _SLOW)
        keep(path, built.read_bytes())  # with a digest, which a loader of shared objects does not look at
    return path


def _digest(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


@functools.cache
def _surroundings(folder: Path) -> tuple[str, ...]:
    """Return what machine code depends on beside text and options: headers, the C library, the processor.

    Not where the sources lie: two checkouts of one version share what is built. Nor the system's kernel: a
    container meets many.
    """
    headers = {file.name: file for each in (_FOLDER, folder) for file in each.glob("_*.hpp")}
    texts = (headers[name].read_text(encoding="utf-8") for name in sorted(headers))
    return *texts, platform.system(), platform.machine(), *platform.libc_ver(), _processor()


_VECTORS = re.compile(
    r"\b(?:avx|ss?se|fma|f16c|bmi|abm|popcnt|movbe|aes|vaes|p?clmul|vpclmul|gfni|sha|adx|amx)\w*"
)
"""Of an x86's flags those by which code is chosen: the others also change with the system's kernel."""


def _processor() -> str:
    """Return what tells processors apart: -march=native follows them, and a home directory may be shared."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor()
    told = {line for line in lines if line.startswith(("model name", "Features"))}
    told |= {" ".join(sorted(set(_VECTORS.findall(line)))) for line in lines if line.startswith("flags")}
    return "\n".join(sorted(told))


def find_compiler() -> str | None:
    """Return the path of the C++ compiler: `CXX`, or the first of `COMPILERS`; None where there is none."""
    return next(filter(None, map(shutil.which, (os.environ.get("CXX", ""), *COMPILERS))), None)


@functools.cache
def compiler() -> str:
    """Return the first line of what the compiler says of its version; empty where none answers."""
    program = find_compiler()
    try:
        return "" if program is None else _version(program).partition("\n")[0]
    except OSError:
        return ""


@functools.cache
def _version(program: str) -> str:
    return run([program, "--version"])


def seconds() -> float:
    """Return what a build may take, `STAF_COMPILE_SECONDS`, 120 by default.

    Raises:
        OSError: if that is no positive number.
    """
    given = os.environ.get("STAF_COMPILE_SECONDS", "120")
    try:
        found = float(given)
    except ValueError:
        found = math.nan
    if not 0 < found < math.inf:
        raise OSError(f"`STAF_COMPILE_SECONDS` must be a positive number; got {given!r}")
    return found


def run(command: list[str], *, short: bool = True, folder: Path | None = None) -> str:
    """Return what a compiler prints.

    A ``short`` one takes seconds at most; if it does not end, this process does not call it again. It raises
    OSError if it fails or does not end in time.
    """
    if command[0] in _hanging:
        raise OSError(f"{command[0]} did not end before")
    limit, pipe = seconds(), subprocess.PIPE
    with subprocess.Popen(
        command, stdout=pipe, stderr=pipe, text=True, process_group=0, cwd=folder
    ) as process:
        try:
            out, err = process.communicate(timeout=limit)
        except BaseException as error:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.killpg(
                    process.pid, signal.SIGKILL
                )  # with what the driver has started, which works on else
            if isinstance(error, subprocess.TimeoutExpired):
                _hanging.update([command[0]] if short else ())
                raise OSError(f"{command[0]} took more than {limit:g} s (STAF_COMPILE_SECONDS)") from error
            raise
    if process.returncode != 0:
        raise OSError(f"{command[0]} failed: {err.strip() or process.returncode}")
    return out


_hanging: set[str] = set()


def _say(name: str, reason: str) -> None:
    with _one_at_a_time:
        first = name not in _said
        _said.add(name)
    if first:
        _log.warning("%s was not compiled; plain torch or one thread runs instead, slower (%s)", name, reason)
