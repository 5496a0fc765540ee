"""What the objects of an experiment are made of, without running it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from torch import Tensor, nn

Made = dict[str, Any]
"""Numbers, tensors and words by their path."""
_DEEP = 6


def made_of(value: Any) -> Made:
    """Numbers, tensors and words of an object, of what it has, and so on; functions are left out.

    Each object is told once, where it is met first.
    """
    return dict(_parts(value, "", _DEEP, set()))


def _parts(value: Any, path: str, deep: int, seen: set[int]) -> Iterator[tuple[str, Any]]:
    if isinstance(value, str | bool | int | float | Tensor | np.ndarray):
        yield path, value
    elif deep and id(value) not in seen:
        seen.add(id(value))
        for name, part in _inside(value):
            yield from _parts(part, f"{path}.{name}".strip("."), deep - 1, seen)


def _inside(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        yield from ((str(name), part) for name, part in value.items())
    elif hasattr(value, "_fields"):
        yield from zip(value._fields, value, strict=True)
    elif isinstance(value, list | tuple):
        yield from ((str(at), part) for at, part in enumerate(value))
    elif isinstance(value, nn.Module):
        held = {k: part for k, part in vars(value).items() if not k.startswith("_") and k != "training"}
        yield from (held | value._buffers | value._parameters | value._modules).items()
        yield "kind", type(value).__name__
    elif type(value).__module__.startswith("staf_torch"):
        yield from ((name, part) for name, part in vars(value).items() if not name.startswith("_"))
        yield "kind", type(value).__name__
