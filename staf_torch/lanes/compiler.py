"""C++ of the package and of row programs, compiled where it is first used and kept in the user's cache."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import platform
import shlex
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

from .cache import cache, used
from .locks import Mutex

COMPILERS = ("g++", "c++", "clang++")
"""Names that are looked for where `CXX` names none."""


_log = logging.getLogger(__name__)
_FOLDER = Path(__file__).parent
_SHARED = ("-march=native", "-std=c++17", "-shared", "-fPIC")
# What -O3 adds to these takes a filter twice as long to build, and makes nothing faster.
_OF_FILES = ("-O2", "-fpeel-loops", *_SHARED, "-pthread")
_ROUNDED_AS_WRITTEN = ("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fno-signaling-nans")
_OF_PROGRAMS = ("-O2", *_SHARED, "-w", *_ROUNDED_AS_WRITTEN)
# A long program takes GCC half the time without what looks at all of its loops and branches together.
_LONG, _OF_LONG = 1500, ("-fira-region=one", "-fno-tree-pre", "-fno-gcse")  # lines
_SLOW = 6000  # lines from which a user hears of it: some seconds
_DIGEST = 32  # bytes at the end of a library in the cache
_one_at_a_time = Mutex()  # threads of a chase ask for the same at the same time
_said: set[str] = set()  # what has been logged
_programs: dict[str, Callable[..., None]] = {}  # by their text


@functools.cache
def compiled(source: Path, *definitions: str) -> Callable[..., None] | None:
    """Return the function ``staf_<name>`` of ``_<name>.cpp``; None, logged once, where none can be built.

    Args:
        source: the file, which finds the headers of its folder and of this one by their names.
        definitions: of the preprocessor, NAME=value: what is built is for these alone, and built in about
            a second.
    """
    name = source.stem.removeprefix("_")
    options = (*_OF_FILES, *(f"-D{each}" for each in definitions))
    try:
        text = source.read_text(encoding="utf-8")
        with _one_at_a_time:
            library = ctypes.CDLL(str(_library(name, text, options, source.parent)))
        call: Callable[..., None] = library[f"staf_{name}"]
        call.restype = None  # type: ignore[attr-defined]
    except Exception as error:  # whatever a machine lacks, the reference computes the same
        _say(name, " ".join(str(error).split())[:300])
        return None
    return call


def machine_code(text: str) -> Callable[..., None]:
    """Return the entry ``lanes_run`` of a program.

    Args:
        text: C++, of `cpp.emit`.

    Raises:
        OSError: if there is no compiler, or it refuses the text.
    """
    with _one_at_a_time:
        found = _programs.get(text)
        if found is None:
            found = ctypes.CDLL(str(_library("lanes", text, _OF_PROGRAMS, _FOLDER))).lanes_run
            found.restype = None
            found.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)
            _programs[text] = found
        return found


def _library(name: str, text: str, options: tuple[str, ...], folder: Path) -> Path:
    """Return the path of a shared object, built if it is not in the cache."""
    program = find_compiler()
    if program is None:
        raise FileNotFoundError(f"none of {', '.join(COMPILERS)} is on the path")
    lines, of_user = text.count("\n"), shlex.split(os.environ.get("CXXFLAGS", ""))
    # Clang, which also answers to the name of g++, knows none of these.
    if name == "lanes" and lines > _LONG and "clang" not in _version(program).lower():
        options = (*options, *_OF_LONG)
    command = [program, *options, *of_user, *(f"-I{each}" for each in dict.fromkeys((folder, _FOLDER)))]
    parts = (text, *options, *of_user, *_surroundings(program, folder))
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]
    path = cache() / f"{name}-{digest}.so"
    if not _is_whole(path):
        if lines > _SLOW:
            _log.warning("a program of %d lines is compiled, once: some %.0f s", lines, lines / 1600)
        # Under a name of its own first: another process may be building the same.
        with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
            source, built = Path(scratch) / f"{name}.cpp", Path(scratch) / path.name
            source.write_text(text, encoding="utf-8")
            _run([*command, str(source), "-o", str(built)])
            with built.open("ab") as file:  # a digest, which a loader of shared objects does not look at
                file.write(hashlib.sha256(built.read_bytes()).digest())
            os.replace(built, path)
    return path


def _is_whole(library: Path) -> bool:
    """Return whether a library is there and ends with its own digest: half of one would crash the process."""
    try:
        used(library)
        content = library.read_bytes()
    except OSError:
        return False
    return content[-_DIGEST:] == hashlib.sha256(content[:-_DIGEST]).digest()


@functools.cache
def _surroundings(program: str, folder: Path) -> tuple[str, ...]:
    """Return what machine code depends on beside text and options: headers, the compiler, the processor.

    Not where the sources lie: two checkouts of one version share what is built.
    """
    headers = {file.name: file for each in (_FOLDER, folder) for file in each.glob("_*.hpp")}
    texts = (headers[name].read_text(encoding="utf-8") for name in sorted(headers))
    return *texts, _version(program), platform.platform(), _processor()


def _processor() -> str:
    """Return what tells processors apart: -march=native follows them, and a home directory may be shared."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor()
    return "\n".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))


def find_compiler() -> str | None:
    """Return the path of the C++ compiler: `CXX`, or the first of `COMPILERS`; None where there is none."""
    return next(filter(None, map(shutil.which, (os.environ.get("CXX", ""), *COMPILERS))), None)


@functools.cache
def compiler() -> str:
    """Return the first line of what the compiler says of its version; empty where there is none."""
    program = find_compiler()
    return "" if program is None else _version(program).partition("\n")[0]


@functools.cache
def _version(program: str) -> str:
    return _run([program, "--version"])


def _run(command: list[str]) -> str:
    seconds = float(os.environ.get("STAF_COMPILE_SECONDS", "120"))
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, process_group=0) as process:
        try:
            out, err = process.communicate(timeout=seconds)
        except BaseException as error:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.killpg(
                    process.pid, signal.SIGKILL
                )  # with what the driver has started, which works on else
            if isinstance(error, subprocess.TimeoutExpired):
                raise OSError(f"{command[0]} took more than {seconds:g} s (STAF_COMPILE_SECONDS)") from error
            raise
    if process.returncode != 0:
        raise OSError(f"{command[0]} failed: {err.strip() or process.returncode}")
    return out


def _say(name: str, reason: str) -> None:
    with _one_at_a_time:
        first = name not in _said
        _said.add(name)
    if first:
        _log.warning("the %s of a chase runs in plain torch, slower: nothing compiled (%s)", name, reason)
