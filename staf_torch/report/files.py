"""Files that appear complete or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path


def write_text(path: Path, text: str) -> None:
    """Write a file under another name, flush it to disk, then rename it into place."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """`write_text` of bytes."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_metrics(path: Path, metrics: Mapping[str, float | int | None]) -> None:
    """A flat JSON object, name to number or null; JSON has no NaN, so one is refused.

    Raises:
        ValueError: for a number that is not finite.
    """
    write_text(path, json.dumps(metrics, indent=2, allow_nan=False) + "\n")
