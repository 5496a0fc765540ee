"""Run a step once with a single row and write down what every number of it is.

The step runs in torch, below autograd (`TorchDispatchMode`), on a batch of one row. Beside every storage lies
an array of integers, the nodes of its entries; an operation on tensors becomes operations on nodes, so that
views, broadcasting, writes in place, derivatives and `vmap` need no rules: torch has done them when an
operation arrives here. A graph of tensor operations (`torch.fx`, what `torch.compile` starts from) would keep
arrays of three numbers as arrays, in memory; as single numbers they are registers, equal ones are one, and
constants fold. More than `LARGE` entries stay an array, as a text of a thousand lines takes g++ minutes.
"""

from __future__ import annotations

import functools
import math
import re
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

from .captured_tensors import Captured
from .captured_tensors import tensors as _tensors
from .graph import FLAG, NARROW, REAL, ROW, WHOLE, WIDE, Graph, Ids

_OWN = (str(Path(__file__).parent.parent), str(Path(torch.__file__).parent))
_LINE = 120  # letters of a line of code in the log
LARGE = 64  # entries above which an operation on a tensor stays a loop over an array in memory
_READS = ("_local_scalar_dense", "equal", "is_nonzero", "nonzero", "allclose", "masked_select")

_RESHAPED = ("squeeze_", "unsqueeze_", "transpose_", "t_", "as_strided_")  # the same memory seen otherwise
_BLANK = ("zeros_like", "ones_like", "full_like", "new_zeros", "new_ones", "new_full")  # whatever the values
_CHOOSE = "write `torch.where(condition, a, b)`, or `lanes.repeat(..., where=)` for a loop that rows leave"
_MASKED = "write `y = torch.where(mask, new, y)`: how many entries a mask takes is the row's own"
_LEAST_SQUARES = "write `torch.linalg.solve(A.mT @ A, A.mT @ b)`, if the columns are independent"
_GRAM = "write `torch.linalg.eigh(A.mT @ A)`: its roots are the singular values"
_SLIDING = "write `(x.unfold(-1, width, stride) * weights).sum(-1)`"
_BITS = "write `%`, `//` and comparisons, or keep flags as bool"
_TORCH = "write it with torch, `torch.sin` for `math.sin` or `numpy.sin`"
_DRAWN = "draw the numbers before, and give them to every step as inputs of the times (`now`)"
_REAL = "keep the real and the imaginary part as two real tensors"
_INSTEAD: dict[str, str] = {
    **dict.fromkeys(("_local_scalar_dense", "is_nonzero", "equal", "allclose"), _CHOOSE),
    **dict.fromkeys(("nonzero", "masked_select", "masked_scatter", "index", "index_put"), _MASKED),
    **dict.fromkeys(("linalg_lstsq", "linalg_pinv"), _LEAST_SQUARES),
    "_linalg_svd": _GRAM,
    "linalg_eig": "write `torch.linalg.eigh`, if the matrix is symmetric",
    "linalg_lu_factor_ex": "write `torch.linalg.solve`",
    **dict.fromkeys(("convolution", "avg_pool2d", "max_pool2d_with_indices"), _SLIDING),
    **dict.fromkeys(("__lshift__", "__rshift__", "bitwise", "gcd"), _BITS),
    **dict.fromkeys(("numpy", "__array__", "tolist", "__dlpack__"), _TORCH),
    **dict.fromkeys(("_fft_r2c", "_fft_c2c", "_fft_c2r"), "write the sums of cosines and sines"),
    "gather": "write `gather`, `torch.take_along_dim` or `scatter` along one dimension",
    "scatter_add": "write `scatter_add` along one dimension",
    "scatter_reduce": "write `torch.where(index == k, value, ...)` and `amax` over the entries",
    "random": _DRAWN,
    "complex": _REAL,
    "half": "compute in float32 or float64: `.float()` or `.to(x.dtype)`",
}
"""What to write in place of an operation without a scalar form, for the line of the log that names one."""


class NotLoweredError(Exception):
    """A program that cannot be compiled: the operation, the line of user code that asked for it, and what to
    write in its place.
    """

    def __init__(self, reason: str, name: str = "") -> None:
        instead = _INSTEAD.get(name, "")
        super().__init__(f"{reason}{_where(traceback.extract_stack())}{'; ' + instead if instead else ''}")


def explained(error: RuntimeError, call: str) -> Exception:
    """Return the error of torch that a call met, which asks for numbers where there are none, as a
    sentence that names the line of code: of NumPy while torch takes derivatives, and on the meta device;
    another error as it is."""
    if re.search(r"\b([Mm]eta tensor|[Mm]eta device|device meta|register_meta)", str(error)):
        where = _where(traceback.extract_tb(error.__traceback__))
        return ValueError(
            f"`{call.removesuffix('.__init__')}` must have numbers, which decide{where}, and the meta device "
            f'has none: compute on the CPU, and move what is made there by `.to("meta")` ({error}).'
        )
    if "data pointer of Tensor that doesn't have storage" not in str(error):
        return error
    where = _where(traceback.extract_tb(error.__traceback__))
    return ValueError(
        f"numbers leave torch{where}, in a function of which derivatives are taken; {_INSTEAD['numpy']} "
        f"({error})."
    )


def _where(frames: Sequence[traceback.FrameSummary]) -> str:
    """The innermost line of code outside of torch and this compiler."""
    for frame in reversed(frames):
        if not frame.filename.startswith((*_OWN, "<")):
            return f" at {frame.filename}:{frame.lineno}: {(frame.line or '')[:_LINE]}"
    return ""


class Tracer(TorchDispatchMode):
    """Runs torch on a batch of one row and keeps beside every storage the nodes of its entries.

    Views need no rule: they see the nodes of the storage that they look at. What does not depend on an input
    is a constant and is not written down. Derivatives arrive here as ordinary operations.
    """

    def __init__(self, graph: Graph, lower: Callable[..., Any], *, widened: bool, folded: bool) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.graph, self._lower, self._widened = graph, lower, widened
        self.captured, self._folded = Captured(), folded
        self.inside = 0  # loops around what is traced now
        self._storages: dict[int, tuple[Any, Ids]] = {}  # keeps the storages: an address is used once

    def kind(self, dtype: torch.dtype) -> str:
        """The type of nodes for a dtype.

        Raises:
            NotLoweredError: where there is none.
        """
        if dtype == torch.bool:
            return FLAG
        if dtype == torch.float64:
            return WIDE if self.graph.single else REAL
        if dtype == torch.float32:  # widened: a float32 program whose numbers are carried in double
            return REAL if self.graph.single or self._widened else NARROW
        if dtype.is_complex:
            raise NotLoweredError(f"{dtype} is not supported in compiled programs", "complex")
        if dtype.is_floating_point:
            raise NotLoweredError(f"{dtype} is not supported in compiled programs", "half")
        return WHOLE

    def attach(self, tensor: Tensor, nodes: Ids) -> Tensor:
        """Let the entries of a new tensor be these nodes."""
        if tensor.numel():
            storage = tensor.untyped_storage()
            held = np.zeros(storage.nbytes() // tensor.element_size(), dtype=np.int64)
            self._storages[storage.data_ptr()] = (storage, held)
            self._view(held, tensor)[...] = nodes
        return tensor

    def input(self, like: Tensor, op: str, slot: Any, depth: int = ROW) -> Tensor:
        """A tensor whose entries are new inputs; its values are those of ``like``."""
        tensor = like.detach().clone(memory_format=torch.contiguous_format)
        kind = self.kind(tensor.dtype)
        new = [self.graph.add(op, (), kind, (slot, k), depth) for k in range(tensor.numel())]
        return self.attach(tensor, np.array(new, dtype=np.int64).reshape(tensor.shape))

    def traced(self, tensor: Tensor) -> bool:
        """Return whether anything of it depends on an input."""
        if tensor.numel() == 0 or tensor._is_zerotensor():  # of forward mode: zeros without memory
            return False
        return tensor.untyped_storage().data_ptr() in self._storages

    def nodes(self, value: Any, kind: str | None = None) -> Ids:
        """The nodes of a tensor's or number's entries, as one type."""
        if isinstance(value, Tensor):
            traced = self.traced(value)
            half = value.dtype in (torch.float16, torch.bfloat16) and not traced  # numbers of float32 too
            own = self.kind(torch.float32 if half else value.dtype)
            if traced:
                found = self._view(self._storages[value.untyped_storage().data_ptr()][1], value)
            elif self.stated(value):
                found = self._constants(value, own)
            else:
                # A number of float32 is one of float64: the table needs it once.
                direct = kind is not None and (own in (FLAG, NARROW) or {own, kind} <= {REAL, WIDE})
                own = kind if direct and kind is not None else own
                found = self._parameters(value, own)
        else:
            own = FLAG if isinstance(value, bool) else (kind or REAL)
            found = np.array(self.graph.constant(value, own), dtype=np.int64)
        if kind is None or kind == own:
            return found
        return self.each(lambda n: self.graph.convert(n, kind), found)

    def each(self, function: Callable[..., int], *arrays: Ids) -> Ids:
        """The function of every entry of arrays that broadcast."""
        return _of_each(function, _broadcast(arrays))

    def map(self, op: str, *arrays: Ids, least: int = LARGE) -> Ids:
        """An operation of every entry of arrays that broadcast: scalar by scalar, or a loop over many."""
        graph = self.graph
        spread = _broadcast(arrays)
        if spread[0].size > least and not self._folds(spread):
            operands = [self._operand(part.reshape(-1)) for part in spread]
            type = FLAG if op in ("lt", "le", "eq", "ne") else graph.type[int(spread[-1].flat[0])]
            aux = (op, spread[0].shape, *(places for _, places in operands))
            array = graph.add("map", [node for node, _ in operands], type, aux)
            return self.entries(array, type, spread[0].size).reshape(spread[0].shape)
        if op == "where":
            return _of_each(graph.where, spread)
        return _of_each(lambda *entries: graph.apply(op, *entries), spread)

    def cast(self, array: Ids, kind: str) -> Ids:
        """Every entry as another type."""
        return self.each(lambda node: self.graph.convert(node, kind), array)

    def total(self, array: Ids) -> Ids:
        """The sum over the last dimension."""
        graph = self.graph
        if array.size > LARGE and array.shape[-1] > 1:
            node, places = self._operand(array.reshape(-1))
            if places is not None and graph.op[node] == "map" and graph.aux[node][0] == "mul":
                product, inner = graph.args[node], graph.aux[node][2:]
                maps = [None if m is None else tuple(m[p] for p in places) for m in inner]
                return self._dot(product[0], maps[0], product[1], maps[1], array.shape)
            one = graph.constant(1.0, graph.type[int(array.flat[0])])
            return self._dot(one, None, node, places, array.shape)
        out: Ids = array[..., 0]
        for k in range(1, array.shape[-1]):
            out = self.map("add", out, array[..., k])
        return out

    def products(self, a: Ids, b: Ids) -> Ids:
        """The sum over the last dimension of the product of arrays that broadcast."""
        a, b = np.broadcast_arrays(a, b)
        if a.size > LARGE and a.shape[-1] > 1 and not self._folds((a, b)):
            return self._dot(*self._operand(a.reshape(-1)), *self._operand(b.reshape(-1)), a.shape)
        if self.graph.type[int(b.flat[0])] != NARROW:
            return self.total(self.map("mul", a, b))
        total = np.array(self.graph.constant(-0.0, REAL))
        for k in range(a.shape[-1]):  # of float32: products are exact in double, every sum is rounded
            product = self.map("mul", *(self.cast(part[..., k], REAL) for part in (a, b)))
            total = self.cast(self.cast(self.map("add", product, total), NARROW), REAL)
        return self.cast(total, NARROW)

    def _dot(self, a: int, at: Any, b: int, by: Any, shape: Sequence[int]) -> Ids:
        """Sums of products as a loop: shape (..., K), summed over K."""
        kind = self.graph.type[b]
        outs = math.prod(shape[:-1])
        array = self.graph.add("dot", (a, b), kind, (outs, shape[-1], at, by))
        return self.entries(array, kind, outs).reshape(shape[:-1])

    def on_matrix(self, op: str, rows: Ids, kind: str) -> Ids:
        """Return the entries of what an operation of `graph.IN_PLACE` makes of a matrix.

        Of "tridiagonal": the diagonal and the squares beside it, over the largest |entry|, and that; of
        "cholesky": L, row by row, and 0 or the place of a pivot that is not positive; of "substitute" of
        (T B), a lower triangle and what is beside it: (T T^-1 B).
        """
        array, places = self.array(rows.reshape(-1), kind)
        node = self.graph.add(op, (array,), kind, ("copy", rows.shape, tuple(places.tolist())))
        return self.entries(node, kind, self.graph.size(node))

    def _folds(self, arrays: Sequence[Ids]) -> bool:
        op = self.graph.op
        return all(op[n] == "const" for array in arrays for n in set(array.reshape(-1).tolist()))

    def _operand(self, flat: Ids) -> tuple[int, tuple[int, ...] | None]:
        """Return what a loop over these nodes reads: one node for all, or an array and the places in it."""
        if (flat == flat[0]).all():
            return int(flat[0]), None
        array, places = self.array(flat, self.graph.type[int(flat[0])])
        return array, tuple(places.tolist())

    def array(self, flat: Ids, kind: str) -> tuple[int, Ids]:
        """An array that holds these nodes, and their places in it."""
        graph, first = self.graph, int(flat[0])
        nodes = flat.tolist()
        if graph.op[first] == "elem":
            array = graph.args[first]
            if all(graph.op[n] == "elem" and graph.args[n] == array for n in nodes):
                return array[0], np.array([graph.aux[n] for n in nodes], dtype=np.int64)
        place: dict[
            int, int
        ] = {}  # in the order of first use: a broadcast tensor is then read at even strides
        places = [place.setdefault(n, len(place)) for n in nodes]
        if 4 * len(place) <= len(nodes):  # a tensor that was broadcast
            return self.pack(np.array(list(place), dtype=np.int64), kind), np.array(places, dtype=np.int64)
        return self.pack(flat, kind), np.arange(len(nodes))

    def pack(self, flat: Ids, kind: str) -> int:
        """A new array of these nodes."""
        return self.graph.add("pack", flat.tolist(), kind, len(flat))

    def entries(self, array: int, kind: str, count: int) -> Ids:
        """The nodes of the entries of an array."""
        new = [self.graph.add("elem", (array,), kind, k) for k in range(count)]
        return np.array(new, dtype=np.int64)

    def stated(self, tensor: Tensor) -> bool:
        """Return whether the values of a tensor shared by all rows may be written into the generated code."""
        return self._folded or self.captured.stated(tensor)

    def _parameters(self, tensor: Tensor, kind: str) -> Ids:
        return self.captured.numbers(tensor, kind, lambda number: self.graph.parameter(number, kind))

    def _constants(self, tensor: Tensor, kind: str) -> Ids:
        with _disable_current_modes():
            # The tangent of a constant in forward mode is a zero without memory.
            numbers = (
                [0.0] * tensor.numel() if tensor._is_zerotensor() else tensor.detach().reshape(-1).tolist()
            )
        return np.array([self.graph.constant(n, kind) for n in numbers], dtype=np.int64).reshape(tensor.shape)

    def _view(self, held: Ids, tensor: Tensor) -> Ids:
        strides = [8 * s for s in tensor.stride()]
        return np.ndarray(tensor.shape, np.int64, held, 8 * tensor.storage_offset(), strides)

    def _dispatch(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        tensors = _tensors((args, kwargs))
        name, draws, writes = _facts(func)
        if draws and not _own_generator(args, kwargs):
            raise NotLoweredError(f"`{func}` draws random numbers", "random")
        if name in _BLANK or not any(self.traced(tensor) for tensor in tensors):
            out = func(*args, **kwargs)
            self.captured.ran(func, args, kwargs, out)
            return out
        masked = name == "index" and any(i is not None and i.dtype == torch.bool for i in args[1])
        if masked and any(self.traced(i) for i in args[1] if i is not None):
            reason = "`aten.index` at a mask that the row computes cannot be compiled"
            raise NotLoweredError(reason, "index")  # also where it takes no entry of this row
        if name in _READS or (name != "index" and torch.Tag.dynamic_output_shape in func.tags):
            raise NotLoweredError(f"`{func}` reads a value of a row", name)
        if name in _RESHAPED:
            return func(*args, **kwargs)
        if name.endswith("_") and not name.endswith("__"):
            return self._in_place(func, name.removesuffix("_"), args, kwargs)
        if writes:
            raise NotLoweredError(f"`{func}` writes to an argument")
        out = func(*args, **kwargs)
        results = _tensors(out)
        if all(self.traced(result) or not result.numel() for result in results):
            return out  # views
        nodes = self._lower(self, func, name, out, args, kwargs)
        for result, entries in zip(results, nodes if isinstance(nodes, list) else [nodes], strict=True):
            alike = entries.shape == result.shape
            self.attach(result, entries if alike else np.broadcast_to(entries, result.shape))
        return out

    def _in_place(self, func: Any, name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> Tensor:
        """x.f_(...): the nodes of x become those of x.f(...)."""
        target: Tensor = args[0]
        if not self.traced(target):  # a tensor of constants that a row's numbers go into
            storage = target.untyped_storage()
            whole = torch.as_strided(target, (storage.nbytes() // target.element_size(),), (1,), 0)
            self.attach(whole, self.nodes(whole))
        nodes = self._lower(self, func, name, target, args, kwargs)
        held = self._storages[target.untyped_storage().data_ptr()][1]
        self._view(held, target)[...] = nodes
        return target


@functools.cache
def _facts(func: Any) -> tuple[str, bool, bool]:
    """The name of an operation, whether it draws random numbers and whether it writes to an argument.

    torch makes the list of its arguments anew whenever it is asked, which takes as long as the operation.
    """
    writes = any(argument.alias_info and argument.alias_info.is_write for argument in func._schema.arguments)
    draws = torch.Tag.nondeterministic_seeded in func.tags
    return func._schema.name.removeprefix("aten::"), draws, writes


def _broadcast(arrays: Sequence[Ids]) -> Sequence[Ids]:
    """The arrays in one shape, which most have already."""
    alike = all(array.shape == arrays[0].shape for array in arrays)
    return arrays if alike else np.broadcast_arrays(*arrays)


def _of_each(function: Callable[..., int], spread: Sequence[Ids]) -> Ids:
    """The function of every entry of arrays of one shape."""
    flat = [array.reshape(-1).tolist() for array in spread]
    out = [function(*entries) for entries in zip(*flat, strict=True)]
    return np.array(out, dtype=np.int64).reshape(spread[0].shape)


def _own_generator(args: Sequence[Any], kwargs: dict[str, Any]) -> bool:
    """Return whether random numbers come from a given generator: one seeded in a step repeats itself."""
    return any(isinstance(value, torch.Generator) for value in (*args, *kwargs.values()))


# Set here and not in the class, where torch would wrap the method and import its compiler, three seconds.
Tracer.__torch_dispatch__ = Tracer._dispatch  # type: ignore[assignment]
