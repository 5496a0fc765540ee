"""Rules that the text of a file keeps, whatever runs: each takes the nodes of its tree, outer ones first."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator, Sequence

from torch import nn

_MAKERS = ("zeros", "ones", "full", "empty", "eye", "linspace", "logspace", "rand", "randn", "tensor")
_ANYWHERE = {*_MAKERS, "arange", "as_tensor", "asarray", "empty_permuted", "empty_quantized", "empty_strided"}
_ANYWHERE |= {"fftfreq", "nested_tensor", "randint", "randperm", "range", "rfftfreq", "scalar_tensor"}
_ANYWHERE |= {"tril_indices", "triu_indices", "sparse_compressed_tensor", "sparse_coo_tensor"}
_ANYWHERE |= {f"sparse_{k}_tensor" for k in ("bsc", "bsr", "csc", "csr")}
_ANYWHERE |= {f"{k}_window" for k in ("bartlett", "blackman", "hamming", "hann", "kaiser")}
"""All that `torch.set_default_device` changes."""
_CASTS = ("double", "to", "long", "type_as")
_TEXT = ("read_text", "write_text")
_PATCHES = {"setattr", "delattr", "setitem", "delitem", "patch", "object", "multiple", "dict"}
_INSIDE = r"staf_torch(\.\w+)*\._[a-z]\w*"
_DOCUMENTED = {"_asdict", "_field_defaults", "_fields", "_make", "_replace", "_exit"}
"""Private by their names, and in the manuals of named tuples, `os` and torch."""


def on_defaults(nodes: Sequence[ast.AST]) -> Iterator[str]:
    """Calls that make a tensor, or a layer's parameters, of torch's default device or dtype, which are the
    user's: by line. So may whoever gets such a function under another name."""
    calls = {id(node.func): node for node in nodes if isinstance(node, ast.Call)}
    cast = {id(node.value) for node in nodes if isinstance(node, ast.Attribute) and node.attr in _CASTS}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "torch":
            yield from (f"{node.lineno}: imports {each.name}" for each in node.names if _makes(each.name))
        elif isinstance(node, ast.Attribute) and _makes(node.attr) and _plain_root(node) in ("torch", "nn"):
            call = calls.get(id(node))
            words = {word.arg for word in call.keywords} if call else set()
            typed = node.attr not in _MAKERS or id(call) in cast or words & {"dtype", "out", None}
            if not words & {"device", "out"} or not typed:
                yield f"{node.lineno}: {ast.unparse(node if call is None else call)[:80]}"


def _makes(name: str) -> bool:
    """Whether a function of torch, or a layer, makes tensors on the default device."""
    layer = getattr(nn, name, None)
    return name in _ANYWHERE or (
        isinstance(layer, type) and "device" in inspect.signature(layer.__init__).parameters
    )


def without_encoding(nodes: Sequence[ast.AST]) -> Iterator[str]:
    """Calls that read or write text in the encoding of the user's locale: by line."""
    for node in nodes:
        if not isinstance(node, ast.Call) or any(word.arg in ("encoding", None) for word in node.keywords):
            continue
        method, constant = isinstance(node.func, ast.Attribute), ast.Constant
        text = method and _called(node.func) in _TEXT
        if _called(node.func) == "open" and (not method or all(isinstance(a, constant) for a in node.args)):
            modes = [each.value for each in ast.walk(node) if isinstance(each, constant)]
            text = not any(isinstance(mode, str) and "b" in mode for mode in modes)
        if text:
            yield f"{node.lineno}: {ast.unparse(node)[:80]}"


def _called(function: ast.expr) -> str:
    """The last part of the name of what is called; empty where it has none."""
    return getattr(function, "attr", getattr(function, "id", ""))


def _plain_root(node: ast.AST) -> str | None:
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else None


def looks_inside(nodes: Sequence[ast.AST]) -> Iterator[str]:
    """What a test must not do, by line: read private names, replace or fake parts of the package."""
    ours = {"staf_torch"}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "staf_torch":
            ours |= {each.asname or each.name for each in node.names}
        elif isinstance(node, ast.Import):
            own = (each for each in node.names if each.name.partition(".")[0] == "staf_torch")
            ours |= {each.asname or "staf_torch" for each in own}
    for node in nodes:
        told = ""
        if isinstance(node, ast.ImportFrom):
            names = [*(node.module or "").split("."), *(each.name for each in node.names)]
            told = next(filter(_private, names), "")
        elif isinstance(node, ast.Name | ast.Attribute) and _called(node) in ("__new__", "SimpleNamespace"):
            told = "" if ast.unparse(node).startswith("super().") else ast.unparse(node)
        elif isinstance(node, ast.Attribute) and _private(node.attr):
            told = "" if ast.unparse(node.value) in ("self", "cls") else ast.unparse(node)
        elif isinstance(node, ast.Call) and _called(node.func) in ("getattr", "hasattr"):
            told = ast.unparse(node) if _private(getattr(node.args[1], "value", "")) else ""
        elif isinstance(node, ast.Constant) and re.fullmatch(_INSIDE, str(node.value)):
            told = str(node.value)
        elif isinstance(node, ast.Call) and node.args and _called(node.func) in _PATCHES:
            first = node.args[0]
            text = str(first.value) if isinstance(first, ast.Constant) else ""
            told = ast.unparse(node) if _plain_root(first) in ours or text.startswith("staf_torch.") else ""
        elif isinstance(node, ast.Assign | ast.Delete | ast.AugAssign):
            targets = [node.target] if isinstance(node, ast.AugAssign) else node.targets
            told = ", ".join(
                ast.unparse(each)
                for each in targets
                if isinstance(each, ast.Attribute) and _plain_root(each) in ours
            )
        if told:
            yield f"{node.lineno}: {told[:80]}"  # type: ignore[attr-defined]


def _private(name: object) -> bool:
    return isinstance(name, str) and re.match(r"_[a-z]", name) is not None and name not in _DOCUMENTED
