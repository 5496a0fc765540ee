"""A program of tensor operations at one row, written out as arithmetic on single numbers."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, fx
from torch.export import ExportedProgram

Scalar = float | str
"""A number known now, or the C expression of one that is not: a name."""
Array = np.ndarray[Any, np.dtype[np.object_]]

_INFIX: dict[str, tuple[str, Callable[[Any, Any], Any]]] = {
    "add": ("+", operator.add),
    "sub": ("-", operator.sub),
    "mul": ("*", operator.mul),
    "div": ("/", operator.truediv),
    "le": ("<=", operator.le),
    "lt": ("<", operator.lt),
    "ge": (">=", operator.ge),
    "gt": (">", operator.gt),
}
_CALLS: dict[str, Callable[[float], float]] = {
    "exp": math.exp,
    "expm1": math.expm1,
    "log1p": math.log1p,
    "sin": math.sin,
    "cos": math.cos,
    "tanh": math.tanh,
    "sqrt": math.sqrt,
}
_SHAPES: dict[str, Callable[..., Any]] = {
    "unsqueeze": lambda a, dim: np.expand_dims(a, dim),
    "squeeze": lambda a, dim: np.squeeze(a, axis=tuple(dim) if isinstance(dim, list) else dim),
    "view": lambda a, shape: a.reshape(shape),
    "reshape": lambda a, shape: a.reshape(shape),
    "permute": lambda a, order: a.transpose(order),
    "expand": lambda a, shape: np.broadcast_to(a, [o if s == -1 else s for s, o in _paired(shape, a)]),
    "select": lambda a, dim, at: np.take(a, at, axis=dim),
    "zeros_like": lambda a, **_: np.full(a.shape, 0.0, dtype=object),
    "ones_like": lambda a, **_: np.full(a.shape, 1.0, dtype=object),
    "full_like": lambda a, value, **_: np.full(a.shape, value, dtype=object),
    "new_zeros": lambda a, shape, **_: np.full(shape, 0.0, dtype=object),
    "new_ones": lambda a, shape, **_: np.full(shape, 1.0, dtype=object),
    "full": lambda shape, value, **_: np.full(shape, value, dtype=object),
    "unbind": lambda a, dim=0: list(np.moveaxis(a, dim, 0)),
    "stack": lambda parts, dim=0: np.stack(parts, axis=dim),
    "transpose": lambda a, i, j: np.swapaxes(a, i, j),
    "getitem": operator.getitem,
    "clone": lambda a, **_: a,
    "alias": lambda a: a,
    "cat": lambda parts, dim=0: np.concatenate(parts, axis=dim),
    "slice": lambda a, dim=0, start=0, end=None, step=1: _slice(a, dim, start, end, step),
}


class Scalars(fx.Interpreter):
    """Runs a program of `trace`, made for a batch of one row, on names instead of numbers.

    Args:
        program: the program.
        suffix: of C's functions and constants: "" for double, "f" for float.

    Attributes:
        lines: statements of C, in order.

    Raises:
        ValueError: on `run`, for an operation that has no C here.
    """

    def __init__(self, program: ExportedProgram, suffix: str = "") -> None:
        super().__init__(program.graph_module)
        self.lines: list[str] = []
        self.suffix = suffix
        inputs = (node for node in program.graph.nodes if node.op == "placeholder" and node.meta["val"].dim())
        self._sizes = {
            node.name: int(node.meta["val"].shape[-1]) for node in inputs if node.meta["val"].dim()
        }
        self._given = {**program.state_dict, **program.constants}
        self._lifted = {
            **program.graph_signature.inputs_to_buffers,
            **program.graph_signature.inputs_to_parameters,
            **program.graph_signature.inputs_to_lifted_tensor_constants,
        }

    def placeholder(self, target: Any, args: Any, kwargs: Any) -> Array:
        if target in self._lifted:
            constant = self._given[self._lifted[target]]
            assert isinstance(constant, Tensor)
            return np.array(constant.tolist(), dtype=object)
        size = self._sizes[target]
        return np.array([[f"state[{k}]" for k in range(size)]], dtype=object)

    def call_function(self, target: Any, args: Any, kwargs: Any) -> Any:
        name = getattr(target, "_opname", None) or target.__name__
        if name in _SHAPES:
            return _SHAPES[name](*args, **kwargs)
        if name in _INFIX and not kwargs:
            return self._each(lambda a, b: self._infix(name, a, b), *args)
        if name in _CALLS:
            return self._each(lambda a: self._call(name, a), *args)
        own = getattr(self, f"_do_{name}", None)
        if own is None:
            raise ValueError(f"`{target}` has no C here: export this run as ONNX, pt2 or aoti.")
        return own(*args, **kwargs)

    def _do__to_copy(self, a: Array, dtype: torch.dtype | None = None, **_: Any) -> Array:
        if self.suffix and dtype == torch.float64:
            raise ValueError("This needs float64 inside, or float32 loses its digits: use --dtype float64.")
        return a

    def _do_neg(self, a: Array) -> Array:
        return self._each(lambda x: self._infix("sub", 0.0, x), a)

    def _do_reciprocal(self, a: Array) -> Array:
        return self._each(lambda x: self._infix("div", 1.0, x), a)

    def _do_pow(self, a: Array, power: float) -> Array:
        if not isinstance(power, int | float) or power != int(power) or not 1 <= power <= 16:
            raise ValueError("A power that is no small integer has no C here: export as ONNX, pt2 or aoti.")
        out = a
        for _ in range(int(power) - 1):
            out = self._each(lambda x, y: self._infix("mul", x, y), out, a)
        return out

    def _do_where(self, chosen: Array, a: Any, b: Any) -> Array:
        return self._each(self._choice, chosen, a, b)

    def _do_sum(self, a: Array, dims: Any = None, keepdim: bool = False, **_: Any) -> Array:
        axes = sorted(d % a.ndim for d in (range(a.ndim) if dims is None else dims))
        rest = [d for d in range(a.ndim) if d not in axes]
        flat = a.transpose([*rest, *axes]).reshape([*(a.shape[d] for d in rest), -1])
        out = self._fold(flat)
        return np.expand_dims(out, tuple(axes)) if keepdim else out

    def _do_mm(self, a: Array, b: Array) -> Array:
        products = self._each(lambda x, y: self._infix("mul", x, y), a[:, None, :], b.T[None, :, :])
        return self._fold(products)

    def _do_bmm(self, a: Array, b: Array) -> Array:
        return np.stack([self._do_mm(x, y) for x, y in zip(a, b, strict=True)])

    def _do_addmm(self, bias: Array, a: Array, b: Array) -> Array:
        return self._each(lambda x, y: self._infix("add", x, y), self._do_mm(a, b), bias)

    def _fold(self, a: Array) -> Array:
        out = a[..., 0]
        for k in range(1, a.shape[-1]):
            out = self._each(lambda x, y: self._infix("add", x, y), out, a[..., k])
        return out

    def _each(self, function: Callable[..., Scalar], *parts: Any) -> Array:
        arrays = np.broadcast_arrays(*(np.asarray(part, dtype=object) for part in parts))
        out = np.empty(arrays[0].shape, dtype=object)
        for at in np.ndindex(out.shape):
            out[at] = function(*(array[at] for array in arrays))
        return out

    def _infix(self, name: str, a: Scalar, b: Scalar) -> Scalar:
        symbol, now = _INFIX[name]
        if not isinstance(a, str) and not isinstance(b, str):
            return float(now(a, b))
        if (name == "mul" and a == 1) or (name == "add" and a == 0):
            return b
        if (name in ("mul", "div") and b == 1) or (name in ("add", "sub") and b == 0):
            return a
        return self._name(f"{self.text(a)} {symbol} {self.text(b)}")

    def _call(self, name: str, a: Scalar) -> Scalar:
        return self._name(f"{name}{self.suffix}({a})") if isinstance(a, str) else _CALLS[name](a)

    def _choice(self, chosen: Scalar, a: Scalar, b: Scalar) -> Scalar:
        if not isinstance(chosen, str):
            return a if chosen else b
        return self._name(f"{chosen} != 0 ? {self.text(a)} : {self.text(b)}")

    def _name(self, expression: str) -> str:
        name = f"t{len(self.lines)}"
        kind = "float" if self.suffix else "double"
        self.lines.append(f"const {kind} {name} = {expression};")
        return name

    def text(self, value: Scalar) -> str:
        """A name, or a number with all its digits."""
        if isinstance(value, str):
            return value
        number = float(np.float32(value)) if self.suffix else float(value)
        if math.isnan(number):
            return "NAN"
        written = f"{number:.9g}" if self.suffix else repr(number)
        if "." not in written and "e" not in written:
            written += ".0"
        return f"({written}{self.suffix})" if number < 0 else f"{written}{self.suffix}"


def _paired(shape: Any, a: Array) -> list[tuple[int, int]]:
    before = (1,) * (len(shape) - a.ndim) + a.shape
    return list(zip(shape, before, strict=True))


def _slice(a: Array, dim: int, start: int | None, end: int | None, step: int) -> Array:
    at: list[Any] = [slice(None)] * a.ndim
    at[dim] = slice(start, None if end is None or end > 2**62 else end, step)
    out: Array = a[tuple(at)]
    return out
