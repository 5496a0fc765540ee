"""Slopes by the arguments of an operation on numbers, or on the entries of arrays: torch's formulas."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

from ..trace.graph import Graph
from ..trace.step_copy import NoReverseError

Apply = Callable[..., Any]


def _no_slope() -> Any:
    raise NoReverseError("an exponent that has a slope")


def signs_last(graph: Graph) -> Callable[..., int]:
    """Return the operations of a graph that take the sign out of a product, for a sum to take it along."""

    def apply(op: str, *args: int) -> int:
        if op == "where":
            return graph.where(*args)
        signs = sum(graph.op[a] == "neg" for a in args)
        if op != "mul" or not signs:
            return graph.apply(op, *args)
        product = graph.apply("mul", *(graph.args[a][0] if graph.op[a] == "neg" else a for a in args))
        return product if signs == 2 else graph.apply("neg", product)

    return apply


def slopes_of(
    op: str,
    slope: Any,
    args: Sequence[Any],
    out: Any,
    wanted: Collection[bool],
    apply: Apply,
    number: Callable[[float], Any],
) -> list[Any]:
    """Return the slopes by the arguments of an operation, None where none is wanted: torch's formulas."""
    a, b = args[0], args[-1]

    def times(x: Any) -> Any:
        return apply("mul", slope, x)

    def over(x: Any) -> Any:
        return apply("div", slope, x)

    rules: dict[str, Sequence[Callable[[], Any]]] = {
        "add": (lambda: slope, lambda: slope),
        "sub": (lambda: slope, lambda: apply("neg", slope)),
        "copy": (lambda: slope,),
        "neg": (lambda: apply("neg", slope),),
        "mul": (lambda: times(b), lambda: times(a)),
        "div": (lambda: over(b), lambda: apply("neg", apply("mul", over(b), out))),
        "sqrt": (lambda: over(apply("mul", number(2.0), out)),),
        "exp": (lambda: times(out),),
        "expm1": (lambda: times(apply("add", out, number(1.0))),),
        "log": (lambda: over(a),),
        "log1p": (lambda: over(apply("add", a, number(1.0))),),
        "sin": (lambda: times(apply("cos", a)),),
        "cos": (lambda: apply("neg", times(apply("sin", a))),),
        "tan": (lambda: times(apply("add", apply("mul", out, out), number(1.0))),),
        "pow": (lambda: times(apply("mul", b, apply("pow", a, apply("sub", b, number(1.0))))), _no_slope),
        "tanh": (lambda: times(apply("sub", number(1.0), apply("mul", out, out))),),
        "where": (
            lambda: None,
            lambda: apply("where", a, slope, number(0.0)),
            lambda: apply("where", a, number(0.0), slope),
        ),
        "abs": (
            lambda: apply(
                "where",
                apply("lt", number(0.0), a),
                slope,
                apply(
                    "where",
                    apply("lt", a, number(0.0)),
                    apply("neg", slope),
                    apply("mul", slope, number(0.0)),
                ),
            ),
        ),
    }
    if op not in rules:
        raise NoReverseError(f"`{op}` has no slope in single numbers")
    return [rule() if one else None for rule, one in zip(rules[op], wanted, strict=True)]
