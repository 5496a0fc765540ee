"""Fill a run directory: history, tables and figures, and at last the metrics."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.lib.npyio import NpzFile

from .files import FIGURES, HISTORY, METRICS, open_after, partial_name, write_bytes, write_metrics, write_text
from .untrusted import UnreadableError, open_regular, visible

T = TypeVar("T")


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
        """Write a table as CSV with every digit and as Markdown.

        Args:
            name: of both files, without their endings.
            table: for programs.
            shown: tables for the Markdown in place of that one.

        Returns:
            The Markdown.
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
        """Write `metrics.json`, the last of the files: who finds it finds them all.

        Returns:
            The metrics.

        Raises:
            ValueError: for a number that is not finite.
        """
        write_metrics(self._place(METRICS), metrics)
        self._closed = True
        return metrics

    def _place(self, name: str) -> Path:
        assert not self._closed, f"{name} comes after the metrics, which have to be the last file of a run"
        return self._path / name


class History(Mapping[str, np.ndarray]):
    """The arrays of a `history.npz`, each read when it is first asked for.

    Args:
        path: of the archive.

    Raises:
        UnreadableError: if there is none that can be read.
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
    """Write arrays (B, T, ...) that arrive in pieces (B, C, ...) of consecutive times.

    Memory does not grow with T: the pieces go to scratch files beside the archive; `close` packs them, and
    the archive appears at once and complete, or not at all. A context manager: leaving it by an exception
    removes the scratch files.

    Args:
        path: of the archive.
        batch: B.
        times: T.

    Raises:
        OSError: if the directory cannot be written.
    """

    def __init__(self, path: Path, batch: int, times: int) -> None:
        self._path, self._batch, self._times = path, batch, times
        self._scratch = Path(tempfile.mkdtemp(prefix=".history-", dir=path.parent))
        self._files: dict[str, tuple[int, int]] = {}  # name -> (descriptor, bytes of the header)
        self._done = 0

    def add(self, pieces: Mapping[str, np.ndarray]) -> None:
        """Append the next piece of every array, each (B, C, ...) with the same C."""
        length = next(iter(pieces.values())).shape[1]
        for name, piece in pieces.items():
            assert piece.shape[:2] == (self._batch, length)
            if name not in self._files:
                self._files[name] = self._open(name, piece)
            descriptor, header = self._files[name]
            entry = piece.dtype.itemsize * math.prod(piece.shape[2:])
            for row, block in enumerate(np.ascontiguousarray(piece)):
                start = header + entry * (row * self._times + self._done)
                os.pwrite(descriptor, block.tobytes(), start)
        self._done += length

    def close(self, **whole: np.ndarray) -> None:
        """Pack the archive, with ``whole`` arrays as they are."""
        assert self._done == self._times
        for name, array in whole.items():
            np.save(self._scratch / f"{name}.npy", array)
        packed = self._scratch / HISTORY
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
            for name in (*whole, *self._files):
                archive.write(self._scratch / f"{name}.npy", f"{name}.npy")
        os.replace(packed, self._path)

    def __enter__(self) -> HistoryWriter:
        return self

    def __exit__(self, *raised: object) -> None:
        for descriptor, _ in self._files.values():
            os.close(descriptor)
        shutil.rmtree(self._scratch, ignore_errors=True)

    def _open(self, name: str, piece: np.ndarray) -> tuple[int, int]:
        path = self._scratch / f"{name}.npy"
        shape = (self._batch, self._times, *piece.shape[2:])
        with path.open("wb") as file:
            np.lib.format.write_array_header_1_0(
                file, {"descr": piece.dtype.str, "fortran_order": False, "shape": shape}
            )
            header = file.tell()
        return os.open(path, os.O_WRONLY), header
