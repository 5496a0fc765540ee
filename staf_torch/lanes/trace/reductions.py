"""Operations on entries together: sums, extremes, norms, products."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from .graph import FLAG, NARROW, REAL, WHOLE, Ids
from .rules import RULES, numbers, rule, zeros
from .tracer import LARGE, NotLoweredError, Tracer

_FEW = 8  # numbers that need no loop


def _rows(array: Ids, dims: Any, keepdim: bool) -> tuple[Ids, Callable[[Ids], Ids]]:
    """The array with the reduced dimensions last as one, and how a result gets its shape."""
    if array.ndim == 0:
        return array.reshape(1), lambda out: out.reshape(())
    given = (
        range(array.ndim) if dims is None or dims == [] else dims if isinstance(dims, Sequence) else [dims]
    )
    axes = sorted(d % array.ndim for d in given)
    rest = [d for d in range(array.ndim) if d not in axes]
    flat = array.transpose([*rest, *axes]).reshape([*(array.shape[d] for d in rest), -1])
    return flat, lambda out: np.expand_dims(out, tuple(axes)) if keepdim else out


def _chain(t: Tracer, op: str, flat: Ids) -> Ids:
    if op in ("and", "or"):  # halves, an odd entry in both: every loop goes on in the next one's place
        while flat.size > LARGE and flat.shape[-1] > 1:
            half = -(-flat.shape[-1] // 2)
            flat = t.map(op, flat[..., :half], flat[..., -half:], least=_FEW)
    if op != "mul":  # in pairs, the order being free: g++ takes minutes over a long chain of choices
        least = _FEW if flat.size > LARGE else LARGE  # what is in memory stays there until little is left
        while flat.shape[-1] > 1:
            odd = flat[..., flat.shape[-1] // 2 * 2 :]
            paired = t.map(op, flat[..., 0:-1:2], flat[..., 1::2], least=least)
            flat = np.concatenate((paired, odd), axis=-1)
    out: Ids = flat[..., 0]
    for k in range(1, flat.shape[-1]):
        out = t.map(op, out, flat[..., k])
    return out


@rule("sum")
def _sum(t: Tracer, out: Tensor, a: Tensor, dims: Any = None, keepdim: bool = False, **_: Any) -> Ids:
    flat, shaped = _rows(t.nodes(a, t.kind(out.dtype)), dims, keepdim)
    return shaped(t.total(flat)) if flat.shape[-1] else zeros(t, out)


@rule("mean")
def _mean(t: Tracer, out: Tensor, a: Tensor, dims: Any = None, keepdim: bool = False, **_: Any) -> Ids:
    flat, shaped = _rows(t.nodes(a, t.kind(out.dtype)), dims, keepdim)
    return shaped(t.map("div", t.total(flat), t.nodes(float(flat.shape[-1]), t.kind(out.dtype))))


def _reduction(op: str, kind: str | None, *names: str) -> None:
    def rule(t: Tracer, out: Tensor, a: Tensor, dims: Any = None, keepdim: bool = False, **_: Any) -> Ids:
        flat, shaped = _rows(t.nodes(a, kind or t.kind(out.dtype)), dims, keepdim)
        return shaped(_chain(t, op, flat))

    RULES.update(dict.fromkeys(names, rule))


_reduction("max", None, "amax")
_reduction("min", None, "amin")
_reduction("and", FLAG, "all")
_reduction("or", FLAG, "any")
_reduction("mul", None, "prod")


def _extreme(name: str, op: str) -> None:
    def positions(t: Tracer, flat: Ids) -> tuple[Ids, Ids]:
        best, at = flat[..., 0], np.broadcast_to(t.nodes(0, WHOLE), flat.shape[:-1])
        for k in range(1, flat.shape[-1]):
            new = flat[..., k]
            further = t.map("lt", best, new) if op == "max" else t.map("lt", new, best)
            lost = t.map("and", t.map("ne", new, new), t.map("eq", best, best))  # NaN is the extreme of all
            taken = t.map("or", further, lost)
            best, at = t.map("where", taken, new, best), t.map("where", taken, t.nodes(k, WHOLE), at)
        return best, at

    def rule(t: Tracer, out: Any, a: Tensor, dim: int | None = None, keepdim: bool = False) -> Any:
        flat, shaped = _rows(t.nodes(a), dim, keepdim)
        if isinstance(out, Tensor):
            return shaped(_chain(t, op, flat))
        return [shaped(part) for part in positions(t, flat)]

    def argument(t: Tracer, out: Tensor, a: Tensor, dim: int | None = None, keepdim: bool = False) -> Ids:
        flat, shaped = _rows(t.nodes(a), dim, keepdim)
        return shaped(positions(t, flat)[1])

    RULES[name] = lambda t, out, a, *rest: (
        t.map(op, *numbers(t, t.kind(out.dtype), a, rest[0]))
        if rest and isinstance(rest[0], Tensor)
        else rule(t, out, a, *rest)
    )
    RULES[f"arg{name}"] = argument


_extreme("max", "max")
_extreme("min", "min")


@rule("cumsum")
def _cumsum(t: Tracer, out: Tensor, a: Tensor, dim: int, **_: Any) -> Ids:
    kind = t.kind(out.dtype)
    moved = np.moveaxis(t.nodes(a, REAL if kind == NARROW else kind), dim, 0)  # torch sums floats in double
    parts = [moved[0]]
    for part in moved[1:]:
        parts.append(t.map("add", parts[-1], part))
    return t.cast(np.moveaxis(np.stack(parts), 0, dim), kind)


@rule("linalg_vector_norm")
def _norm(
    t: Tracer, out: Tensor, a: Tensor, order: float = 2, dims: Any = None, keepdim: bool = False, **_: Any
) -> Ids:
    flat, shaped = _rows(t.nodes(a, t.kind(out.dtype)), dims, keepdim)
    return shaped(_length(t, flat, order))


def _length(t: Tracer, flat: Ids, order: float) -> Ids:
    """The norm over the last dimension."""
    if order == 2:
        return t.map("sqrt", t.total(t.map("mul", flat, flat)))
    size = t.map("abs", flat)
    if math.isinf(order):
        return _chain(t, "max" if order > 0 else "min", size)
    kind = t.graph.type[int(flat.flat[0])]
    if order == 0:
        return t.total(t.cast(t.map("ne", size, t.nodes(0.0, kind)), kind))
    if order == 1:
        return t.total(size)
    return t.map(
        "pow", t.total(t.map("pow", size, t.nodes(float(order), kind))), t.nodes(1 / float(order), kind)
    )


@rule("_cdist_forward")
def _distances(t: Tracer, out: Tensor, a: Tensor, b: Tensor, order: float, mode: int | None) -> Ids:
    x, y = numbers(t, t.kind(out.dtype), a, b)
    return _length(t, t.map("sub", x[..., :, None, :], y[..., None, :, :]), order)


@rule("_cdist_backward")
def _slope_of_distances(
    t: Tracer, out: Tensor, slope: Tensor, a: Tensor, b: Tensor, order: float, distances: Tensor
) -> Ids:
    if order != 2:
        raise NotLoweredError(f"the slope of distances of order {order} cannot be compiled")
    kind = t.kind(out.dtype)
    g, x, y, r = numbers(t, kind, slope, a, b, distances)
    nothing, one = t.nodes(0.0, kind), t.nodes(1.0, kind)
    apart = t.map("ne", r, nothing)  # torch: no slope where two points meet
    share = t.map("where", apart, t.map("div", g, t.map("where", apart, r, one)), nothing)
    away = t.map("sub", x[..., :, None, :], y[..., None, :, :])
    return t.total(np.moveaxis(t.map("mul", share[..., None], away), -2, -1))


# Products.


@rule("mm", "bmm")
def _mm(t: Tracer, out: Tensor, a: Tensor, b: Tensor) -> Ids:
    x, y = numbers(t, t.kind(out.dtype), a, b)
    return t.products(x[..., :, None, :], np.swapaxes(y, -1, -2)[..., None, :, :])


@rule("mv")
def _mv(t: Tracer, out: Tensor, a: Tensor, b: Tensor) -> Ids:
    return t.products(*numbers(t, t.kind(out.dtype), a, b))


RULES["dot"] = RULES["vdot"] = _mv


@rule("addmm", "baddbmm", "addmv")
def _addmm(
    t: Tracer, out: Tensor, bias: Tensor, a: Tensor, b: Tensor, beta: float = 1, alpha: float = 1
) -> Ids:
    kind = t.kind(out.dtype)
    product, added = (_mv if b.dim() == 1 else _mm)(t, out, a, b), t.nodes(bias, kind)
    product = product if alpha == 1 else t.map("mul", t.nodes(float(alpha), kind), product)
    if beta == 0:  # torch: also where the other is no number
        return product
    return t.map("add", product, added if beta == 1 else t.map("mul", t.nodes(float(beta), kind), added))
