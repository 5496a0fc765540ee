"""Linear systems of any size, with the linear-quadratic optimum as ground truth."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..lanes.row_numbers import RowNumbers
from ..numerics.checks import fail, hold, number, states, vector
from ..numerics.linalg import exponential, riccati
from .base import ControlAffineSystem


class Linear(ControlAffineSystem):
    """x' = A x + B u; without control the flow is e^{At} x(0).

    Example:
        >>> plant = systems.Linear([[0.0, 1.0], [-1.0, -0.1]])
        >>> plant.drift(torch.tensor([1.0, 0.0]).double())
        tensor([ 0., -1.], dtype=torch.float64)

        Shown by `staf system=linear`.

    Args:
        matrix: A, (n, n), in 1/s.
        input_matrix: B, (n, m); None for a plant without inputs.

    Raises:
        ValueError: if ``matrix`` is not square and finite, or ``input_matrix`` has other than n rows.
    """

    def __init__(
        self,
        matrix: Sequence[Sequence[float]] | Tensor,
        input_matrix: Sequence[Sequence[float]] | Tensor | None = None,
    ) -> None:
        super().__init__()
        size = len(hold(self, "matrix", _stack("matrix", matrix, "must be (n, n)")))
        given = [[]] * size if input_matrix is None else input_matrix
        rows, inputs = hold(self, "input_matrix", _stack("input_matrix", given, "must be (n, m)")).shape
        if rows != size:
            raise fail("Linear", "input_matrix", f"must have {size} rows, one a state", input_matrix)
        self.dim, self.inputs = size, inputs
        self.matrix: Tensor
        self.input_matrix: Tensor

    def drift(self, x: Tensor) -> Tensor:
        return states(self, "x", x, self.dim) @ self.matrix.to(x).mT

    def effectiveness(self, x: Tensor) -> Tensor:
        return self.input_matrix.to(x).expand(*x.shape, self.inputs)

    def flow(self, x: Tensor, time: Tensor) -> Tensor:
        propagators = exponential(time[:, None, None] * self.matrix.to(time))
        # Row by row, so that the bits of a trajectory do not depend on the batch.
        return (propagators.to(x) * x[..., None, None, :]).sum(-1)

    def optimal_value(self, x: Tensor, state_cost: Tensor, input_cost: Tensor) -> Tensor | None:
        """x'Px with P from the Riccati equation: (..., n) -> (...)."""
        if self.inputs == 0:
            return None
        p = riccati(self.matrix, self.input_matrix, state_cost, input_cost).to(x)
        return ((x @ p) * x).sum(-1)


def _stack(name: str, matrix: object, rule: str) -> Tensor:
    if isinstance(matrix, Tensor):
        if matrix.dim() != 2 or (name == "matrix" and len(matrix) != matrix.shape[1]):
            raise fail("Linear", name, rule, tuple(matrix.shape))
        if isinstance(matrix, RowNumbers) or matrix.is_meta or matrix.requires_grad:
            number("Linear", name, matrix)
            return matrix.double()  # a parameter as it is, to be learned
        matrix = matrix.tolist()
    if isinstance(matrix, str) or not isinstance(matrix, Sequence) or not matrix:
        raise fail("Linear", name, rule, matrix)
    if not all(isinstance(row, Sequence) and not isinstance(row, str) for row in matrix):
        raise fail("Linear", name, rule, matrix)
    length = len(matrix) if name == "matrix" else len(matrix[0])
    numbers = [vector("Linear", name, row, length) for row in matrix]
    return torch.tensor(numbers, dtype=torch.float64, device="cpu")
