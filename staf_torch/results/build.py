"""The origin of a run's numbers: settings, source, the user's own modules, torch and the compiler.

Two runs of one sweep may stand in one table only where these agree. Nothing here imports torch, and no module
is imported to be looked at.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import importlib.metadata
import json
import os
import platform
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from .._version import __version__
from .files import RUN, UnreadableError, all_visible, open_regular

_PACKAGE = Path(__file__).resolve().parent.parent
_MOST_MODULES = 200
_ABSENT = "nothing"


def digest(path: Path, recorded: str | None = None) -> str:
    """Return the checksum of a regular file of any size: its SHA-256, or `archive_digest` of an `.npz`.

    One that it had (``recorded``) is compared as that was made, with all contents read. Raises
    UnreadableError if there is no such file.
    """
    with open_regular(path) as file:
        marked = path.suffix == ".npz" if recorded is None else recorded.startswith(MARK)
        found = archive_digest(file, thorough=recorded is not None) if marked else None
        if found is not None:
            return found
        file.seek(0)
        return hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]


@functools.cache
def installed(package: str) -> str | None:
    """Return the version of a package; None where it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


@functools.cache
def source() -> str:
    """Return a hash of the package's own files, installed or in a checkout: 12 hexadecimal digits."""
    found = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*")):
        if "plugins" in path.relative_to(_PACKAGE).parts:  # a wheel has them elsewhere
            continue
        if path.suffix in (".py", ".hpp", ".cpp", ".html") and path.is_file():
            found.update(f"{path.relative_to(_PACKAGE)} {path.stat().st_size}\0".encode())
            found.update(path.read_bytes())
    return found.hexdigest()[:12]


def build(settings: Mapping[str, Any], compiler: str) -> dict[str, Any]:
    """Return what a run is made by, besides its settings (by dotted keys), as `run.json` has it; the compiler
    in its own words."""
    return {
        "version": __version__,
        "source": source(),
        "torch": installed("torch") or "of unknown version",
        "compiler": compiler,
        "modules": modules(settings),
    }


@functools.cache
def machine() -> str:
    """Return a machine in a few words: `AMD EPYC 9V84, 2 CPUs, Linux`."""
    return f"{processor()}, {os.cpu_count()} CPUs, {platform.system()}"


def processor() -> str:
    """Return the name of the processor."""
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as lines:
        for line in lines:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def modules(settings: Mapping[str, Any]) -> dict[str, str]:
    """Return a hash of every module of the user's own that settings name, and of those that it imports."""
    found: dict[str, str] = {}
    for path in _named(settings):
        _collect_first(path.rpartition(".")[0], tuple(sys.path), found)
    return dict(sorted(found.items()))


def imported(own: Mapping[str, str]) -> dict[str, str]:
    """Return a hash of every further module of this process that lies where the user's own modules lie, as
    `modules` found them.

    Among them are those that the user's code imports by names that it makes, which nobody finds by reading.
    """
    places = (_place(name, tuple(sys.path)) for name in own)
    bases = tuple(f"{base}{os.sep}" for _, base in filter(None, places) if not _installed(base))
    standard = os.path.dirname(os.__file__)  # may lie below a working directory
    found: dict[str, str | None] = {}
    for name, module in sorted(sys.modules.items()) if bases else ():
        file = getattr(module, "__dict__", {}).get("__file__")
        if name in own or name.partition(".")[0] in (_PACKAGE.name, "__main__") or not isinstance(file, str):
            continue
        if file.startswith(bases) and not file.startswith(standard):
            found[name] = None if any(map(_installed, Path(file).parents)) else _hash(name)
    return {name: known for name, known in found.items() if known is not None}


def _installed(folder: Path) -> bool:
    return folder.name in ("site-packages", "dist-packages")


def _hash(name: str) -> str | None:
    """The hash of a module's file as it is now, None: there is none."""
    place = _place(name, tuple(sys.path))
    if place is None or not place[0].is_file():
        return None
    stamp = place[0].stat()
    return _module(place[0], stamp.st_mtime_ns, stamp.st_size)[0]


def differences(
    then: Mapping[str, Any], now: Mapping[str, Any], free: Callable[[str], bool] = lambda key: False
) -> Iterator[str]:
    """Yield one phrase for each setting, unless it is ``free`` to differ, or other entry of a record
    (`settings` and `build`, where it has them) that is not what it was."""
    was, will = _plain(then.get("settings")), _plain(now.get("settings"))
    for key in sorted({*was, *will}) if was else ():
        before, after = was.get(key, _ABSENT), will.get(key, _ABSENT)
        if before != after and not free(key):
            yield f"{key} was {_shown(before)} and is now {_shown(after)}"
    was, will = _plain(then.get("build")), _plain(now.get("build"))
    for key in ("source", "torch", "compiler") if was else ():
        if was.get(key) != will.get(key):
            what = "the source of staf_torch" if key == "source" else key
            yield f"{what} was {_shown(was.get(key))} and is now {_shown(will.get(key))}"
    others = _plain(was.get("imported"))
    was, will = _plain(was.get("modules")), _plain(will.get("modules"))
    changed = [name for name in sorted({*was, *will}) if was.get(name) != will.get(name)]
    changed += [name for name in sorted({*others} - {*was, *will}) if others[name] != _hash(name)]
    yield from (f"the module {name} has changed" for name in changed)


def short(build: Mapping[str, Any]) -> str:
    """Return a build without the user's modules: `0.2.0 source 3f2a91b0c4d5 torch 2.13.0 compiler 4a5b6c`."""
    text = f"{build.get('version')} source {build.get('source')} torch {build.get('torch')}"
    return f"{text} compiler {shortened(build.get('compiler'))}"


def shortened(value: Any) -> str:
    """Return the first six digits of the hash of a value as JSON has it."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:6]


def _plain(value: Any) -> dict[str, Any]:
    """Return a value as a JSON file has it."""
    return json.loads(json.dumps(value)) if isinstance(value, dict) else {}


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _named(settings: Mapping[str, Any]) -> Iterator[str]:
    """The dotted paths outside the package that settings name."""
    for key, value in settings.items():
        group, _, last = key.rpartition(".")
        if last not in ("_target_", "path", "task"):
            continue
        target = str(settings.get(f"{group}._target_"))
        ours = f"{_PACKAGE.name}."
        loads = target.startswith(ours) and target.rpartition(".")[2].islower()  # a function of ours
        names = last == "_target_" or key == "task" or (last == "path" and loads)
        if names and isinstance(value, str) and "." in value and not value.startswith(ours):
            yield value


def _place(name: str, path: tuple[str, ...]) -> tuple[Path, Path] | None:
    """The file of a module, and the entry of Python's path that leads there."""
    return _locate(name, path, os.getcwd())


@functools.lru_cache(1000)
def _locate(name: str, path: tuple[str, ...], here: str) -> tuple[Path, Path] | None:
    for entry in path:
        base = Path(here, entry)
        stem = base.joinpath(*name.split("."))
        for file in (stem.with_suffix(".py"), stem / "__init__.py"):
            if file.is_file():
                return file, base
    return None


def _collect(name: str, file: Path, base: Path, found: dict[str, str]) -> None:
    """Add a module, and what it imports from the same folder; of an installed one, from its package."""
    if name in found or len(found) >= _MOST_MODULES:
        return
    stamp = file.stat()
    found[name], imported = _module(file, stamp.st_mtime_ns, stamp.st_size)
    installed = _installed(base)
    for other in imported:
        absolute = _absolute(name, other, file.name == "__init__.py")
        if not installed or absolute.partition(".")[0] == name.partition(".")[0]:
            _collect_first(absolute, (str(base),), found)


def _collect_first(name: str, path: tuple[str, ...], found: dict[str, str]) -> None:
    """Add the module of a dotted name: the longest beginning of the name that has a file."""
    while name:
        place = _place(name, path)
        if place is not None:
            _collect(name, *place, found)
            return
        name = name.rpartition(".")[0]


def _absolute(name: str, other: str, package: bool) -> str:
    """`..b.c` as it is meant in the module ``name``."""
    level = len(other) - len(other.lstrip("."))
    if not level:
        return other
    parts = name.split(".")
    kept = parts[: len(parts) - level + package]
    return ".".join([*kept, *filter(None, [other[level:]])])


@functools.lru_cache(1000)
def _module(file: Path, modified: int, size: int) -> tuple[str, tuple[str, ...]]:
    """The hash of a file of that time and size, and the names in its imports."""
    content = file.read_bytes()
    names: list[str] = []
    try:
        for node in ast.walk(ast.parse(content)):
            if isinstance(node, ast.Import):
                names += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                stem = "." * node.level + (node.module or "")
                dot = "" if stem.endswith(".") or not stem else "."
                names += [f"{stem}{dot}{alias.name}" for alias in node.names]
    except (SyntaxError, ValueError, RecursionError):
        pass
    return hashlib.sha256(content).hexdigest()[:12], tuple(names)


def record_checksum(record: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a record without its own checksum."""
    rest = {key: value for key, value in record.items() if key != "checksum"}
    return hashlib.sha256(json.dumps(all_visible(rest), sort_keys=True).encode()).hexdigest()


def damaged(directory: Path, record: Mapping[str, Any], *, thorough: bool) -> str | None:
    """Return what is wrong with a run's record or files, None: nothing; ``thorough`` as of `damage`."""
    if "checksum" in record and record["checksum"] != record_checksum(record):
        return f"{RUN} is damaged: its checksum does not match"
    files = record.get("files")
    return damage(directory, files, thorough=thorough) if isinstance(files, dict) else None


def damage(directory: Path, recorded: Mapping[str, Any], *, thorough: bool) -> str | None:
    """Return what is wrong with the files of a run, name to size and checksum; None: they are as they were
    written.

    Unless ``thorough`` they are not read: their sizes are looked at, and whether they are there only where
    they hold numbers.
    """
    for name, about in recorded.items():
        if not (isinstance(about, list) and len(about) == 2) or Path(name).is_absolute() or ".." in name:
            return f"{name} has no checksum"
        path = directory / name
        try:
            size = path.lstat().st_size
            if size != about[0]:
                return f"{name} is damaged: it has {size} bytes in place of {about[0]}"
            if thorough and digest(path, str(about[1])) != about[1]:
                return f"{name} is damaged: its checksum does not match"
        except UnreadableError as error:
            return str(error)
        except OSError:
            if thorough and path.suffix in (".json", ".npz", ".csv"):
                return f"{name} is missing"
    return None


def checksums(
    directory: Path, but: frozenset[str] = frozenset(), patterns: Sequence[str] = ("**/*",)
) -> dict[str, list[Any]]:
    """Return size and checksum of every result file in and under a run directory, by their names there."""
    found: dict[str, list[Any]] = {}
    for path in sorted(path for pattern in patterns for path in directory.glob(pattern)):
        name = path.relative_to(directory).as_posix()
        if path.is_symlink() or not path.is_file() or path.name in but or path.suffix == ".log":
            continue
        if not any(part.startswith(".") for part in Path(name).parts):
            found[name] = [path.stat().st_size, digest(path)]
    return found


MARK = "crc32+sha256:"
"""What such a checksum begins with."""
_PIECE = 2**22  # bytes that are read at once
_HEADER = 30  # bytes of a local header in front of its two texts, whose lengths stand at its end


def archive_digest(file: BinaryIO, *, thorough: bool) -> str | None:
    """Return the checksum of an archive whose members are stored as they are; None of any other file.

    A zip archive, and so an `.npz`, keeps the CRC-32 of every member, found while it was written. The
    checksum is the SHA-256 of all that is not content: names, sizes, places and those CRCs; no content is
    read to find it. If ``thorough`` the contents are read, too, and None is returned where one has not its
    CRC.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            members = sorted(archive.infolist(), key=lambda member: member.header_offset)
    except Exception:  # zipfile raises a dozen kinds over damaged bytes
        return None
    found, place = hashlib.sha256(), 0
    for member in members:
        stored = member.compress_type == zipfile.ZIP_STORED and member.compress_size == member.file_size
        if not stored or member.header_offset < place:
            return None
        file.seek(member.header_offset)
        header = file.read(_HEADER)
        if len(header) < _HEADER:
            return None
        lengths = int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:30], "little")
        begin = member.header_offset + _HEADER + lengths
        for piece in _read(file, place, begin):
            found.update(piece)
        place = begin + member.file_size
        if thorough:
            crc = 0
            for piece in _read(file, begin, place):
                crc = zlib.crc32(piece, crc)
            if crc != member.CRC:
                return None
    for piece in _read(file, place, file.seek(0, 2)):
        found.update(piece)
    return f"{MARK}{found.hexdigest()}"


def _read(file: BinaryIO, begin: int, end: int) -> Iterator[bytes]:
    """Yield the bytes of a file between two places, as far as it has them."""
    file.seek(begin)
    while begin < end and (piece := file.read(min(_PIECE, end - begin))):
        begin += len(piece)
        yield piece
