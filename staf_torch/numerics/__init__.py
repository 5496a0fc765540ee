"""Linear algebra, derivatives, checks of arguments; here the sentence of every error, without torch."""

from __future__ import annotations

COMMAND_LINE = "staf"
"""As the name of a call: the setting of that name on the command line."""
TABLE_COMMAND = "staf-table"
"""As the name of a call: the option of that name of `staf-table`."""


def fail(call: str, name: str, rule: str, value: object) -> ValueError:
    """The one sentence form of the library: what was called, what must hold, what came."""
    where = {COMMAND_LINE: f"staf {name}=...", TABLE_COMMAND: f"staf-table --{name}"}
    return ValueError(f"`{where.get(call, f'{call}({name}=...)')}` {rule}; got {show(value)}.")


def show(value: object) -> str:
    """A value as the user wrote it; of a large tensor its shape alone."""
    if hasattr(value, "numel") and hasattr(value, "tolist"):  # a tensor; an array has no numel
        if hasattr(value, "full"):  # numbers of rows
            return f"rows({show(value.full)})"
        return repr(value.tolist()) if value.numel() <= 8 else f"a tensor {tuple(value.shape)}"  # type: ignore[attr-defined]
    return repr(value)
