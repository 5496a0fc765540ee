"""Operations in single numbers, entry by entry."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .graph import FLAG, REAL, Ids
from .tracer import NotLoweredError, Tracer

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
