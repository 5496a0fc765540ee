"""What a step does with a single row, written down."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .captured import Recipe
from .combinators import Tree, tracing
from .eliminations import InPlainTorch
from .given import Given
from .graph import NOW, STEP, Graph
from .lowering import lower
from .schedule import Layout
from .tracer import NoReading, NotLoweredError, Tracer
from .tree import Shared, flatten, plain

Step = Callable[[Tree, Tree, Tree], tuple[Tree, Tree]]


class Traced(NamedTuple):
    """A program as every back end takes it, and its outputs for one row."""

    program: tuple[Graph, Layout, list[int], list[int]]
    outputs: tuple[tuple[torch.Size, torch.dtype], ...]
    structure: Any
    recipe: Recipe


def trace(step: Step, given: Given, *, widened: bool = False, folded: bool = False) -> Traced:
    """Write down what a step does with a single row.

    Args:
        step: of the program.
        given: inputs.
        widened: whether the numbers of a float32 program are carried in double.
        folded: whether the numbers of captured tensors become part of the text.

    Raises:
        NotLoweredError: if an operation has no scalar form.
    """
    graph = Graph(given.real == torch.float32 and not widened)
    learning = torch.is_grad_enabled()
    tracer = Tracer(graph, lower, learning=learning, widened=widened, folded=folded)

    def inputs(op: str, leaves: Sequence[Any], depth: int, times: int) -> list[Tensor]:
        traced = []
        for slot, leaf in enumerate(leaves):
            at = plain(leaf).detach()
            at = at if isinstance(leaf, Shared) else at[:1]
            at = at.select(0 if isinstance(leaf, Shared) else 1, 0) if times else at
            traced.append(tracer.input(at, op, slot, depth))
        return traced

    with torch.no_grad():
        row = given.tree("row", inputs("row", given.row, 0, 0))
        now = given.tree("now", inputs("now", given.now, NOW, 1))
        carry = inputs("state", given.carry, STEP, 0)
        with tracer, tracing(tracer), NoReading(tracer), InPlainTorch(tracer.traced):
            try:
                after, out = step(given.tree("carry", carry), now, row)
            except NotLoweredError:
                raise
            except (
                Exception
            ) as error:  # of the step itself, which the definition raises again, or of the tracer
                raise NotLoweredError(f"{type(error).__name__}: {error}") from error
        ends, structure = flatten(after)
        if structure != given.structures["carry"] or [(e.shape, e.dtype) for e in ends] != [
            (c.shape, c.dtype) for c in carry
        ]:
            raise NotLoweredError("the step returns a carry of other shapes or dtypes than it was given")
        leaves, shape = flatten(out)
        if any(leaf.dim() == 0 or leaf.shape[0] != 1 for leaf in leaves):
            raise NotLoweredError("an output of the step has no dimension of rows")
        following = [node for end in ends for node in tracer.nodes(end).ravel().tolist()]
        outputs = [node for leaf in leaves for node in tracer.nodes(leaf).ravel().tolist()]
        layout = Layout(
            [_entries(leaf, 1) for leaf in given.row],
            [_entries(leaf, 2) for leaf in given.now],
            [_entries(leaf, 1) for leaf in given.carry],
            [leaf.numel() for leaf in leaves],
        )
    shapes = tuple((leaf.shape[1:], leaf.dtype) for leaf in leaves)
    return Traced((graph, layout, following, outputs), shapes, shape, tracer.captured.recipe())


def _entries(leaf: Any, skip: int) -> int:
    shape = leaf.tensor.shape[skip - 1 :] if isinstance(leaf, Shared) else leaf.shape[skip:]
    return shape.numel()
