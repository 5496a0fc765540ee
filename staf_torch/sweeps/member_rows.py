"""The rows of `members.json` while a job writes them, and those that a killed job has left.

Beside the file, which has another name until it is complete, a hidden file has one line a row: the checksums
of the row and of its history, and a hash of what made it. `sweep.resume` takes over the rows that agree with
theirs.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from .. import __version__
from ..results.build import checksums, damage, modules
from ..results.files import MEMBERS, open_after, partial_name
from ..results.run_directory import RunDirectory
from ..results.untrusted import UnreadableError, parse_object, read_lines

_log = logging.getLogger(__name__)
SUMS = f".{MEMBERS}.sums"
FOLDER = "members"
_HEAD = f'{{"version": {json.dumps(__version__)}, "members": [\n'
_DIGITS = 16  # of the hash of what made a row: enough to tell two settings apart


class Left(NamedTuple):
    """What an earlier start of a job has left of its members."""

    made: list[str]  # what made each whole row, from the first row on
    size: int = 0  # bytes of the rows' file up to the end of the last of them, without its comma
    sums: int = 0  # bytes of the checksums' file up to the end of their line


Write = Callable[[Sequence[dict[str, Any]], Sequence[str]], None]


def made_by(settings: Mapping[str, Any]) -> str:
    """Return a hash of the settings of a member, by dotted keys, and of the user's modules that they name."""
    text = json.dumps([settings, modules(settings)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]


def left(directory: Path, run: str) -> Left | None:
    """Return the rows that an earlier start has left, up to the first that is not whole.

    Args:
        directory: of the run.
        run: hash of what makes the run.

    Returns:
        The rows; None where something else made them.
    """
    partial, found = directory / partial_name(MEMBERS), Left([])
    if not os.path.lexists(directory / SUMS) or not os.path.lexists(partial):
        return found
    try:
        sums, rows = read_lines(directory / SUMS), read_lines(partial)
        head = next(sums, b"")
        if parse_object(head, SUMS).get("run") != run:
            return None
        if next(rows, b"") != _HEAD.encode():
            return found
        size, found = len(_HEAD), Left([], len(_HEAD), len(head))
        for line, row in zip(sums, rows, strict=False):
            about, text = parse_object(line, SUMS), row.removesuffix(b"\n").removesuffix(b",")
            wrong = _damage(directory / FOLDER / str(len(found.made)), about, text)
            if wrong is not None:
                raise UnreadableError(wrong)
            found.made.append(about["made"])
            found = Left(found.made, size + len(text), found.sums + len(line))
            size += len(row)
    except UnreadableError as error:
        _log.warning("%s; member %d and those after it run again", error, len(found.made))
    return found


def _damage(directory: Path, about: Mapping[str, Any], row: bytes) -> str | None:
    """Return what is wrong with a row or with its history in a directory."""
    if about.get("sha256") != hashlib.sha256(row).hexdigest() or not isinstance(about.get("made"), str):
        return f"a row of {MEMBERS} is damaged or cut off"
    files = about.get("files")
    return damage(directory, files, thorough=True) if isinstance(files, dict) else None


def rows_left(directory: Path, count: int) -> Iterator[dict[str, Any]]:
    """Yield the first rows of a file of members that is not complete."""
    rows = read_lines(directory / partial_name(MEMBERS))
    next(rows)
    for _, row in zip(range(count), rows, strict=False):
        yield parse_object(row.removesuffix(b"\n").removesuffix(b","), MEMBERS)


@contextlib.contextmanager
def writer(directory: Path, run: str, total: int, before: Left) -> Iterator[Write]:
    """Yield a function that appends rows to `members.json`, with what made each of them.

    Args:
        directory: of the run.
        run: hash of what makes the run.
        total: rows in the end.
        before: rows that stay; what the files have after them is cut off.
    """
    done = len(before.made)

    def ending(number: int) -> str:
        return ",\n" if number < total else "\n]}\n"

    with (
        os.fdopen(open_after(directory / SUMS, before.sums), "wb") as sums,
        RunDirectory(directory).lines(MEMBERS, keep=before.size) as write,
    ):

        def note(lines: Sequence[dict[str, Any]]) -> None:
            sums.write("".join(json.dumps(line) + "\n" for line in lines).encode())
            sums.flush()
            os.fsync(sums.fileno())

        if before.size == 0:
            note([{"run": run}])
            write(_HEAD)
        elif done:
            write(ending(done))

        def add(rows: Sequence[dict[str, Any]], made: Sequence[str]) -> None:
            nonlocal done
            about, text = [], []
            for row, by in zip(rows, made, strict=True):
                line, done = json.dumps(row, allow_nan=False), done + 1
                text.append(line + ending(done))  # one member a line
                line_sum = hashlib.sha256(line.encode()).hexdigest()
                files = checksums(directory / FOLDER / str(row["num"]), frozenset())
                about.append({"made": by, "sha256": line_sum} | ({"files": files} if files else {}))
            write("".join(text))
            note(about)

        yield add
    (directory / SUMS).unlink()
