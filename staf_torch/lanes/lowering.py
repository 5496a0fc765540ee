"""What every tensor operation is in single numbers."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch._decomp import decomposition_table

from .eliminations import FACTORISATIONS
from .graph import FLAG, REAL, WHOLE, Ids
from .tracer import NotLoweredError, Tracer

Rule = Callable[..., Any]
_RULES: dict[str, Rule] = {}
_LARGEST_POWER = 64


def lower(t: Tracer, func: Any, name: str, out: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """The nodes of what an operation returns: an array, or a list of them.

    Args:
        t: knows the nodes of the arguments.
        func: the operation.
        name: its name without overload.
        out: what torch returned, for shapes and dtypes.
        args, kwargs: of the operation.

    Raises:
        NotLoweredError: if there is no rule.
    """
    rule = _RULES.get(name)
    if rule is not None:
        return rule(t, out, *args, **kwargs)
    if name in _MOVEMENTS:
        return _moved(t, func, out, args, kwargs)
    decomposition = FACTORISATIONS.get(name) or decomposition_table.get(func)
    if decomposition is None and func._can_decompose():  # of several operations, also in torch
        decomposition = func.decompose
    if decomposition is None:
        raise NotLoweredError(f"`{func}` has no scalar form here")
    with t:
        result = decomposition(*args, **kwargs)
    parts = [result] if isinstance(result, Tensor) else list(result)
    nodes = [t.nodes(part) for part in parts]
    return nodes[0] if isinstance(result, Tensor) else nodes


def _rule(*names: str) -> Callable[[Rule], Rule]:
    def register(rule: Rule) -> Rule:
        _RULES.update(dict.fromkeys(names, rule))
        return rule

    return register


# Entry by entry.


def _common(t: Tracer, *values: Any) -> str:
    """The type in which torch computes with these together."""
    given = [v for v in values if v is not None]
    dtype = functools.reduce(torch.promote_types, [torch.result_type(v, w) for v in given for w in given])
    return t.kind(dtype)


def _numbers(t: Tracer, kind: str, *values: Any) -> list[Ids]:
    return [t.nodes(value, kind) for value in values]


def _entrywise(name: str, op: str | None = None) -> None:
    def rule(t: Tracer, out: Tensor, *args: Any) -> Ids:
        return t.map(op or name, *_numbers(t, t.kind(out.dtype), *args))

    _RULES[name] = rule


for _name in ("neg", "abs", "sqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "tanh", "atan2"):
    _entrywise(_name)
for _name in (
    "asin",
    "acos",
    "atan",
    "sinh",
    "cosh",
    "log2",
    "log10",
    "exp2",
    "erf",
    "floor",
    "ceil",
    "trunc",
):
    _entrywise(_name)
for _name, _op in (("maximum", "max"), ("minimum", "min"), ("mul", "mul")):
    _entrywise(_name, _op)


@_rule("add", "sub", "rsub")
def _sum_of_two(t: Tracer, out: Tensor, a: Any, b: Any, alpha: Any = 1, _name: str = "add") -> Ids:
    kind = t.kind(out.dtype)
    left, right = _numbers(t, kind, a, b)
    if alpha != 1:
        right = t.map("mul", right, t.nodes(alpha, kind))
    return t.map(_name, left, right)


_RULES["sub"] = functools.partial(_sum_of_two, _name="sub")
_RULES["rsub"] = lambda t, out, a, b, alpha=1: _sum_of_two(t, out, b, _times(t, out, a, alpha), _name="sub")


def _times(t: Tracer, out: Tensor, a: Tensor, alpha: Any) -> Tensor:
    if alpha != 1:
        raise NotLoweredError("`aten.rsub` with alpha has no scalar form here")
    return a


@_rule("div")
def _div(t: Tracer, out: Tensor, a: Any, b: Any, rounding_mode: str | None = None) -> Ids:
    kind = t.kind(out.dtype) if out.dtype.is_floating_point else REAL
    quotient = t.map("div", *_numbers(t, kind, a, b))
    if rounding_mode is not None:
        quotient = t.map(rounding_mode, quotient)
    return t.cast(quotient, t.kind(out.dtype))


@_rule("reciprocal")
def _reciprocal(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    kind = t.kind(out.dtype)
    return t.map("div", t.nodes(1.0, kind), t.nodes(a, kind))


@_rule("rsqrt")
def _rsqrt(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    return t.map("div", t.nodes(1.0, t.kind(out.dtype)), t.map("sqrt", t.nodes(a, t.kind(out.dtype))))


@_rule("sigmoid")
def _sigmoid(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    kind = t.kind(out.dtype)
    one = t.nodes(1.0, kind)
    return t.map("div", one, t.map("add", one, t.map("exp", t.map("neg", t.nodes(a, kind)))))


@_rule("round")
def _round(t: Tracer, out: Tensor, a: Tensor, decimals: int = 0) -> Ids:
    if decimals:
        raise NotLoweredError("`aten.round` to decimals has no scalar form here")
    return t.map("round", t.nodes(a))


@_rule("frac")
def _frac(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    return t.map("sub", t.nodes(a), t.map("trunc", t.nodes(a)))


@_rule("remainder", "fmod")
def _remainder(t: Tracer, out: Tensor, a: Any, b: Any) -> Ids:
    raise NotLoweredError("a remainder has no scalar form here")


@_rule("sign", "sgn")
def _sign(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    x, kind = t.nodes(a), t.kind(a.dtype)
    zero = t.nodes(0.0, kind)
    up, down = (t.cast(flag, kind) for flag in (t.map("lt", zero, x), t.map("lt", x, zero)))
    return t.map("sub", up, down)


@_rule("pow")
def _pow(t: Tracer, out: Tensor, a: Any, power: Any) -> Ids:
    kind = t.kind(out.dtype)
    base = t.nodes(a, kind)
    stated = isinstance(power, Tensor) and not t.traced(power) and t.stated(power)
    exponents = power.tolist() if stated else power
    if isinstance(exponents, int | float):
        return _power(t, kind, base, exponents)
    if stated and power.dim() > 0:
        flat = np.broadcast_to(base, out.shape).reshape(-1)
        each = power.expand(out.shape).reshape(-1).tolist()
        return np.array([_power(t, kind, np.asarray(n), e) for n, e in zip(flat, each, strict=True)]).reshape(
            out.shape
        )
    return t.map("pow", base, t.nodes(power, kind))


def _power(t: Tracer, kind: str, base: Ids, exponent: float) -> Ids:
    if exponent == 0.5:
        return t.map("sqrt", base)
    if exponent != int(exponent) or abs(exponent) > _LARGEST_POWER:
        return t.map("pow", base, t.nodes(float(exponent), kind))
    if exponent < 0:
        return t.map("div", t.nodes(1.0, kind), _power(t, kind, base, -exponent))
    if exponent == 0:
        return np.broadcast_to(t.nodes(1.0, kind), np.shape(base))
    half = _power(t, kind, base, int(exponent) // 2) if exponent > 1 else None
    square = None if half is None else t.map("mul", half, half)
    return base if square is None else t.map("mul", square, base) if exponent % 2 else square


@_rule("clamp")
def _clamp(t: Tracer, out: Tensor, a: Tensor, low: Any = None, high: Any = None) -> Ids:
    kind = t.kind(out.dtype)
    x = t.nodes(a, kind)
    x = x if low is None else t.map("max", x, t.nodes(low, kind))
    return x if high is None else t.map("min", x, t.nodes(high, kind))


_RULES["clamp_min"] = lambda t, out, a, low: _clamp(t, out, a, low)
_RULES["clamp_max"] = lambda t, out, a, high: _clamp(t, out, a, None, high)


@_rule("addcmul")
def _addcmul(t: Tracer, out: Tensor, a: Tensor, b: Tensor, c: Tensor, value: float = 1) -> Ids:
    x, y, z, factor = _numbers(t, t.kind(out.dtype), a, b, c, value)
    return t.map("add", x, t.map("mul", factor, t.map("mul", y, z)))


@_rule("addcdiv")
def _addcdiv(t: Tracer, out: Tensor, a: Tensor, b: Tensor, c: Tensor, value: float = 1) -> Ids:
    x, y, z, factor = _numbers(t, t.kind(out.dtype), a, b, c, value)
    return t.map("add", x, t.map("mul", factor, t.map("div", y, z)))


@_rule("lerp")
def _lerp(t: Tracer, out: Tensor, a: Tensor, b: Tensor, weight: Any) -> Ids:
    x, y, w = _numbers(t, t.kind(out.dtype), a, b, weight)
    return t.map("add", x, t.map("mul", w, t.map("sub", y, x)))


def _comparison(name: str, op: str, swapped: bool) -> None:
    def rule(t: Tracer, out: Tensor, a: Any, b: Any) -> Ids:
        kind = _common(t, a, b)
        left, right = _numbers(t, REAL if kind == FLAG else kind, a, b)
        return t.map(op, right, left) if swapped else t.map(op, left, right)

    _RULES[name] = rule


for _name, _op, _swap in (("lt", "lt", False), ("gt", "lt", True), ("le", "le", False), ("ge", "le", True)):
    _comparison(_name, _op, _swap)
for _name in ("eq", "ne"):
    _comparison(_name, _name, False)


def _logic(op: str, *names: str) -> None:
    def rule(t: Tracer, out: Tensor, *args: Any) -> Ids:
        if out.dtype != torch.bool:
            raise NotLoweredError("logic on the bits of integers has no scalar form here")
        return t.map(op, *_numbers(t, FLAG, *args))

    _RULES.update(dict.fromkeys(names, rule))


_logic("and", "logical_and", "bitwise_and", "__and__")
_logic("or", "logical_or", "bitwise_or", "__or__")
_logic("xor", "logical_xor", "bitwise_xor", "__xor__")
_logic("not", "logical_not", "bitwise_not")
_multiply = _RULES["mul"]
_RULES["mul"] = lambda t, out, a, b: (
    t.map("and", *_numbers(t, FLAG, a, b)) if out.dtype == torch.bool else _multiply(t, out, a, b)
)


@_rule("isnan")
def _isnan(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    return t.map("ne", t.nodes(a), t.nodes(a))


@_rule("where")
def _where(t: Tracer, out: Tensor, chosen: Tensor, a: Any, b: Any) -> Ids:
    kind = t.kind(out.dtype)
    return t.map("where", t.nodes(chosen, FLAG), t.nodes(a, kind), t.nodes(b, kind))


@_rule("masked_fill")
def _masked_fill(t: Tracer, out: Tensor, a: Tensor, mask: Tensor, value: Any) -> Ids:
    kind = t.kind(out.dtype)
    return t.map("where", t.nodes(mask, FLAG), t.nodes(value, kind), t.nodes(a, kind))


@_rule("_to_copy", "clone", "copy", "lift_fresh_copy", "contiguous", "detach_copy")
def _copied(t: Tracer, out: Tensor, a: Any, *source: Any, **_: Any) -> Ids:
    given = source[0] if source and isinstance(source[0], Tensor) else a
    return np.broadcast_to(t.nodes(given, t.kind(out.dtype)), out.shape)


@_rule("zeros_like", "new_zeros", "zero", "_new_zeros_with_same_feature_meta")
def _zeros(t: Tracer, out: Tensor, *_: Any, **__: Any) -> Ids:
    return np.full(out.shape, t.graph.constant(0.0, t.kind(out.dtype)), dtype=np.int64)


@_rule("ones_like", "new_ones")
def _ones(t: Tracer, out: Tensor, *_: Any, **__: Any) -> Ids:
    return np.full(out.shape, t.graph.constant(1.0, t.kind(out.dtype)), dtype=np.int64)


@_rule("full_like", "new_full", "fill", "empty_like", "new_empty", "new_empty_strided")
def _full(t: Tracer, out: Tensor, *args: Any, **_: Any) -> Ids:
    value = args[-1] if len(args) > 1 and not isinstance(args[-1], list | tuple) else 0.0
    return np.broadcast_to(t.nodes(value, t.kind(out.dtype)), out.shape)


# Entries together.


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
    if op != "mul":  # in pairs, the order being free: g++ takes minutes over a long chain of choices
        while flat.shape[-1] > 1:
            odd = flat[..., flat.shape[-1] // 2 * 2 :]
            flat = np.concatenate((t.map(op, flat[..., 0:-1:2], flat[..., 1::2]), odd), axis=-1)
    out: Ids = flat[..., 0]
    for k in range(1, flat.shape[-1]):
        out = t.map(op, out, flat[..., k])
    return out


@_rule("sum")
def _sum(t: Tracer, out: Tensor, a: Tensor, dims: Any = None, keepdim: bool = False, **_: Any) -> Ids:
    flat, shaped = _rows(t.nodes(a, t.kind(out.dtype)), dims, keepdim)
    return shaped(t.total(flat)) if flat.shape[-1] else _zeros(t, out)


@_rule("mean")
def _mean(t: Tracer, out: Tensor, a: Tensor, dims: Any = None, keepdim: bool = False, **_: Any) -> Ids:
    flat, shaped = _rows(t.nodes(a, t.kind(out.dtype)), dims, keepdim)
    return shaped(t.map("div", t.total(flat), t.nodes(float(flat.shape[-1]), t.kind(out.dtype))))


def _reduction(op: str, kind: str | None, *names: str) -> None:
    def rule(t: Tracer, out: Tensor, a: Tensor, dims: Any = None, keepdim: bool = False, **_: Any) -> Ids:
        flat, shaped = _rows(t.nodes(a, kind or t.kind(out.dtype)), dims, keepdim)
        return shaped(_chain(t, op, flat))

    _RULES.update(dict.fromkeys(names, rule))


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

    _RULES[name] = lambda t, out, a, *rest: (
        t.map(op, *_numbers(t, t.kind(out.dtype), a, rest[0]))
        if rest and isinstance(rest[0], Tensor)
        else rule(t, out, a, *rest)
    )
    _RULES[f"arg{name}"] = argument


_extreme("max", "max")
_extreme("min", "min")


@_rule("cumsum")
def _cumsum(t: Tracer, out: Tensor, a: Tensor, dim: int, **_: Any) -> Ids:
    moved = np.moveaxis(t.nodes(a, t.kind(out.dtype)), dim, 0)
    parts = [moved[0]]
    for part in moved[1:]:
        parts.append(t.map("add", parts[-1], part))
    return np.moveaxis(np.stack(parts), 0, dim)


@_rule("linalg_vector_norm")
def _norm(
    t: Tracer, out: Tensor, a: Tensor, order: float = 2, dims: Any = None, keepdim: bool = False, **_: Any
) -> Ids:
    flat, shaped = _rows(t.nodes(a, t.kind(out.dtype)), dims, keepdim)
    if order == 2:
        return shaped(t.map("sqrt", t.total(t.map("mul", flat, flat))))
    size = t.map("abs", flat)
    if order in (1, math.inf):
        return shaped(t.total(size) if order == 1 else _chain(t, "max", size))
    raise NotLoweredError(f"a norm of order {order} has no scalar form here")


# Products.


@_rule("mm", "bmm")
def _mm(t: Tracer, out: Tensor, a: Tensor, b: Tensor) -> Ids:
    x, y = _numbers(t, t.kind(out.dtype), a, b)
    return t.products(x[..., :, None, :], np.swapaxes(y, -1, -2)[..., None, :, :])


@_rule("mv")
def _mv(t: Tracer, out: Tensor, a: Tensor, b: Tensor) -> Ids:
    return t.products(*_numbers(t, t.kind(out.dtype), a, b))


_RULES["dot"] = _RULES["vdot"] = _mv


@_rule("addmm", "baddbmm", "addmv")
def _addmm(
    t: Tracer, out: Tensor, bias: Tensor, a: Tensor, b: Tensor, beta: float = 1, alpha: float = 1
) -> Ids:
    if beta != 1 or alpha != 1:
        raise NotLoweredError("a scaled product has no scalar form here")
    product = (_mv if b.dim() == 1 else _mm)(t, out, a, b)
    return t.map("add", product, t.nodes(bias, t.kind(out.dtype)))


# Entries that move: torch itself moves the numbers of nodes.

_MOVEMENTS = frozenset(
    (
        "cat",
        "stack",
        "index",
        "index_select",
        "gather",
        "flip",
        "roll",
        "repeat",
        "select_scatter",
        "slice_scatter",
        "index_put",
        "scatter",
        "constant_pad_nd",
        "diag_embed",
        "tril",
        "triu",
        "_unsafe_view",
        "view_copy",
        "expand_copy",
        "unfold_copy",
        "diagonal_scatter",
        "as_strided_scatter",
        "select_backward",
        "slice_backward",
        "diagonal_backward",
        "index_copy",
        "take",
        "take_along_dim",
    )
)


def _moved(t: Tracer, func: Any, out: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    name = func._schema.name.removeprefix("aten::")
    at = 2 if name in ("gather", "scatter") else 1 if name.startswith("index") else None
    if name == "index_put" and (kwargs.get("accumulate") or (len(args) > 3 and args[3])):
        raise NotLoweredError(f"`{func}` has no scalar form here")
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
            return torch.from_numpy(np.ascontiguousarray(nodes))
        return value

    values = [numbers(a, position == at) for position, a in enumerate(args)]
    fill = 4 if name == "scatter" else 2 if name == "constant_pad_nd" else 3
    if (
        name in ("scatter", "constant_pad_nd")
        and len(args) > fill - 1
        and not isinstance(args[-1], Tensor | list)
    ):
        values[-1] = t.graph.constant(args[-1], kind) - zero
    result = func(*values, **{k: numbers(v, False) for k, v in kwargs.items()})
    return result.numpy() + zero


def _listed(value: Any) -> Sequence[Any]:
    return value if isinstance(value, list | tuple) else [value]


def _indexed(
    t: Tracer, name: str, out: Tensor, a: Tensor, dim: Any, index: Any = None, *rest: Any, **_: Any
) -> Ids:
    """gather, scatter and selection at an index that a row computes, or that numbers of the table do."""
    kind = t.kind(out.dtype)
    if name == "index" and sum(i is not None for i in dim) == 1:
        axis = next(k for k, i in enumerate(dim) if i is not None)
        name, dim, index = "index_select", axis, dim[axis]
    if name == "index_select" and index.dtype != torch.bool:
        entries = np.moveaxis(t.nodes(a, kind), dim, -1)
        chosen = _chosen(t, entries[(..., *[None] * index.dim(), slice(None))], t.nodes(index, WHOLE))
        return np.moveaxis(chosen, range(a.dim() - 1, chosen.ndim), range(dim, dim + index.dim()))
    if name not in ("gather", "scatter"):
        raise NotLoweredError(f"`aten.{name}` at an index that the row computes has no scalar form here")
    x = np.moveaxis(t.nodes(a, kind), dim, -1)
    at = np.moveaxis(t.nodes(index, WHOLE), dim, -1)
    if name == "gather":
        x = x[tuple(slice(s) for s in at.shape[:-1])]
        return np.moveaxis(_chosen(t, x[..., None, :], at), -1, dim)
    source = t.nodes(rest[0], kind)
    source = np.broadcast_to(source, at.shape) if source.ndim == 0 else np.moveaxis(source, dim, -1)
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
