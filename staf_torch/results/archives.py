"""The checksum of an archive whose members have some of their own: no content is read to find it.

A zip archive, and so an `.npz`, keeps the CRC-32 of every member, found while it was written. The checksum is
the SHA-256 of all that is not content: names, sizes, places and those CRCs. An archive is as it was written
where that hash agrees and each content has its CRC.
"""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from collections.abc import Iterator
from typing import BinaryIO

MARK = "crc32+sha256:"
"""What such a checksum begins with."""
_PIECE = 2**22  # bytes that are read at once
_HEADER = 30  # bytes of a local header in front of its two texts, whose lengths stand at its end


def archive_digest(file: BinaryIO, *, thorough: bool) -> str | None:
    """Return the checksum of an archive whose members are stored as they are; None of any other file.

    Args:
        file: open for reading.
        thorough: whether the contents are read, too, and None is returned where one has not its CRC.
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
