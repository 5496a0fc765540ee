"""Mutants that change nothing that anybody could see: kinds of them, and each by its name.

A line of `mutants_accepted.jsonl` is a file, a line of it, what changes, into what, and why nobody sees it.
"""

from __future__ import annotations

import ast
import json
import re
from functools import cache
from pathlib import Path

from mutants import Mutant

_DEVICE = "of another device than the processor, which machines that run the tests lack"
_LOOKS = "how a line of a figure is drawn, not where"
_STYLE = (
    "marker",
    "markersize",
    "alpha",
    "linewidth",
    "zorder",
    "fontsize",
    "handlelength",
    "frameon",
    "rotation",
    "size",
    "ncols",
    "borderaxespad",
    "length",
    "columnspacing",
    "handletextpad",
)
_SPEED = "decides which of two ways that find the same is taken: the threshold is of speed alone"
_EDGE = (
    "a number that equals a tolerance (below 1e-3, or above 1e100) to the last bit: none does but by chance"
)
_LENGTHS = "an assertion of our own that lengths agree; other assertions are no mutants either"
_TOLERANCE, _HUGE = 1e-3, 1e100
_LIMIT = "a limit that is chosen, of a hundred or more, by one"
_SIZE = "the size of a page of figures"
_ONES = "zeros and ones, which are exact in every dtype, and meet numbers of float64"
_EDGES = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
_ROOT = Path(__file__).resolve().parent.parent


def accepted(mutant: Mutant) -> str | None:
    """Why a mutant changes nothing that anybody could see; None where it does."""
    if _at_a_tolerance(mutant):
        return _EDGE
    if _of_lengths(mutant):
        return _LENGTHS
    if mutant.was.startswith("zip(") and "strict=False" in mutant.was and _without(mutant, "strict"):
        return "which is the default"
    if re.match(r"work = [0-9.]+$", _code(mutant)) and _is_number(mutant.was):
        return _SPEED
    if _without(mutant, "device"):
        return _DEVICE
    if mutant.room == "figures" and any(_without(mutant, name) or _of(mutant, name) for name in _STYLE):
        return _LOOKS
    if mutant.was.startswith("torch.eye(") and _without(mutant, "dtype"):
        return _ONES
    if re.match(r"(Program|RowFunction)\(", mutant.was) and _without(mutant, "name"):
        return "a name in messages"
    if mutant.room == "figures" and f"colour({mutant.was})" in mutant.context:
        return "which of our colours"
    if _is_number(mutant.was) and f"stacklevel={mutant.was}" in mutant.context:
        return "the line that a warning names"
    if mutant.file == "staf_torch/lanes/cuda.py":
        return _DEVICE
    if _of_a_limit(mutant):
        return _LIMIT
    if mutant.room == "figures" and re.search(r"\bpage\(", mutant.context) and re.search(r"\d", mutant.was):
        return _SIZE
    return _named().get(mutant.key)


@cache
def _named() -> dict[tuple[str, str, str, str], str]:
    rows = map(json.loads, Path(__file__).with_suffix(".jsonl").read_text(encoding="utf-8").splitlines())
    return {(file, context, was, now): why for file, context, was, now, why in rows}


def _is_number(text: str) -> bool:
    return re.fullmatch(r"[0-9.]+", text) is not None


def _of_a_limit(mutant: Mutant) -> bool:
    """Whether a whole number of at least a hundred, a named one or of passes, has become the next one."""
    named = re.match(
        rf"_?[A-Z][A-Z_, ]* = [^\"']*$|for \w+ in range\({re.escape(mutant.was)}\):", _code(mutant)
    )
    numbers = mutant.was.replace("_", ""), mutant.now.replace("_", "")
    if named is None or not all(each.isdecimal() for each in numbers):
        return False
    was, now = map(int, numbers)
    return was >= 100 and now == was + 1


def _code(mutant: Mutant) -> str:
    return mutant.context.split("#")[0].strip()


def _without(mutant: Mutant, name: str) -> bool:
    """Whether all that a mutant changes is that a call lacks an argument of that name."""
    fewer = re.sub(rf",?\s*\b{name}=[^,()]*(\([^()]*\))?[^,()]*(?=[,)])", "", mutant.was, count=1)
    return fewer != mutant.was and _plain(fewer) == _plain(mutant.now)


def _of(mutant: Mutant, name: str) -> bool:
    """Whether a mutant changes the number of an argument of that name."""
    stated = f"{name}={mutant.was}", f'"{name}": {mutant.was}'
    return _is_number(mutant.was) and any(each in mutant.context for each in stated)


def _of_lengths(mutant: Mutant) -> bool:
    """Whether all that a mutant changes is that `zip` does not see whether lengths agree."""
    if mutant.was == "True":
        return (
            "strict=True" in mutant.context and "zip(" in mutant.context and mutant.context.count("True") == 1
        )
    return mutant.was.startswith("zip(") and "strict=True" in mutant.was and _without(mutant, "strict")


def _at_a_tolerance(mutant: Mutant) -> bool:
    """Whether all that a mutant changes is on which side of a small tolerance an equal number falls."""
    try:
        was, now = (ast.parse(text.strip(), mode="eval").body for text in (mutant.was, mutant.now))
    except SyntaxError:
        return False
    if not isinstance(was, ast.Compare) or not isinstance(now, ast.Compare) or len(was.ops) != 1:
        return False
    if _EDGES.get(type(was.ops[0])) is not type(now.ops[0]):
        return False
    numbers = [_number(mutant.file, side) for side in (was.left, was.comparators[0])]
    return any(0 < number < _TOLERANCE or number > _HUGE for number in numbers)


def _number(file: str, node: ast.expr) -> float:
    """The value of a number, or of a constant of the file by its name; 0 for anything else."""
    if isinstance(node, ast.Constant) and isinstance(node.value, float):
        return node.value
    if isinstance(node, ast.Name) and node.id.isupper():
        text = (_ROOT / file).read_text(encoding="utf-8") if (_ROOT / file).exists() else ""
        found = re.search(rf"^{node.id} = ([0-9.]+e-[0-9]+)\b", text, re.MULTILINE)
        return float(found[1]) if found else 0.0
    return 0.0


def _plain(text: str) -> str:
    """Without blanks, kinds of quotes and a last comma."""
    return re.sub(r",(?=\))", "", re.sub(r"\s", "", text)).replace('"', "'")
