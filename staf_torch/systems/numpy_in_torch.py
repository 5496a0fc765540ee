"""A function written in NumPy, evaluated with torch: NumPy calls back for operations on what is no array.

NumPy's protocols for other arrays (NEP 13, ``__array_ufunc__``, and NEP 18, ``__array_function__``) call back
for every operation on an object that has them. A `TensorArray` does each with torch, so that a simulator as
``np.stack((x[:, 0] + dt * x[:, 1], np.sin(x[:, 0]) + u[:, 0]), axis=1)`` has derivatives and is compiled, in
place of differences and a call a step. What NumPy makes by itself (``np.array([x[:, 0], ...])``), branches on
values, and functions that are not listed here raise TypeError: such a function stays a black box.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

Function = Callable[..., Any]


def _torch(value: Any) -> Any:
    """Return tensors in the place of arrays; all else as it is."""
    if isinstance(value, TensorArray):
        return value.tensor
    if isinstance(value, np.ndarray):
        return torch.as_tensor(
            value,
            dtype=torch.bool if value.dtype == bool else torch.float64,
            device=getattr(value, "device", "cpu"),
        )
    return type(value)(map(_torch, value)) if isinstance(value, list | tuple) else value


def _number(value: Any) -> Any:
    """Return `_torch`, and a tensor in the place of a number."""
    return _torch(value) if isinstance(value, TensorArray | np.ndarray) else _wide(value)


def _power(x: Tensor, exponent: Tensor) -> Tensor:
    """x ** p, with p a number where it is one: its derivative has no logarithm."""
    return x ** (exponent.item() if exponent.dim() == 0 and not exponent.requires_grad else exponent)


def _clip(x: Tensor, low: Any = None, high: Any = None, **other: Any) -> Tensor:
    low, high = other.pop("a_min", low), other.pop("a_max", high)
    low, high = other.pop("min", low), other.pop("max", high)
    if other:
        raise TypeError(f"clip with {sorted(other)}")
    x = x if low is None else torch.maximum(x, _wide(low))
    return x if high is None else torch.minimum(x, _wide(high))


def _wide(value: Any) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64, device=getattr(value, "device", "cpu"))


def _joined(join: Function) -> Function:
    def joined(parts: Any, axis: int = 0) -> Tensor:
        result: Tensor = join([_wide(part) for part in parts], dim=axis)
        return result

    return joined


def _reduced(reduce: Function) -> Function:
    def reduced(x: Tensor, axis: Any = None, keepdims: bool = False) -> Tensor:
        return reduce(x) if axis is None else reduce(x, dim=axis, keepdim=keepdims)  # type: ignore[no-any-return]

    return reduced


_SAME = (
    *("add", "subtract", "multiply", "divide", "negative", "positive", "absolute", "sign", "square", "sqrt"),
    *("exp", "expm1", "exp2", "log", "log1p", "log2", "log10", "sin", "cos", "tan", "sinh", "cosh", "tanh"),
    *("arcsin", "arccos", "arctan", "arcsinh", "arccosh", "arctanh", "arctan2", "hypot", "floor", "ceil"),
    *("trunc", "remainder", "fmod", "reciprocal", "maximum", "minimum", "greater", "greater_equal", "less"),
    *("less_equal", "not_equal", "logical_and", "logical_or", "logical_not", "isfinite", "isnan", "copysign"),
    *("deg2rad", "rad2deg", "matmul", "heaviside", "true_divide", "fmax", "fmin"),
)
_UFUNCS: dict[str, Function] = {name: getattr(torch, name) for name in _SAME}
_UFUNCS |= {"power": _power, "float_power": _power, "rint": torch.round, "fabs": torch.abs, "equal": torch.eq}
_FUNCTIONS: dict[str, Function] = {
    "stack": _joined(torch.stack),
    "concatenate": _joined(torch.cat),
    "column_stack": torch.column_stack,
    "hstack": torch.hstack,
    "vstack": torch.vstack,
    "clip": _clip,
    "where": lambda c, a, b: torch.where(c, _wide(a), _wide(b)),
    "sum": _reduced(torch.sum),
    "mean": _reduced(torch.mean),
    "zeros_like": torch.zeros_like,
    "ones_like": torch.ones_like,
    "empty_like": torch.zeros_like,
    "full_like": lambda x, value: torch.zeros_like(x) + value,
    "copy": torch.clone,
    "dot": torch.matmul,
    "einsum": torch.einsum,
    "sinc": torch.sinc,
    "expand_dims": lambda x, axis: x.unsqueeze(axis),
    "squeeze": lambda x, axis: x.squeeze(axis),
    "reshape": lambda x, shape: x.reshape(shape),
    "transpose": lambda x: x.mT,
    "round": torch.round,
    "atleast_2d": torch.atleast_2d,
    "broadcast_to": lambda x, shape: x.expand(shape),
}


class TensorArray(np.lib.mixins.NDArrayOperatorsMixin):
    """A tensor in the place of an array of float64."""

    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *given: Any, **more: Any) -> Any:
        function = _UFUNCS.get(ufunc.__name__)
        if function is None or method != "__call__" or more:
            return NotImplemented
        return TensorArray(function(*map(_number, given)))

    def __array_function__(self, func: Function, types: Any, args: Any, given: dict[str, Any]) -> Any:
        function = _FUNCTIONS.get(func.__name__)
        if function is None:
            return NotImplemented
        return TensorArray(
            function(*map(_torch, args), **{name: _torch(part) for name, part in given.items()})
        )

    def __array__(self, *given: Any, **more: Any) -> Any:
        raise TypeError("a tensor that is followed is no array")

    def __bool__(self) -> bool:
        raise TypeError("a branch on a value")

    def __getitem__(self, key: Any) -> TensorArray:
        return TensorArray(self.tensor[_key(key)])

    def __setitem__(self, key: Any, value: Any) -> None:
        tensor = self.tensor.clone()
        tensor[_key(key)] = _torch(value)
        self.tensor = tensor

    def __len__(self) -> int:
        return len(self.tensor)

    def __getattr__(self, name: str) -> Any:
        """Shape and methods of an array, as far as they have a function above."""
        if name in ("shape", "ndim"):
            return getattr(self.tensor, name)
        if name == "T":
            return TensorArray(self.tensor.permute(*range(self.tensor.dim() - 1, -1, -1)))
        if name == "astype":
            return lambda *given, **more: self
        if name == "dtype":
            return np.dtype(np.float64)
        if name in ("copy", "sum", "mean", "clip", "dot", "round", "squeeze"):
            return lambda *given, **more: self.__array_function__(getattr(np, name), (), (self, *given), more)
        if name == "reshape":
            return lambda *shape: TensorArray(self.tensor.reshape(*shape))
        raise AttributeError(name)


def _key(key: Any) -> Any:
    return tuple(_key(part) for part in key) if isinstance(key, tuple) else getattr(key, "tensor", key)


class InTorch:
    """A function of arrays x (B, n) and u (B, m), written in NumPy, of tensors."""

    def __init__(self, function: Function) -> None:
        self.function = function

    def __call__(self, x: Tensor, u: Tensor) -> Tensor:
        """(B, n), (B, m) -> (B, n)."""
        after = self.function(TensorArray(x), TensorArray(u))
        if not isinstance(after, TensorArray):
            raise TypeError(f"the function returns {type(after).__name__}")
        return after.tensor


def agrees(function: Function, x: Tensor, u: Tensor) -> bool:
    """Return whether a function in NumPy is the same in torch at states x (B, n) and inputs u (B, m)."""
    try:
        with torch.no_grad():
            found = InTorch(function)(x, u)
        wanted = torch.as_tensor(np.asarray(function(x.numpy(), u.numpy()), dtype=np.float64), device="cpu")
    except Exception:  # it is a black box then
        return False
    scale = 1 + wanted.abs()
    return found.shape == wanted.shape and bool(((found - wanted).abs() <= 1e-12 * scale).all())
