"""Files that somebody else may have written: regular ones only, behind no link, of limited size and depth.

A folder of results may come from anywhere. What is read from it here costs bounded memory and time, and has
no character that a terminal would obey.
"""

from __future__ import annotations

import errno
import json
import os
import re
import stat
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

MOST_BYTES = 4 * 2**20
"""Bytes of a record, of metrics or of settings at most."""
_MOST_PARTS = 10**6  # lists and objects in one JSON text: each takes 60 bytes of memory, however short
_MOST_LINE = 2**20  # bytes
_DEEPEST = 20
_ESCAPED = re.compile(r"\\[ubfr]")
_UNSEEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}  # categories: control, bidirectional, surrogates, ...


class UnreadableError(Exception):
    """A directory or file that cannot be read; the message says why."""


def open_regular(path: Path, most: int | None = None, *, root: Path | None = None) -> BinaryIO:
    """Open a regular file for reading, without waiting for it and without following a link to it.

    Args:
        path: of the file.
        most: bytes; None: any number.
        root: a folder above the file; no folder between the two may be a link either.

    Raises:
        UnreadableError: if there is no such file, or it is a link, a pipe, a device or too large.
    """
    parts = (path.name,) if root is None else path.relative_to(root).parts
    try:
        folder = os.open(path.parent if root is None else root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            for part in parts[:-1]:
                inner = os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=folder)
                os.close(folder)
                folder = inner
            # O_NONBLOCK: a pipe that nobody writes to would keep us for ever.
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
            file = os.open(parts[-1], flags, dir_fd=folder)
        finally:
            os.close(folder)
    except OSError as error:
        linked = error.errno == errno.ELOOP or (error.errno == errno.ENOTDIR and path.parent.is_symlink())
        why = "a link, which is not followed" if linked else error.strerror
        raise UnreadableError(f"{path.name} cannot be read: {why}") from error
    except ValueError as error:  # a null character
        raise UnreadableError(f"{path.name!r} is no name of a file") from error
    about = os.fstat(file)
    if not stat.S_ISREG(about.st_mode):
        os.close(file)
        raise UnreadableError(f"{path.name} is not a regular file")
    if most is not None and about.st_size > most:
        os.close(file)
        raise UnreadableError(f"{path.name} has {about.st_size} bytes, and {most} are the most that is read")
    return os.fdopen(file, "rb")


def read_bytes(path: Path, most: int = MOST_BYTES, *, root: Path | None = None) -> bytes:
    """Return the content of a regular file; arguments and errors as of `open_regular`."""
    with open_regular(path, most, root=root) as file:
        content = file.read(most + 1)  # a file may grow between the two
    if len(content) > most:
        raise UnreadableError(f"{path.name} grows while it is read")
    return content


def read_text(path: Path, most: int = MOST_BYTES, *, root: Path | None = None) -> str:
    """Return the text of a regular file; arguments and errors as of `open_regular`."""
    return _decoded(read_bytes(path, most, root=root), path.name)


def read_object(path: Path, most: int = MOST_BYTES) -> dict[str, Any]:
    """Return the JSON object in a file.

    Raises:
        UnreadableError: if there is none.
    """
    return parse_object(read_bytes(path, most), path.name)


def parse_object(content: bytes, name: str) -> dict[str, Any]:
    """Return a JSON object; ``name`` is for the message.

    Whole numbers of more than 20 digits become floats, which may be infinite. Texts and keys are `visible`.

    Raises:
        UnreadableError: if it is none, or has too many or too deep parts.
    """
    text = _decoded(content, name)
    if content.count(b"[") + content.count(b"{") > _MOST_PARTS:
        raise UnreadableError(f"{name} has more than {_MOST_PARTS} lists and objects")
    try:
        found = json.loads(text, parse_int=_integer)
        # Only escapes and letters beyond ASCII can make a character that is not seen.
        if not text.isascii() or "\x7f" in text or _ESCAPED.search(text):
            found = all_visible(found)
    except RecursionError as error:
        raise UnreadableError(f"{name} is nested too deep") from error
    except ValueError as error:
        raise UnreadableError(f"{name} is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise UnreadableError(f"{name} holds no object")
    return found


def read_lines(path: Path) -> Iterator[bytes]:
    """Yield the lines of a regular file of any size.

    Raises:
        UnreadableError: if there is no such file, or a line is longer than a megabyte.
    """
    with open_regular(path) as file:
        while line := file.readline(_MOST_LINE + 1):
            if len(line) > _MOST_LINE:
                raise UnreadableError(f"{path.name} has a line of more than {_MOST_LINE} bytes")
            yield line


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
    """Return a JSON value with all its texts and keys `visible`."""
    if isinstance(value, str):
        return visible(value)
    if isinstance(value, list):
        return [all_visible(each) for each in value]
    if isinstance(value, dict):
        return {visible(key): all_visible(each) for key, each in value.items()}
    return value


def too_deep(value: Any, left: int = _DEEPEST) -> bool:
    """Return whether lists and objects in a value are nested deeper than anything that the library writes."""
    if not isinstance(value, list | dict):
        return False
    inner = value.values() if isinstance(value, dict) else value
    return left == 0 or any(too_deep(each, left - 1) for each in inner)


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


def _decoded(content: bytes, name: str) -> str:
    try:
        return content.decode()
    except ValueError as error:
        raise UnreadableError(f"{name} is not text: {error}") from error


def _integer(text: str) -> int | float:
    return int(text) if len(text) <= 20 else float(text)
