"""Inputs of a program's call: lists of tensors, checked, structures of their trees, and where they are."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ..tree import Shared, Tree, flatten, labels, plain, unflatten

Form = tuple[torch.Size, tuple[int, ...], torch.dtype, Hashable]
"""Shape, strides and dtype of an input, whether all rows share it, and its device unless it is the CPU."""
Where = bool | torch.device
"""What runs compiled code: True for the processor's lanes, a device for its kernels, False for neither."""
processor: Where = True  # of tensors on the CPU; `device.host` has it be a device


def readable(x: Any, recorded: bool) -> bool:
    """Return whether compiled code may read a tensor where it lies, wherever that is.

    The one rule of all that is given to compiled code, samples of streams, too: a tensor of no subclass,
    without a pending sign, of which nobody wants a derivative: one that requires a gradient is refused where
    that is ``recorded``. Device, dtype and layout are the caller's.
    """
    return type(x) in _TENSORS and not (recorded and x.requires_grad) and not x.is_neg()


def seen(leaves: Sequence[Any]) -> tuple[tuple[Form, ...], Where]:
    """Return the forms of inputs, and where they are as `ordinary` has it."""
    recorded = torch.is_grad_enabled()
    if seen_by_others():
        return tuple(map(form, leaves)), False
    forms: list[Form] = []
    for leaf in leaves:
        shared = type(leaf) is Shared
        x = leaf.tensor if shared else leaf
        if not (readable(x, recorded) and x.is_cpu):
            return tuple(map(form, leaves)), ordinary(leaves)
        forms.append((x.shape, x.stride(), x.dtype, shared))
    return tuple(forms), processor


def ordinary(leaves: Sequence[Any], *, recorded: bool | None = None) -> Where:
    """Return where plain tensors are of which nobody wants a derivative, False of others.

    All that is given to compiled code passes here: dense, `readable`, on the CPU or one CUDA device. Under a
    tracer, a transform of torch.func or another mode the operations themselves are wanted.

    Where ``recorded``, by default where autograd is on, one that requires a gradient is refused.
    """
    if seen_by_others():
        return False
    recorded = torch.is_grad_enabled() if recorded is None else recorded
    tensors = [leaf.tensor if type(leaf) is Shared else leaf for leaf in leaves]
    if not all(readable(x, recorded) for x in tensors):
        return False
    if all(x.is_cpu for x in tensors):
        return processor
    places = {x.device for x in tensors if x.dim() or not x.is_cpu}  # single numbers aside
    where = places.pop()
    return where if not places and where.type == "cuda" else False


def served(leaves: Sequence[Any]) -> Where:
    """Return where plain tensors are, as `ordinary`, also where a derivative is wanted."""
    return ordinary(leaves, recorded=False)


def seen_by_others() -> bool:
    """Return whether a tracer, a transform of torch.func or forward mode looks at the operations."""
    looks = _transforms() is not None or forward_ad._current_level >= 0 or _modes() > 0
    return looks or _tracing() is not None


def transformed() -> bool:
    """Return whether a transform of torch.func or forward mode looks at the operations."""
    return _transforms() is not None or forward_ad._current_level >= 0


_TENSORS = (Tensor, torch.nn.Parameter)
_transforms, _modes = torch._C._functorch.peek_interpreter_stack, torch._C._len_torch_dispatch_stack
_tracing = torch._C._get_tracing_state  # of `torch.jit.trace`


def at_once(x: Tensor) -> bool:
    """Return `ordinary` of one tensor where the processor's lanes run it, and not on `device.host`."""
    return readable(x, torch.is_grad_enabled()) and x.is_cpu and processor is True and not seen_by_others()


def form(leaf: Any) -> Form:
    """Return what a plan must know about an input."""
    if type(leaf) is Tensor and leaf.is_cpu:  # most of all
        return leaf.shape, leaf.stride(), leaf.dtype, False
    tensor = plain(leaf)
    shared = type(leaf) is Shared
    place = shared if tensor.is_cpu else (shared, tensor.device)
    return tensor.shape, tensor.stride(), tensor.dtype, place


class one_precision:  # noqa: N801
    """Context of a function that computes in the precision of its inputs, as its machine code does.

    `torch.autocast` changes nothing within, or a result would hang on whether code had been built before.

    It raises ValueError in place of torch's error on two dtypes, where it reads a network or tensor of
    another.
    """

    def __init__(self, name: str, *inputs: Tree) -> None:
        self._name, self._inputs, self._uncast = name, inputs, uncast()

    def __enter__(self) -> None:
        self._uncast.__enter__()

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self._uncast.__exit__(kind, error, trace)
        if kind is None or kind is not RuntimeError or not re.search("same dtype|scalar type", str(error)):
            return
        floats = [x.dtype for x in map(plain, flatten(self._inputs)[0]) if x.is_floating_point()]
        real = floats[0] if floats else "of no precision"
        raise ValueError(
            f"{self._name}: its inputs are {real}, and a network or tensor that it reads is not: write "
            f"`net.to({real})`, or `net(x.float())` for 7 digits; torch's error: {str(error).strip()}"
        ) from error


def uncast() -> AbstractContextManager[object]:
    """Return a context in which `torch.autocast` is off."""
    kinds = [kind for kind in ("cpu", "cuda") if torch.is_autocast_enabled(kind)]
    if len(kinds) > 1:
        return _off(kinds)
    return torch.autocast(kinds[0], enabled=False) if kinds else nullcontext()  # torch's compiler reads it


@contextmanager
def _off(kinds: list[str]) -> Iterator[None]:
    with ExitStack() as off:
        for kind in kinds:
            off.enter_context(torch.autocast(kind, enabled=False))
        yield


def whole(name: str, value: object, least: int) -> int:
    """Return an argument of a program's call that must be an integer."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"`Program({name}=...)` must be an integer, at least {least}; got {value!r}.")
    return value


def _sizes(leaves: dict[str, list[Any]], structures: dict[str, Any]) -> tuple[int | None, int | None]:
    """Return the numbers of rows and times of inputs, checked: all that compiled code reads by address.

    Raises:
        ValueError: that names the input which has no numbers in order here, or another size than the others.
    """
    sizes: dict[str, tuple[int, str]] = {}
    device: tuple[torch.device, str] | None = None
    for tree in ("carry", "now", "row"):
        for label, leaf in zip(labels(structures[tree], tree), leaves[tree], strict=True):
            shared, tensor = type(leaf) is Shared, plain(leaf)
            name = f"`Program({tree}=...)`" + (f", its {label}," if label != tree else "")
            if shared and tree == "carry":
                raise ValueError(f"{name} must have rows; got a `Shared` tensor.")
            if not isinstance(tensor, Tensor):
                raise ValueError(f"{name} must be a tensor; got {type(tensor).__name__}.")
            if tensor.is_nested or tensor.is_quantized or tensor.layout is not torch.strided:
                kind = "nested" if tensor.is_nested else f"{tensor.layout}, {tensor.dtype}"
                raise ValueError(f"{name} must be dense; got a tensor that is {kind}.")
            if device is None:
                device = tensor.device, name
            elif tensor.device != device[0] and tensor.dim() > 0:
                raise ValueError(
                    f"{name} must be on {device[0]} like {device[1].rstrip(',')}; got one on {tensor.device}."
                )
            kinds = [] if shared else ["rows"]
            kinds += ["times"] if tree == "now" else []
            if tensor.dim() < len(kinds):
                raise ValueError(
                    f"{name} must begin with {' and '.join(kinds)}; got the shape {tuple(tensor.shape)}."
                )
            for kind, size in zip(kinds, tensor.shape, strict=False):
                known, first = sizes.setdefault(kind, (size, name))
                if known != size:
                    raise ValueError(f"{name} must have {known} {kind} like {first.rstrip(',')}; got {size}.")
    return sizes.get("rows", (None, ""))[0], sizes.get("times", (None, ""))[0]


class Given(NamedTuple):
    """The inputs of a call as lists."""

    carry: list[Tensor]
    now: list[Any]
    row: list[Any]
    structures: dict[str, Any]
    rows: int
    times: int

    @classmethod
    def of(cls, carry: Tree, now: Tree, row: Tree, steps: int | None) -> Given:
        leaves, structures = {}, {}
        for name, tree in (("carry", carry), ("now", now), ("row", row)):
            leaves[name], structures[name] = flatten(tree)
            try:
                hash(structures[name])
            except TypeError as error:
                rule = "must be a tree of tensors and numbers: write `torch.as_tensor` around an array"
                raise ValueError(f"`Program({name}=...)` {rule}; {error}.") from error
        rows, times = _sizes(leaves, structures)
        if rows is None:
            raise ValueError(
                "`Program(...)` must be given at least one tensor with a dimension of rows; got none."
            )
        if times is None:
            if steps is None:
                raise ValueError("`Program(steps=...)` must be given where no input has times; got None.")
            times = whole("steps", steps, 0)
        return cls(**leaves, structures=structures, rows=rows, times=times)

    @property
    def real(self) -> torch.dtype:
        floats = [plain(leaf).dtype for leaf in (*self.carry, *self.now, *self.row)]
        return torch.float64 if torch.float64 in floats or torch.float32 not in floats else torch.float32

    @property
    def formal(self) -> bool:
        """Return whether there are times, and no numbers: on the meta device a step has the shapes of all."""
        leaves = (*self.carry, *self.now, *self.row)
        return self.times > 0 and any(plain(leaf).is_meta for leaf in leaves)

    def trees(self) -> Tree:
        """The trees (row, now, carry)."""
        return tuple(self.tree(name, getattr(self, name)) for name in ("row", "now", "carry"))

    def tree(self, name: str, leaves: Sequence[Any]) -> Tree:
        return unflatten(self.structures[name], iter(leaves))

    def key(self) -> Hashable:
        parts: list[Hashable] = [(leaf.shape[1:], leaf.dtype) for leaf in self.carry]
        for skip, leaves in ((2, self.now), (1, self.row)):
            for leaf in leaves:
                shared = isinstance(leaf, Shared)
                tensor = plain(leaf)
                parts.append((tensor.shape[skip - shared :], tensor.dtype, shared))
        return tuple(parts), tuple(self.structures.values())

    def ordinary(self) -> Where:
        """Return where all tensors are, as `ordinary`; False where there are no rows or times."""
        if self.rows == 0 or self.times == 0:
            return False
        return ordinary((*self.carry, *self.now, *self.row))
