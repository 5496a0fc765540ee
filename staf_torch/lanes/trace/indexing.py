"""Operations that move entries: torch itself moves the numbers of nodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .graph import WHOLE, Ids
from .loops import scan
from .tracer import LARGE, NotLoweredError, Tracer

_MOVEMENTS = """cat stack index index_select gather flip roll repeat select_scatter slice_scatter index_put
    scatter constant_pad_nd diag_embed tril triu _unsafe_view view_copy expand_copy unfold_copy
    diagonal_scatter as_strided_scatter select_backward slice_backward diagonal_backward index_copy take
    take_along_dim"""
MOVEMENTS = frozenset(_MOVEMENTS.split())


def moved(t: Tracer, func: Any, out: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """The nodes of what an operation of `MOVEMENTS` returns; arguments as of `step.lower`."""
    name = func._schema.name.removeprefix("aten::").removesuffix("_")
    named = [argument.name for argument in func._schema.arguments]
    at = next((k for k, argument in enumerate(named) if argument in ("index", "indices")), None)
    if name == "index_put" and (kwargs.get("accumulate") or (len(args) > 3 and args[3])):
        return _accumulated(t, out, *args[:3])
    if at is not None and any(
        isinstance(i, Tensor) and (t.traced(i) or not t.stated(i)) for i in _listed(args[at])
    ):
        return _indexed(t, name, out, *args, **kwargs)
    kind = t.kind(out.dtype)
    zero = t.graph.constant(0.0, kind)

    def numbers(value: Any, fixed: bool) -> Any:
        if isinstance(value, list | tuple):
            return type(value)(numbers(part, fixed) for part in value)
        if isinstance(value, Tensor) and not fixed:
            nodes = t.nodes(value, kind) - zero  # what torch fills with 0 is then the node of 0
            return torch.from_numpy(np.array(nodes))  # `ascontiguousarray` knows none without dimensions
        return value.cpu() if isinstance(value, Tensor) else value

    values = [numbers(a, position == at) for position, a in enumerate(args)]
    if name in ("scatter", "constant_pad_nd") and not isinstance(args[-1], Tensor | list):
        # a number that torch is to fill with
        values[-1] = t.graph.constant(args[-1], kind) - zero
    result = func(*values, **{k: numbers(v, False) for k, v in kwargs.items()})
    return result.numpy() + zero


def added_at(t: Tracer, out: Tensor, a: Tensor, dim: int, index: Tensor, source: Tensor) -> Ids:
    """Entries added at places along a dimension, also at such as the row computes: the slope of `gather`."""
    kind = t.kind(out.dtype)
    total = np.moveaxis(t.nodes(a, kind), dim, -1).copy()
    at = np.moveaxis(t.nodes(index, WHOLE), dim, -1)
    added = np.moveaxis(t.nodes(source, kind), dim, -1)
    inner = tuple(slice(size) for size in at.shape[:-1])
    part, added, nothing = total[inner], added[inner], t.nodes(0.0, kind)
    for s in range(at.shape[-1]):
        for k in range(total.shape[-1]):
            here = t.map("eq", at[..., s], t.nodes(k, WHOLE))
            part[..., k] = t.map("add", part[..., k], t.map("where", here, added[..., s], nothing))
    return np.moveaxis(total, -1, dim)


def _accumulated(t: Tracer, out: Tensor, a: Tensor, index: Sequence[Tensor | None], source: Tensor) -> Ids:
    """Entries added at an index that no row computes: the slope of an entry that was read twice, say."""
    if any(isinstance(i, Tensor) and (t.traced(i) or not t.stated(i)) for i in index):
        reason = "`aten.index_put` at an index that the row computes cannot be compiled"
        raise NotLoweredError(reason, "scatter_add")
    kind = t.kind(out.dtype)
    places = torch.arange(a.numel(), device="cpu").reshape(a.shape)[
        tuple(slice(None) if i is None else i.cpu() for i in index)
    ]
    nodes = np.broadcast_to(t.nodes(a, kind), a.shape).reshape(-1).copy()
    added = np.broadcast_to(t.nodes(source, kind), tuple(places.shape)).reshape(-1)
    for place, node in zip(places.reshape(-1).tolist(), added, strict=True):
        nodes[place] = t.map("add", np.asarray(nodes[place]), np.asarray(node))
    return nodes.reshape(a.shape)


def _listed(value: Any) -> Sequence[Any]:
    return value if isinstance(value, list | tuple) else [value]


def _indexed(
    t: Tracer,
    name: str,
    out: Tensor,
    a: Tensor,
    dim: Any,
    index: Any = None,
    *rest: Any,
    reduce: str | None = None,
    **_: Any,
) -> Ids:
    """gather, scatter and selection at an index that a row computes, or that numbers of the table do."""
    kind = t.kind(out.dtype)
    if name == "index_put" and len(dim) == 1 and dim[0].dtype == torch.bool and index.numel() == 1:
        chosen = t.nodes(dim[0])  # y[y > 1] = 1
        chosen = chosen.reshape(*chosen.shape, *[1] * (a.dim() - chosen.ndim))
        return t.map("where", chosen, t.nodes(index, kind).reshape(()), t.nodes(a, kind))
    if name == "index" and sum(i is not None for i in dim) == 1:
        axis = next(k for k, i in enumerate(dim) if i is not None)
        name, dim, index = "index_select", axis, dim[axis]
    if name == "index_select" and index.dtype != torch.bool:
        entries = np.moveaxis(t.nodes(a, kind), dim, -1)
        chosen = _chosen(t, entries[(..., *[None] * index.dim(), slice(None))], t.nodes(index, WHOLE))
        return np.moveaxis(chosen, range(a.dim() - 1, chosen.ndim), range(dim, dim + index.dim()))
    if name not in ("gather", "scatter"):
        masked = any(isinstance(i, Tensor) and i.dtype == torch.bool for i in (*_listed(dim), index))
        reason = f"`aten.{name}` at {'a mask' if masked else 'an index'} that the row computes"
        raise NotLoweredError(f"{reason} cannot be compiled", "index" if masked else "gather")
    x = np.moveaxis(t.nodes(a, kind), dim, -1)
    at = np.moveaxis(t.nodes(index, WHOLE), dim, -1)
    if name == "gather":
        x = x[tuple(slice(s) for s in at.shape[:-1])]
        return np.moveaxis(_chosen(t, x[..., None, :], at), -1, dim)
    if reduce is not None:
        raise NotLoweredError("`scatter` with reduce= cannot be compiled; `scatter_add` can")
    source = t.nodes(rest[0], kind)
    source = np.broadcast_to(source, at.shape) if source.ndim == 0 else np.moveaxis(source, dim, -1)
    source = source[tuple(slice(s) for s in at.shape)]
    out_nodes = x.copy()
    part = out_nodes[tuple(slice(s) for s in at.shape[:-1])]
    for s in range(at.shape[-1]):
        for k in range(x.shape[-1]):
            here = t.map("eq", at[..., s], t.nodes(k, WHOLE))
            part[..., k] = t.map("where", here, source[..., s], part[..., k])
    return np.moveaxis(out_nodes, -1, dim)


def _chosen(t: Tracer, x: Ids, at: Ids) -> Ids:
    """Entry ``at`` (...) of the last dimension of arrays (..., K) that broadcast."""
    found: Ids = np.broadcast_arrays(x[..., 0], at)[0]
    for k in range(1, x.shape[-1]):
        found = t.map("where", t.map("eq", at, t.nodes(k, WHOLE)), x[..., k], found)
    return found


def many(name: str, a: Tensor, dim: object, index: object) -> bool:
    """Return whether so many choices are left that they stay a loop: one of `CHOICES` along a dimension."""
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
        source.movedim(dim, 0)
        if isinstance(source, Tensor) and source.dim()
        else torch.as_tensor(source, device=getattr(source, "device", "cpu"))
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
