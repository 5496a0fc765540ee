"""A function of state and input that a user brings, in torch or in NumPy, and its derivatives."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..lanes.gradients import defer_gradient, jacrev, marked
from ..numerics.derivatives import Apart, central_slopes
from .base import Linearisation

Motion = Callable[..., Any]
"""(x (B, n), u (B, m)) -> (B, n), of torch tensors or of NumPy arrays."""
Slopes = Callable[[Any, Any], tuple[Any, Any]]
"""(x (n,), u (m,)) -> the derivatives with respect to x, (n, n), and u, (n, m), of NumPy arrays."""
Numbers = np.ndarray[Any, np.dtype[np.float64]]
_PROBES = (3, 5, 7, 11)  # rows that the function is tried with: the first that is no other size, nor half
_PUSHES = (1.0, 10.0, 100.0, 1000.0)  # of the inputs' tries, one after the other, until one moves the plant
_KINK = 0.05  # of the largest slope, by which the slopes of two step sizes may differ


class BlackBox:
    """A batched function of x and u, called with what it understands.

    It is tried once: with torch tensors that want derivatives, else with NumPy arrays. Only the first kind is
    differentiated by autograd and compiled; the slopes of the other come from central differences, as those
    of a function of tensors whose result has no derivative (a network under `torch.no_grad`). Parameters of a
    network count with the values that they have: no gradient reaches them.

    Args:
        call: name of the constructor and the argument, for messages: ``StepPlant(step=...)``.
        function: (B, n), (B, m) -> (B, n).
        x: a state to try it near, (n,).
        u: an input to try it near, (m,).
        slopes: its derivatives, where they are known.

    Attributes:
        torch: whether the function is torch all the way through.

    Raises:
        ValueError: if it raises, with what it says of tensors and of arrays; if it returns another shape or
            something not finite, or ignores u.
    """

    def __init__(
        self, call: str, function: Motion, x: Tensor, u: Tensor, slopes: Slopes | None = None
    ) -> None:
        if not callable(function):
            raise ValueError(f"`{call}` must be a function of x (B, n) and u (B, m); got {function!r}.")
        self._call, self._function, self._slopes = call, function, slopes
        self._said = ""  # by the function, of tensors
        self._tensors = True  # whether it takes them
        sizes = {len(x), len(u), len(x) + len(u)}
        self._rows = next(count for count in _PROBES if not sizes & {count, 2 * count})
        self.torch = self._traces(x, u)
        self._try(x, u)

    def in_torch(self, x: Tensor, u: Tensor) -> BlackBox | None:
        """The function by torch, where that follows it through NumPy and agrees at x (B, n), u (B, m)."""
        if not agrees(self._function, x, u):
            return None
        try:
            box = BlackBox(self._call, InTorch(self._function), x[0], u[0])
        except ValueError:
            return None
        return box if box.torch else None

    def __call__(self, x: Tensor, u: Tensor) -> Tensor:
        """(..., n), (..., m) -> (..., n)."""
        lead: tuple[int, ...] = x.shape[:-1]
        if u.shape[:-1] != lead:
            lead = np.broadcast_shapes(lead, u.shape[:-1])
        rows = x.expand(*lead, -1).reshape(-1, x.shape[-1]), u.expand(*lead, -1).reshape(-1, u.shape[-1])
        after = self._function(*rows) if self.torch else self._numpy(*rows)
        return after.reshape(*lead, x.shape[-1])

    def follow(
        self, x: Numbers, feedback: Callable[[Numbers], Numbers], steps: int
    ) -> tuple[Numbers, Numbers]:
        """Return every state (B, T + 1, n) and control (B, T, m) from x (B, n) under a feedback (B, n) ->
        (B, m), of a function in NumPy that is a step: by the function's own ``follow_feedback``, where it
        has one that does not return None, else a call a step."""
        whole = getattr(self._function, "follow_feedback", None)
        found: tuple[Numbers, Numbers] | None = whole(x, feedback, steps) if callable(whole) else None
        if found is not None:
            return found
        states, controls = [x], []
        for _ in range(steps):
            controls.append(feedback(states[-1]))
            states.append(np.asarray(self._function(states[-1], controls[-1]), dtype=np.float64))
        return np.stack(states, axis=1), np.stack(controls, axis=1)

    def linearisation(self, x: Tensor, u: Tensor, apart: Apart = operator.sub) -> Linearisation:
        """d/dx and d/du at one point (n,), (m,); ``apart`` is the difference of two values, of a step with
        angles as `Plant.difference`.

        Raises:
            ValueError: if the function has a kink there: slopes of two step sizes differ by more than 5 %; or
                if known slopes have another shape or are not finite.
        """
        if self._slopes is not None:
            return self._known(self._slopes, x, u)
        size, at = len(x), torch.cat((x, u))

        def whole(z: Tensor) -> Tensor:
            return self(z[..., :size], z[..., size:])

        if self.torch:
            slopes: Tensor = jacrev(lambda z: whole(z.unsqueeze(0))[0])(at).detach()
        else:
            slopes = central_slopes(whole, at, apart=apart)
            wider = central_slopes(whole, at, 100 * at.abs().clamp(min=1.0), apart)
            off = (slopes - wider).abs().max() / slopes.abs().max().clamp(min=1e-12)
            if not bool(off <= _KINK):
                raise ValueError(
                    f"`{self._call}` is not smooth at the state {x.tolist()} and the input {u.tolist()}: its "
                    f"slopes over {6e-6:g} and {6e-4:g} differ by {float(off):.2g} of the largest. Linearise "
                    "it elsewhere (`equilibrium`), or smooth what switches there."
                )
        return Linearisation(slopes[:, :size], slopes[:, size:])

    def _known(self, slopes: Slopes, x: Tensor, u: Tensor) -> Linearisation:
        found = slopes(x.detach().cpu().numpy(), u.detach().cpu().numpy())
        a, b = (torch.as_tensor(np.asarray(part, dtype=np.float64), device="cpu") for part in found)
        if a.shape != (len(x), len(x)) or b.shape != (len(x), len(u)):
            raise ValueError(
                f"the `slopes` of `{self._call}` must have the shapes {(len(x), len(x))} and "
                f"{(len(x), len(u))}; got {tuple(a.shape)} and {tuple(b.shape)}."
            )
        if not bool(torch.isfinite(torch.cat((a, b), dim=1)).all()):
            raise ValueError(f"the `slopes` of `{self._call}` are not finite at the state {x.tolist()}.")
        return Linearisation(a, b)

    def _traces(self, x: Tensor, u: Tensor) -> bool:
        """Return whether the function maps tensors to a tensor with a derivative, also under `torch.func`."""
        z = torch.cat((x, u)).expand(self._rows, -1).clone().requires_grad_()
        try:
            with torch.enable_grad():
                after = self._function(z[:, : len(x)], z[:, len(x) :])
            self._tensors = isinstance(after, Tensor)
            return self._tensors and after.requires_grad
        except Exception as error:  # it is tried again with NumPy; both complaints are shown
            self._tensors, self._said = False, _shown(error)
            return False

    def _numpy(self, x: Tensor, u: Tensor) -> Tensor:
        call = f"{self._call} of a function without derivatives"
        late = defer_gradient(call, x=x, u=u)
        if self._tensors:
            found: Tensor = self._function(x.detach(), u.detach())
            return marked(call, late, found)
        after = self._function(x.detach().cpu().numpy(), u.detach().cpu().numpy())
        found = torch.as_tensor(np.asarray(after, dtype=np.float64), device="cpu").to(x)
        return marked(call, late, found)

    def _try(self, x: Tensor, u: Tensor) -> None:
        generator = torch.Generator().manual_seed(0)
        away = 0.1 * torch.randn(
            self._rows, len(x) + 2 * len(u), dtype=torch.float64, generator=generator, device="cpu"
        )
        states, inputs = x + away[:, : len(x)], u + away[:, len(x) : len(x) + len(u)]

        def asked(*rows: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
            with torch.no_grad():
                return rows, self._function(*rows) if self.torch else self._numpy(*rows)

        def pushed(size: float) -> tuple[tuple[Tensor, ...], Tensor]:
            return asked(states.repeat(2, 1), torch.cat((inputs, inputs + size * away[:, -len(u) :])))

        try:
            tried = pushed(1.0), asked(states, inputs)  # by two numbers of rows
        except Exception as error:
            kind = "as torch tensors" if self._tensors else "as NumPy arrays"
            said = f"; as torch tensors of float64 {self._said}" if self._said else ""
            hint = " A network in float32 needs `.double()`." if "Float" in said else ""
            raise ValueError(
                f"`{self._call}` raised {_shown(error)} at x and u of the shapes {tuple(states.shape)} and "
                f"{tuple(inputs.shape)}, {kind}{said}. It must map rows to rows.{hint}"
            ) from error
        for rows, after in tried:
            if not isinstance(after, Tensor) or after.shape != rows[0].shape:
                got = tuple(after.shape) if isinstance(after, Tensor) else type(after).__name__
                raise ValueError(
                    f"`{self._call}` must map x and u of the shapes {tuple(rows[0].shape)} and "
                    f"{tuple(rows[1].shape)} to {tuple(rows[0].shape)}; got {got}."
                )
        if not bool(torch.isfinite(tried[0][1]).all()):
            raise ValueError(f"`{self._call}` returned values that are not finite near x = {x.tolist()}.")
        # What sticks is moved by a large input alone.
        if all(_same(pushed, size) for size in _PUSHES):
            rule = "ignores u: another input changes nothing"
            raise ValueError(f"`{self._call}` {rule} near x = {x.tolist()}.")


def _same(pushed: Callable[[float], tuple[Any, Tensor]], size: float) -> bool:
    """Return whether the two halves of the rows, which differ in u, move alike."""
    try:
        first, second = pushed(size)[1].chunk(2)
    except Exception:  # of a simulator that refuses a large input
        return True
    return torch.equal(first.nan_to_num(), second.nan_to_num())


def _shown(error: Exception) -> str:
    """Kind and first line of an error."""
    return f"{type(error).__name__} ({str(error).splitlines()[0] if str(error) else ''})"


def _torch(value: Any) -> Any:
    """Return tensors in the place of arrays; all else as it is."""
    if isinstance(value, TensorArray):
        return value.tensor
    if isinstance(value, np.ndarray):
        dtype = torch.bool if value.dtype == bool else torch.float64
        return torch.as_tensor(value, dtype=dtype, device="cpu")
    return type(value)(map(_torch, value)) if isinstance(value, list | tuple) else value


def _number(value: Any) -> Any:
    """Return `_torch`, and a tensor in the place of a number."""
    return _torch(value) if isinstance(value, TensorArray | np.ndarray) else _wide(value)


def _power(x: Tensor, exponent: Tensor) -> Tensor:
    """x ** p, with p a number where it is one: its derivative has no logarithm."""
    return x ** (exponent.item() if exponent.dim() == 0 and not exponent.requires_grad else exponent)


def _clip(x: Tensor, min: Any = None, max: Any = None) -> Tensor:
    x = x if min is None else torch.maximum(x, _wide(min))
    return x if max is None else torch.minimum(x, _wide(max))


def _wide(value: Any) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64, device=getattr(value, "device", "cpu"))


_SAME = (
    *("add", "subtract", "multiply", "divide", "negative", "positive", "absolute", "sign", "square", "sqrt"),
    *("exp", "expm1", "exp2", "log", "log1p", "log2", "log10", "sin", "cos", "tan", "sinh", "cosh", "tanh"),
    *("arcsin", "arccos", "arctan", "arcsinh", "arccosh", "arctanh", "arctan2", "hypot", "floor", "ceil"),
    *("trunc", "remainder", "fmod", "reciprocal", "maximum", "minimum", "greater", "greater_equal", "less"),
    *("less_equal", "not_equal", "logical_and", "logical_or", "logical_not", "isfinite", "isnan", "copysign"),
    *("deg2rad", "rad2deg", "matmul", "heaviside", "true_divide", "fmax", "fmin", "stack", "sinc"),
    *("column_stack", "hstack", "vstack", "sum", "mean", "zeros_like", "ones_like", "einsum"),
    *("squeeze", "reshape", "round", "atleast_2d", "broadcast_to"),
)
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(torch, name) for name in _SAME},
    **{"power": _power, "float_power": _power, "rint": torch.round, "fabs": torch.abs, "equal": torch.eq},
    **{"clip": _clip, "where": lambda c, a, b: torch.where(c, _wide(a), _wide(b)), "copy": torch.clone},
    **{
        "concatenate": torch.cat,
        "dot": torch.matmul,
        "expand_dims": torch.unsqueeze,
        "empty_like": torch.zeros_like,
    },
    **{"full_like": lambda x, value: torch.zeros_like(x) + value, "transpose": lambda x: x.mT},
}
_ARGUMENTS = {"axis": "dim", "keepdims": "keepdim", "a_min": "min", "a_max": "max"}
"""Arguments of NumPy: those of torch."""


class TensorArray(np.lib.mixins.NDArrayOperatorsMixin):
    """A tensor in the place of an array of float64: NumPy calls back for operations on what is no array.

    Its protocols for other arrays (NEP 13, ``__array_ufunc__``, and NEP 18, ``__array_function__``) do so for
    every operation on an object that has them, and each is done with torch. So a simulator as
    ``np.stack((x[:, 0] + dt * x[:, 1], np.sin(x[:, 0]) + u[:, 0]), axis=1)`` has derivatives and is compiled,
    in place of differences and a call a step. What NumPy makes by itself (``np.array([x[:, 0], ...])``),
    branches on values, and functions that are not listed above raise TypeError: such a function stays a
    black box.
    """

    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *given: Any, **more: Any) -> Any:
        function = _FUNCTIONS.get(ufunc.__name__)
        if function is None or method != "__call__" or more:
            return NotImplemented
        return TensorArray(function(*map(_number, given)))

    def __array_function__(
        self, func: Callable[..., Any], types: Any, args: Any, given: dict[str, Any]
    ) -> Any:
        function = _FUNCTIONS.get(func.__name__)
        if function is None:
            return NotImplemented
        named = {_ARGUMENTS.get(name, name): _torch(part) for name, part in given.items()}
        return TensorArray(function(*map(_torch, args), **named))

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

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function

    def __call__(self, x: Tensor, u: Tensor) -> Tensor:
        """(B, n), (B, m) -> (B, n)."""
        after = self.function(TensorArray(x), TensorArray(u))
        if not isinstance(after, TensorArray):
            raise TypeError(f"the function returns {type(after).__name__}")
        return after.tensor


def agrees(function: Callable[..., Any], x: Tensor, u: Tensor) -> bool:
    """Return whether a function in NumPy is the same in torch at states x (B, n) and inputs u (B, m)."""
    try:
        with torch.no_grad():
            found = InTorch(function)(x, u)
        wanted = torch.as_tensor(np.asarray(function(x.numpy(), u.numpy()), dtype=np.float64), device="cpu")
    except Exception:  # it is a black box then
        return False
    scale = 1 + wanted.abs()
    return found.shape == wanted.shape and bool(((found - wanted).abs() <= 1e-12 * scale).all())
