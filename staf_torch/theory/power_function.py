"""How far a kernel function is from the span of the basis: the power function."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .._checks import trailing
from ..basis import StaFBasis
from ..local import GradedBasis, GradedSpace, newton_space
from ..local.phi import phi


def power_function(basis: StaFBasis, x: Tensor, z: Tensor, *, relative: bool = False) -> Tensor:
    """P(y) = sqrt(k(y,y) - k(y,c) K(c)^-1 k(c,y)) at y = x + z.

    |V(y) - V^(y)| <= P(y) ||V - V^||_H for every V in the native space, with the ideal weights.

    For the exponential and Gaussian kernels to relative accuracy at every radius, where P falls like
    r^(k+1) and the formula cancels to nothing: the difference is taken on paper. For other kernels by a
    pivoted Cholesky factor; below sqrt(M eps k(y,y)) it is then rounding, and what rounds below zero is
    zero.

    Args:
        basis: kernel and centers.
        x: states, (..., n).
        z: offsets of the points, (..., P, n).
        relative: divide by sqrt(k(y,y)); the exponential kernel's P itself overflows for large |x|.

    Returns:
        (..., P).

    Raises:
        ValueError: if a tensor has another shape.

    Source: Schaback, "Error estimates and condition numbers for radial basis function interpolation",
    Adv. Comput. Math. 3 (1995).
    """
    trailing("power_function", "x", x, dims=1, last=basis.dim)
    trailing("power_function", "z", z, dims=2, last=basis.dim)
    space = basis.local(x)
    core = _pair_core(basis, x, z)
    if isinstance(space, GradedSpace):
        square = _graded_square(space, z)
    else:
        factor = newton_space(basis.kernel, x, space.offsets).factor
        row = basis.kernel.core(x, z, space.offsets)
        columns = [factor.solve_lower(part).square().sum(-1) for part in row.unbind(-2)]
        square = (core - torch.stack(columns, dim=-1)).clamp(min=0.0)
    if relative:
        return (square / core).sqrt()
    s, g = basis.kernel.log_scale(x, z), basis.kernel.log_gain(x)
    power = square.sqrt()
    power = power if s is None else power * s.exp()
    return power if g is None else power * (0.5 * g).exp().unsqueeze(-1)


def _pair_core(basis: StaFBasis, x: Tensor, z: Tensor) -> Tensor:
    """k0(z, z), point by point: (..., P)."""
    point = z.unsqueeze(-2)  # (..., P, 1, n)
    return basis.kernel.core(x.unsqueeze(-2), point, point).squeeze(-1).squeeze(-1)


def _graded_square(space: GradedSpace, z: Tensor) -> Tensor:
    """k0(z,z) - k0(z,d) K0^-1 k0(d,z) for k0 = exp(q z'd): (..., P).

    delta_z minus the combination of the centers that agrees with it on all polynomials of degree <= k
    leaves of the exponential series its tail from k + 1 on, a factor r^(2k+2); what the span can still
    represent of that remainder is of higher order and subtracted without cancellation.
    """
    graded, r = space.basis, space.radius.double()
    some = r[..., None, None] > 0
    zeta = torch.where(some, z.double() / torch.where(some, r[..., None, None], 1.0), 0.0)
    u = graded.directions.to(zeta)
    r2 = (space.rate.double() * r.square())[..., None, None]
    order = _complete_degree(graded) + 1
    reproduce = _polynomial_weights(graded, zeta, order - 1)  # (..., P, M)
    top = max(order, graded.degrees[-1])
    across, among = _tails(zeta @ u.mT, r2, top), _tails(u @ u.mT, r2, top)
    itself = _tails(zeta.square().sum(-1, keepdim=True), r2, top)[order].squeeze(-1)
    quadratic = ((reproduce @ among[order]) * reproduce).sum(-1)
    remainder = itself - 2 * (across[order] * reproduce).sum(-1) + quadratic
    # Pairings of the remainder with the graded functionals and their Gram matrix, without powers of r.
    rho = r2.sqrt()
    pairs, weights = [], []
    for index, degree in enumerate(graded.degrees):
        high = max(order, degree)
        members = graded.weights[:, index, graded.degree == degree].to(zeta)
        scale = math.sqrt(math.factorial(degree) * math.factorial(order)) / math.factorial(high)
        pairs.append(
            scale * rho ** (2 * high - degree - order) * ((across[high] - reproduce @ among[high]) @ members)
        )
        weights.append(members)
    gram = _graded_gram(graded, weights, among, rho)
    b = torch.cat(pairs, dim=-1)
    explained = (b * torch.linalg.solve(gram, b.mT).mT).sum(-1)
    factor = r2.squeeze(-1) ** order / math.factorial(order)
    square: Tensor = factor * (remainder - explained).clamp(min=0.0)
    return square.to(z)


def _graded_gram(graded: GradedBasis, weights: list[Tensor], among: list[Tensor], rho: Tensor) -> Tensor:
    """Gram matrix of the functionals r^(-k_j) sqrt(k_j!) sum_i W_ij delta_{u_i}: (..., M, M)."""
    rows = []
    for k, left in zip(graded.degrees, weights, strict=True):
        row = []
        for m, right in zip(graded.degrees, weights, strict=True):
            high = max(k, m)
            scale = math.sqrt(math.factorial(k) * math.factorial(m)) / math.factorial(high)
            row.append(scale * rho ** abs(k - m) * (left.mT @ among[high] @ right))
        rows.append(torch.cat(row, dim=-1))
    return torch.cat(rows, dim=-2)


def _tails(products: Tensor, r2: Tensor, top: int) -> list[Tensor]:
    """p^k f_k(r^2 p), f_k = k! phi_k, for k = 0..top: the series of exp from degree k on, without r^2k/k!."""
    power, found = torch.ones_like(products), []
    for tail in phi(r2 * products, top):
        found.append(power * tail)
        power = power * products
    return found


def _complete_degree(graded: GradedBasis) -> int:
    """The largest k such that the centers are unisolvent for all polynomials of degree <= k."""
    dim = graded.directions.shape[-1]
    k = 0
    while int((graded.degree == k + 1).sum()) == math.comb(dim + k, k + 1):
        k += 1
    return k


def _polynomial_weights(graded: GradedBasis, zeta: Tensor, degree: int) -> Tensor:
    """l with sum_i l_i p(u_i) = p(zeta) for all polynomials of the degree: (..., P, n) -> (..., P, M)."""
    kept = graded.degree <= degree
    flat = zeta.new_zeros(1, 1)
    at_centers = graded.functions(graded.directions.to(zeta), flat)[:, kept]  # (M, N), r = 0: polynomials
    values = graded.functions(zeta, flat)[..., kept]
    functionals = graded.weights.sum(1).to(zeta)[:, kept]
    system = functionals.mT @ at_centers  # (N, N), block triangular
    first = torch.linalg.solve(system.mT, values.mT).mT @ functionals.mT
    missing = values - first @ at_centers
    correction: Tensor = first + torch.linalg.solve(system.mT, missing.mT).mT @ functionals.mT
    return correction
