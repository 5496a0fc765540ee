"""Rules that the text of a file keeps, whatever runs: of `test_structure.py`, and of `mutation.py`."""

from __future__ import annotations

import ast
from collections.abc import Iterator

_MAKERS = ("zeros", "ones", "full", "empty", "eye", "linspace", "logspace", "rand", "randn", "tensor")
_CASTS = ("double", "to", "long", "type_as")


def without_dtype(source: str) -> Iterator[str]:
    """Calls that make a tensor of torch's default dtype, which is the user's: by line."""
    tree = ast.parse(source)
    cast = {
        id(node.func.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in _CASTS
    }
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Call)
            and id(node) not in cast
            and isinstance(node.func, ast.Attribute)
            and node.func.attr in _MAKERS
            and ast.unparse(node.func.value) == "torch"
            and not any(word.arg in ("dtype", "out", None) for word in node.keywords)
        ):
            yield f"{node.lineno}: {ast.unparse(node)[:80]}"
