"""Names in exported files, of the function or graph and of its outputs; what every exporter checks."""

from __future__ import annotations

import re
from collections.abc import Sequence

from torch import Tensor, nn

from ..adp import Controller, Feedback
from ..lanes.emit.identifiers import checked_names, refused
from ..numerics.checks import fail
from .controllers import FilteredPolicy, SupervisedPolicy

_LONGEST = 48  # characters of a name that nobody gave


def function_name(
    call: str, name: str | None, thing: nn.Module | Controller | None, beside: Sequence[str] = ()
) -> str:
    """Return the name of what is exported, by default that of its class in small letters, "policy" of
    nothing.

    ``beside`` are names that its function has inside; ``call`` is the exporter, for messages. Raises
    ValueError if C or C++ has taken the name.
    """
    if name is None:
        found = made_name(_of(thing), "policy")
        return f"{found}_policy" if found in beside else found
    checked_names(call, "name", [name], beside)
    return name


def made_name(text: str, kind: str) -> str:
    """Return a name that C and C++ take, of any text: other characters become _; ``kind`` stands before a
    number, and behind a name that is taken."""
    found = re.sub(r"_{2,}", "_", re.sub(r"[^A-Za-z0-9]", "_", text)).strip("_")[:_LONGEST].rstrip("_")
    if not found or not found[0].isalpha():
        found = f"{kind}_{found}".rstrip("_")
    return found if refused(found) is None else f"{found}_{kind}"


def _of(thing: nn.Module | Controller | None) -> str:
    if thing is None:
        return "policy"
    if isinstance(thing, FilteredPolicy):
        return f"filtered_{_of(thing.policy)}"
    if isinstance(thing, SupervisedPolicy):
        return f"supervised_{_of(thing.policy)}"
    if isinstance(thing, Feedback) and isinstance(thing.policy, nn.Module):
        return _of(thing.policy)
    kind = type(thing).__name__.removesuffix("Policy").removeprefix("Folded")
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", kind).lower()


def listed_names(call: str, outputs: Sequence[str], argument: str = "outputs") -> list[str]:
    """Return names of outputs, or of another argument, as a list.

    Raises:
        ValueError: if they are one string, whose letters would be names.
    """
    if isinstance(outputs, str) or not all(isinstance(name, str) for name in outputs):
        raise fail(call, argument, 'must be a list of names, such as ["u"]', outputs)
    return list(outputs)


def check_count(call: str, outputs: Sequence[str], count: int) -> None:
    """Refuse another number of names than there are outputs.

    Raises:
        ValueError: that says how many there are.
    """
    if len(outputs) != count:
        rule = f"must be {count} name{'s' * (count > 1)}, one an output of the module"
        raise fail(call, "outputs", rule, list(outputs))


def check_dtype(call: str, module: nn.Module, example: Tensor) -> None:
    """Refuse an example of another dtype than the module computes in.

    Raises:
        ValueError: that says how to make the two alike.
    """
    held = {part.dtype for part in (*module.buffers(), *module.parameters()) if part.is_floating_point()}
    if held and example.dtype not in held:
        rule = (
            f"must be in the dtype of the module, {', '.join(map(str, held))} (`policy_of(..., dtype=...)`)"
        )
        raise fail(call, "example", rule, str(example.dtype))
