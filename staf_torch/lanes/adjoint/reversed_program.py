"""The program of an adjoint, of the numbers of a step."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..trace.graph import NOW, REAL, STEP, Graph, Sizes
from ..trace.step_copy import StepCopy
from .carries import parts
from .reverse import Reverse

if TYPE_CHECKING:
    from .steps import Differentiated


def reversed_program(
    program: tuple[Graph, Sizes, list[int], list[int]],
    wanted: Differentiated,
    numbers: Sequence[tuple[int, int]],
    rows: int,
) -> tuple[Graph, Sizes, list[int], list[int]]:
    """Return the program of the adjoint: carry, inputs and outputs as of `steps.adjoint_step`.

    In the place of captured tensors and slopes by them it has numbers of the table.

    Args:
        program: of the step.
        wanted: for which there are gradients.
        numbers: of the table that have slopes: where each run of them begins, and its length.
        rows: inputs that a row has once, before rows' own numbers.
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
