"""Batched small symmetric linear algebra, Riccati equations, and derivatives of functions of rows.

Each matrix of a batch is treated alone; none can raise for the others: what cannot be computed is NaN, or a
rank below the size, in its own row.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..lanes.combinators import scan
from .checks import fail

_Elimination = tuple[Tensor, Tensor, Tensor, Tensor]
_IN_REGISTERS = 8  # rows of a matrix that a compiled program writes out entry by entry


class PivotedCholesky(NamedTuple):
    """P K P' = L L' with the largest remaining diagonal entry first, cut off at the rank."""

    factor: Tensor  # (..., M, M) lower triangular L in pivoted order; identity beyond the rank
    order: Tensor  # (..., M) int64: row k of L belongs to row order[k] of K
    rank: Tensor  # (...) int64: pivots above the tolerance

    def kept(self) -> Tensor:
        """(..., M) bool in pivoted order: whether the pivot was above the tolerance."""
        size = self.factor.shape[-1]
        return torch.arange(size, device=self.rank.device) < self.rank.unsqueeze(-1)

    def solve_lower(self, values: Tensor) -> Tensor:
        """L^-1 P v, zero beyond the rank: (..., M) -> (..., M)."""
        shape = torch.broadcast_tensors(self.order, values)[0].shape
        permuted = values.expand(shape).gather(-1, self.order.expand(shape))
        solved = torch.linalg.solve_triangular(self.factor, permuted.unsqueeze(-1), upper=False)
        return torch.where(self.kept(), solved.squeeze(-1), 0.0)

    def solve_upper(self, coefficients: Tensor) -> Tensor:
        """P' L^-T beta, with beta zero beyond the rank: (..., M) -> (..., M)."""
        solved = torch.linalg.solve_triangular(
            self.factor.mT, torch.where(self.kept(), coefficients, 0.0).unsqueeze(-1), upper=True
        ).squeeze(-1)
        solved = torch.where(self.kept(), solved, 0.0)
        order = self.order.expand(solved.shape)
        return torch.zeros_like(solved).scatter(-1, order, solved)


def pivoted_cholesky(gram: Tensor) -> PivotedCholesky:
    """Factor K (..., M, M), symmetric positive semidefinite, stopping at its numerical rank.

    A pivot is dropped when it is at most M eps times the largest diagonal entry: below that it is
    rounding error. No jitter is added. A matrix with a non-finite entry has rank 0.
    """
    size = gram.shape[-1]
    if torch.compiler.is_compiling() and gram.requires_grad:
        # I^-1 K is K, by a call that inductor fuses with nothing. Fused with what makes K, torch 2.13
        # differentiates the elimination wrongly: AnchoredKernel, M = 3, learned directions and width, errors
        # of 2 to 12 times the gradient.
        identity = torch.eye(size, dtype=gram.dtype, device=gram.device)
        gram = torch.linalg.solve_triangular(identity, gram, upper=False)
    scale = gram.diagonal(dim1=-2, dim2=-1).amax(-1)
    tolerance = size * torch.finfo(gram.dtype).eps * scale
    places = torch.arange(size, device=gram.device)

    def eliminate(carry: _Elimination, _: Tensor) -> tuple[_Elimination, tuple[Tensor, Tensor]]:
        rest, open_, alive, rank = carry
        diagonal = rest.diagonal(dim1=-2, dim2=-1)
        pivot = torch.where(open_, diagonal, -torch.inf).argmax(-1, keepdim=True)  # (..., 1)
        value = diagonal.gather(-1, pivot).squeeze(-1)
        alive = alive & (value > tolerance)
        column = rest.gather(-1, pivot.unsqueeze(-2).expand(*rest.shape[:-1], 1)).squeeze(-1)
        root = torch.where(alive, value, 1.0).sqrt().unsqueeze(-1)
        column = torch.where(alive.unsqueeze(-1) & open_, column / root, 0.0)
        rest = rest - column.unsqueeze(-1) * column.unsqueeze(-2)
        return (rest, open_.scatter(-1, pivot, False), alive, rank + alive), (column, pivot.squeeze(-1))

    open_ = torch.ones(gram.shape[:-1], dtype=torch.bool, device=gram.device)
    alive = torch.isfinite(gram).all(-1).all(-1)
    start = gram, open_, alive, torch.zeros_like(scale, dtype=torch.int64)
    (_, _, _, rank), (columns, pivots) = scan(eliminate, start, places, dim=0, unrolled=size <= _IN_REGISTERS)
    unpivoted, order = columns.movedim(0, -1), pivots.movedim(0, -1)
    factor = unpivoted.gather(-2, order.unsqueeze(-1).expand(unpivoted.shape))
    dropped = places >= rank.unsqueeze(-1)
    return PivotedCholesky(factor + torch.diag_embed(dropped.to(factor)), order, rank)


def newton_basis(gram: Tensor) -> Tensor:
    """C = P'L^-T of K0 (..., M, M), with zero columns beyond the rank: (..., M, M)."""
    factor = pivoted_cholesky(gram)
    units = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    columns = [factor.solve_upper(unit.expand(factor.order.shape)) for unit in units]
    return torch.stack(columns, dim=-1)


def condition_number(gram: Tensor) -> Tensor:
    """lambda_max / lambda_min of K (..., M, M) -> (...): inf where not definite, NaN where not finite.

    Meaningful up to 1 / eps; beyond that it is inf or rounding error.
    """
    finite = torch.isfinite(gram).all(-1).all(-1)
    identity = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    values = torch.linalg.eigvalsh(torch.where(finite[..., None, None], gram, identity))
    low, high = values[..., 0], values[..., -1]
    ratio = torch.where(low > 0, high / low, torch.inf)
    return torch.where(finite, ratio, torch.nan)


def _symmetric(call: str, name: str, matrix: Tensor, size: int) -> None:
    if matrix.shape != (size, size):
        raise fail(call, name, f"must be ({size}, {size})", matrix)
    if not bool(torch.isfinite(matrix).all()):
        raise fail(call, name, "must be finite", matrix)
    if not torch.allclose(matrix, matrix.mT, rtol=1e-12, atol=0.0):
        raise fail(call, name, "must be symmetric", matrix)


def positive_definite(call: str, name: str, matrix: Tensor, size: int) -> Tensor:
    """A symmetric positive definite (size, size) float64 matrix.

    Raises:
        ValueError: if it is anything else.
    """
    _symmetric(call, name, matrix, size)
    if float(torch.linalg.eigvalsh(matrix)[0]) <= 0:
        raise fail(call, name, "must be positive definite", matrix)
    return matrix.to(torch.float64)


def positive_semidefinite(call: str, name: str, matrix: Tensor, size: int) -> Tensor:
    """A symmetric positive semidefinite (size, size) float64 matrix, to 1e-12 of its largest eigenvalue.

    Raises:
        ValueError: if it is anything else.
    """
    _symmetric(call, name, matrix, size)
    values = torch.linalg.eigvalsh(matrix)
    if float(values[0]) < -1e-12 * float(values.abs().max()):
        raise fail(call, name, "must be positive semidefinite", matrix)
    return matrix.to(torch.float64)


def unstabilisable_mode(a: Tensor, b: Tensor, discrete: bool = False) -> complex | None:
    """An eigenvalue of A with Re >= 0, or |.| >= 1, that no input reaches (Hautus), None if there is none.

    Args:
        a: (n, n).
        b: (n, m).
        discrete: whether A and B are those of x+ = A x + B u.
    """
    size = a.shape[0]
    scale = max(1.0, float(a.abs().max()))
    for eigenvalue in torch.linalg.eigvals(a).tolist():
        if abs(eigenvalue) < 1 - 1e-9 if discrete else eigenvalue.real < -1e-9 * scale:
            continue
        pencil = torch.cat((a - eigenvalue * torch.eye(size, dtype=torch.complex128), b + 0j), dim=1)
        if float(torch.linalg.svdvals(pencil)[size - 1]) < 1e-9 * scale:
            return complex(eigenvalue)
    return None


def check_modes(a: Tensor, b: Tensor, q: Tensor, *, name: str, discrete: bool = False) -> None:
    """Refuse a linear plant with a mode that does not decay and that no input reaches or no cost sees.

    Args:
        a: (n, n), of x' = A x + B u in 1/s, or of x+ = A x + B u.
        b: (n, m).
        q: Q, (n, n).
        name: of the plant, for the message.
        discrete: whether it is x+.

    Raises:
        ValueError: if there is one; the message names its eigenvalue.
    """
    unit = "a step" if discrete else "1/s"
    for matrix, other, fault in (
        (a, b, "not stabilisable: no input reaches"),
        (a.mT, q / q.abs().max() if bool((q != 0).any()) else q, "not detectable: the cost Q does not see"),
    ):
        mode = unstabilisable_mode(matrix, other, discrete)
        if mode is not None:
            shown = f"{mode.real:.6g}" if abs(mode.imag) < 1e-12 else f"{mode.real:.6g}{mode.imag:+.6g}j"
            raise ValueError(
                f"The linearisation of {name} at its equilibrium is {fault} "
                f"its mode with the eigenvalue {shown} {unit}."
            )


def solver(name: str) -> Callable[..., Any]:
    """A function of scipy.linalg, imported where it is needed: half a second that no other import need pay.

    Raises:
        ValueError: if SciPy is missing.
    """
    try:
        import scipy.linalg
    except ImportError as error:
        raise ValueError(
            "The Riccati equation of the LQR needs SciPy, which is not installed: "
            "pip install 'staf_torch[adp]'."
        ) from error
    found: Callable[..., Any] = getattr(scipy.linalg, name)
    return found


def riccati(a: Tensor, b: Tensor, q: Tensor, r: Tensor, *, name: str = "the system") -> Tensor:
    """P >= 0 with A'P + PA - P B R^-1 B'P + Q = 0: the optimal value x'Px of the linear plant.

    Args:
        a: A, (n, n), in 1/s.
        b: B, (n, m).
        q: Q, (n, n), positive semidefinite.
        r: R, (m, m), positive definite.
        name: of the plant, for the message.

    Returns:
        (n, n), float64, symmetric.

    Raises:
        ValueError: if Q is not positive semidefinite or R not positive definite, (A, B) is not stabilisable
            or (A, Q) not detectable; the message names the eigenvalue that no input reaches or no cost sees.
    """
    positive_semidefinite("riccati", "q", q, a.shape[0])
    positive_definite("riccati", "r", r, b.shape[1])
    check_modes(a.double(), b.double(), q.double(), name=name)
    solution = solver("solve_continuous_are")(*(m.double().cpu().numpy() for m in (a, b, q, r)))
    p = torch.from_numpy(solution)
    return 0.5 * (p + p.mT)


def row_jacobian(function: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Tensor]:
    """Values and derivatives of a function of rows, in which no row sees another.

    One backward pass for every entry of an output, whatever the number of rows.

    Args:
        function: (..., n) -> (..., *outputs).
        at: (..., n), with all the leading dimensions of the values.

    Returns:
        (..., *outputs) and (..., *outputs, n).
    """
    values, pull = torch.func.vjp(function, at)[:2]
    outputs = values.shape[at.dim() - 1 :]
    if not outputs:
        return values, pull(torch.ones_like(values))[0]
    units = torch.eye(math.prod(outputs), dtype=values.dtype, device=values.device)
    rows = [pull(unit.reshape(outputs).expand_as(values).contiguous())[0] for unit in units.unbind(0)]
    return values, torch.stack(rows, dim=-2).unflatten(-2, outputs)
