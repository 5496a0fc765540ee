"""The user's cache: the folder of libraries and traces, which is shared by processes and kept small.

Machine code is run from there, so that a folder or a file to which somebody else may write is not used. Files
are written under another name first, and what nobody has used for long is deleted. A library spares a process
one to thirty seconds, a trace .1 to .5.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import logging
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

_log = logging.getLogger(__name__)
LARGEST = 2**30
"""Bytes that the cache may hold: a trace is some 15 kilobytes, a library 30."""
_SCRATCH = tempfile.gettempprefix()  # of names under which a file is written at first
_DAY, _DIGEST = 86_400.0, 32
_LONGEST_UNUSED = 60 * _DAY
_temporary: dict[int, Path] = {}  # caches, by the process that made them


def cache() -> Path:
    """Return the folder to which libraries and traces are written: in `XDG_CACHE_HOME`, else in ``~/.cache``.

    Where nothing may be written there, or somebody else may write, a folder that goes with the process.
    """
    folder = _home()
    if folder is None or not os.access(folder, os.W_OK):
        return _cache_of_the_process()
    _pruned(folder)
    return folder


def found(pattern: str) -> Iterator[Path]:
    """Yield the files of a name, or a pattern of names, that may be read from the caches, in their order."""
    for folder in filter(None, (_home(), _temporary.get(os.getpid()))):
        for path in sorted(folder.glob(pattern)):
            if not _refused(path):
                yield path


def _home() -> Path | None:
    """Return the user's own cache, None where there is none, or somebody else may write to it."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    try:
        folder = Path(home if os.path.isabs(home) else Path.home() / ".cache") / "staf_torch"
        with contextlib.suppress(OSError):  # it may be there and not ours to write
            folder.mkdir(mode=_OURS, parents=True, exist_ok=True)
        return None if not folder.is_dir() or _refused(folder) else folder
    except (OSError, RuntimeError):  # a folder that may not be looked into, a user without a home
        return None


def _refused(path: Path) -> bool:
    """Return whether somebody but this user and root may have written a file or folder, and say so."""
    if not hasattr(os, "geteuid"):
        return False
    try:
        state = path.stat()
    except OSError:
        return True
    wrong = f"it belongs to user {state.st_uid}" if state.st_uid not in (os.geteuid(), 0) else ""
    if state.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        wrong = f"others than its owner may write to it (mode {stat.S_IMODE(state.st_mode):o})"
    if wrong and path not in _told:
        _told.add(path)
        told = "%s is not used, as machine code is run from there: %s. Remove it, or set XDG_CACHE_HOME"
        _log.warning(told, path, wrong)
    return bool(wrong)


_told: set[Path] = set()
_OURS = 0o755  # also where the user's umask lets a group write


@contextlib.contextmanager
def scratch(folder: Path) -> Iterator[Path]:
    """Context: a folder in a cache where a file is made; it is gone in the end, at the latest for `prune`."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        yield Path(place)


def publish(made: Path, path: Path) -> None:
    """Give a file its name in the cache, where nobody else may write to it."""
    made.chmod(_OURS & (made.stat().st_mode | stat.S_IWUSR))
    os.replace(made, path)


def keep(path: Path, content: bytes) -> None:
    """Write a file of the cache, which ends with its digest: under another name first, as another process may
    be writing the same."""
    with scratch(path.parent) as folder:
        (folder / path.name).write_bytes(content + hashlib.sha256(content).digest())
        publish(folder / path.name, path)


def kept(path: Path) -> bytes | None:
    """Return what `keep` has written, None of another or half a file; it counts as used now for `prune`."""
    try:
        content = path.read_bytes()
        with contextlib.suppress(OSError):  # it belongs to somebody else
            os.utime(path)
    except OSError:
        return None
    content, digest = content[:-_DIGEST], content[-_DIGEST:]
    return content if digest == hashlib.sha256(content).digest() else None


def prune(folder: Path, *, now: float | None = None, largest: int = LARGEST) -> None:
    """Delete files of the cache that nobody has used for long, and the oldest while there are too many bytes.

    What was used within a day stays in any case: another process may be about to load it, or is making it. A
    library that a process has loaded stays with that process. Other names are left alone.
    """
    now = time.time() if now is None else now
    found = list[tuple[float, int, Path]]()
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith((".so", ".cubin")) or entry.name.startswith(("trace-", _SCRATCH)):
                with contextlib.suppress(OSError):  # deleted by another process
                    state = entry.stat()
                    found.append((state.st_mtime, state.st_size, Path(entry.path)))
    held = sum(size for _, size, _ in found)
    for last_use, size, path in sorted(found):
        unused = now - last_use
        longest = _DAY if path.name.startswith(_SCRATCH) else _LONGEST_UNUSED  # left by what was killed
        if unused <= longest and (unused <= _DAY or held <= largest):
            continue
        held -= size
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


@functools.cache
def _pruned(folder: Path) -> None:
    """Prune a cache once in a process."""
    try:
        prune(folder)
    except OSError as error:
        _log.debug("the cache %s was not pruned: %s", folder, error)


def _cache_of_the_process() -> Path:
    """Return a folder for this process alone, which is removed with it."""
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
