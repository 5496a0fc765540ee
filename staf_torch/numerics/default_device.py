"""New tensors beside those that are given, whatever torch's default device is; designs on the CPU."""

from __future__ import annotations

import contextlib
import copy
import functools
import logging
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, Self, TypeVar

import torch
from torch import Tensor, nn
from torch.utils import _device
from torch.utils._pytree import tree_map_only

from ..lanes.calls.inputs import uncast
from ..lanes.trace.tracer import explained

Given = ParamSpec("Given")
Found = TypeVar("Found")
_log = logging.getLogger(__name__)


def on(device: torch.device) -> contextlib.AbstractContextManager[object]:
    """Return a context in which new tensors are on a device; of no cost where there is no default device."""
    return contextlib.nullcontext() if _device.CURRENT_DEVICE is None else device


def beside(function: Callable[Given, Found]) -> Callable[Given, Found]:
    """Decorate what makes tensors: they are on the device of its first tensor argument, else on the CPU.

    A default device (`torch.set_default_device`) is of the caller's own tensors. Designs and plans are made
    on the CPU, runs where their states are; an index or a table elsewhere would be read at a false address.
    Nor does `torch.autocast` reach within: products with the inverse of a Gram matrix have no digits to lose.
    """

    @functools.wraps(function)
    def placed(*args: Given.args, **more: Given.kwargs) -> Found:
        try:
            with uncast():
                if _device.CURRENT_DEVICE is None:
                    return function(*args, **more)
                given = (each.device for each in (*args, *more.values()) if isinstance(each, Tensor))
                with torch.device(next(given, torch.device("cpu"))):
                    return function(*args, **more)
        except RuntimeError as error:
            if (instead := explained(error, function.__qualname__)) is error:
                raise
            raise instead from error

    return placed


def device_of(*given: object) -> torch.device:
    """Return the device of the first tensor among tensors and those that modules hold, else the CPU."""
    return next((each.device for each in _tensors(given)), torch.device("cpu"))


def without_numbers(*given: object) -> bool:
    """Return whether a tensor among tensors and those that modules hold is on the meta device, so that
    nothing can be decided by its numbers."""
    return any(each.is_meta for each in _tensors(given))


def designed_on_cpu(function: Callable[Given, Found]) -> Callable[Given, Found]:
    """Decorate a design by small matrices: computed on the CPU, its tensors where those given are.

    A Riccati equation or a table of exponentials is no work for a device, branches on values, and has the
    same bits wherever the run is.
    """

    @functools.wraps(function)
    def designed(*args: Given.args, **more: Given.kwargs) -> Found:
        devices = (each.device for each in _tensors((*args, *more.values())) if not each.is_cpu)
        device = next(devices, None)
        if device is None:
            return function(*args, **more)
        if device.type == "meta":
            rule = "numbers decide, and the meta device has none: compute on the CPU"
            raise ValueError(f"in `{function.__name__}` {rule}, and move what is made there.")
        args, more = tree_map_only(Tensor, Tensor.cpu, (args, more))
        found: Found = tree_map_only(Tensor, lambda each: each.to(device), function(*args, **more))
        return found

    return designed


def where_held(
    call: str, held: Callable[[Any], Tensor]
) -> Callable[[Callable[Given, Found]], Callable[Given, Found]]:
    """Decorate a method, of this name in the log, that computes where a tensor of its object is: tensors
    of another device are moved there, what it returns back, and that is logged once."""

    def decorated(method: Callable[Given, Found]) -> Callable[Given, Found]:
        @functools.wraps(method)
        def moved(*args: Given.args, **more: Given.kwargs) -> Found:
            owner, where = args[0], held(args[0]).device
            first = next((each for each in (*args[1:], *more.values()) if isinstance(each, Tensor)), None)
            if first is None or first.device == where or first.is_meta:
                return method(*args, **more)
            _say_moved(call, where, first.device)
            given: Any = tree_map_only(Tensor, lambda each: each.to(where), (args[1:], more))
            answer = method(*(owner, *given[0]), **given[1])
            found: Found = tree_map_only(Tensor, lambda each: each.to(first.device), answer)
            return found

        return moved

    return decorated


@functools.cache
def _say_moved(call: str, where: torch.device, given: torch.device) -> None:
    _log.warning(
        "%s computes on %s, where its object is: states on %s are moved there, answers back. "
        "Modules moved with `.to(%r)` before compute there",
        *(call, where, given, str(given)),
    )


def on_cpu(given: Found) -> Found:
    """Return a module or a tensor on the CPU: itself, or a copy of what is on a device."""
    if isinstance(given, Tensor):
        return given.cpu()  # type: ignore[return-value]
    if isinstance(given, nn.Module) and not all(each.is_cpu for each in _tensors((given,))):
        return copy.deepcopy(given).cpu()
    return given


def _tensors(given: tuple[object, ...]) -> Iterator[Tensor]:
    for each in given:
        if isinstance(each, Tensor):
            yield each
        elif isinstance(each, nn.Module):  # names, as `parameters()` finds them, take ten times as long
            own = (*each._parameters.values(), *each._buffers.values())
            yield from (tensor for tensor in own if tensor is not None)
            yield from _tensors(tuple(each._modules.values()))


class KeptPrecision(nn.Module):
    """Base of modules that compute in the dtype that they were made with, whatever the caller's is.

    `.float()` and `.to(dtype)` leave their tensors as they are, and those of what they hold; devices are
    followed. A forward converts what comes and returns the caller's dtype.
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        def moved(tensor: Tensor) -> Tensor:
            after = fn(tensor)
            return after if after.dtype == tensor.dtype else tensor.to(after.device)

        done: Any = super()._apply(moved, recurse)  # type: ignore[no-untyped-call]
        return done  # type: ignore[no-any-return]
