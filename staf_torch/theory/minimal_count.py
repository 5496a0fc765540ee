"""The smallest layout of centers whose ideal weights reach an accuracy.

The power function says how far a kernel function is from the span of the basis.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from ..approximation.basis import StaFBasis
from ..centers import StateFollowingCenters, ball, polygon, rings
from ..kernels import Kernel
from ..lanes.per_row.objects import refuse_rows
from ..local_basis import GradedBasis, GradedSpace, LocalSpace, newton_space, phi
from ..numerics.checks import fail, positive_real, trailing
from ..signs import Sign
from .uniform_approximation import ball_grid, supremum

_BLOCK = 2**21  # kernel values in a temporary
_SHELLS = 6
_DIRECTIONS = {2: 128}  # of each shell in the plane; in space 256, and on a line there are two
_MOST_CENTERS = 500


@dataclasses.dataclass(frozen=True)
class MinimalCount:
    """Result of `minimal_count`, over L layouts and the states (...) of a trajectory."""

    count: int  # the smallest M that does for all states
    pointwise: Tensor  # (...) int64, the smallest M that does for each state
    counts: Tensor  # (L,) int64, M of the layouts
    errors: Tensor  # (L, ...) sup |V - V^| on the ball of each state


def standard_layouts(dim: int) -> list[Tensor]:
    """Directions (M, n) of growing M, each unisolvent for polynomials of one degree more.

    In the plane one and two points, then `rings` with 3 to 28; in other dimensions `ball` with
    C(n + k, n) points, k = 0, 1, ..., up to 500 of them and k = 6.

    Example:
        >>> [len(directions) for directions in theory.standard_layouts(2)][:4]
        [1, 2, 3, 6]

        Shown by `staf experiment=feasibility`.
    """
    if dim == 2:
        return [polygon(1), polygon(2), *(rings(count) for count in (3, 6, 10, 15, 21, 28))]
    counts = [math.comb(dim + degree, dim) for degree in range(7)]
    return [ball(count, dim) for count in counts if count <= _MOST_CENTERS]


@Sign("minimal_count")
def minimal_count(
    target: Callable[[Tensor], Tensor],
    kernel: Kernel,
    states: Tensor,
    radius: float,
    epsilon: float,
    layouts: Sequence[Tensor] | None = None,
) -> MinimalCount:
    """The smallest M with sup |V(y) - V^(y; x)| <= epsilon on the ball N_r(x) of every state x.

    V^ has the ideal weights. The layouts are tried from the fewest centers on; the first that does gives M.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> states = systems.simulate(systems.Oscillator(), x0, dt=0.5, steps=12)
        >>> minimal_count(targets.Paper(), ExponentialKernel(), states, radius=0.1, epsilon=1e-2).count
        6

        Shown by `staf experiment=feasibility`.

    Args:
        target: V, points (..., n) to values (...).
        kernel: of the basis.
        states: a trajectory, (..., n).
        radius: r, positive, in the units of the state.
        epsilon: positive, in the units of V.
        layouts: directions (M, n), one layout each; `standard_layouts` if None.

    Returns:
        M over the trajectory and for each of its states, and all errors.

    Raises:
        ValueError: if an argument breaks its rule, or no layout does (the message has the best one).

    Source: the feasibility theorem of Rosenfeld et al., section 3, and the proposition after it (in the
    supremum norm): such an M exists. Here it is measured.
    """
    refuse_rows("minimal_count", target=target, kernel=kernel, radius=radius)
    call = "minimal_count"
    trailing(call, "states", states, dims=1)
    allowed = positive_real(call, "epsilon", epsilon)
    families = standard_layouts(states.shape[-1]) if layouts is None else layouts
    ordered = sorted(_checked(call, families, states.shape[-1]), key=len)
    errors = layout_errors(target, kernel, states, radius, ordered)
    counts = torch.tensor([len(layout) for layout in ordered], dtype=torch.int64, device="cpu")
    good = errors <= allowed  # (L, ...)
    enough = good.reshape(len(counts), -1).all(-1)
    if not bool(enough.any()):
        worst = errors.reshape(len(counts), -1).amax(-1)
        best = int(worst.nan_to_num(nan=torch.inf).argmin())
        raise ValueError(
            f"`minimal_count(epsilon=...)` must be in the reach of a layout, but the best one "
            f"({int(counts[best])} centers) leaves an error of {float(worst[best]):.3g}; got {epsilon!r}."
        )
    pointwise = counts[good.int().argmax(0)]  # the first layout that does at the state
    return MinimalCount(int(counts[enough.int().argmax()]), pointwise, counts, errors)


@Sign("layout_errors")
def layout_errors(
    target: Callable[[Tensor], Tensor],
    kernel: Kernel,
    states: Tensor,
    radius: float,
    layouts: Sequence[Tensor],
) -> Tensor:
    """sup |V(y) - V^(y; x)| over the ball N_r(x), ideal weights, for each layout and state.

    The supremum is the largest value on a grid of the ball (769 points in the plane, denser towards its
    surface), improved by a search from its largest points.

    Example:
        >>> x = torch.tensor([[1.0, 0.5]]).double()
        >>> layouts = [rings(3), rings(6)]
        >>> few, more = theory.layout_errors(targets.Paper(), ExponentialKernel(), x, 0.1, layouts).flatten()
        >>> bool(more < few)
        True

        Shown by `staf experiment=layouts`.

    Arguments and errors are those of `minimal_count`, L layouts; the result is (L, ...), NaN where the target
    is not finite.
    """
    refuse_rows("layout_errors", target=target, kernel=kernel, radius=radius)
    call = "layout_errors"
    trailing(call, "states", states, dims=1)
    extent = positive_real(call, "radius", radius)
    dim = states.shape[-1]
    _checked(call, layouts, dim)
    grid = extent * ball_grid(dim, _SHELLS, _DIRECTIONS.get(dim, 256)).to(states)
    rows = states.reshape(-1, dim)
    with torch.no_grad():
        bases = [StaFBasis(kernel, StateFollowingCenters(u, extent)) for u in layouts]
        errors = [torch.cat(list(_errors(target, basis, rows, grid))) for basis in bases]
    return torch.stack(errors).reshape(len(errors), *states.shape[:-1])


def _checked(call: str, layouts: Sequence[Tensor], dim: int) -> Sequence[Tensor]:
    if not layouts:
        raise fail(call, "layouts", "must name at least one layout", layouts)
    for layout in layouts:
        trailing(call, "layouts", layout, dims=2, last=dim)
    return layouts


def _errors(
    target: Callable[[Tensor], Tensor], basis: StaFBasis, states: Tensor, grid: Tensor
) -> Iterator[Tensor]:
    """For some of the states (S, n) at a time, so that memory stays bounded: (S',)."""
    radius = float(grid.norm(dim=-1).max())
    for x in states.split(max(1, _BLOCK // (len(grid) * basis.count))):
        space = basis.local(x)
        coefficients = space.fit(basis.values(x, target))

        def error(
            z: Tensor, x: Tensor = x, space: LocalSpace = space, coefficients: Tensor = coefficients
        ) -> Tensor:
            return (target(x.unsqueeze(-2) + z) - space.evaluate(z, coefficients)).abs()

        yield supremum(error, grid, radius)


def power_function(basis: StaFBasis, x: Tensor, z: Tensor, *, relative: bool = False) -> Tensor:
    """P(y) = sqrt(k(y,y) - k(y,c) K(c)^-1 k(c,y)) at y = x + z.

    |V(y) - V^(y)| <= P(y) ||V - V^||_H for every V in the native space, with the ideal weights.

    For the exponential and Gaussian kernels to relative accuracy at every radius, where P falls like
    r^(k+1) and the formula cancels to nothing: the difference is taken on paper. For other kernels by a
    pivoted Cholesky factor; below sqrt(M eps k(y,y)) it is then rounding, and what rounds below zero is
    zero.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> x = torch.tensor([[1.0, 0.5]]).double()
        >>> bool(theory.power_function(basis, x, 0.1 * rings(3)).max() < 1e-6)  # 0 at the centers
        True

        Shown by `staf experiment=feasibility`.

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
    refuse_rows("power_function", basis=basis)
    trailing("power_function", "x", x, dims=1, last=basis.dim)
    trailing("power_function", "z", z, dims=2, last=basis.dim)
    space = basis.local(x)
    point = z.unsqueeze(-2)  # (..., P, 1, n)
    core = basis.kernel.core(x.unsqueeze(-2), point, point).squeeze(-1).squeeze(-1)  # k0(z, z), (..., P)
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
        power = rho ** (2 * high - degree - order)
        pairs.append(scale * power * ((across[high] - reproduce @ among[high]) @ members))
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
    power, terms = torch.ones_like(products), []
    for tail in phi(r2 * products, top):
        terms.append(power * tail)
        power = power * products
    return terms


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
