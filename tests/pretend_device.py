"""A device without a card: tensors that say they are elsewhere, and refuse to meet those of the CPU.

Their numbers are computed by the CPU, so that branches on values, metrics and files work as on a card. What a
card refuses is refused: tensors of two devices in one operation, NumPy, and reading at an address.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

DEVICE = torch.device("lazy", 0)  # a kind that every torch knows, without a card or a driver


class Elsewhere(Tensor):
    """A tensor that is on `DEVICE`."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> Elsewhere:
        more = {"strides": here.stride(), "storage_offset": here.storage_offset(), "dtype": here.dtype}
        # The shape is that of `here` at any time, as some operations change it in place.
        found = Tensor._make_wrapper_subclass(
            cls, here.shape, device=DEVICE, dispatch_sizes_strides_policy="sizes", **more
        )
        found.here = here
        return found

    def __repr__(self, *, tensor_contents: object = None) -> str:
        return f"Elsewhere({self.here!r})"

    def tolist(self) -> Any:
        return self.here.tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        with torch.DisableTorchFunctionSubclass():
            return func(*args, **(kwargs or {}))


BESIDE = ("copy_", "_to_copy", "index", "index_put", "index_put_", "_index_put_impl_", "set_")
"""Operations that take tensors of two devices."""


_FORM = {
    "sym_size": Tensor.size,
    "size": Tensor.size,
    "sym_stride": Tensor.stride,
    "stride": Tensor.stride,
    "sym_storage_offset": Tensor.storage_offset,
    "storage_offset": Tensor.storage_offset,
    "sym_numel": Tensor.numel,
    "numel": Tensor.numel,
    "dim": Tensor.dim,
    "is_contiguous": Tensor.is_contiguous,
    "sym_is_contiguous": Tensor.is_contiguous,
    "is_strides_like_format": lambda here, _: here.is_contiguous(),
    "is_non_overlapping_and_dense": lambda here: True,
}


def computed(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Compute an operation on the CPU, its results where a card would have them."""
    name = func.overloadpacket.__name__
    if name in _FORM:
        return _FORM[name](args[0].here, *args[1:])
    given: dict[int, Elsewhere] = {}
    others: list[Tensor] = []

    def brought(each: Any) -> Any:
        if isinstance(each, Elsewhere):
            given[id(each.here)] = each
            return each.here
        if isinstance(each, Tensor):
            others.append(each)
        elif isinstance(each, list | tuple) and each and not isinstance(each[0], int | float | str):
            return type(each)(map(brought, each))
        return each

    args = tuple(map(brought, args))
    kwargs = {key: brought(value) for key, value in kwargs.items()}
    if others and name not in BESIDE:
        single = torch.Tag.pointwise in func.tags or name == "where"
        if not single or any(each.dim() for each in others):
            shapes = ", ".join(str(tuple(each.shape)) for each in (*given.values(), *others))
            raise RuntimeError(f"Expected all tensors to be on the same device; {func} of {shapes}")
    if name == "_local_scalar_dense":
        return func(*args)
    away = True
    if kwargs.get("device") is not None:
        away = torch.device(kwargs["device"]).type == DEVICE.type
        kwargs["device"] = torch.device("cpu")
    elif name in BESIDE:
        away = id(args[0]) in given

    def sent(each: Any) -> Any:
        if isinstance(each, Tensor):
            return given[id(each)] if id(each) in given else Elsewhere(each)
        return type(each)(map(sent, each)) if isinstance(each, list | tuple) else each

    found = func(*args, **kwargs)
    return sent(found) if away else found


def _made(function: Any) -> Any:
    def make(*args: Any, layout: Any = None, pin_memory: Any = None, **more: Any) -> Tensor:
        return Elsewhere(function(*args, **{**more, "device": torch.device("cpu")}))

    return make


def _copied(source: Tensor, target: Elsewhere, non_blocking: bool = False) -> Tensor:
    target.here.copy_(source.here if isinstance(source, Elsewhere) else source)
    return target


_MAKING = {"empty": ("memory_format",), "eye": ("default", "m"), "arange": ("default", "start", "start_step")}
_MAKING |= dict.fromkeys(
    ("empty_strided", "linspace", "logspace", "tril_indices", "triu_indices"), ("default",)
)
_LIBRARY = torch.library.Library("aten", "IMPL")  # what makes tensors of the device; all else meets them
_KEY = DEVICE.type.capitalize()
for _name, _overloads in _MAKING.items():
    for _overload in _overloads:
        _operation = getattr(getattr(torch.ops.aten, _name), _overload)
        _LIBRARY.impl(_operation, _made(_operation), _KEY)
_LIBRARY.impl("_efficientzerotensor", _made(torch.zeros), _KEY)
_LIBRARY.impl("_copy_from", _copied, _KEY)
