"""The algebraic Riccati equation, by SciPy, and why it can have no solution."""

from __future__ import annotations

import torch
from torch import Tensor

from ._checks import fail


def positive_definite(call: str, name: str, matrix: Tensor, size: int) -> Tensor:
    """A symmetric positive definite (size, size) float64 matrix.

    Raises:
        ValueError: if it is anything else.
    """
    if matrix.shape != (size, size):
        raise fail(call, name, f"must be ({size}, {size})", matrix)
    if not bool(torch.isfinite(matrix).all()):
        raise fail(call, name, "must be finite", matrix)
    if not torch.allclose(matrix, matrix.mT, rtol=1e-12, atol=0.0):
        raise fail(call, name, "must be symmetric", matrix)
    if float(torch.linalg.eigvalsh(matrix)[0]) <= 0:
        raise fail(call, name, "must be positive definite", matrix)
    return matrix.to(torch.float64)


def unstabilisable_mode(a: Tensor, b: Tensor) -> complex | None:
    """An eigenvalue of A with Re >= 0 that no input reaches (Hautus), None if there is none.

    Args:
        a: (n, n).
        b: (n, m).
    """
    size = a.shape[0]
    scale = max(1.0, float(a.abs().max()))
    for eigenvalue in torch.linalg.eigvals(a).tolist():
        if eigenvalue.real < -1e-9 * scale:
            continue
        pencil = torch.cat((a - eigenvalue * torch.eye(size, dtype=torch.complex128), b + 0j), dim=1)
        if float(torch.linalg.svdvals(pencil)[size - 1]) < 1e-9 * scale:
            return complex(eigenvalue)
    return None


def riccati(a: Tensor, b: Tensor, q: Tensor, r: Tensor, *, name: str = "the system") -> Tensor:
    """P >= 0 with A'P + PA - P B R^-1 B'P + Q = 0: the optimal value x'Px of the linear plant.

    Args:
        a: A, (n, n), in 1/s.
        b: B, (n, m).
        q: Q, (n, n), positive definite.
        r: R, (m, m), positive definite.
        name: of the plant, for the message.

    Returns:
        (n, n), float64, symmetric.

    Raises:
        ValueError: if Q or R is not positive definite, or (A, B) is not stabilisable; the message
            names the eigenvalue that no input reaches.
    """
    positive_definite("riccati", "q", q, a.shape[0])
    positive_definite("riccati", "r", r, b.shape[1])
    mode = unstabilisable_mode(a.double(), b.double())
    if mode is not None:
        shown = f"{mode.real:.6g}" if abs(mode.imag) < 1e-12 else f"{mode.real:.6g}{mode.imag:+.6g}j"
        raise ValueError(
            f"The linearisation of {name} at its equilibrium is not stabilisable: no input reaches "
            f"its mode with the eigenvalue {shown} 1/s."
        )
    from scipy.linalg import solve_continuous_are  # here: half a second that no other import need pay

    solution = solve_continuous_are(*(m.double().cpu().numpy() for m in (a, b, q, r)))
    p = torch.from_numpy(solution)
    return 0.5 * (p + p.mT)
