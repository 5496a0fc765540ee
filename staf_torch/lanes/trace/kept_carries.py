"""Leaves of a carry that need not be kept for a gradient: outputs have them, or they never change."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from .graph import Graph, Sizes

SAME, BEFORE, AFTER, NOWHERE = "same", "before", "after", "nowhere"
"""Where the numbers of a leaf before a step are: in the first carry, in an output of that time, in an output
of the time before, in the carry alone."""


def carried(
    graph: Graph, layout: Sizes, following: Sequence[int], outputs: Sequence[int]
) -> tuple[tuple[str, int], ...]:
    """Return where the numbers of each leaf of the carry are, and in which output.

    Args:
        graph, layout, following, outputs: of a traced program.
    """
    made = parts(outputs, layout.outputs)
    found = []
    for k, after in enumerate(parts(following, layout.carries)):

        def before(nodes: Sequence[int], k: int = k, size: int = len(after)) -> bool:
            inputs = [("state", (k, entry)) for entry in range(size)]
            return [(graph.op[node], graph.aux[node]) for node in nodes] == inputs

        met = (
            (BEFORE if before(nodes) else AFTER, j)
            for j, nodes in enumerate(made)
            if nodes == after or before(nodes)
        )
        found.append((SAME, 0) if before(after) else next(met, (NOWHERE, 0)))
    return tuple(found)


def parts(nodes: Sequence[int], sizes: Sequence[int]) -> list[list[int]]:
    """Return the nodes of each leaf.

    Args:
        nodes: of all leaves.
        sizes: entries of each.
    """
    ends = itertools.accumulate(sizes, initial=0)
    return [[*nodes[a:b]] for a, b in itertools.pairwise(ends)]
