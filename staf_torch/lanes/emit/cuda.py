"""A row program on a CUDA device, a thread a row.

Run on an H100 by ``python -m tests.gpu``: equal to plain torch on the processor to 6e-15 in float64.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..call import Given
from ..program import Program
from ..trace.graph import ROW, STEP, Graph
from ..trace.step import trace
from ..tree import Shared, Tree, flatten, plain, unflatten
from .c import Names, _ScalarWriter
from .schedule import Schedule, Sizes

_KINDS = ("row", "now", "carry", "out")
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


class CudaKernel:
    """A program compiled for a device, for inputs of the shapes and dtypes of these.

    Example:
        >>> kernel = lanes.cuda.CudaKernel(program, x0, u, (gain,))  # tensors on the device
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
            raise ValueError("`CudaKernel(...)` needs inputs of the shapes that it was made for.")
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


class _CudaWriter(_ScalarWriter):
    def __init__(self, *given: Any, shared: Sequence[str]) -> None:
        super().__init__(*given)
        self._shared = frozenset(shared)

    def _fma(self, a: str, b: str, c: str) -> str:
        return f"fma{self._suffix}({a}, {b}, {c})"

    def _buffer(self, op: str, place: int, j: int, at: str = "0") -> str:
        slot, entry = self._slot(op, place)
        name, sizes = self._names[op][slot], {"row": self.layout.rows, "now": self.layout.nows}[op]
        index = f"{entry}" if at == "0" else f"({entry} + {at})"
        if op == "now":
            index = f"(t * {sizes[slot]} + {index})"
        return f"{name}[{index}]" if name in self._shared else f"{name}[{index} * rows + r]"

    def body(self, names: Names, following: Sequence[int], outputs: Sequence[int]) -> None:
        self._lines.append("{")
        self._line("const long long rows = row_count, times = time_count, every = period;")
        self._line("const long long r = (long long)blockIdx.x * blockDim.x + threadIdx.x;")
        self._line("if (r >= rows) return;")
        self._block(self.schedule.block(ROW))
        for place, node in enumerate(following):
            slot, entry = self._slot("state", place)
            value = self._typed(node, f"{names.carries[slot]}[{entry} * rows + r]")
            self._line(f"{self._type(node)} s{place} = {value};")
        with self._braces("for (long long t = 0; t < times; ++t)"):
            self._block(self.schedule.block(STEP))
            self._line("if (t % every == 0) {")
            done = 0
            for name, size in zip(names.outputs, self.layout.outputs, strict=True):
                for e in range(size):
                    value = self._ref(outputs[done + e], 0)
                    self._line(f"    {name}[(t / every * {size} + {e}) * rows + r] = {value};")
                done += size
            self._line("}")
            self._assign([(f"s{k}", node) for k, node in enumerate(following)])
        for place in range(len(following)):
            slot, entry = self._slot("state", place)
            self._line(f"{names.carries[slot]}_end[{entry} * rows + r] = s{place};")
        self._lines.append("}")


def cuda_text(
    graph: Graph,
    layout: Sizes,
    following: Sequence[int],
    outputs: Sequence[int],
    *,
    name: str,
    shared: Sequence[str],
) -> str:
    """Return CUDA C of a program, a thread a row, all times inside.

    ``NAME(row_count, time_count, period, row..., now..., carry..., carry_end..., out...)``; the numbers of a
    time lie together, entry after entry, a row beside the other: (times, entries, rows), without rows where
    shared: row0, now1, ...
    """
    names = Names(
        *([f"{kind}{k}" for k in range(len(sizes))] for kind, sizes in zip(_KINDS, layout, strict=True))
    )
    writer = _CudaWriter(graph, Schedule(graph, following, outputs), layout, names, shared=shared)
    read = [f"const {writer.real} *{n}" for n in (*names.rows, *names.nows, *names.carries)]
    written = [f"{writer.real} *{n}" for n in (*(f"{c}_end" for c in names.carries), *names.outputs)]
    arguments = ["int row_count", "int time_count", "int period", *read, *written]
    lines = [f'extern "C" __global__ void {name}({", ".join(arguments)})']
    lines += writer._function(lambda: writer.body(names, following, outputs))
    return "\n".join(lines) + "\n"
