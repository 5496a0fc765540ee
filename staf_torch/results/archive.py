"""`history.npz` as it is read: arrays that are stored as they are.

Nothing is unpacked and nothing unpickled: a small file cannot become a large array, and runs no code.
"""

from __future__ import annotations

import math
import struct
import zipfile
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from .untrusted import UnreadableError, open_regular, visible

_DIRECTORY = 2**16  # bytes of the list of arrays at most
_END, _END_64, _LOCAL = struct.Struct("<4s4H2LH"), struct.Struct("<4sQ2H2L4Q"), struct.Struct("<4s5H3L2H")
_LOCATOR = 20  # bytes between the two ends


class Stored(NamedTuple):
    """An array of the archive."""

    start: int  # of the numbers in the file
    shape: tuple[int, ...]
    dtype: np.dtype
    fortran: bool


class Archive:
    """The arrays of an archive that `HistoryWriter` or `numpy.savez` wrote.

    Args:
        path: of the archive.
        root: the run directory, where a link between the two must not be followed.

    Raises:
        UnreadableError: if it is no such archive.
    """

    def __init__(self, path: Path, root: Path | None = None) -> None:
        self._path, self._root = path, root
        try:
            with open_regular(path, root=root) as file:
                self._size = file.seek(0, 2)
                _short_directory(file, self._size)
                with zipfile.ZipFile(file) as archive:
                    entries = archive.infolist()
                self._stored = dict(self._entry(file, each) for each in entries)
        except UnreadableError:
            raise
        except Exception as error:  # zipfile and numpy raise a dozen kinds over bytes that nobody meant
            raise self._bad(str(error)) from error

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the arrays."""
        return tuple(self._stored)

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of an array.

        Raises:
            KeyError: if there is none of that name.
        """
        return self._known(name).shape

    def read(self, name: str, row: int | None = None) -> np.ndarray:
        """Return an array, or one entry along its first axis, of which no other byte is read.

        Raises:
            KeyError: if there is none of that name.
            UnreadableError: if the file has changed since.
        """
        stored = self._known(name)
        shape, start = stored.shape, stored.start
        if row is not None and not stored.fortran:
            shape = shape[1:]
            start += row * stored.dtype.itemsize * math.prod(shape)
        size = stored.dtype.itemsize * math.prod(shape)
        with open_regular(self._path, root=self._root) as file:
            file.seek(start)
            content = file.read(size)
        if len(content) != size:
            raise self._bad(f"{visible(name)} is cut off")
        found = (
            np.frombuffer(content, stored.dtype).reshape(shape, order="F" if stored.fortran else "C").copy()
        )
        return found[row] if row is not None and stored.fortran else found

    def _known(self, name: str) -> Stored:
        if name not in self._stored:
            raise KeyError(f"{name!r} is not in {self._path}; there are {', '.join(self._stored)}")
        return self._stored[name]

    def _entry(self, file: BinaryIO, entry: zipfile.ZipInfo) -> tuple[str, Stored]:
        name = visible(entry.filename.removesuffix(".npy"))
        if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
            raise self._bad(f"{name} is compressed, which staf_torch never does")
        file.seek(entry.header_offset)
        local = _LOCAL.unpack(file.read(_LOCAL.size))
        begin = entry.header_offset + _LOCAL.size + local[9] + local[10]
        file.seek(begin)
        version = np.lib.format.read_magic(file)
        reader = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, fortran, dtype = reader(file)  # of 10 000 bytes at most, by numpy's own limit
        start = file.tell()
        size = dtype.itemsize * math.prod(shape)
        if dtype.hasobject or dtype.kind not in "biufU" or min(shape, default=0) < 0:
            raise self._bad(f"{name} holds no numbers")
        if size != begin + entry.file_size - start or start + size > self._size:
            raise self._bad(f"{name} has another size than it says")
        return name, Stored(start, shape, dtype, fortran)

    def _bad(self, why: str) -> UnreadableError:
        return UnreadableError(f"{self._path} cannot be read: {' '.join(why.split())}")


def _short_directory(file: BinaryIO, size: int) -> None:
    """Look how long the list of arrays is before `zipfile` makes an object of every entry.

    Raises:
        ValueError: if it is long, or there is none at the end of the file.
    """
    file.seek(max(0, size - _END.size))
    sign, *_, length, _, comment = _END.unpack(file.read(_END.size))
    if sign != b"PK\5\6" or comment:
        raise ValueError("it does not end as an archive of arrays")
    if size >= _END.size + _LOCATOR + _END_64.size:
        file.seek(size - _END.size - _LOCATOR - _END_64.size)
        large = _END_64.unpack(file.read(_END_64.size))
        if large[0] == b"PK\6\6":
            length = large[8]
    if length > _DIRECTORY:
        raise ValueError(f"it lists its arrays in {length} bytes")
