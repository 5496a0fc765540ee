"""`history.npz`, written piece by piece so that memory does not grow with the horizon."""

from __future__ import annotations

import os
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

import numpy as np


class HistoryWriter:
    """Collects arrays (B, T, ...) that arrive in pieces (B, C, ...) of consecutive times.

    The pieces go to scratch files beside the archive; `close` packs them, and the archive appears
    under its name at once and complete, or not at all. A context manager: leaving it by an exception
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
        """The next piece of every array, each (B, C, ...) with the same C."""
        length = next(iter(pieces.values())).shape[1]
        for name, piece in pieces.items():
            assert piece.shape[:2] == (self._batch, length)
            if name not in self._files:
                self._files[name] = self._open(name, piece)
            descriptor, header = self._files[name]
            entry = piece.dtype.itemsize * int(np.prod(piece.shape[2:], dtype=np.int64))
            for row, block in enumerate(np.ascontiguousarray(piece)):
                start = header + entry * (row * self._times + self._done)
                os.pwrite(descriptor, block.tobytes(), start)
        self._done += length

    def close(self, **whole: np.ndarray) -> None:
        """Pack the archive; ``whole`` arrays are stored as they are."""
        assert self._done == self._times
        for name, array in whole.items():
            np.save(self._scratch / f"{name}.npy", array)
        packed = self._scratch / "history.npz"
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name in (*whole, *self._files):
                archive.write(self._scratch / f"{name}.npy", f"{name}.npy")
        os.replace(packed, self._path)

    def __enter__(self) -> HistoryWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for descriptor, _ in self._files.values():
            os.close(descriptor)
        shutil.rmtree(self._scratch, ignore_errors=True)

    def _open(self, name: str, piece: np.ndarray) -> tuple[int, int]:
        path = self._scratch / f"{name}.npy"
        shape = (self._batch, self._times, *piece.shape[2:])
        with path.open("wb") as file:
            np.lib.format.write_array_header_1_0(
                file,
                {"descr": piece.dtype.str, "fortran_order": False, "shape": shape},
            )
            header = file.tell()
            file.truncate(header + piece.dtype.itemsize * int(np.prod(shape, dtype=np.int64)))
        return os.open(path, os.O_WRONLY), header
