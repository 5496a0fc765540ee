"""Tracing of a step with a single row: inputs become nodes, each operation is looked up among the rules.

An operation has a rule in single numbers (`rules`), moves entries (`decompositions`: torch itself
moves the numbers of nodes), or is written in simpler operations of torch that are traced in its place: this
library's (`factorisations`, `decompositions`), else torch's own decomposition.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from ..calls.inputs import Given, uncast
from ..row_numbers import RowNumbers, made_of_list, resolving
from ..tree import Shared, Tree, flatten, plain
from . import eigenvalues, factorisations
from . import reductions as reductions  # its rules
from .captured_tensors import Recipe, tensors
from .decompositions import MOVEMENTS, REPLACEMENTS, choice, moved, of_torch
from .graph import NOW, STEP, Graph, Sizes
from .loops import tracing
from .rules import RULES
from .tracer import NotLoweredError, Tracer


def lower(t: Tracer, func: Any, name: str, out: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """The nodes of what an operation returns: an array, or a list of them.

    Raises:
        NotLoweredError: if there is no rule.
    """
    # What torch's own decompositions end in takes the arguments of the operation of the same name.
    plain = name if name in REPLACEMENTS else name.removeprefix("prims::")
    if (chosen := choice(t, func, name, args, kwargs)) is None:
        if (rule := RULES.get(plain)) is not None:
            return rule(t, out, *args, **kwargs)
        if name in MOVEMENTS:
            return moved(t, func, out, args, kwargs)
    tables: Any = (FACTORISATIONS, REPLACEMENTS)
    decomposition = chosen or next((table[name] for table in tables if name in table), of_torch(func, args))
    if name == "linalg_lu_solve" and any(
        t.graph.value(node) != -1 for node in t.nodes(args[1]).ravel().tolist()
    ):
        decomposition = None  # the factors of somebody else
    if decomposition is None and func._can_decompose():  # of several operations, also in torch
        decomposition = func.decompose
    if decomposition is None:
        raise NotLoweredError(f"`{func}` cannot be compiled", plain)
    with t:
        result = decomposition(*args, **kwargs)
    parts = tensors(result)  # a slope that nobody wants is None
    nodes = [t.nodes(part) for part in parts]
    return nodes[0] if isinstance(result, Tensor) else nodes


Step = Callable[[Tree, Tree, Tree], tuple[Tree, Tree]]


class Traced(NamedTuple):
    """A program as every back end takes it, and its outputs for one row."""

    program: tuple[Graph, Sizes, list[int], list[int]]
    outputs: tuple[tuple[torch.Size, torch.dtype], ...]
    structure: Any
    recipe: Recipe
    rows: tuple[RowNumbers, ...]  # whose columns follow what a row has once


def trace(
    step: Step, given: Given, *, widened: bool = False, folded: bool = False, kept: Sequence[Tensor] = ()
) -> Traced:
    """Write down what a step does with a single row.

    Args:
        step: of the program.
        given: inputs.
        widened: whether the numbers of a float32 program are carried in double.
        folded: whether the numbers of captured tensors become part of the text.
        kept: captured tensors of which the text has what follows from them, too, and not the table.

    Raises:
        NotLoweredError: if an operation has no scalar form.
    """
    graph = Graph(given.real == torch.float32 and not widened)
    tracer = Tracer(graph, lower, widened=widened, folded=folded)

    own = _OwnNumbers(tracer, len(given.row), folded)
    with torch.no_grad():
        for tensor in kept:
            tracer.attach(tensor, tracer.nodes(tensor))
        row = given.tree("row", _inputs(tracer, "row", given.row, 0, 0))
        now = given.tree("now", _inputs(tracer, "now", given.now, NOW, 1))
        carry = _inputs(tracer, "state", given.carry, STEP, 0)
        with uncast(), tracer, tracing(tracer), resolving(own), _TorchFunctions(tracer):
            after, out = _taken(step, given.tree("carry", carry), now, row)
        ends, structure = flatten(after)
        if structure != given.structures["carry"] or _forms(ends) != _forms(carry):
            raise NotLoweredError(_other_carry(ends, carry))
        leaves, shape = flatten(out)
        _refuse_outputs(ends, leaves)
        following = [node for end in ends for node in tracer.nodes(end).ravel().tolist()]
        outputs = [node for leaf in leaves for node in tracer.nodes(leaf).ravel().tolist()]
        layout = Sizes(
            [_entries(leaf, 1) for leaf in given.row] + [numbers.numel() for numbers in own.read],
            [_entries(leaf, 2) for leaf in given.now],
            [_entries(leaf, 1) for leaf in given.carry],
            [leaf.numel() for leaf in leaves],
        )
    shapes = tuple((leaf.shape[1:], leaf.dtype) for leaf in leaves)
    return Traced((graph, layout, following, outputs), shapes, shape, tracer.captured.recipe(), own.read)


class _OwnNumbers:
    """Numbers of `rows(...)` that a step has read, in order: inputs that follow those of the row."""

    def __init__(self, tracer: Tracer, first: int, folded: bool) -> None:
        self._tracer, self._first, self._folded = tracer, first, folded
        self._found: dict[int, tuple[RowNumbers, Tensor]] = {}

    def __call__(self, numbers: RowNumbers) -> Tensor:
        """The input of one row that takes their place."""
        if self._folded:
            raise NotLoweredError(
                "it reads numbers of `rows(...)`, which this form of the program cannot hold"
            )
        if id(numbers) not in self._found:
            with _outside_transforms():  # met first in a derivative, say
                slot = self._first + len(self._found)
                found = self._tracer.input(numbers.full[:1], "row", slot)[0]
            self._found[id(numbers)] = numbers, found
        return self._found[id(numbers)][1]

    @property
    def read(self) -> tuple[RowNumbers, ...]:
        return tuple(numbers for numbers, _ in self._found.values())


def _inputs(tracer: Tracer, op: str, leaves: Sequence[Any], depth: int, times: int) -> list[Tensor]:
    """Leaves of an input for a single row, at one time where they have times."""
    traced = []
    for slot, leaf in enumerate(leaves):
        at = plain(leaf).detach()
        at = at if isinstance(leaf, Shared) else at[:1]
        at = at.select(0 if isinstance(leaf, Shared) else 1, 0) if times else at
        traced.append(tracer.input(at, op, slot, depth))
    return traced


def _taken(step: Step, carry: Any, now: Any, row: Any) -> tuple[Any, Any]:
    """The step; an error of its own, which the definition raises again, is NotLoweredError."""
    try:
        after, out = step(carry, now, row)
    except NotLoweredError:
        raise
    except Exception as error:
        raise NotLoweredError(f"{type(error).__name__}: {error}") from error
    return after, out


def _forms(leaves: Sequence[Any]) -> list[tuple[torch.Size, torch.dtype]]:
    return [(leaf.shape, leaf.dtype) for leaf in leaves]


def _refuse_outputs(ends: Sequence[Any], leaves: Sequence[Any]) -> None:
    if any(isinstance(leaf, RowNumbers) for leaf in (*ends, *leaves)):
        raise NotLoweredError("it reads numbers of `rows(...)` in another thread than the call's")
    if any(leaf.dim() == 0 or leaf.shape[0] != 1 for leaf in leaves):
        raise NotLoweredError("an output of the step has no dimension of rows")


def _other_carry(found: Sequence[Tensor], given: Sequence[Tensor]) -> str:
    pairs = (pair for pair in zip(_forms(found), _forms(given), strict=False) if pair[0] != pair[1])
    told = [f": {tuple(b[0])} {b[1]} became {tuple(a[0])} {a[1]}" for a, b in pairs]
    return f"the step returns a carry of other shapes or dtypes than it was given{''.join(told[:1])}"


def _entries(leaf: Any, skip: int) -> int:
    shape = leaf.tensor.shape[skip - 1 :] if isinstance(leaf, Shared) else leaf.shape[skip:]
    return shape.numel()


def _one_hot(index: Tensor, num_classes: int = -1) -> Tensor:
    if num_classes < 1:  # torch would read the largest index
        return torch.nn.functional.one_hot(index, num_classes)
    return (index.unsqueeze(-1) == torch.arange(num_classes, device=index.device)).to(torch.int64)


def _is_finite(x: Tensor) -> Tensor:
    if not x.is_floating_point():
        return torch.ones_like(x, dtype=torch.bool)
    return x.abs() < math.inf  # one comparison, where torch has two


class _TorchFunctions(TorchFunctionMode):
    """Context: what must be seen before a function of torch becomes operations, which are all a tracer sees.

    What takes the numbers of a row out of torch is refused, as nobody sees what becomes of them. A few
    functions of a traced tensor are plain torch operations: `eigvalsh` looks like `eigh` below, which takes
    many times as long; the slope of a determinant reads the factors that torch keeps; `one_hot` reads its
    input; `isfinite` compares twice.
    """

    def __init__(self, tracer: Tracer) -> None:
        super().__init__()
        self._traced, self._captured = tracer.traced, tracer.captured

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs, plain, name = kwargs or {}, _PLAIN.get(func), getattr(func, "__name__", "")
        if plain is not None and args and isinstance(args[0], Tensor):
            wrapped = torch._C._functorch.is_functorch_wrapped_tensor(args[0])
            if plain is eigenvalues.eigenvalues:  # a bisection has no derivative worth the name
                chosen = not wrapped and len(args) == 1 and not kwargs and self._traced(args[0])
            else:
                chosen = wrapped or self._traced(args[0])
            if chosen:
                return plain(*args, **kwargs)
        if (made := made_of_list(func, args, kwargs)) is not None:
            return made
        if name in _LEAVES_TORCH:
            if self._traced(args[0]):
                raise NotLoweredError(f"`Tensor.{name}` takes numbers of a row out of torch", name)
            self._captured.taken(args[0])
        if name == "__bool__" and args[0].is_floating_point():  # other numbers may be as true as this
            return bool(args[0] != 0)
        return func(*args, **kwargs)


def _outside_transforms() -> Any:
    """Context in which no derivative of `torch.func` is taken."""
    if torch._C._functorch.peek_interpreter_stack() is None:
        return contextlib.nullcontext()
    from torch._functorch.pyfunctorch import temporarily_clear_interpreter_stack

    return temporarily_clear_interpreter_stack()


_LEAVES_TORCH = ("numpy", "__array__", "tolist", "__dlpack__", "__repr__")
_PLAIN: dict[Any, Callable[..., Any]] = {
    torch.linalg.eigvalsh: eigenvalues.eigenvalues,
    torch.nn.functional.one_hot: _one_hot,
    **dict.fromkeys((torch.isfinite, Tensor.isfinite), _is_finite),
    **dict.fromkeys((torch.linalg.det, torch.det, Tensor.det), factorisations.determinant),
    **dict.fromkeys((torch.linalg.slogdet, torch.slogdet, Tensor.slogdet), factorisations.log_determinant),
    **dict.fromkeys((torch.logdet, Tensor.logdet), factorisations.log_of_determinant),
}

FACTORISATIONS: dict[str, Callable[..., Any]] = {
    "linalg_cholesky_ex": factorisations.cholesky,
    "linalg_solve_triangular": factorisations.triangular,
    "cholesky_solve": factorisations.cholesky_solve,
    "linalg_inv_ex": factorisations.inverse,
    "_linalg_solve_ex": factorisations.solve,
    "linalg_lu_solve": factorisations.solve_again,
    "linalg_qr": factorisations.orthogonal,
    "_linalg_eigh": eigenvalues.eigen,
}
