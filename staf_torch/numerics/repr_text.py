"""Numbers, tensors and settings in the few words of a `repr`."""

from __future__ import annotations

import inspect
from typing import Any

import torch
from torch import Tensor

from ..lanes.row_numbers import RowNumbers

_MOST = 16  # numbers of a tensor that are shown
_PLAIN = (bool, int, float, str)


def shown(value: Any) -> str:
    """Return a number or a tensor in four digits, diagonal matrices as `diag(1, 2)`, large ones by shape."""
    if callable(value):
        return str(getattr(value, "__name__", type(value).__name__))
    if not isinstance(value, float | Tensor):
        return str(value)
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, RowNumbers):
        return f"rows({shown(value.full)})"
    if value.numel() > _MOST or value.is_meta:
        return f"a tensor {tuple(value.shape)}"
    if value.dim() == 2 and 1 < len(value) == value.shape[1] and torch.equal(value, value.diag().diag()):
        return f"diag({', '.join(map(shown, value.diag().tolist()))})"
    return _listed(value.tolist())


def _listed(value: Any) -> str:
    return f"[{', '.join(map(_listed, value))}]" if isinstance(value, list) else shown(value)


def settings(thing: Any, *left_out: str) -> list[str]:
    """Return `name=value` of the constructor's arguments that are attributes, and numbers or tensors."""
    names = [name for name in inspect.signature(type(thing).__init__).parameters if name not in left_out]
    found = [(name, getattr(thing, name, None)) for name in names]
    return [f"{name}={shown(value)}" for name, value in found if isinstance(value, (*_PLAIN, Tensor))]


def sizes(dim: int | None, inputs: int) -> str:
    """Return `2 states, 1 input`."""
    states = "any number of states" if dim is None else f"{dim} state{'s' if dim != 1 else ''}"
    return f"{states}, {inputs} input{'s' if inputs != 1 else ''}"


def limits(bounds: Any) -> list[str]:
    """Return `low=...` and `high=...` of `systems.Bounds`; nothing of None."""
    return [] if bounds is None else [f"low={shown(bounds.low)}", f"high={shown(bounds.high)}"]


def count(mask: Tensor) -> str:
    """Return the number of entries in which a mask holds; `?` on the meta device."""
    return "?" if mask.is_meta else str(int(mask.sum()))


def span(values: Tensor) -> str:
    """Return `0.1 to 0.7` of the finite ones, `none found` where there are none."""
    if values.is_meta:
        return "on the meta device"
    finite = values.detach()[torch.isfinite(values)]
    if not len(finite):
        return "none found"
    low, high = float(finite.min()), float(finite.max())
    return f"{low:.6g}" if low == high and values.numel() == 1 else f"{low:.6g} to {high:.6g}"
