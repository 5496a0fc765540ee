"""Entries at places that a row computes, of tensors of many entries: a loop goes through the places.

Written out, every entry of the result is a chain of choices between all that it could be.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from .combinators import scan
from .tracer import LARGE


def many(name: str, a: Tensor, dim: object, index: object) -> bool:
    """Whether so many choices are left that they stay a loop: of one of `CHOICES` along a dimension."""
    if name not in CHOICES or not isinstance(dim, int) or not isinstance(index, Tensor) or a.dim() == 0:
        return False
    others = 1 if name != "index_select" else a.numel() // max(1, a.shape[dim])
    return index.dtype != torch.bool and index.numel() * a.shape[dim] * others > 2 * LARGE


def gather(a: Tensor, dim: int, index: Tensor, *, sparse_grad: bool = False) -> Tensor:
    """Entry index_i along a dimension: as `torch.gather`."""
    at = index.movedim(dim, -1)
    entries = a.movedim(dim, 0)[(slice(None), *(slice(size) for size in at.shape[:-1]))]
    start = entries[0].unsqueeze(-1).expand(at.shape).clone()

    def choose(found: Tensor, now: tuple[Tensor, Tensor]) -> tuple[Tensor, tuple[()]]:
        entry, place = now
        return torch.where(at == place, entry.unsqueeze(-1), found), ()

    found: Tensor = scan(choose, start, (entries, _places(a, dim)), dim=0)[0]
    return found.movedim(-1, dim).clone()


def index_select(a: Tensor, dim: int, index: Tensor) -> Tensor:
    """The entries index_i along a dimension: as `torch.index_select`."""
    shape = list(a.shape)
    shape[dim] = index.numel()
    spread = index.reshape([-1 if k == dim % a.dim() else 1 for k in range(a.dim())])
    return gather(a, dim, spread.expand(shape))


def scatter(a: Tensor, dim: int, index: Tensor, source: Tensor | float) -> Tensor:
    """A tensor with other entries at index_i along a dimension, the last of equal places: `torch.scatter`."""
    return _put(a, dim, index, source, lambda before, here, value: torch.where(here, value, before))


def scatter_add(a: Tensor, dim: int, index: Tensor, source: Tensor) -> Tensor:
    """A tensor with entries added at index_i along a dimension: as `torch.scatter_add`."""
    return _put(
        a,
        dim,
        index,
        source,
        lambda before, here, value: before + torch.where(here, value, torch.zeros_like(value)),
    )


def _put(
    a: Tensor,
    dim: int,
    index: Tensor,
    source: Tensor | float,
    after: Callable[[Tensor, Tensor, Tensor], Tensor],
) -> Tensor:
    at = index.movedim(dim, 0)
    values = (
        source.movedim(dim, 0) if isinstance(source, Tensor) and source.dim() else torch.as_tensor(source)
    )
    inner = tuple(slice(size) for size in at.shape[1:])
    values = (
        values.to(a.dtype).expand(at.shape) if values.dim() == 0 else values[(slice(at.shape[0]), *inner)]
    )
    whole = a.movedim(dim, -1)
    place = _places(a, dim)

    def put(part: Tensor, now: tuple[Tensor, Tensor]) -> tuple[Tensor, tuple[()]]:
        here, value = now
        return after(part, here.unsqueeze(-1) == place, value.unsqueeze(-1)), ()

    part: Tensor = scan(put, whole[inner].clone(), (at, values), dim=0)[0]
    if part.shape != whole.shape:
        out = whole.clone()
        out[inner] = part
        part = out
    return part.movedim(-1, dim).clone()


def _places(a: Tensor, dim: int) -> Tensor:
    return torch.arange(a.shape[dim], device=a.device)


CHOICES = {"gather": gather, "index_select": index_select, "scatter": scatter, "scatter_add": scatter_add}
