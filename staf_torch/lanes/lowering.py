"""What every tensor operation is in single numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor
from torch._decomp import decomposition_table

from . import entrywise, reductions  # noqa: F401  their rules
from .eliminations import FACTORISATIONS
from .movements import MOVEMENTS, moved, scatter_add
from .replacements import REPLACEMENTS
from .rolled_choices import CHOICES, many
from .rules import RULES
from .tracer import NotLoweredError, Tracer

RULES["scatter_add"] = scatter_add


def lower(t: Tracer, func: Any, name: str, out: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """The nodes of what an operation returns: an array, or a list of them.

    Args:
        t: knows the nodes of the arguments.
        func: the operation.
        name: its name without overload.
        out: what torch returned, for shapes and dtypes.
        args, kwargs: of the operation.

    Raises:
        NotLoweredError: if there is no rule.
    """
    # What torch's own decompositions end in takes the arguments of the operation of the same name.
    plain = name if name in REPLACEMENTS else name.removeprefix("prims::")
    rule = RULES.get(plain)
    rolled = (
        len(args) > 2
        and "reduce" not in kwargs
        and many(name, *args[:3])
        and (t.traced(args[2]) or not t.stated(args[2]))
    )
    if rule is not None and not rolled:
        return rule(t, out, *args, **kwargs)
    if name in MOVEMENTS and not rolled:
        return moved(t, func, out, args, kwargs)
    tables: Any = (CHOICES,) if rolled else (FACTORISATIONS, REPLACEMENTS)
    decomposition = next((table[name] for table in tables if name in table), decomposition_table.get(func))
    if decomposition is None and func._can_decompose():  # of several operations, also in torch
        decomposition = func.decompose
    if decomposition is None:
        raise NotLoweredError(f"`{func}` has no scalar form here")
    with t:
        result = decomposition(*args, **kwargs)
    parts = [result] if isinstance(result, Tensor) else list(result)
    nodes = [t.nodes(part) for part in parts]
    return nodes[0] if isinstance(result, Tensor) else nodes
