"""The files of run and sweep directories: their names, and how they are written: complete or not at all.

Somebody else may have written those that are read: regular files, of plain values, harmless on a terminal.
"""

from __future__ import annotations

import functools
import json
import math
import os
import re
import stat
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, TypeGuard, TypeVar

RUN, METRICS, HISTORY, ROWS = "run.json", "metrics.json", "history.npz", "rows.json"
SWEEP, PAGE, TABLE = "sweep.json", "report.html", "table"
FIGURES, HYDRA = "figures", ".hydra"
COMPLETED, FAILED, RUNNING, UNFINISHED = "completed", "failed", "running", "unfinished"
"""Status of a run: it ended, it raised, it has not said that it ended, or there is no word of its end."""

FREE = ("figures", "animation", "tracker")
"""Settings that change no number: a sweep that is resumed may have others."""

Value = str | float | int | bool | list[Any] | None
"""What a setting holds; a list may hold lists."""
_WORDS: Mapping[str, Value] = {"null": None, "none": None, "true": True, "false": False}
Item = TypeVar("Item")
Key = TypeVar("Key")


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Return the items by a key, groups and items in the order in which they came."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


@functools.lru_cache(4096)  # a table of a thousand rows asks for the same keys a thousand times
def is_free(line: str) -> bool:
    """Return whether an override, or a dotted key, is about one of `FREE`."""
    return re.split(r"[.=@/]", line.lstrip("+~"), maxsplit=1)[0] in FREE


def is_number(value: object) -> TypeGuard[int | float]:
    """Return whether a value is a number, which a truth value is not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def write_text(path: Path, text: str) -> None:
    """Write a file under another name, flush it to disk, then rename it into place."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write bytes as `write_text` writes a text."""
    partial = path.with_name(partial_name(path.name))
    try:
        partial.unlink(missing_ok=True)  # of a run that was killed; and a link there would be written through
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
        with os.fdopen(os.open(partial, flags, 0o666), "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def open_after(path: Path, keep: int) -> int:
    """Return the descriptor of a file to write to after its first ``keep`` bytes; the rest of it is cut off.

    With none to keep it is a new file. A link is not followed.
    """
    if keep:
        file = os.open(path, os.O_WRONLY | os.O_NOFOLLOW)
        os.ftruncate(file, keep)
        os.lseek(file, keep, os.SEEK_SET)
        return file
    path.unlink(missing_ok=True)
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666)


def partial_name(name: str) -> str:
    """Return the name of a file until it is complete."""
    return f".{name}.partial"


def write_metrics(path: Path, metrics: Mapping[str, float | int | None]) -> None:
    """Write a flat JSON object, name to number or null.

    Raises:
        ValueError: for a number that is not finite, which JSON does not have.
    """
    write_text(path, json.dumps(metrics, indent=2, allow_nan=False) + "\n")


def flatten(settings: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings with dotted keys: ``{"centers": {"count": 3}}`` -> ``{"centers.count": 3}``."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def plain(value: Any) -> Any:
    """Return what JSON can hold of a value; a number that is not finite becomes its name."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def parse_overrides(lines: Iterable[str]) -> dict[str, Value]:
    """Return overrides as typed: ``["kernel=gaussian", "+seed=3"]`` -> ``{"kernel": "gaussian", "seed": 3}``.

    Hydra's own are left out. Hydra itself is not asked: it takes a second to import.
    """
    typed: dict[str, Value] = {}
    for line in lines:
        key, given, text = line.lstrip("+~").partition("=")
        if given and not key.startswith(("hydra.", "hydra/")):
            typed[key] = _parsed(text.strip())
    return typed


def _parsed(word: str) -> Value:
    """A number, word, list or text; what is none of the first three stays as it was typed."""
    if word.lower() in _WORDS:
        return _WORDS[word.lower()]
    if len(word) > 1 and word[0] == word[-1] and word[0] in "'\"":
        return word[1:-1]
    for kind in (int, float):
        try:
            number: float = kind(word)
        except ValueError:
            continue
        return number if abs(number) < float("inf") else word  # neither nan nor inf is a JSON number
    if word.startswith("["):
        try:
            listed = json.loads(word)
        except ValueError:
            return word
        return plain(listed) if isinstance(listed, list) else word
    return word


_UNSEEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}  # categories: control, bidirectional, surrogates, ...


class UnreadableError(ValueError):
    """A directory or file that cannot be read; the message says why."""


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading: a link is not followed, and a pipe or a device is not waited for.

    Raises:
        UnreadableError: if there is no such file, or it is not a regular one.
    """
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        why = "it is a link" if path.is_symlink() else getattr(error, "strerror", None) or str(error)
        raise UnreadableError(f"{path.name} cannot be read: {why}") from error
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise UnreadableError(f"{path.name} is not a regular file")
    return os.fdopen(file, "rb")


def read_bytes(path: Path) -> bytes:
    """Return the content of a regular file; errors as of `open_regular`."""
    with open_regular(path) as file:
        return file.read()


def read_lines(path: Path) -> Iterator[bytes]:
    """Yield the lines of a regular file; errors as of `open_regular`."""
    with open_regular(path) as file:
        yield from file


def read_object(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file.

    Raises:
        UnreadableError: if there is none.
    """
    return parse_object(read_bytes(path), path.name)


def parse_object(content: bytes, name: str) -> dict[str, Any]:
    """Return a JSON object; ``name`` is for the message.

    Whole numbers of more than 20 digits become floats, which may be infinite. Texts and keys are `visible`.

    Raises:
        UnreadableError: if it is none.
    """
    try:
        text = content.decode()
        found = json.loads(text, parse_int=_integer)
        if not text.isascii() or "\\" in text or "\x7f" in text:
            found = all_visible(found)
    except RecursionError as error:
        raise UnreadableError(f"{name} is nested too deep") from error
    except ValueError as error:
        raise UnreadableError(f"{name} is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise UnreadableError(f"{name} holds no object")
    return found


def visible(text: str) -> str:
    r"""Return a text with control characters, direction marks and lone surrogates written as `\u001b`.

    Tabs and line ends stay.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        c if c in "\n\t" or unicodedata.category(c) not in _UNSEEN else f"\\u{ord(c):04x}" for c in text
    )


def all_visible(value: Any) -> Any:
    """Return a value of JSON or YAML with all its texts and keys `visible`."""
    if isinstance(value, str):
        return visible(value)
    if isinstance(value, list):
        return [all_visible(each) for each in value]
    if isinstance(value, dict):
        return {visible(str(key)): all_visible(each) for key, each in value.items()}
    return value


def links_in(directory: Path) -> list[Path]:
    """Return what in and under a folder is neither a regular file of one name nor a folder, such as links.

    Nothing of ours writes one, and who writes to a file behind a link, or to one that has another name
    elsewhere (a hard link), writes elsewhere. A folder that cannot be listed counts too.
    """
    found, folders = [], [directory]
    while folders:
        folder = folders.pop()
        try:
            with os.scandir(folder) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(Path(entry.path))
                    elif not _plain_file(entry):
                        found.append(Path(entry.path))
        except FileNotFoundError:
            continue
        except OSError:
            found.append(folder)
    return found


def _plain_file(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_file(follow_symlinks=False) and entry.stat(follow_symlinks=False).st_nlink < 2
    except FileNotFoundError:  # it has gone since it was listed
        return True


def _integer(text: str) -> int | float:
    return int(text) if len(text) <= 20 else float(text)
