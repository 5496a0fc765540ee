"""Fill a run directory: history, tables and figures, and at last the metrics."""

from __future__ import annotations

import contextlib
import errno
import io
import math
import os
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Protocol, TypeVar

import numpy as np
from numpy.lib.npyio import NpzFile

from .files import (
    FIGURES,
    HISTORY,
    METRICS,
    UnreadableError,
    open_after,
    open_regular,
    partial_name,
    visible,
    write_bytes,
    write_metrics,
    write_text,
)

T = TypeVar("T")
_HELD = 2**26
"""Bytes of a history that are held until they are written."""


class Printable(Protocol):
    """A table that a directory can write, such as `staf_torch.tables.Table`."""

    def markdown(self) -> str:
        """Return the table to be read by people."""
        ...

    def csv(self) -> str:
        """Return the table with every digit, for programs."""
        ...


class RunDirectory:
    """The directory of a run while it is being filled. After `metrics` it takes nothing more.

    Example:
        >>> run = RunDirectory(Path("runs/mine"))
        >>> text = run.table("laws", table)
        >>> run.figure("laws", images(draw_convergence(curves)))
        >>> metrics = run.metrics({"ball_error": 0.1})

    Args:
        path: a directory that exists.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._closed = path, False

    def history(self, batch: int, times: int) -> HistoryWriter:
        """Return the writer of `history.npz` for arrays (B, T, ...)."""
        return HistoryWriter(self._place(HISTORY), batch, times)

    def text(self, name: str, text: str) -> None:
        """Write a text file."""
        write_text(self._place(name), text)

    @contextlib.contextmanager
    def lines(self, name: str, *, keep: int = 0) -> Iterator[Callable[[str], None]]:
        """Yield a function that appends to a text file, which gets its name when it is complete.

        Until then the text is in a file of `partial_name`, also where the run is killed; so many bytes of an
        earlier one are kept.
        """
        path = self._place(name)
        partial = path.with_name(partial_name(name))
        with os.fdopen(open_after(partial, keep), "w", encoding="utf-8") as file:

            def write(text: str) -> None:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())

            yield write
        os.replace(partial, path)

    def table(self, name: str, table: Printable, *, shown: Printable | Sequence[Printable] = ()) -> str:
        """Write a table as CSV with every digit and as Markdown, and return the Markdown.

        ``name`` is that of both files, without their endings; ``shown`` are tables for the Markdown in place
        of that one.
        """
        several = shown if isinstance(shown, Sequence) else [shown]
        text = "\n".join(each.markdown() for each in several or [table])
        self.text(f"{name}.md", text)
        self.text(f"{name}.csv", table.csv())
        return text

    def figure(self, name: str, images: Mapping[str, bytes]) -> None:
        """Write the images of a figure, by their endings (`staf_torch.figures.style.images`)."""
        folder = self._place(FIGURES)
        folder.mkdir(exist_ok=True)
        if folder.is_symlink():
            raise OSError(errno.ELOOP, "it is a link, which is not written through", str(folder))
        for ending, content in images.items():
            write_bytes(folder / f"{name}.{ending}", content)

    def metrics(self, metrics: dict[str, float | None]) -> dict[str, float | None]:
        """Write `metrics.json`, the last of the files, and return the metrics: who finds it finds them all.

        Raises ValueError for a number that is not finite.
        """
        write_metrics(self._place(METRICS), metrics)
        self._closed = True
        return metrics

    def _place(self, name: str) -> Path:
        assert not self._closed, f"{name} comes after the metrics, which have to be the last file of a run"
        return self._path / name


class History(Mapping[str, np.ndarray]):
    """The arrays of a `history.npz`, each read when it is first asked for.

    Raises UnreadableError if there is none that can be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read: dict[str, np.ndarray] = {}
        self._names: tuple[str, ...] = self._of_archive(lambda archive: tuple(archive.files))

    def __getitem__(self, name: str) -> np.ndarray:
        """Return an array.

        Raises:
            KeyError: if there is none of that name.
            UnreadableError: if it is damaged.
        """
        if name not in self._names:
            raise KeyError(f"{name!r} is not in {self._path}; there are {', '.join(self._names)}")
        if name not in self._read:
            self._read[name] = self._of_archive(lambda archive: archive[name])
        return self._read[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __repr__(self) -> str:
        return visible(f"<History {', '.join(self._names)}>")

    def _of_archive(self, read: Callable[[NpzFile], T]) -> T:
        """Return what a function reads of the archive; pickles are refused."""
        try:
            with open_regular(self._path) as file, np.load(file, allow_pickle=False) as archive:
                return read(archive)
        except UnreadableError:
            raise
        except Exception as error:  # zipfile and numpy raise a dozen kinds over damaged bytes
            why = visible(" ".join(str(error).split()))
            raise UnreadableError(f"{self._path} cannot be read: {why}") from error


class HistoryWriter:
    """Write arrays (B, T, ...) that arrive in blocks of rows, each in pieces (b, C, ...) of time.

    Memory grows neither with B nor with T. The pieces of a block of rows are held until all its times are
    there, or a budget is full; they go into a hidden archive beside the place of the final one in a few large
    writes, each to where it stays. The archive appears at once and complete, or not at all. A context
    manager: leaving it by an exception removes the hidden file. Raises OSError if the directory cannot be
    written.
    """

    def __init__(self, path: Path, batch: int, times: int) -> None:
        self._path, self._batch, self._times = path, batch, times
        self._hidden = path.with_name(partial_name(path.name))
        self._hidden.unlink(missing_ok=True)  # of a run that was killed
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
        self._file = os.fdopen(os.open(self._hidden, flags, 0o666), "w+b")
        self._members: dict[str, _Array] = {}
        self._held: dict[str, np.ndarray] = {}  # (b, C, ...)
        self._row = self._done = 0  # of the block: its first row, and the times that were added
        self._complete = self._fill = 0  # rows with all times; times that are held

    def add(self, pieces: Mapping[str, np.ndarray], row: int = 0) -> None:
        """Append the next piece of time of a block of rows, arrays (b, C, ...) by the same names each time.

        Blocks follow each other by their first ``row``, each with all its times.
        """
        rows, length = next(iter(pieces.values())).shape[:2]
        assert all(piece.shape[:2] == (rows, length) for piece in pieces.values())
        if row != self._row:
            assert row == self._complete
            self._row, self._done = row, 0
        if not self._members:
            self._reserve(pieces)
        if length == self._times:  # nothing is held: it goes where it stays
            for name, piece in pieces.items():
                self._members[name].put(self._file, row * length, piece)
            self._done = length
        else:
            self._hold(pieces, rows, length)
        if self._done == self._times:
            self._complete += rows

    def close(self, **whole: np.ndarray) -> None:
        """Complete the archive, with ``whole`` arrays as they are."""
        assert self._complete == self._batch
        for member in self._members.values():
            member.finish(self._file)
        self._file.seek(0, os.SEEK_END)
        with zipfile.ZipFile(self._file, "w", zipfile.ZIP_STORED) as archive:
            for name, array in whole.items():
                content = io.BytesIO()
                np.lib.format.write_array(content, array, allow_pickle=False)
                archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getbuffer())  # of no date
            archive.filelist += [member.info for member in self._members.values()]
        self._file.close()  # which may find the disk full
        os.replace(self._hidden, self._path)

    def __enter__(self) -> HistoryWriter:
        return self

    def __exit__(self, *raised: object) -> None:
        with contextlib.suppress(OSError):  # of a full disk, which was told already
            self._file.close()
        self._hidden.unlink(missing_ok=True)

    def _reserve(self, pieces: Mapping[str, np.ndarray]) -> None:
        """Lay the arrays out in the archive, one behind the other."""
        begin = 0
        for name, piece in pieces.items():
            shape = self._batch, self._times, *piece.shape[2:]
            self._members[name] = _Array(f"{name}.npy", begin, shape, piece.dtype)
            begin = self._members[name].end
        self._file.truncate(begin)

    def _hold(self, pieces: Mapping[str, np.ndarray], rows: int, length: int) -> None:
        """Take in a piece of time of a block of rows, and write what is held when that is enough."""
        if any(len(held) != rows for held in self._held.values()) or not self._held:
            size = sum(piece.nbytes for piece in pieces.values()) // max(1, length)  # of one time
            room = rows, max(1, min(self._times, _HELD // max(1, size)))
            self._held = {n: np.empty((*room, *piece.shape[2:]), piece.dtype) for n, piece in pieces.items()}
        room, taken = next(iter(self._held.values())).shape[1], 0
        while taken < length:
            take = min(length - taken, room - self._fill)
            for name, piece in pieces.items():
                self._held[name][:, self._fill : self._fill + take] = piece[:, taken : taken + take]
            taken, self._fill, self._done = taken + take, self._fill + take, self._done + take
            if self._fill == room or self._done == self._times:
                self._write(rows)

    def _write(self, rows: int) -> None:
        """Write the times that are held."""
        times, first = self._fill, self._done - self._fill
        for name, member in self._members.items():
            if times == self._times:
                member.put(self._file, self._row * times, self._held[name])
                continue
            for row in range(rows):
                member.put(self._file, (self._row + row) * self._times + first, self._held[name][row, :times])
        self._fill = 0


class _Array:
    """An array of an archive whose data arrive in any order; it begins at that byte of the archive."""

    def __init__(self, name: str, begin: int, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        head, described = io.BytesIO(), {"descr": dtype.str, "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(head, described)
        self.info, self._head = zipfile.ZipInfo(name), head.getvalue()
        self.info.header_offset, self.info.CRC = begin, 0
        self._entry = dtype.itemsize * math.prod(shape[2:])
        size = len(self._head) + self._entry * shape[0] * shape[1]
        self.info.file_size = self.info.compress_size = size
        self._data = begin + len(self.info.FileHeader(zip64=True)) + len(self._head)
        self.end = self._data - len(self._head) + size
        self._summed, self._sum = self._data, zlib.crc32(self._head)  # the checksum, up to where it goes

    def put(self, file: BinaryIO, entry: int, block: np.ndarray) -> None:
        """Write a block at one of the B T entries."""
        at, data = self._data + self._entry * entry, _bytes(block)
        file.seek(at)
        file.write(data)
        if at == self._summed:
            self._summed, self._sum = at + data.nbytes, zlib.crc32(data, self._sum)

    def finish(self, file: BinaryIO) -> None:
        """Write what stands before the data."""
        file.seek(self._summed)
        while self._summed < self.end:  # the rest did not come in its order
            data = file.read(min(2**24, self.end - self._summed))
            self._summed, self._sum = self._summed + len(data), zlib.crc32(data, self._sum)
        self.info.CRC = self._sum
        file.seek(self.info.header_offset)
        file.write(self.info.FileHeader(zip64=True) + self._head)


def _bytes(array: np.ndarray) -> memoryview:
    """The bytes of an array, in C's order: a copy only where they do not lie so."""
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
