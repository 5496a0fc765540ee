"""Operations in single numbers: entry by entry, and on entries together."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .graph import FLAG, NARROW, REAL, WHOLE, Ids
from .tracer import LARGE, NotLoweredError, Tracer

Rule = Callable[..., Any]
RULES: dict[str, Rule] = {}


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Decorator: a function of (tracer, what torch returned, arguments) is the rule of these operations."""

    def register(rule: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, rule))
        return rule

    return register


def common(t: Tracer, *values: Any) -> str:
    """The type in which torch computes with these together."""
    given = [v for v in values if v is not None]
    dtype = functools.reduce(torch.promote_types, [torch.result_type(v, w) for v in given for w in given])
    return t.kind(dtype)


def numbers(t: Tracer, kind: str, *values: Any) -> list[Ids]:
    """The nodes of tensors and numbers, as one type."""
    return [t.nodes(value, kind) for value in values]


_LARGEST_POWER = 64


def _entrywise(name: str, op: str | None = None) -> None:
    def rule(t: Tracer, out: Tensor, *args: Any) -> Ids:
        return t.map(op or name, *numbers(t, t.kind(out.dtype), *args))

    RULES[name] = rule


_ALIKE = """neg abs sqrt exp expm1 log log1p sin cos tan tanh atan2 asin acos atan sinh cosh asinh acosh atanh
    log2 log10 exp2 erf erfc lgamma hypot copysign floor ceil trunc"""  # called in C as in torch
for _name in _ALIKE.split():
    _entrywise(_name)
for _name, _op in (("maximum", "max"), ("minimum", "min"), ("mul", "mul")):
    _entrywise(_name, _op)


@rule("add", "sub", "rsub")
def _sum_of_two(t: Tracer, out: Tensor, a: Any, b: Any, alpha: Any = 1, _name: str = "add") -> Ids:
    kind = t.kind(out.dtype)
    left, right = numbers(t, kind, a, b)
    if alpha != 1:
        right = t.map("mul", right, t.nodes(alpha, kind))
    return t.map(_name, left, right)


RULES["sub"] = functools.partial(_sum_of_two, _name="sub")
RULES["rsub"] = lambda t, out, a, b, alpha=1: _sum_of_two(t, out, b, a, alpha, _name="sub")


@rule("div")
def _div(t: Tracer, out: Tensor, a: Any, b: Any, rounding_mode: str | None = None) -> Ids:
    kind = t.kind(out.dtype) if out.dtype.is_floating_point else REAL
    quotient = t.map("div", *numbers(t, kind, a, b))
    if rounding_mode is not None:
        quotient = t.map(rounding_mode, quotient)
    return t.cast(quotient, t.kind(out.dtype))


@rule("reciprocal")
def _reciprocal(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    kind = t.kind(out.dtype)
    return t.map("div", t.nodes(1.0, kind), t.nodes(a, kind))


@rule("rsqrt")
def _rsqrt(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    return t.map("div", t.nodes(1.0, t.kind(out.dtype)), t.map("sqrt", t.nodes(a, t.kind(out.dtype))))


@rule("sigmoid")
def _sigmoid(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    kind = t.kind(out.dtype)
    one = t.nodes(1.0, kind)
    return t.map("div", one, t.map("add", one, t.map("exp", t.map("neg", t.nodes(a, kind)))))


@rule("round")
def _round(t: Tracer, out: Tensor, a: Tensor, decimals: int = 0) -> Ids:
    if not decimals:
        return t.map("round", t.nodes(a))
    unit = t.nodes(10.0 ** abs(decimals), t.kind(out.dtype))
    up, down = ("mul", "div") if decimals > 0 else ("div", "mul")
    return t.map(down, t.map("round", t.map(up, t.nodes(a), unit)), unit)


@rule("frac")
def _frac(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    return t.map("sub", t.nodes(a), t.map("trunc", t.nodes(a)))


@rule("fmod")
def _fmod(t: Tracer, out: Tensor, a: Any, b: Any) -> Ids:
    return t.cast(t.map("fmod", *numbers(t, _divided(t, out), a, b)), t.kind(out.dtype))


@rule("remainder")
def _remainder(t: Tracer, out: Tensor, a: Any, b: Any) -> Ids:
    kind = _divided(t, out)
    x, y = numbers(t, kind, a, b)
    rest, zero = t.map("fmod", x, y), t.nodes(0.0, kind)
    unlike = t.map("xor", t.map("lt", rest, zero), t.map("lt", y, zero))
    moved = t.map("and", t.map("ne", rest, zero), unlike)  # the rest has the sign of the divisor
    return t.cast(t.map("where", moved, t.map("add", rest, y), rest), t.kind(out.dtype))


def _divided(t: Tracer, out: Tensor) -> str:
    return t.kind(out.dtype) if out.dtype.is_floating_point else REAL


@rule("sign", "sgn")
def _sign(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    x, kind = t.nodes(a), t.kind(a.dtype)
    zero = t.nodes(0.0, kind)
    up, down = (t.cast(flag, kind) for flag in (t.map("lt", zero, x), t.map("lt", x, zero)))
    return t.map("sub", up, down)


@rule("pow")
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


@rule("clamp")
def _clamp(t: Tracer, out: Tensor, a: Tensor, low: Any = None, high: Any = None) -> Ids:
    kind = t.kind(out.dtype)
    x = t.nodes(a, kind)
    x = x if low is None else t.map("max", x, t.nodes(low, kind))
    return x if high is None else t.map("min", x, t.nodes(high, kind))


RULES["clamp_min"] = lambda t, out, a, low: _clamp(t, out, a, low)
RULES["clamp_max"] = lambda t, out, a, high: _clamp(t, out, a, None, high)


@rule("addcmul")
def _addcmul(
    t: Tracer, out: Tensor, a: Tensor, b: Tensor, c: Tensor, value: float = 1, _name: str = "mul"
) -> Ids:
    x, y, z, factor = numbers(t, t.kind(out.dtype), a, b, c, value)
    return t.map("add", x, t.map("mul", factor, t.map(_name, y, z)))


RULES["addcdiv"] = functools.partial(_addcmul, _name="div")


@rule("lerp")
def _lerp(t: Tracer, out: Tensor, a: Tensor, b: Tensor, weight: Any) -> Ids:
    x, y, w = numbers(t, t.kind(out.dtype), a, b, weight)
    return t.map("add", x, t.map("mul", w, t.map("sub", y, x)))


def _comparison(name: str, op: str, swapped: bool) -> None:
    def rule(t: Tracer, out: Tensor, a: Any, b: Any) -> Ids:
        kind = common(t, a, b)
        left, right = numbers(t, REAL if kind == FLAG else kind, a, b)
        return t.map(op, right, left) if swapped else t.map(op, left, right)

    RULES[name] = rule


for _name, _op, _swap in (("lt", "lt", False), ("gt", "lt", True), ("le", "le", False), ("ge", "le", True)):
    _comparison(_name, _op, _swap)
for _name in ("eq", "ne"):
    _comparison(_name, _name, False)


def _logic(op: str, *names: str) -> None:
    def rule(t: Tracer, out: Tensor, *args: Any) -> Ids:
        if out.dtype != torch.bool:
            raise NotLoweredError("logic on the bits of integers cannot be compiled", "bitwise")
        return t.map(op, *numbers(t, FLAG, *args))

    RULES.update(dict.fromkeys(names, rule))


_logic("and", "logical_and", "bitwise_and", "__and__")
_logic("or", "logical_or", "bitwise_or", "__or__")
_logic("xor", "logical_xor", "bitwise_xor", "__xor__")
_logic("not", "logical_not", "bitwise_not")
_multiply = RULES["mul"]
RULES["mul"] = lambda t, out, a, b: (
    t.map("and", *numbers(t, FLAG, a, b)) if out.dtype == torch.bool else _multiply(t, out, a, b)
)


@rule("staf_torch::philox")
def _philox(t: Tracer, out: Tensor, *args: Any) -> Ids:
    *parts, second = args
    return t.map("philox_second" if second else "philox_first", *numbers(t, t.kind(out.dtype), *parts))


@rule("signbit")
def _signbit(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    kind = t.kind(a.dtype)  # of zeros, too
    return t.map("lt", t.map("copysign", t.nodes(1.0, kind), t.nodes(a)), t.nodes(0.0, kind))


@rule("isnan")
def _isnan(t: Tracer, out: Tensor, a: Tensor) -> Ids:
    return t.map("ne", t.nodes(a), t.nodes(a))


@rule("where")
def _where(t: Tracer, out: Tensor, chosen: Tensor, a: Any, b: Any) -> Ids:
    kind = t.kind(out.dtype)
    return t.map("where", t.nodes(chosen, FLAG), t.nodes(a, kind), t.nodes(b, kind))


@rule("masked_fill")
def _masked_fill(t: Tracer, out: Tensor, a: Tensor, mask: Tensor, value: Any) -> Ids:
    kind = t.kind(out.dtype)
    return t.map("where", t.nodes(mask, FLAG), t.nodes(value, kind), t.nodes(a, kind))


@rule("_to_copy", "clone", "copy", "lift_fresh_copy", "contiguous", "detach_copy")
def _copied(t: Tracer, out: Tensor, a: Any, *source: Any, **_: Any) -> Ids:
    given = source[0] if source and isinstance(source[0], Tensor) else a
    return np.broadcast_to(t.nodes(given, t.kind(out.dtype)), out.shape)


@rule("zeros_like", "new_zeros", "zero", "_new_zeros_with_same_feature_meta")
def zeros(t: Tracer, out: Tensor, *_: Any, **__: Any) -> Ids:
    """The nodes of as many zeros as torch returned."""
    return np.full(out.shape, t.graph.constant(0.0, t.kind(out.dtype)), dtype=np.int64)


@rule("ones_like", "new_ones")
def _ones(t: Tracer, out: Tensor, *_: Any, **__: Any) -> Ids:
    return np.full(out.shape, t.graph.constant(1.0, t.kind(out.dtype)), dtype=np.int64)


@rule("full_like", "new_full", "fill", "empty_like", "new_empty", "new_empty_strided")
def _full(t: Tracer, out: Tensor, *args: Any, **_: Any) -> Ids:
    value = args[-1] if len(args) > 1 and not isinstance(args[-1], list | tuple) else 0.0
    return np.broadcast_to(t.nodes(value, t.kind(out.dtype)), out.shape)


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
