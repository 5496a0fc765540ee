"""The steps behind a gradient: one that keeps the carries, and the adjoint, from the last time to the first.

The adjoint is a step of a row like any other, written with `torch.func.vjp`, so that a program of it runs
where the first one runs. A tensor that the step found elsewhere becomes an input of it: wherever torch meets
it, another stands in its place.

The program of an adjoint, of the numbers of a step.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from ..calls.inputs import Given
from ..gradients import vjp
from ..row_numbers import RowNumbers
from ..trace.graph import NOW, REAL, STEP, Graph, Sizes
from ..trace.step import Step, Traced, trace
from ..trace.step_copy import StepCopy
from ..trace.tracer import NotLoweredError
from ..tree import Shared, Tree, flatten, plain, unflatten
from .carries import parts
from .reverse import Reverse


class Differentiated(NamedTuple):
    """Flags of leaves: which have a gradient, and which one comes from."""

    carry: tuple[bool, ...]  # leaves of the next carry that decide what is wanted
    now: tuple[bool, ...]
    shared: tuple[bool, ...]  # which inputs of a time are alike for all rows
    row: tuple[bool, ...]
    captured: tuple[int, ...]  # places among the tensors that the step reads
    numbers: tuple[int, ...]  # places among the numbers of rows
    outputs: tuple[bool, ...]


def keeping_step(step: Step) -> Step:
    """Return the step that also puts out the carry as it was before."""

    def keeping(carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
        after, out = step(carry, now, row)
        return after, (out, tuple(flatten(carry)[0]))

    return keeping


def adjoint_step(
    step: Step,
    structures: dict[str, Any],
    wanted: Differentiated,
    captured: Sequence[Tensor],
    numbers: Sequence[RowNumbers],
) -> Step:
    """Return the step from the gradients by the next carry to those by the carry.

    Its carry is (gradients by the carry's leaves that matter, sums over times of those by what a row has once
    and by captured tensors), its inputs of a time (the carry before, leaf by leaf, the inputs, the gradients
    by the outputs that have one), its inputs of a row (their leaves, captured tensors, numbers of rows).
    """

    def adjoint(carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
        (slopes, sums), (before, brought, ends), (once, found, columns) = carry, now, row
        groups = [*zip(before, wanted.carry, strict=True), *zip(brought, wanted.now, strict=True)]
        groups += [*zip(once, wanted.row, strict=True)]
        given = [leaf for leaf, one in groups if one] + [*found, *columns]

        def forward(*inputs: Tensor) -> tuple[Tensor, ...]:
            rest = iter(inputs)
            leaves = iter([next(rest) if one else leaf for leaf, one in groups])
            trees = [unflatten(structures[kind], leaves) for kind in ("carry", "now", "row")]
            others: dict[int, Tensor] = {id(tensor): next(rest) for tensor in captured}
            others |= {id(each): next(rest)[0] for each in numbers}
            with Substituted(others) as substituted:
                after, out = step(*trees)
            if substituted.unmet:
                raise NotLoweredError(
                    "the step reads a tensor that requires a gradient in a way that a trace does not record"
                )
            made = *flatten(after)[0], *flatten(out)[0]
            chosen = zip(made, (*wanted.carry, *wanted.outputs), strict=True)
            return tuple(leaf for leaf, one in chosen if one)

        _, pull = vjp(forward, *given)[:2]
        found_slopes = iter(pull((*slopes, *ends)))
        earlier = [next(found_slopes) for one in wanted.carry if one]
        at_times = [
            next(found_slopes).unsqueeze(0) if shared else next(found_slopes)
            for one, shared in zip(wanted.now, wanted.shared, strict=True)
            if one
        ]
        total = [before + slope.to(before.dtype) for before, slope in zip(sums, found_slopes, strict=True)]
        return (tuple(earlier), tuple(total)), tuple(at_times)

    return adjoint


class ReversedStep:
    """The step of `adjoint_step` as the reverse of the numbers of a step, where torch's conventions allow it.

    ``numbers`` of its table have slopes: where each run of them begins, and its length.
    """

    def __init__(
        self, step: Step, given: Given, wanted: Differentiated, numbers: tuple[tuple[int, int], ...]
    ) -> None:
        self._step, self._given, self._wanted, self._numbers = step, given, wanted, numbers

    def __call__(self, carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
        raise NotLoweredError("an adjoint that is no function of torch")

    def traced(self, given: Given, *, widened: bool = False) -> Traced:
        """Return the program, for inputs like these."""
        one = trace(self._step, self._given, widened=widened)
        program = reversed_program(one.program, self._wanted, self._numbers, len(self._given.row))
        brought = given.now[len(self._given.carry) :]
        slopes = [leaf for leaf, chosen in zip(brought, self._wanted.now, strict=False) if chosen]
        forms = [
            (x.tensor.shape[1:], x.tensor.dtype) if isinstance(x, Shared) else (x.shape[2:], x.dtype)
            for x in slopes
        ]
        return one._replace(program=program, outputs=tuple(forms), structure=flatten(tuple(slopes))[1])


class Deciding(NamedTuple):
    """Facts that an adjoint depends on."""

    carry: tuple[bool, ...]  # leaves that decide, now or later, what has a gradient: all goes through them
    usual: bool  # whether it is made of a row by operations of which `reverse` has torch's derivative


def deciding(
    step: Step, given: Given, own: Sequence[Tensor], ends: Sequence[bool], outputs: Sequence[bool]
) -> Deciding:
    """Find out what an adjoint depends on by a step in plain torch, with all passes of loops."""

    def leaf(x: Tensor) -> Tensor:
        return x.detach().requires_grad_(x.is_floating_point())

    leaves = [*map(leaf, given.carry)]
    now = [leaf(plain(x)[0] if isinstance(x, Shared) else x[:, 0]) for x in given.now]
    row = [leaf(plain(x)) for x in given.row]
    with torch.enable_grad(), _Seen(), _Cut() as cut:  # type: ignore[no-untyped-call]
        after, out = step(given.tree("carry", leaves), given.tree("now", now), given.tree("row", row))
    following, made = flatten(after)[0], flatten(out)[0]
    moves = [x.requires_grad for x in leaves]
    real = [leaf for leaf in leaves if leaf.requires_grad]
    alive = [end and moving for end, moving in zip(ends, moves, strict=True)]
    while True:
        roots = [x for x, one in zip((*following, *made), (*alive, *outputs), strict=True) if one]
        with torch.enable_grad():  # of sums: beside gradients of another shape torch imports SymPy
            sums = [root.sum() for root in roots if root.requires_grad]
        slopes = (
            torch.autograd.grad(sums, real, retain_graph=True, allow_unused=True) if sums and real else ()
        )
        met = iter([slope is not None for slope in slopes] or [False] * len(real))
        reached = [moving and next(met) for moving in moves]
        more = [one or found for one, found in zip(alive, reached, strict=True)]
        if more == alive:
            break
        alive = more
    return Deciding(tuple(alive), not cut.met and _usual(roots, [*leaves, *now, *row, *own]))


def _usual(roots: Sequence[Tensor], leaves: Sequence[Tensor]) -> bool:
    """Return whether operations on a row are among `_USUAL`, and others torch's own."""
    own = {id(x) for x in leaves}
    waiting = [x.grad_fn or torch.autograd.graph.get_gradient_edge(x).node for x in roots if x.requires_grad]
    above: dict[Any, list[Any]] = {node: [] for node in waiting}
    rows = []
    while waiting:
        node = waiting.pop()
        if isinstance(node, torch.autograd.function.BackwardCFunction):
            return False
        if id(getattr(node, "variable", None)) in own:
            rows.append(node)
        for below, _ in node.next_functions:
            if below is not None:
                if below not in above:
                    above[below] = []
                    waiting.append(below)
                above[below].append(node)
    seen, own_nodes = set(rows), frozenset(rows)
    while rows:
        for node in above[rows.pop()]:
            if node in seen:
                continue
            seen.add(node)
            rows.append(node)
    for node in seen.difference(own_nodes):
        name = _BACKWARD.sub("", node.name())
        power = getattr(node, "_saved_exponent", 1) if name == "Pow" else 1
        if name not in _USUAL or isinstance(power, Tensor) or (power < 1 and power != 0.5):
            return False
        factor = node.next_functions[1][0] if name == "CholeskySolve" else None
        if factor is not None and (factor in seen or _BACKWARD.sub("", factor.name()) not in _LOWER):
            return False  # torch has slopes above the diagonal, which nobody reads
    return True


_LOWER = ("LinalgCholeskyEx", "Tril")
_BACKWARD = re.compile(r"(Backward)+s?\d*$")
_NAMES = """Add Sub Rsub Mul Div Neg Exp Expm1 Log Log1P Sin Cos Tan Tanh Sqrt Rsqrt Reciprocal Pow
    Abs Where MaskedFill Sum Mean Cumsum Mm Bmm Addmm Baddbmm Mv Dot CholeskySolve
    LinalgSolveTriangular View ReshapeAlias UnsafeView Expand Permute Transpose T Squeeze Unsqueeze
    Select Slice Unbind Split SplitWithSizes Cat Stack Index IndexSelect IndexPut IndexPutImpl
    Gather ConstantPadNd Diagonal DiagEmbed Flip Roll Repeat Unfold Clone ToCopy Alias Copy
    CopySlices Fill Tril Triu"""
_USUAL = frozenset(_NAMES.split())
"""Operations, as autograd calls them, that have torch's derivative where they are single numbers."""


class _Cut(TorchFunctionMode):
    """Context that notes whether something cuts a derivative that goes through other operations."""

    met = False

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        name = getattr(func, "__name__", "")
        off = name.endswith("set_grad_enabled") and not args[0]
        self.met = self.met or off or name in ("detach", "detach_") or func == _DATA
        return func(*args, **kwargs or {})


_DATA = Tensor.data.__get__  # type: ignore[attr-defined]


class _Seen(TorchDispatchMode):
    """Context in which nothing but operations is done, as somebody who traces them wants it."""

    def _dispatch(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return func(*args, **kwargs or {})


# Set here and not in the class, where torch would wrap the method and import its compiler, seconds.
_Seen.__torch_dispatch__ = _Seen._dispatch  # type: ignore[assignment]


class Substituted(TorchFunctionMode):
    """Context: in place of some tensors, wherever a function of torch meets them, it is given others."""

    def __init__(self, others: dict[int, Tensor]) -> None:
        super().__init__()
        self._others, self.unmet = others, set(others)

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if getattr(func, "__name__", "") in _OF_IDENTITY:
            return func(*args, **kwargs or {})
        return func(*map(self._swapped, args), **{k: self._swapped(v) for k, v in (kwargs or {}).items()})

    def _swapped(self, value: Any) -> Any:
        if isinstance(value, Tensor):
            other = self._others.get(id(value))
            if other is None:
                return value
            self.unmet.discard(id(value))
            return other
        if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
            return type(value)(map(self._swapped, value))
        return value


_OF_IDENTITY = frozenset(("__hash__", "__repr__", "__format__"))


def reversed_program(
    program: tuple[Graph, Sizes, list[int], list[int]],
    wanted: Differentiated,
    numbers: Sequence[tuple[int, int]],
    rows: int,
) -> tuple[Graph, Sizes, list[int], list[int]]:
    """Return the program of the adjoint: carry, inputs and outputs as of `steps.adjoint_step`.

    In the place of captured tensors and slopes by them it has numbers of the table.
    """
    old, layout, following, outputs = program
    carries = len(layout.carries)
    ends = [
        *itertools.compress(parts(following, layout.carries), wanted.carry),
        *itertools.compress(parts(outputs, layout.outputs), wanted.outputs),
    ]
    step = StepCopy(old, layout, [node for part in ends for node in part])
    graph, roots = step.graph, iter(step.roots)
    slots = {("now", k): size for k, size in enumerate(layout.carries) if wanted.carry[k]}
    slots |= {("now", carries + k): size for k, size in enumerate(layout.nows) if wanted.now[k]}
    summed = [("row", k) for k, one in enumerate(wanted.row) if one]
    own = [("row", rows + k) for k in wanted.numbers]
    slots |= {slot: layout.rows[slot[1]] for slot in (*summed, *own)}
    summed += [("param", k) for k in range(len(numbers))]
    slots |= {("param", k): size for k, (_, size) in enumerate(numbers)}
    summed += own
    places = {start + e: (k, e) for k, (start, size) in enumerate(numbers) for e in range(size)}
    pairs, decides = [], sum(wanted.carry)
    for k, part in enumerate(ends):
        op, slot, depth = (
            ("state", k, STEP) if k < decides else ("now", carries + len(layout.nows) + k - decides, NOW)
        )
        for e in range(len(part)):
            root = next(roots)
            pairs.append((root, graph.add(op, (), graph.type[root], (slot, e), depth)))
    found = Reverse(step, slots, places)
    found.run(pairs)
    after = [node for k in range(carries) if wanted.carry[k] for node in found.entries(("now", k))]
    for k, each in enumerate(summed, decides):
        after += found.added(each, [graph.add("state", (), REAL, (k, e), STEP) for e in range(slots[each])])
    brought = [("now", carries + k) for k, one in enumerate(wanted.now) if one]
    sizes = Sizes(
        layout.rows,
        [*layout.carries, *layout.nows, *(len(part) for part in ends[decides:])],
        [*(len(part) for part in ends[:decides]), *(slots[each] for each in summed)],
        [slots[each] for each in brought],
    )
    return graph, sizes, after, [node for each in brought for node in found.entries(each)]
