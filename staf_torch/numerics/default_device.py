"""New tensors beside those that are given, whatever torch's default device is."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.utils import _device

Given = ParamSpec("Given")
Found = TypeVar("Found")


def on(device: torch.device) -> contextlib.AbstractContextManager[object]:
    """Return a context in which new tensors are on a device; of no cost where there is no default device."""
    return contextlib.nullcontext() if _device.CURRENT_DEVICE is None else device


def beside(function: Callable[Given, Found]) -> Callable[Given, Found]:
    """Decorate what makes tensors: they are on the device of its first tensor argument, else on the CPU.

    A default device (`torch.set_default_device`) is of the caller's own tensors. Designs and plans are made
    on the CPU, runs where their states are; an index or a table elsewhere would be read at a false address.
    """

    @functools.wraps(function)
    def placed(*args: Given.args, **more: Given.kwargs) -> Found:
        if _device.CURRENT_DEVICE is None:
            return function(*args, **more)
        given = (each.device for each in (*args, *more.values()) if isinstance(each, Tensor))
        with torch.device(next(given, torch.device("cpu"))):
            return function(*args, **more)

    return placed
