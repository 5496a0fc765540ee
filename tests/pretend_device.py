"""A device without a card: tensors that say they are elsewhere, and refuse to meet those of the CPU.

Their numbers are computed by the CPU, so that branches on values, metrics and files work as on a card. What a
card refuses is refused: tensors of two devices in one operation, NumPy, and reading at an address.
"""

from __future__ import annotations

from typing import Any, Self

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map_only, tree_unflatten

DEVICE = torch.device("lazy", 0)  # a kind that every torch knows, without a card or a driver


class Elsewhere(Tensor):
    """A tensor that is on `DEVICE`."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> Elsewhere:
        found = Tensor._make_wrapper_subclass(
            cls,
            here.shape,
            strides=here.stride(),
            storage_offset=here.storage_offset(),
            dtype=here.dtype,
            device=DEVICE,
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

    __torch_function__ = torch._C._disabled_torch_function_impl


class PretendDevice(TorchDispatchMode):
    """While this lasts `device="lazy"` makes tensors of the device."""

    def __enter__(self) -> Self:
        torch._C._set_only_lift_cpu_tensors(True)  # `torch.tensor` and its like go through here, too
        return super().__enter__()

    def __exit__(self, *raised: Any) -> None:
        torch._C._set_only_lift_cpu_tensors(False)
        super().__exit__(*raised)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})


BESIDE = ("copy_", "_to_copy", "index", "index_put", "index_put_", "_index_put_impl_", "set_", "lift_fresh")
"""Operations that take tensors of two devices."""


def computed(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Compute an operation on the CPU, its results where a card would have them."""
    leaves, _ = tree_flatten((args, kwargs))
    tensors = [leaf for leaf in leaves if isinstance(leaf, Tensor)]
    there = [each for each in tensors if isinstance(each, Elsewhere)]
    name = func.overloadpacket.__name__
    single = torch.Tag.pointwise in func.tags or name in ("where", "_local_scalar_dense")
    others = [each for each in tensors if not isinstance(each, Elsewhere) and not (single and each.dim() == 0)]
    if there and others and name not in BESIDE:
        shapes = ", ".join(f"{tuple(each.shape)} on {each.device}" for each in tensors)
        raise RuntimeError(f"Expected all tensors to be on the same device; {func} of {shapes}")
    if name == "_local_scalar_dense":
        return func(args[0].here) if there else func(*args)
    device = kwargs.get("device")
    if device is not None and torch.device(device).type == DEVICE.type:
        away = True
    elif device is not None:
        away = False
    elif name in ("copy_", "index", "index_put", "index_put_", "_index_put_impl_"):
        away = isinstance(args[0], Elsewhere)
    else:
        away = bool(there)
    if away and device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    plain_args, plain_kwargs = tree_map_only(Elsewhere, lambda each: each.here, (args, kwargs))
    if name == "_efficientzerotensor":  # without numbers, as some derivatives begin
        func = torch.ops.aten.zeros.default
    found = func(*plain_args, **plain_kwargs)
    given = {id(each.here): each for each in there}
    parts, structure = tree_flatten(found)
    for k, part in enumerate(parts):
        if isinstance(part, Tensor):
            if id(part) in given:  # written in place
                parts[k] = given[id(part)]
            elif away:
                parts[k] = Elsewhere(part)
    return tree_unflatten(parts, structure)
