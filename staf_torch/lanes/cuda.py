"""A row program on a CUDA device, a thread a row.

No device has run this yet; ``python -m tests.gpu`` does where there is one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from .combinators import Tree
from .given import Given
from .one_row import trace
from .program import Program
from .scalar_text import cuda_text
from .tree import Shared, flatten, plain, unflatten

_BLOCK = 128
_PRELUDE = """#ifndef NAN
#define NAN __int_as_float(0x7fffffff)
#endif
#ifndef INFINITY
#define INFINITY __int_as_float(0x7f800000)
#endif
"""
Compiler = Callable[[str, str], Callable[..., None]]


def device_compiler(source: str, name: str) -> Callable[..., None]:
    """Compile a kernel by NVRTC, through torch.

    Raises:
        RuntimeError: if this torch has no such way, or there is no device.
    """
    found = getattr(torch.cuda, "_compile_kernel", None)
    if found is None:
        raise RuntimeError(f"`lanes.cuda` needs torch 2.8 or later; got {torch.__version__}.")
    kernel: Callable[..., None] = found(source, name)
    return kernel


class Kernel:
    """A program compiled for a device, for inputs of the shapes and dtypes of these.

    Example:
        >>> kernel = lanes.cuda.Kernel(program, x0, u, (gain,))  # tensors on the device
        >>> x, history = kernel(x0, u, (gain,))

    Args:
        program: the program.
        carry, now, row, steps: as in a call of it.
        compile: source and name to a function called with grid, block, args.

    Attributes:
        source: CUDA C.

    Raises:
        NotLoweredError: if an operation has no scalar form.
    """

    def __init__(
        self,
        program: Program,
        carry: Tree,
        now: Tree = (),
        row: Tree = (),
        *,
        steps: int | None = None,
        compile: Compiler = device_compiler,
    ) -> None:
        given = Given.of(carry, now, row, steps)
        self._traced, self._real, self._key = trace(program.step, given, folded=True), given.real, given.key()
        shared = [
            f"{kind}{k}"
            for kind, leaves in (("row", given.row), ("now", given.now))
            for k, leaf in enumerate(leaves)
            if isinstance(leaf, Shared)
        ]
        self.source = _PRELUDE + cuda_text(*self._traced.program, name="lanes_kernel", shared=shared)
        self._kernel = compile(self.source, "lanes_kernel")

    def __call__(
        self, carry: Tree, now: Tree = (), row: Tree = (), *, steps: int | None = None, every: int = 1
    ) -> tuple[Tree, Tree]:
        """The carry after the last step, and the outputs at every ``every``-th time, as the program's.

        Raises:
            ValueError: if the inputs have other shapes or dtypes than those that the kernel was made for.
        """
        given = Given.of(carry, now, row, steps)
        if given.key() != self._key:
            raise ValueError("`Kernel(...)` must be called with inputs of the shapes that it was made for.")
        rows, recorded = given.rows, -(-given.times // every)
        leaves = flatten((row, now, carry))[0]
        times = [0] * len(given.row) + [1] * len(given.now) + [0] * len(given.carry)
        read = [self._packed(leaf, timed) for leaf, timed in zip(leaves, times, strict=True)]
        like = torch.empty(0, dtype=self._real, device=plain(leaves[-1]).device)
        ends = [like.new_empty(leaf[0].numel(), rows) for leaf in given.carry]
        outs = [like.new_empty(recorded, shape.numel(), rows) for shape, _ in self._traced.outputs]
        grid = (-(-rows // _BLOCK), 1, 1)
        self._kernel(grid, (_BLOCK, 1, 1), [rows, given.times, every, *read, *ends, *outs])
        after = [
            room.mT.reshape(leaf.shape).to(leaf.dtype) for room, leaf in zip(ends, given.carry, strict=True)
        ]
        results = [
            room.permute(2, 0, 1).reshape(rows, recorded, *shape).to(dtype)
            for room, (shape, dtype) in zip(outs, self._traced.outputs, strict=True)
        ]
        return given.tree("carry", after), unflatten(self._traced.structure, iter(results))

    def _packed(self, leaf: Any, timed: int) -> Tensor:
        """The numbers of an input as the kernel reads them: (times, entries, rows)."""
        tensor = plain(leaf).to(self._real)
        if isinstance(leaf, Shared):
            return tensor.contiguous()
        flat = tensor.reshape(*tensor.shape[: 1 + timed], -1)
        return flat.movedim(0, -1).contiguous()
