"""The steps behind a gradient: one that keeps the carries, and the adjoint, from the last time to the first.

The adjoint is a step of a row like any other, written with `torch.func.vjp`, so that a program of it runs
where the first one runs. A tensor that the step found elsewhere becomes an input of it: wherever torch meets
it, another stands in its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from .call import Given
from .row_numbers import RowNumbers
from .trace.step import Step
from .trace.tracer import NotLoweredError
from .tree import Shared, Tree, flatten, plain, unflatten


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

    Args:
        step: of a program.
        structures: of the program's inputs.
        wanted: for which there are gradients.
        captured, numbers: those of ``wanted``.
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
                raise NotLoweredError("a tensor that requires a gradient is read where nobody sees it")
            made = *flatten(after)[0], *flatten(out)[0]
            chosen = zip(made, (*wanted.carry, *wanted.outputs), strict=True)
            return tuple(leaf for leaf, one in chosen if one)

        _, pull = torch.func.vjp(forward, *given)[:2]
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


def deciding(step: Step, given: Given, ends: Sequence[bool], outputs: Sequence[bool]) -> tuple[bool, ...]:
    """Return which leaves of the carry decide, now or later, what has a gradient: through no others one goes.

    Found out by a step in plain torch, in which loops take all of their passes.

    Args:
        step: of a program.
        given: one row and one time.
        ends: which leaves of the last carry have a gradient.
        outputs: which outputs have one.
    """
    moves = [leaf.is_floating_point() for leaf in given.carry]
    leaves = [x.detach().requires_grad_(real) for x, real in zip(given.carry, moves, strict=True)]
    now = [plain(x)[0] if isinstance(x, Shared) else x[:, 0] for x in given.now]
    with torch.enable_grad(), _Seen():  # type: ignore[no-untyped-call]
        after, out = step(
            given.tree("carry", leaves), given.tree("now", now), given.tree("row", [*map(plain, given.row)])
        )
    following, made = flatten(after)[0], flatten(out)[0]
    real = [leaf for leaf in leaves if leaf.requires_grad]
    alive = [end and moving for end, moving in zip(ends, moves, strict=True)]
    while True:
        roots = [x for x, one in zip((*following, *made), (*alive, *outputs), strict=True) if one]
        with torch.enable_grad():  # of sums: beside gradients of another shape torch imports SymPy
            sums = [root.sum() for root in roots if root.requires_grad]
        slopes = torch.autograd.grad(sums, real, retain_graph=True, allow_unused=True) if sums else ()
        met = iter([slope is not None for slope in slopes] or [False] * len(real))
        reached = [moving and next(met) for moving in moves]
        more = [one or found for one, found in zip(alive, reached, strict=True)]
        if more == alive:
            return tuple(alive)
        alive = more


class _Seen(TorchDispatchMode):
    """Context in which nothing but operations is done, as somebody who traces them wants it."""

    def _dispatch(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return func(*args, **kwargs or {})


# Set here and not in the class, where torch would wrap the method and import its compiler, seconds.
_Seen.__torch_dispatch__ = _Seen._dispatch  # type: ignore[assignment]


class Substituted(TorchFunctionMode):
    """Context: in place of some tensors, wherever a function of torch meets them, it is given others.

    Args:
        others: by the identities of those that they replace.

    Attributes:
        unmet: identities of those that no function met.
    """

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
