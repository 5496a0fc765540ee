"""Files that somebody else may have written: regular ones, of plain values, harmless on a terminal."""

from __future__ import annotations

import json
import os
import stat
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

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
