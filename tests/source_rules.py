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
_DOCUMENTED = {"_asdict", "_field_defaults", "_fields", "_make", "_replace", "_exit"}
"""Of named tuples, `os` and torch: their manuals name them."""
_PATCHES = {"setattr", "delattr", "setitem", "delitem", "patch", "object", "multiple", "dict"}
_PRIVATE = re.compile(r"staf_torch(\.\w+)*\._[a-z]\w*")


def without_dtype(nodes: Sequence[ast.AST]) -> Iterator[str]:
    """Calls that make a tensor of torch's default dtype, which is the user's: by line."""
    cast = {
        id(node.func.value)
        for node in nodes
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in _CASTS
    }
    for node in nodes:
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.func.attr in _MAKERS
            and id(node) not in cast
            and ast.unparse(node.func.value) == "torch"
            and not any(word.arg in ("dtype", "out", None) for word in node.keywords)
        ):
            yield f"{node.lineno}: {ast.unparse(node)[:80]}"


def without_device(nodes: Sequence[ast.AST]) -> Iterator[str]:
    """Calls that make a tensor, or a layer's parameters, on torch's default device, which is the user's: by
    line. So may whoever gets such a function under another name."""
    calls = {id(node.func): node for node in nodes if isinstance(node, ast.Call)}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "torch":
            yield from (f"{node.lineno}: imports {each.name}" for each in node.names if _makes(each.name))
        elif isinstance(node, ast.Attribute) and _makes(node.attr) and _plain_root(node) in ("torch", "nn"):
            call = calls.get(id(node))
            if call is None or not any(word.arg in ("device", "out") for word in call.keywords):
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
        if not isinstance(node, ast.Call) or _called(node.func) not in ("open", *_TEXT):
            continue
        if any(word.arg in ("encoding", None) for word in node.keywords):
            continue
        modes = [each.value for each in ast.walk(node) if isinstance(each, ast.Constant)]
        binary = any(isinstance(mode, str) and "b" in mode for mode in modes)
        opened = _called(node.func) == "open" and ast.unparse(node.func) != "os.open" and not binary
        opened = opened and not _opens_no_file(node)
        if opened or (isinstance(node.func, ast.Attribute) and node.func.attr in _TEXT):
            yield f"{node.lineno}: {ast.unparse(node)[:80]}"


def _opens_no_file(node: ast.Call) -> bool:
    """Whether it is a method of something else: of a path, it would be given a mode or nothing."""
    function = node.func
    given = bool(node.args) and not any(isinstance(each, ast.Constant) for each in node.args)
    return (
        isinstance(function, ast.Attribute) and given and ast.unparse(function.value) not in ("io", "codecs")
    )


def _called(function: ast.expr) -> str:
    """The last part of the name of what is called; empty where it has none."""
    return getattr(function, "attr", getattr(function, "id", ""))


def looks_inside(nodes: Sequence[ast.AST]) -> Iterator[str]:
    """What a test must not do, by line: read private names, replace or fake parts of the package."""
    ours = set(_imported(nodes))
    made = ours | set(_made(nodes, ours))
    for node in nodes:
        for told in (_private(node), _patched(node, ours, made), _assigned(node, ours)):
            if told:
                yield f"{node.lineno}: {told}"  # type: ignore[attr-defined]


def _imported(nodes: Sequence[ast.AST]) -> Iterator[str]:
    """Names that a file has from the package."""
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "staf_torch":
            yield from (each.asname or each.name for each in node.names)
        elif isinstance(node, ast.Import):
            ours = (each for each in node.names if each.name.partition(".")[0] == "staf_torch")
            yield from (each.asname or "staf_torch" for each in ours)


def _made(nodes: Sequence[ast.AST], ours: set[str]) -> Iterator[str]:
    """Variables that hold what a call of the package returned, or one of its modules."""
    for node in nodes:
        if isinstance(node, ast.Assign) and (_root(node.value) in ours or _names_the_package(node.value)):
            yield from (target.id for target in node.targets if isinstance(target, ast.Name))


def _root(node: ast.AST) -> str | None:
    """The name that an expression such as `name.part(...).other[0]` begins with."""
    while isinstance(node, ast.Attribute | ast.Call | ast.Subscript):
        node = node.func if isinstance(node, ast.Call) else node.value
    return node.id if isinstance(node, ast.Name) else None


def _names_the_package(node: ast.AST) -> bool:
    """Whether it is a dotted name of the package, `import_module` of one, or an entry of `sys.modules`."""
    if isinstance(node, ast.Call) and _called(node.func).endswith("import_module"):
        node = node.args[0]
    elif isinstance(node, ast.Subscript) and ast.unparse(node.value) == "sys.modules":
        node = node.slice
    elif isinstance(node, ast.Call | ast.Subscript | ast.JoinedStr):
        return False
    texts = [each.value for each in ast.walk(node) if isinstance(each, ast.Constant)]
    return any(isinstance(text, str) and re.match(r"staf_torch\b(\.|$)", text) for text in texts)


def _private(node: ast.AST) -> str | None:
    if isinstance(node, ast.Attribute):
        if node.attr == "__new__" and not ast.unparse(node.value).startswith("super("):
            return f"calls {ast.unparse(node)}"
        own = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
        if not own and _is_private(node.attr):
            return f"reads {ast.unparse(node)[-60:]}"
    if isinstance(node, ast.ImportFrom):
        names = [*(node.module or "").split("."), *(each.name for each in node.names)]
        wanted = [name for name in names if _is_private(name) or name == "SimpleNamespace"]
        return f"imports {wanted[0]}" if wanted else None
    if isinstance(node, ast.Constant) and isinstance(node.value, str) and _PRIVATE.fullmatch(node.value):
        return f"names {node.value}"
    if isinstance(node, ast.Call) and _called(node.func) in ("getattr", "hasattr") and len(node.args) > 1:
        name = node.args[1]
        if isinstance(name, ast.Constant) and _is_private(str(name.value)):
            return f"reads {name.value}"
    named = node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""
    return "uses SimpleNamespace" if named == "SimpleNamespace" else None


def _is_private(name: str) -> bool:
    return (
        name.startswith("_")
        and name.strip("_") != ""
        and not name.startswith("__")
        and name not in _DOCUMENTED
    )


def _patched(node: ast.AST, ours: set[str], made: set[str]) -> str | None:
    """Of `monkeypatch`, `unittest.mock` or `setattr`, with a thing of the package or its dotted name."""
    if not isinstance(node, ast.Call) or not node.args:
        return None
    called, target = _called(node.func), node.args[0]
    if called not in _PATCHES or (called[3:] != "attr" and "patch" not in ast.unparse(node.func)):
        return None
    # `setattr(policy, "horizon", 1)` is a user's own.
    known = ours if isinstance(node.func, ast.Name) else made
    return f"patches {ast.unparse(target)}" if _root(target) in known or _names_the_package(target) else None


def _assigned(node: ast.AST, ours: set[str]) -> str | None:
    """Assignments to what was imported: `module.name = ...`, `vars(module)[...] = ...`, `del module.name`."""
    targets: list[ast.expr] = []
    if isinstance(node, ast.Assign | ast.Delete):
        targets = node.targets
    elif isinstance(node, ast.AugAssign | ast.AnnAssign):
        targets = [node.target]
    for target in targets:
        if isinstance(target, ast.Subscript):
            inner = target.value
            if isinstance(inner, ast.Call) and _called(inner.func) == "vars" and inner.args:
                target = ast.Attribute(inner.args[0], "name")
            elif isinstance(inner, ast.Attribute):
                target = inner
            else:
                continue
        if isinstance(target, ast.Attribute) and _plain_root(target.value) in ours:
            return f"changes {ast.unparse(target)}"
    return None


def _plain_root(node: ast.AST) -> str | None:
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else None
