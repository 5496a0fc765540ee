"""C++ of the package, compiled where it is first used and kept in the user's cache."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

_log = logging.getLogger(__name__)
_FOLDER = Path(__file__).parent
# What -O3 adds to these takes a filter twice as long to build, and makes nothing faster.
_FLAGS = ("-O2", "-fpeel-loops", "-march=native", "-std=c++17", "-shared", "-fPIC", "-pthread")
_COMPILERS = ("g++", "c++", "clang++")
_SECONDS = 120
_SCRATCH = tempfile.gettempprefix()  # of names under which a file is written at first
_DAY = 86_400.0
_LONGEST_UNUSED = 60 * _DAY
_MOST_BYTES = 2**30  # a trace is some 15 kilobytes, a library 30
_DIGEST = 32  # bytes at the end of a library in the cache
_one_at_a_time = threading.Lock()  # threads of a chase ask for the same at the same time
_said: set[str] = set()  # what has been logged
_temporary: dict[int, Path] = {}  # caches, by the process that made them


@functools.cache
def compiled(source: Path, *definitions: str) -> Callable[..., None] | None:
    """Return the function ``staf_<name>`` of ``_<name>.cpp``; None, logged once, where none can be built.

    Args:
        source: the file, which finds the headers of this folder by their names.
        definitions: of the preprocessor, NAME=value: what is built is for these alone, and built in about
            a second.
    """
    name = source.stem.removeprefix("_")
    try:
        with _one_at_a_time:
            library = ctypes.CDLL(str(_library(source, definitions)))
        call: Callable[..., None] = library[f"staf_{name}"]
        call.restype = None  # type: ignore[attr-defined]
    except Exception as error:  # whatever a machine lacks, the reference computes the same
        _say(name, " ".join(str(error).split())[:300])
        return None
    return call


def _say(name: str, reason: str) -> None:
    with _one_at_a_time:
        first = name not in _said
        _said.add(name)
    if first:
        _log.warning("the %s of a chase runs in plain torch, slower: nothing compiled (%s)", name, reason)


def used(path: Path) -> None:
    """Note that a file of the cache is in use now, which `prune` goes by."""
    with contextlib.suppress(OSError):  # there is none, or it belongs to somebody else
        os.utime(path)


def prune(folder: Path, *, now: float | None = None) -> None:
    """Delete files of the cache that nobody has used for long, and the oldest while there are too many bytes.

    What was used within a day stays in any case: another process may be about to load it. A library that a
    process has loaded stays with that process. Names that this library did not give are left alone.

    Args:
        folder: of the cache.
        now: in seconds; the present by default.
    """
    now = time.time() if now is None else now
    found = list[tuple[float, int, Path]]()
    for path in folder.iterdir():
        with contextlib.suppress(OSError):  # deleted by another process
            state = path.stat()
            if path.suffix == ".so" or path.name.startswith(("trace-", _SCRATCH)):
                found.append((state.st_mtime, state.st_size, path))
    kept = sum(size for _, size, _ in found)
    for last_use, size, path in sorted(found):
        unused, left_over = now - last_use, path.name.startswith(_SCRATCH)  # by a process that was killed
        if unused > _LONGEST_UNUSED or (unused > _DAY and (left_over or kept > _MOST_BYTES)):
            kept -= size
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


@functools.cache
def compiler() -> str:
    """Return the first line of what the compiler says of its version; empty where there is none."""
    program = _program()
    return "" if program is None else _run([program, "--version"]).partition("\n")[0]


def _program() -> str | None:
    return next(filter(None, map(shutil.which, (os.environ.get("CXX", ""), *_COMPILERS))), None)


def flags(ours: tuple[str, ...]) -> tuple[str, ...]:
    """Return the compiler's options: ours, then the user's `CXXFLAGS`, of which the last one holds."""
    return (*ours, *shlex.split(os.environ.get("CXXFLAGS", "")))


def _library(source: Path, definitions: tuple[str, ...]) -> Path:
    """The path of the shared object, built if it is not in the cache."""
    program = _program()
    if program is None:
        raise FileNotFoundError(f"none of {', '.join(_COMPILERS)} is on the path")
    command = [program, *flags(_FLAGS), f"-I{_FOLDER}", *(f"-D{each}" for each in definitions), str(source)]
    path = _cache() / f"{source.stem.removeprefix('_')}-{_key(program, source, definitions)}.so"
    if not is_whole(path):
        # Under a name of its own first: another process may be building the same.
        with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
            built = Path(scratch) / path.name
            _run([*command, "-o", str(built)])
            seal(built)
            os.replace(built, path)
    return path


def seal(library: Path) -> None:
    """Append the digest of a library that was built, which a loader of shared objects does not look at."""
    with library.open("ab") as file:
        file.write(hashlib.sha256(library.read_bytes()).digest())


def is_whole(library: Path) -> bool:
    """Whether a library is there and ends with its own digest: half of one would crash the process."""
    try:
        used(library)
        content = library.read_bytes()
    except OSError:
        return False
    return content[-_DIGEST:] == hashlib.sha256(content[:-_DIGEST]).digest()


def _key(program: str, source: Path, definitions: tuple[str, ...]) -> str:
    """What the machine code depends on: sources, flags, definitions, the compiler and the processor.

    Not where the sources lie: two checkouts of one version share what is built.
    """
    version = _run([program, "--version"])
    files = sorted(
        {source, *source.parent.glob("_*.hpp"), *_FOLDER.glob("_*.hpp")}, key=lambda file: file.name
    )
    sources = [file.read_text(encoding="utf-8") for file in files]
    parts = (*sources, *flags(_FLAGS), *definitions, version, platform.platform(), _processor())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def _processor() -> str:
    """-march=native follows the processor: a home directory may be shared between several."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor()
    return "\n".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))


def _cache() -> Path:
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    folder = Path(home) / "staf_torch"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            _pruned(folder)
            return folder
    except OSError:
        pass
    return _cache_of_the_process()


def _cache_of_the_process() -> Path:
    """Where nothing may be written at home: one folder, which goes with the process."""
    process = os.getpid()
    folder = _temporary.get(process)
    if folder is None or not folder.is_dir():  # somebody may have tidied up
        folder = _temporary[process] = Path(tempfile.mkdtemp(prefix="staf_torch-"))
        atexit.register(_remove, folder, process)
    return folder


def _remove(folder: Path, process: int) -> None:
    """Remove a folder where its process ends; a fork of it ends by itself."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)


@functools.cache
def _pruned(folder: Path) -> None:
    """Prune a cache once in a process."""
    try:
        prune(folder)
    except OSError as error:
        _log.debug("the cache %s was not pruned: %s", folder, error)


def _run(command: list[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS, check=False)
    except subprocess.TimeoutExpired as error:
        raise OSError(f"{command[0]} took more than {_SECONDS} s") from error
    if done.returncode != 0:
        raise OSError(f"{command[0]} failed: {done.stderr.strip() or done.returncode}")
    return done.stdout
