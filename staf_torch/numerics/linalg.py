"""Batched small symmetric linear algebra and Riccati equations.

Each matrix of a batch is treated alone; none can raise for the others: what cannot be computed is NaN, or a
rank below the size, in its own row.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..lanes import scan
from ..lanes.per_row.decisions import in_any_row
from ..lanes.threads import alone, small_in_scipy
from .checks import fail, non_negative, positive, vector
from .default_device import designed_on_cpu
from .riccati import continuous_solution, discrete_gain, discrete_solution

_Elimination = tuple[Tensor, Tensor, Tensor, Tensor]
_IN_REGISTERS = 8  # rows of a matrix that a compiled program writes out entry by entry
Matrix = float | Sequence[float] | Sequence[Sequence[float]] | Tensor


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


def square(call: str, name: str, value: Matrix, size: int) -> Tensor:
    """A matrix given as itself, by its diagonal, or as a number times the identity: (size, size)."""
    number = non_negative if name == "terminal" else positive  # nothing may be paid at the end
    if isinstance(value, Tensor):
        given = value.to(torch.float64)
        if given.dim() > 1:
            return given
        if not given.dim():
            number(call, name, given)
        identity = torch.eye(size, dtype=torch.float64, device=given.device)
        return given.diag() if given.dim() else given * identity
    if isinstance(value, Sequence) and not isinstance(value, str):
        if value and all(isinstance(entry, int | float) for entry in value):
            if len(value) != size:
                raise fail(
                    call, name, f"must have {size} entries of a diagonal, or be ({size}, {size})", value
                )
            given = torch.tensor(vector(call, name, value, size), dtype=torch.float64, device="cpu")
            return given.diag()
        rows = [vector(call, name, row, len(value)) for row in value]
        return torch.tensor(rows, dtype=torch.float64, device="cpu")
    return number(call, name, value) * torch.eye(size, dtype=torch.float64, device="cpu")


def positive_definite(call: str, name: str, matrix: Tensor, size: int, *, semi: bool = False) -> Tensor:
    """Return a symmetric positive definite (size, size) float64 matrix; with ``semi`` a semidefinite one, to
    1e-12 of its largest eigenvalue. Anything else is refused."""
    if matrix.shape != (size, size):
        raise fail(call, name, f"must be ({size}, {size})", matrix)
    if not matrix.is_meta:
        if not bool(torch.isfinite(matrix).all()):
            raise fail(call, name, "must be finite", matrix)
        if bool(((matrix - matrix.mT).abs() > 1e-12 * matrix.abs()).any()):
            raise fail(call, name, "must be symmetric", matrix)
        values = torch.linalg.eigvalsh(matrix.detach())
        if bool(values[0] < -1e-12 * values.abs().max() if semi else values[0] <= 0):
            raise fail(call, name, f"must be positive {'semi' * semi}definite", matrix)
    return matrix.to(torch.float64)


def positive_semidefinite(call: str, name: str, matrix: Tensor, size: int) -> Tensor:
    """Return `positive_definite` with ``semi``."""
    return positive_definite(call, name, matrix, size, semi=True)


@designed_on_cpu
def unstabilisable_mode(a: Tensor, b: Tensor, discrete: bool = False) -> complex | None:
    """Return an eigenvalue of A (n, n) with Re >= 0, or |.| >= 1 of x+ = A x + B u, that no input of B
    (n, m) reaches (Hautus); None if there is none."""
    scale = a.abs().max().clamp(min=1.0)
    modes = torch.linalg.eigvals(a)
    stays = modes.abs() >= 1 - 1e-9 if discrete else modes.real >= -1e-9 * scale
    if not in_any_row(stays):
        return None
    shifted = a - modes[:, None, None] * torch.eye(len(a), dtype=modes.dtype, device=a.device)
    pencil = torch.cat((shifted, (b + 0j).expand(len(a), *b.shape)), dim=-1)
    missed = stays & (torch.linalg.svdvals(pencil)[:, len(a) - 1] < 1e-9 * scale)
    return complex(modes[missed][0].item()) if bool(missed.any()) else None


@designed_on_cpu
def check_modes(a: Tensor, b: Tensor, q: Tensor, *, name: str, discrete: bool = False) -> None:
    """Refuse a linear plant x' = A x + B u in 1/s, or x+, with a mode that does not decay and that no
    input reaches or no cost Q (n, n) sees; the message names the plant and the eigenvalue."""
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
    """Return a function of scipy.linalg, imported where it is needed: half a second that no other import
    need pay.

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
    return small_in_scipy(found)


@designed_on_cpu
def riccati(a: Tensor, b: Tensor, q: Tensor, r: Tensor, *, name: str = "the system") -> Tensor:
    """Return P >= 0 with A'P + PA - P B R^-1 B'P + Q = 0, the optimal value x'Px of the linear plant: A (n,
    n) in 1/s, B (n, m), Q positive semidefinite, R positive definite -> (n, n), float64, symmetric.

    Raises:
        ValueError: if Q is not positive semidefinite or R not positive definite, (A, B) is not stabilisable
            or (A, Q) not detectable; the message names the eigenvalue that no input reaches or no cost sees.
    """
    positive_semidefinite("riccati", "q", q, a.shape[0])
    positive_definite("riccati", "r", r, b.shape[1])
    check_modes(a.double(), b.double(), q.double(), name=name)
    given = [m.double().cpu() for m in (a, b, q, r)]
    p = continuous_solution(*given)
    if bool(torch.isnan(p).any()):
        p = torch.from_numpy(solver("solve_continuous_are")(*(m.numpy() for m in given)))
    return 0.5 * (p + p.mT)


@designed_on_cpu
def discrete_riccati(a: Tensor, b: Tensor, paid: Tensor) -> tuple[Tensor, Tensor]:
    """Return P and K of x+ = A x + B u that pays z'Wz a step, z = (x, u), W (n + m, n + m): the best control
    -K x, of the value x'Px.

    Raises:
        numpy.linalg.LinAlgError, ValueError: of SciPy, if there is none; ValueError if SciPy is missing.
    """
    n = len(a)
    q, s, r = paid[:n, :n], paid[:n, n:], paid[n:, n:]
    p = discrete_solution(a, b, q, s, r)
    if bool(torch.isnan(p).any()):
        p = torch.from_numpy(solver("solve_discrete_are")(*(t.numpy() for t in (a, b, q, r)), s=s.numpy()))
    p = 0.5 * (p + p.mT)
    return p, discrete_gain(p, a, b, s, r)


def exponential(matrix: Tensor) -> Tensor:
    """e^A: (..., n, n).

    Up to version 2.14 torch has a wrong coefficient for a single matrix whose norm is .0003 to .05, and loses
    six digits there; not for several (https://github.com/pytorch/pytorch/issues/196592).
    """
    several = matrix.numel() > matrix.shape[-1] ** 2
    with alone(matrix.numel()):
        found: Tensor = torch.linalg.matrix_exp(matrix if several else torch.stack((matrix, matrix)))
    return found if several else found[0]


def root(x: Tensor) -> Tensor:
    """Return the square root; its derivative at 0 is 0."""
    zero = x == 0
    return torch.where(zero, 0.0, torch.where(zero, 1.0, x).sqrt())


def length(a: Tensor, b: Tensor) -> Tensor:
    """Return sqrt(a^2 + b^2); its derivative at 0 is 0."""
    zero = (a == 0) & (b == 0)
    return torch.where(zero, 0.0, torch.hypot(torch.where(zero, 1.0, a), b))


def shortest_solution(rows: Tensor, value: Tensor) -> Tensor:
    """Return the shortest solution of one or two linear equations, least squares where they depend on each
    other: (P, d, n), (P, d) -> (P, n)."""
    gram = rows @ rows.mT
    square = gram.diagonal(dim1=-2, dim2=-1)
    size = square.sum(-1, keepdim=True)
    share = value / torch.where(size > 0, size, 1.0)
    if rows.shape[-2] == 2:
        product, mixed = square.prod(-1, keepdim=True), gram[:, 0, 1:]
        determinant = product - mixed.square()
        apart = determinant > 8 * torch.finfo(rows.dtype).eps * product
        both = square.flip(-1) * value - mixed * value.flip(-1)
        share = torch.where(apart, both / torch.where(apart, determinant, 1.0), share)
    return (rows.mT @ share.unsqueeze(-1)).squeeze(-1)


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
