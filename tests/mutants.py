"""The changes that `mutation.py` makes to a file, one operator, number or statement each."""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from typing import NamedTuple

_OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
_SAID = ("warn", "info", "debug", "warning", "error")  # calls that only say something
_WORDS = ("stacklevel", "maxsplit")  # arguments that only say something


class Mutant(NamedTuple):
    """One change of a file."""

    file: str
    line: int
    last_line: int
    was: str  # source of the part that changes
    now: str
    context: str  # the whole line, stripped: what names the mutant where line numbers move
    begin: int  # in bytes
    end: int

    @property
    def room(self) -> str:
        """The package, or the file beside the packages, that has the line."""
        return room_of(self.file)

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What names the mutant in any version that has the same line."""
        return self.file, self.context, self.was, self.now

    def applied(self, source: str) -> str:
        """The changed file."""
        raw = source.encode()
        return (raw[: self.begin] + self.now.encode() + raw[self.end :]).decode()


def room_of(file: str) -> str:
    """The package below staf_torch that a file is in, or itself."""
    return file.split("/")[1]


def mutants_of(file: str, source: str) -> Iterator[Mutant]:
    """Every mutant of a file, in the order of its lines."""
    tree = ast.parse(source)
    skipped = set(_skipped(tree))
    raw, lines = source.encode(), source.splitlines()
    starts = [0]
    for line in raw.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        for place, now in _changes(node):
            begin = starts[place.lineno - 1] + place.col_offset
            end = starts[place.end_lineno - 1] + place.end_col_offset
            was = raw[begin:end].decode()
            if now == was:
                continue
            line = lines[place.lineno - 1].strip()
            yield Mutant(file, place.lineno, place.end_lineno, was, now, line, begin, end)


def _skipped(tree: ast.AST) -> Iterator[int]:
    """Nodes that decide nothing when the program runs: annotations, texts of errors, what is logged."""
    for node in ast.walk(tree):
        parts: list[ast.AST | None] = []
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            parts = [node.returns, *node.decorator_list]
        elif isinstance(node, ast.arg | ast.AnnAssign):
            parts = [node.annotation]
        elif isinstance(node, ast.JoinedStr) or (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id in ("cast", "TypeVar")
        ):
            parts = [node]
        elif isinstance(
            node, ast.Call
        ):  # of a matrix axis 1 is axis -1: -2 tells more, and it is there as well
            yield from (id(each) for each in node.args if _is_last_axis(each))
            yield from (id(each.value) for each in node.keywords if _is_last_axis(each.value))
        elif isinstance(node, ast.Raise):
            parts = [node.exc, node.cause]
        elif isinstance(node, ast.Assert) or (isinstance(node, ast.Expr) and _says(node.value)):
            parts = [node]
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            parts = [node] if node.targets[0].id in ("__all__", "__version__") else []
            if isinstance(node.value, ast.BinOp) and isinstance(node.value.op, ast.BitOr):
                parts = [node.value]  # an alias of types
        for part in filter(None, parts):
            yield from (id(inner) for inner in ast.walk(part))


def _is_last_axis(node: ast.AST) -> bool:
    return isinstance(node, ast.UnaryOp) and ast.unparse(node) in ("-1", "-2")


def _says(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in _SAID


def _changes(node: ast.AST) -> Iterator[tuple[ast.AST, str]]:
    """Pairs of a node with a position, and the text that replaces it."""
    other = copy.copy(node)
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        other.ops = [_OPERATORS[type(node.ops[0])]()]
        yield node, f"({ast.unparse(other)})"
    elif isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in _OPERATORS:
        if isinstance(node, ast.BinOp) and any(_is_text(side) for side in (node.left, node.right)):
            return
        other.op = _OPERATORS[type(node.op)]()
        yield node, f"({ast.unparse(other)})"
    elif isinstance(node, ast.AugAssign) and type(node.op) in _OPERATORS:
        other.op = _OPERATORS[type(node.op)]()
        yield node, ast.unparse(other)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
        yield node, f"({ast.unparse(node.operand)})"
    elif isinstance(node, ast.Constant):
        if isinstance(node.value, bool):
            yield node, str(not node.value)
        elif isinstance(node.value, int):
            yield node, str(node.value + 1)
        elif isinstance(node.value, float):
            yield node, repr(node.value * 2 if node.value else 1.0)
    elif isinstance(node, ast.If | ast.IfExp | ast.While):
        yield node.test, f"(not ({ast.unparse(node.test)}))"
    elif isinstance(node, ast.Raise) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        yield node, "pass"
    elif isinstance(node, ast.Call):
        for keyword in node.keywords:
            if keyword.arg is not None and keyword.arg not in _WORDS:
                fewer = copy.copy(node)
                fewer.keywords = [each for each in node.keywords if each is not keyword]
                yield node, ast.unparse(fewer)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))
