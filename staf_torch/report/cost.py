"""What a gradient chase costs, in products of an M x M matrix with a vector."""

from __future__ import annotations

from .overrides import Value
from .run import Run

_START = {"normalised_lms": 0, "exact": 0}  # products beside those of the iterations; 1 for all others
_EACH = {"normalised_lms": 0}  # products an iteration; 1 for all others


def products(
    law: str,
    iterations: int,
    count: int,
    preconditioner: str | None = None,
    predictor: str = "none",
    order: int = 2,
) -> int:
    """Products a time step: with K, with K^-1, and of the predictor.

    A law that carries its residual needs one an iteration and one to begin; the core preconditioner applies
    K^-1 too. Of the filter each of six M x M x M products counts as M. The tangent predictor needs M solves
    and two products, or M more for order 2.

    Args:
        law: its name in `conf/optimizer`.
        iterations: a time step.
        count: M.
        preconditioner: of `preconditioned_descent`.
        predictor: its name in `conf/predictor`.
        order: of the tangent.
    """
    if law == "recursive_least_squares":
        corrected = 6 * count * iterations
    else:
        each = 2 if preconditioner == "core" else _EACH.get(law, 1)
        corrected = each * iterations + _START.get(law, 1)
    return corrected + (0 if predictor != "tangent" else order * count + 2)


def products_per_second(run: Run) -> float | None:
    """`products` over dt, of a gradient chase; None where its settings do not say."""
    law, iterations, count, dt = (
        run.setting(key) for key in ("optimizer", "optimizer.inner_steps", "centers.count", "dt")
    )
    if not isinstance(law, str) or not _whole(iterations) or not _whole(count):
        return None
    if not isinstance(dt, int | float) or dt <= 0:
        return None
    preconditioner, predictor = run.setting("optimizer.preconditioner"), run.setting("predictor")
    order = run.setting("predictor.order")
    assert isinstance(iterations, int)
    assert isinstance(count, int)
    step = products(
        law,
        iterations,
        count,
        preconditioner if isinstance(preconditioner, str) else None,
        predictor if isinstance(predictor, str) else "none",
        order if isinstance(order, int) else 2,
    )
    return step / dt


def _whole(value: Value) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
