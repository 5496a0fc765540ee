"""Rules that the text of a file keeps, whatever runs: of `test_structure.py`, and of `mutation.py`."""

from __future__ import annotations

import ast
from collections.abc import Iterator

_MAKERS = ("zeros", "ones", "full", "empty", "eye", "linspace", "logspace", "rand", "randn", "tensor")
_CASTS = ("double", "to", "long", "type_as")
_TEXT = ("read_text", "write_text")


def broken(source: str) -> list[str]:
    """What of a file breaks a rule: by line."""
    return [*without_dtype(source), *without_encoding(source)]


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


def without_encoding(source: str) -> Iterator[str]:
    """Calls that read or write text in the encoding of the user's locale: by line."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call) or any(word.arg in ("encoding", None) for word in node.keywords):
            continue
        name = ast.unparse(node.func)
        modes = [each.value for each in ast.walk(node) if isinstance(each, ast.Constant)]
        binary = any(isinstance(mode, str) and "b" in mode for mode in modes)
        opened = name.rpartition(".")[2] == "open" and name != "os.open" and not binary
        if opened or (isinstance(node.func, ast.Attribute) and node.func.attr in _TEXT):
            yield f"{node.lineno}: {ast.unparse(node)[:80]}"
