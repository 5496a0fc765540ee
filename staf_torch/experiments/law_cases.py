"""The rows of the comparison of update laws and predictors."""

from __future__ import annotations

from typing import NamedTuple

from .. import optim
from ..chase.predictors import Predictor, Secant, Tangent
from ..optim import UpdateLaw


class Case(NamedTuple):
    """One row of the comparison."""

    law: UpdateLaw
    iterations: int  # a time step
    predictor: Predictor | None
    products: int  # M x M products a time step: with K, with K^-1, and of the predictor

    @property
    def name(self) -> str:
        """The law alone, as in a sentence."""
        words = "".join(" " + c.lower() if c.isupper() else c for c in type(self.law).__name__).strip()
        kind = getattr(self.law, "preconditioner", None)
        words = {"normalised l m s": "normalised LMS"}.get(words, words)
        return words if kind is None else f"{words} ({kind})"

    @property
    def predicted(self) -> str:
        """The predictor, as in a sentence."""
        if self.predictor is None:
            return "none"
        order = getattr(self.predictor, "order", None)
        return type(self.predictor).__name__.lower() + ("" if order is None else f" order {order}")

    @property
    def key(self) -> str:
        """The prefix of the row's metrics."""
        words = f"{self.name} x{self.iterations} {'' if self.predictor is None else self.predicted}"
        return "_".join(words.replace("(", "").replace(")", "").split()).lower()


def cases(work: int, count: int) -> list[Case]:
    """Every law at up to ``work`` products with K a time step, then the predictors.

    A law that carries its residual (g <- g - 2 lambda K p) needs one product an iteration and one to begin.
    Laws that are done sooner are not given more, and what a predictor costs is taken from the iterations;
    one is left where it costs as much as all of them. Of the filter each of six M x M x M products counts
    as M; NormalisedLMS has none. The tangent needs M solves and two products, or M more for order 2.

    Args:
        work: products a time step, at least 2.
        count: M.
    """
    many, tangent, filtered = work - 1, (count + 2, 2 * count + 2), 6 * count
    rows = [
        Case(law, iterations, None, products)
        for law, iterations, products in (
            (optim.FixedStep(), 1, 2),
            (optim.FixedStep(), many, work),
            (optim.SteepestDescent(), 1, 2),
            (optim.SteepestDescent(), many, work),
            (optim.PreconditionedDescent("jacobi"), many, work),
            (optim.BarzilaiBorwein(), many, work),
            (optim.HeavyBall(), many, work),
            (optim.Nesterov(), many, work),
            (optim.ConjugateGradient(), min(2, count), min(2, count) + 1),
            (optim.ConjugateGradient(), min(count, many), min(count, many) + 1),
            (optim.PreconditionedDescent("core"), 1, 3),
            (optim.Exact(), 1, 1),
            (optim.RecursiveLeastSquares(), 1, filtered),
            (optim.NormalisedLMS(), 1, 0),
        )
    ]
    predictors: tuple[tuple[Predictor, int], ...] = (
        (Secant(), 0),
        (Tangent(order=1), tangent[0]),
        (Tangent(order=2), tangent[1]),
    )
    for predictor, extra in predictors:
        for law, iterations, products in (
            (optim.SteepestDescent(), 1, 2),
            (optim.SteepestDescent(), max(1, many - extra), max(2, work - extra)),
            (optim.Exact(), 1, 1),
        ):
            rows.append(Case(law, iterations, predictor, products + extra))
    return list({case.key: case for case in rows}.values())  # with two centers a row would repeat itself


def curves(work: int, count: int) -> list[Case]:
    """The rows worth a curve over the step: each predictor, with the cheapest law and with the exact one."""
    exact, cheap, paper = ("exact", 1), ("steepest descent", 1), ("steepest descent", work - 1)
    shown = {
        "none": (paper, exact),
        "secant": (paper, exact),
        "tangent order 1": (cheap, exact),
        "tangent order 2": (cheap, exact),
    }
    return [row for row in cases(work, count) if (row.name, row.iterations) in shown[row.predicted]]
