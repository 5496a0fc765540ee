"""The OpenMP runtime that torch itself runs on."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable

import torch


@functools.cache
def openmp(name: str) -> Callable[..., None] | None:
    """A function of it; None where there is none."""
    try:
        return getattr(ctypes.CDLL(torch._C.__file__), name, None)
    except OSError:
        return None
