"""Operations that move entries, and those in terms of simpler torch operations that have a scalar form.

Torch itself moves the numbers of nodes. What `lower` finds in `CHOICES` and `REPLACEMENTS` it traces in
place of the operation of torch. Sizes are those of a state or of a handful of centers: order is found by
comparing every pair, the exponential of a matrix by squaring.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch._decomp import decomposition_table

from .graph import Ids
from .loops import repeat, scan
from .special_functions import digamma, erfinv, polygamma
from .tracer import LARGE, NotLoweredError, Tracer

_MOVEMENTS = """cat stack index index_select gather flip roll repeat select_scatter slice_scatter index_put
    scatter constant_pad_nd diag_embed tril triu _unsafe_view view_copy expand_copy unfold_copy
    diagonal_scatter as_strided_scatter select_backward slice_backward diagonal_backward index_copy take
    take_along_dim"""
MOVEMENTS = frozenset(_MOVEMENTS.split())


def moved(t: Tracer, func: Any, out: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """The nodes of what an operation of `MOVEMENTS` returns; arguments as of `step.lower`."""
    name, at = func._schema.name.removeprefix("aten::").removesuffix("_"), _place_of_index(func)
    if name == "index_put" and (kwargs.get("accumulate") or (len(args) > 3 and args[3])):
        return _accumulated(t, out, *args[:3])
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


@functools.cache
def _place_of_index(func: Any) -> int | None:
    named = [argument.name for argument in func._schema.arguments]
    return next((k for k, argument in enumerate(named) if argument in ("index", "indices")), None)


def choice(
    t: Tracer, func: Any, name: str, args: Sequence[Any], kwargs: dict[str, Any]
) -> Callable[..., Tensor] | None:
    """Return the operation of `CHOICES` where the row, or the table, says at which index; else None."""
    at = _place_of_index(func) if name in MOVEMENTS or name in CHOICES else None
    index = () if at is None else args[at] if isinstance(args[at], list | tuple) else (args[at],)
    dynamic = [i for i in index if isinstance(i, Tensor) and (t.traced(i) or not t.stated(i))]
    if not dynamic:
        return None
    masked = any(i.dtype == torch.bool for i in dynamic)
    if "reduce" in kwargs:
        raise NotLoweredError("`scatter` with reduce= cannot be compiled; `scatter_add` can")
    if (
        name == "index_put"
        and masked
        and len(index) == 1
        and args[2].numel() == 1
        and args[3:] in ((), (False,))
    ):
        return _put_by_mask
    if masked or name not in CHOICES or sum(i is not None for i in index) > 1:
        reason = (
            f"`aten.{name}` at {'a mask' if masked else 'an index'} that the row computes cannot be compiled"
        )
        instead = "index" if masked else "scatter_add" if name == "index_put" else "gather"
        raise NotLoweredError(reason, instead)
    return CHOICES[name]


def _accumulated(t: Tracer, out: Tensor, a: Tensor, index: Sequence[Tensor | None], source: Tensor) -> Ids:
    """Entries added at an index that no row computes: the slope of an entry that was read twice, say."""
    kind = t.kind(out.dtype)
    places = torch.arange(a.numel(), device="cpu").reshape(a.shape)[
        tuple(slice(None) if i is None else i.cpu() for i in index)
    ]
    nodes = np.broadcast_to(t.nodes(a, kind), a.shape).reshape(-1).copy()
    added = np.broadcast_to(t.nodes(source, kind), tuple(places.shape)).reshape(-1)
    for place, node in zip(places.reshape(-1).tolist(), added, strict=True):
        nodes[place] = t.map("add", np.asarray(nodes[place]), np.asarray(node))
    return nodes.reshape(a.shape)


def _put_by_mask(a: Tensor, mask: Sequence[Tensor], value: Tensor, accumulate: bool = False) -> Tensor:
    """y[mask] = one number."""
    chosen = mask[0].reshape(*mask[0].shape, *[1] * (a.dim() - mask[0].dim()))
    return torch.where(chosen, value.reshape(()), a)


def gather(a: Tensor, dim: int, index: Tensor, *, sparse_grad: bool = False) -> Tensor:
    """Entry index_i along a dimension: as `torch.gather`."""
    at = index.movedim(dim, -1)
    entries = a.movedim(dim, 0)[(slice(None), *(slice(size) for size in at.shape[:-1]))]
    start = entries[0].unsqueeze(-1).expand(at.shape).clone()

    def choose(found: Tensor, now: tuple[Tensor, Tensor]) -> tuple[Tensor, tuple[()]]:
        entry, place = now
        return torch.where(at == place, entry.unsqueeze(-1), found), ()

    others = entries[1:], _places(a, dim)[1:]
    found: Tensor = (
        scan(choose, start, others, dim=0, unrolled=_few(a, dim, index))[0] if len(entries) > 1 else start
    )
    return found.movedim(-1, dim).clone()


def index_select(a: Tensor, dim: int, index: Tensor) -> Tensor:
    """The entries index_i along a dimension: as `torch.index_select`."""
    shape = list(a.shape)
    shape[dim] = index.numel()
    spread = index.reshape([-1 if k == dim % a.dim() else 1 for k in range(a.dim())])
    return gather(a, dim, spread.expand(shape))


def _indexed(a: Tensor, index: Sequence[Tensor | None]) -> Tensor:
    """a[..., index], counted from the end where it is negative."""
    dim, at = next((k, i) for k, i in enumerate(index) if i is not None)
    at = torch.where(at < 0, at + a.shape[dim], at)
    found = index_select(a, dim, at.reshape(-1))
    return found.reshape(*a.shape[:dim], *at.shape, *a.shape[dim + 1 :])


def scatter(a: Tensor, dim: int, index: Tensor, source: Tensor | float) -> Tensor:
    """A tensor with other entries at index_i along a dimension, the last of equal places: `torch.scatter`."""
    return _put(a, dim, index, source, lambda before, here, value: torch.where(here, value, before))


def scatter_add(a: Tensor, dim: int, index: Tensor, source: Tensor) -> Tensor:
    """A tensor with entries added at index_i along a dimension: as `torch.scatter_add`."""
    return _put(a, dim, index, source, lambda before, here, value: before + torch.where(here, value, 0.0))


Change = Callable[[Tensor, Tensor, Tensor], Tensor]


def _put(a: Tensor, dim: int, index: Tensor, source: Tensor | float, after: Change) -> Tensor:
    at = index.movedim(dim, 0)
    values = torch.as_tensor(source, device=a.device).to(a.dtype)
    inner = tuple(slice(size) for size in at.shape[1:])
    values = values.movedim(dim, 0)[(slice(at.shape[0]), *inner)] if values.dim() else values.expand(at.shape)
    whole = a.movedim(dim, -1)
    place = _places(a, dim)

    def put(part: Tensor, now: tuple[Tensor, Tensor]) -> tuple[Tensor, tuple[()]]:
        here, value = now
        return after(part, here.unsqueeze(-1) == place, value.unsqueeze(-1)), ()

    part: Tensor = scan(put, whole[inner].clone(), (at, values), dim=0, unrolled=_few(a, dim, index))[0]
    if part.shape != whole.shape:
        out = whole.clone()
        out[inner] = part
        part = out
    return part.movedim(-1, dim).clone()


def _places(a: Tensor, dim: int) -> Tensor:
    return torch.arange(a.shape[dim], device=a.device)


def _few(a: Tensor, dim: int, index: Tensor) -> bool:
    """Return whether so few choices are left that they are written out."""
    return index.numel() * a.shape[dim] <= 2 * LARGE


CHOICES: dict[str, Callable[..., Tensor]] = {
    "gather": gather,
    "index": _indexed,
    "index_select": index_select,
    "scatter": scatter,
    "scatter_add": scatter_add,
}

_OF_TORCH = "torch._decomp.decompositions"
_TERMS = 14  # of the Taylor series; the rest is 2e-17 for a matrix of norm 1/2
_HALVINGS = 64  # at most: beyond a norm of 1e19 nothing is left of it


def of_torch(func: Any, args: Sequence[Any]) -> Callable[..., Any] | None:
    """Return torch's own decomposition of an operation, None where there is none.

    That of tensors of one floating dtype comes without the promotion of dtypes around it, which changes
    nothing then: it imports sympy, half a second in every process.
    """
    found: Callable[..., Any] | None = decomposition_table.get(func)
    dtypes = {each.dtype for each in args if isinstance(each, Tensor)}
    if found is None or len(dtypes) != 1 or not dtypes < {torch.float32, torch.float64}:
        return found
    bare: Callable[..., Any] = inspect.unwrap(found)
    return bare if bare.__module__ == _OF_TORCH else found


def sort(
    x: Tensor, dim: int = -1, descending: bool = False, *, stable: bool | None = True
) -> tuple[Tensor, Tensor]:
    """The entries in their order and their places, NaN above all; equal entries stay in their order."""
    if x.dim() == 0:
        return x.clone(), torch.zeros_like(x, dtype=torch.int64)
    moved = x.movedim(dim, -1)
    one, other = moved.unsqueeze(-1), moved.unsqueeze(-2)  # other stands before one
    low, high = (one, other) if descending else (other, one)
    before = (low < high) | (low == low) & (high != high)
    after = (high < low) | (high == high) & (low != low)
    earlier = torch.ones(x.shape[dim], x.shape[dim], dtype=torch.bool, device=x.device).tril(-1)
    rank = (before | ~after & earlier).to(torch.int64).sum(-1)
    place = torch.arange(x.shape[dim], device=x.device)
    places = ((rank.unsqueeze(-2) == place.unsqueeze(-1)).to(torch.int64) * place).sum(-1)
    return moved.gather(-1, places).movedim(-1, dim), places.movedim(-1, dim).clone()


def topk(
    x: Tensor, k: int, dim: int = -1, largest: bool = True, sorted: bool = True
) -> tuple[Tensor, Tensor]:
    """The k largest or smallest entries and their places."""
    values, places = sort(x, dim, descending=largest)
    return values.narrow(dim, 0, k).clone(), places.narrow(dim, 0, k).clone()


def kthvalue(x: Tensor, k: int, dim: int = -1, keepdim: bool = False) -> tuple[Tensor, Tensor]:
    """The k-th smallest entry, k from 1, and its place."""
    found = [part.narrow(dim, k - 1, 1) for part in sort(x, dim)]
    values, places = (part.clone() if keepdim else part.squeeze(dim).clone() for part in found)
    return values, places


def median(x: Tensor, dim: int | None = None, keepdim: bool = False) -> Any:
    """The lower median of all entries, or along a dimension with its place; NaN where there is one."""
    if dim is None:
        return median(x.reshape(-1), 0)[0]
    values, places = sort(x, dim)
    count = x.shape[dim]
    lost = values.narrow(dim, count - 1, 1).isnan()
    found = [
        torch.where(lost, part.narrow(dim, count - 1, 1), part.narrow(dim, (count - 1) // 2, 1))
        for part in (values, places)
    ]
    return tuple(found if keepdim else (part.squeeze(dim) for part in found))


def _running(x: Tensor, dim: int, *, beats: Callable[[Tensor, Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """The extreme entry so far and its place; NaN is the extreme of all."""
    parts = x.unbind(dim)
    best, place = parts[0], torch.zeros_like(parts[0], dtype=torch.int64)
    values, places = [best], [place]
    for k, part in enumerate(parts[1:], start=1):
        taken = beats(part, best) | (part != part)
        best, place = torch.where(taken, part, best), torch.where(taken, k, place)
        values.append(best)
        places.append(place)
    return torch.stack(values, dim), torch.stack(places, dim)


def cumprod(x: Tensor, dim: int, *, dtype: torch.dtype | None = None) -> Tensor:
    """The products of the entries so far."""
    parts = list((x if dtype is None else x.to(dtype)).unbind(dim))
    for k in range(1, len(parts)):
        parts[k] = parts[k - 1] * parts[k]
    return torch.stack(parts, dim)


def logcumsumexp(x: Tensor, dim: int) -> Tensor:
    """The logarithms of the sums of the exponentials so far."""
    parts = list(x.unbind(dim)) if x.dim() else [x]
    for k in range(1, len(parts)):
        parts[k] = torch.logaddexp(parts[k - 1], parts[k])
    return torch.stack(parts, dim) if x.dim() else x.clone()


def _product(x: Tensor, dims: Sequence[int] | None, *, output_dtype: torch.dtype | None = None) -> Tensor:
    axes = range(x.dim()) if dims is None else [d % x.dim() for d in dims]
    x = x if output_dtype is None else x.to(output_dtype)
    for dim in sorted(axes, reverse=True):
        x = x.prod(dim)
    return x


def _sum(x: Tensor, dims: Sequence[int] | None, *, output_dtype: torch.dtype | None = None) -> Tensor:
    return x.sum(list(range(x.dim()) if dims is None else dims), dtype=output_dtype)


def _variance(
    x: Tensor, dims: Sequence[int] | None, correction: float = 1, *, output_dtype: torch.dtype | None = None
) -> Tensor:
    axes = list(range(x.dim()) if dims is None else dims)
    count = torch.Size(x.shape[d] for d in axes).numel()
    square = (x - x.mean(axes, keepdim=True)).square().sum(axes)
    return square / max(0.0, count - correction)


def searchsorted(
    boundaries: Tensor,
    x: Tensor | float,
    *,
    out_int32: bool = False,
    right: bool = False,
    side: str | None = None,
    sorter: Tensor | None = None,
) -> Tensor:
    """Count the boundaries before x; NaN is above all."""
    if not isinstance(x, Tensor) or sorter is not None:
        raise NotLoweredError("`searchsorted` of a number or with a sorter cannot be compiled")
    at = x.unsqueeze(-1)
    edges = boundaries if boundaries.dim() == 1 else boundaries.unsqueeze(-2)
    passed = ~(edges > at) if right or side == "right" else ~(edges >= at)
    return passed.sum(-1)


def _of_numbers(a: Tensor, b: Tensor, *, pick: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """The extreme of two; what is a number where the other is NaN."""
    return torch.where(a.isnan(), b, torch.where(b.isnan(), a, pick(a, b)))


def angle(x: Tensor) -> Tensor:
    """The angle of real numbers: 0, or pi where negative; NaN of NaN."""
    return torch.where(x < 0, torch.pi, torch.where(x != x, x, 0.0))


def _shrink_backward(slope: Tensor, x: Tensor, bound: float) -> Tensor:
    return torch.where((x >= -bound) & (x <= bound), 0.0, slope)


def _trilinear(
    a: Tensor,
    b: Tensor,
    c: Tensor,
    of_a: Sequence[int],
    of_b: Sequence[int],
    of_c: Sequence[int],
    summed: Sequence[int],
    unroll_dim: int = 1,
) -> Tensor:
    """A sum of products of three tensors, with dimensions of size 1 put into each: `torch.nn.Bilinear`."""
    parts = []
    for x, dims in ((a, of_a), (b, of_b), (c, of_c)):
        for dim in dims:
            x = x.unsqueeze(dim)
        parts.append(x)
    product = parts[0] * parts[1] * parts[2]
    return product.sum(list(summed)) if summed else product


def matrix_exponential(matrix: Tensor) -> Tensor:
    """e^A (..., N, N): A is halved until its norm is 1/2, the series of that is squared as often.

    A row squares as often as its largest matrix asks for. Source: Moler and Van Loan, "Nineteen dubious ways
    to compute the exponential of a matrix, twenty-five years later", SIAM Review 45 (2003), method 3.
    """
    size = matrix.shape[-1]
    rows = matrix if matrix.dim() > 2 else matrix.unsqueeze(0)
    largest = rows.abs().sum(-2).reshape(len(rows), -1).amax(-1)  # (B,): no matrix's 1-norm is larger
    halvings = torch.where(largest > 0.5, (2 * largest).log2().ceil(), 0.0).clamp(max=_HALVINGS).to(rows)
    small = rows * (-halvings).exp2().reshape(-1, *[1] * (rows.dim() - 1))
    one = torch.eye(size, dtype=rows.dtype, device=rows.device).expand(rows.shape).clone()

    def term(total: Tensor, share: Tensor) -> tuple[Tensor, tuple[()]]:
        return one + share * (small @ total), ()

    shares = 1 / torch.arange(_TERMS, 0, -1, dtype=rows.dtype, device=rows.device)
    series: Tensor = scan(term, one, shares, dim=0)[0]

    def squared(now: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        power, left = now
        return power @ power, left - 1

    found: Tensor = repeat(_HALVINGS, squared, (series, halvings), where=lambda now: now[1] > 0)[0]
    return found.reshape(matrix.shape)


REPLACEMENTS: dict[str, Callable[..., Any]] = {
    "scatter_add": scatter_add,
    "sort": sort,
    "topk": topk,
    "kthvalue": kthvalue,
    "median": median,
    "cummax": functools.partial(_running, beats=torch.ge),
    "cummin": functools.partial(_running, beats=torch.le),
    "cumprod": cumprod,
    "logcumsumexp": logcumsumexp,
    "prims::prod": _product,
    "prims::sum": _sum,
    "prims::var": _variance,
    "searchsorted": searchsorted,
    "angle": angle,
    "prims::erf_inv": erfinv,
    "prims::digamma": digamma,
    "polygamma": polygamma,
    "softshrink_backward": _shrink_backward,
    "hardshrink_backward": _shrink_backward,
    "_trilinear": _trilinear,
    "linalg_matrix_exp": matrix_exponential,
    "fmin": functools.partial(_of_numbers, pick=torch.minimum),
    "fmax": functools.partial(_of_numbers, pick=torch.maximum),
}
