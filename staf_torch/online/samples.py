"""Samples as users give them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..lanes.calls.inputs import readable
from ..lanes.gradients import refuse_gradient
from ..numerics.checks import fail, fails


def tensor_of(call: str, name: str, value: Any, *, recorded: bool = False) -> Tensor:
    """Return a tensor as it is, arrays and numbers as tensors, integers as float64; where it is
    ``recorded`` a tensor that requires a gradient is taken with it, and not refused."""
    if isinstance(value, Tensor):
        if value.requires_grad and not recorded:
            refuse_gradient(call, **{name: value})
        if torch._C._functorch.is_functorch_wrapped_tensor(value):
            rule = "must hold all samples at once, and not one by one as under transforms of `torch.func`"
            raise ValueError(
                f"`{call}({name}=...)` {rule}; flatten the dimension of `vmap` into the samples."
            )
        if value.is_nested or value.layout is not torch.strided or value.is_complex():
            form = "nested" if value.is_nested else f"{value.layout}, {value.dtype}"
            raise ValueError(
                f"`{call}({name}=...)` must be a dense tensor of real numbers; got one that is {form}."
            )
        found = value if recorded else value.detach()
    else:
        try:
            if hasattr(value, "toarray"):
                raise TypeError("sparse data is not supported: use toarray()")
            array = np.asarray(value)
            if array.dtype == object:
                array = array.astype(float)
            if np.iscomplexobj(array):
                raise ValueError("Complex data not supported")
            try:
                found = torch.from_numpy(array if array.flags.writeable else array.copy())
            except (TypeError, ValueError):  # it runs backwards, or has the bytes of another machine
                found = torch.from_numpy(array.astype(array.dtype.newbyteorder("=")))
        except (TypeError, ValueError, RuntimeError) as error:
            kind = TypeError if hasattr(value, "toarray") or "convert" not in str(error) else ValueError
            kind = ValueError if isinstance(error, ValueError) else kind
            told = fail(call, name, "must be a tensor or an array of numbers", value)
            raise (ValueError if isinstance(value, str) else kind)(f"{told} {error}") from error
    found = found.resolve_neg()  # whose memory is what it says
    return found if found.is_floating_point() else found.double()


def single(value: Any) -> Any:
    """Return the number of a tensor without dimensions; anything else as it is, numbers of rows too."""
    plain = type(value) in (Tensor, torch.nn.Parameter) and value.dim() == 0
    return value.item() if plain else value


def in_place(value: Any, dtype: torch.dtype | None, shape: tuple[int, ...]) -> bool:
    """Return whether compiled code can read a sample where it lies, as one of this dtype and shape."""
    try:
        return (
            readable(value, True)
            and value.dtype is dtype
            and value.shape == shape
            and value.is_cpu
            and value.is_contiguous()
        )
    except RuntimeError:  # a nested tensor has no shape
        return False


def pair(
    call: str, x: Any, y: Any, dims: tuple[int, int], *, recorded: bool = False
) -> tuple[Tensor, Tensor]:
    if y is None:
        raise ValueError(f"`{call}` requires y to be passed, but the target y is None.")
    states, values = (tensor_of(call, name, part, recorded=recorded) for name, part in (("x", x), ("y", y)))
    if 0 in states.shape:
        shape = tuple(states.shape)
        what = f"{states.shape[-1]} feature(s)" if 0 in states.shape[-1:] else "0 sample(s)"
        told = f"must not be empty: {what} (shape={shape}) while a minimum of 1 is required"
        raise ValueError(f"`{call}(x=...)` {told}.")
    fits = states.dim() in dims and values.shape[: states.dim() - 1] == states.shape[:-1]
    if not fits or values.dim() - states.dim() not in (-1, 0):
        rule = (
            "(n,) or (S, n)" if dims == (1, 2) else "(T, n) for one stream in time or (T, S, n) for S streams"
        )
        raise ValueError(
            f"`{call}(x=...)` must have the shape {rule}, and y that without n, or with K "
            f"in its place; got {tuple(states.shape)} and {tuple(values.shape)}."
        )
    return states, values


def lapses(call: str, time: Any, states: Tensor) -> Tensor | None:
    """Time since the sample before, (T, S) or (T, 1), 1 at the first; None without times."""
    if time is None:
        return None
    given = tensor_of(call, "time", time).double()
    steps = given.diff(dim=0)
    fits = tuple(given.shape) in {(len(states),), tuple(states.shape[:-1])}
    if not fits or fails(given.isfinite().all() & (steps >= 0).all() & steps.isfinite().all()):
        streams = "" if states.dim() == 2 else f" or {tuple(states.shape[:-1])}"
        raise fail(call, "time", f"must be finite and increasing, ({len(states)},){streams}", time)
    return torch.cat((torch.ones_like(given[:1]), steps)).reshape(len(states), -1).to(states.device)


def lapse_of(call: str, lapse: Any, streams: int) -> Tensor:
    """Return the time since the sample before, (S,) float64, refused unless it is one number, or one for
    each stream, finite and not negative."""
    given = tensor_of(call, "lapse", lapse).double()
    fits = given.dim() <= 1 and given.numel() in (1, streams)
    if not fits or fails((given >= 0) & (given < torch.inf)):
        told = f"must be finite and not negative, () or ({streams},)"
        raise fail(call, "lapse", told, lapse)
    return given.expand(streams).contiguous()


def like_given(x: Any, found: Tensor) -> Any:
    return found if isinstance(x, Tensor) else found.numpy()
