"""A StaF approximation for a device: the value and its gradient.

For kernels with an exponential core the constants are folded into a series: a few multiplications instead of
a library. For every other kernel the library's own local basis is traced.
"""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor, nn

from ..approximation.staf import StaF
from ..lanes.gradients import grad
from ..local_basis import GradedSpace
from ..numerics.checks import hold, positive_real

_HIGHEST = 60  # degree: beyond it the ball is too wide, in units of the kernel's width, for a series


class RidgeApproximator(nn.Module):
    """V^(y) and its gradient around the state x, the centers frozen, for kernels with an exponential core:

        V^(x + z) = e^{s(z)} sum_i sum_p c_ip (z'u_i / nu)^p,

    with s = x'z for the exponential kernel and s = -|z|^2 / (2 width^2) for the Gaussian. The c_ip are the
    graded basis times its coefficients, expanded: no large numbers of both signs cancel, so float32 keeps
    its digits. The series ends where its next term is below the rounding of ``dtype`` at ``reach`` radii;
    farther out the result is NaN, not a truncated series.

    Args:
        staf: fitted, of one state, with an `ExponentialKernel` or a `GaussianKernel` of one width.
        dtype: of the arithmetic.
        reach: positive; the distance up to which it holds, in radii of the centers.

    Attributes:
        state: x, (n,).
        radius: nu(x), float.
        degree: P.

    Raises:
        ValueError: if ``reach`` is not positive, or so large that the series would be long.

    Source: the series of `local.graded`, term by term.
    """

    def __init__(self, staf: StaF, dtype: torch.dtype = torch.float64, reach: float = 10.0) -> None:
        super().__init__()
        positive_real("RidgeApproximator", "reach", reach)
        x = staf.state.detach().double()
        space = staf.basis.local(x)
        assert isinstance(space, GradedSpace)
        self.radius, self.reach = float(space.radius), float(reach)
        c = _expand(space, staf.coefficients.detach().double(), torch.finfo(dtype).eps, reach)
        directions = space.basis.directions / self.radius  # (M, n): tau = directions z
        self.degree = len(c) - 1
        moving = staf.basis.kernel.log_gain(x) is not None  # the exponential kernel: s(z) = x'z
        self.rate = None if moving else float(space.rate)
        slope = torch.einsum("pi,ia->pia", _derivative(c), directions)  # of the sums along z
        if moving:
            slope = slope + c.unsqueeze(-1) * x
        table = torch.cat((c.unsqueeze(-1), slope), dim=-1)  # (P + 1, M, 1 + n)
        self.state = hold(self, "state", x.to(dtype))
        self.directions = hold(self, "directions", directions.mT.contiguous().to(dtype))  # (n, M)
        self.constant = hold(self, "constant", table[0].sum(0).to(dtype))  # (1 + n,)
        self.table = hold(self, "table", table[1:].flatten(0, 1).to(dtype))  # (P M, 1 + n)

    def forward(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """V^ and grad V^: (B, n) -> (B,), (B, n)."""
        z = y - self.state
        square = (z * z).sum(-1, keepdim=True)
        tau = z @ self.directions
        powers = [tau]
        for p in range(2, self.degree + 1):  # the shortest chain of products: short is accurate
            powers.append(powers[p // 2 - 1] * powers[p - p // 2 - 1])
        sums = torch.addmm(self.constant, torch.cat(powers, dim=-1), self.table)
        log_scale = (z * self.state).sum(-1, keepdim=True) if self.rate is None else -0.5 * self.rate * square
        both = torch.where(square <= (self.reach * self.radius) ** 2, sums * log_scale.exp(), torch.nan)
        value, gradient = both[:, 0], both[:, 1:]
        if self.rate is not None:
            gradient = gradient - self.rate * both[:, :1] * z
        return value, gradient


class LocalApproximator(nn.Module):
    """V^(y) and its gradient around one state, the centers frozen, for any kernel, by the library's own
    local basis. The arithmetic is in float64 whatever comes in and goes out: a sum of kernels loses most
    digits of float32 to cancellation.

    Args:
        staf: fitted, of one state.
        dtype: of what comes in and goes out.

    Attributes:
        state: x, (n,).
        radius: nu(x), float.
    """

    def __init__(self, staf: StaF, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        if staf.state.dim() != 1:
            raise ValueError(
                f"`LocalApproximator(staf=...)` must have one state; got the batch {staf.state.shape[:-1]}."
            )
        own = copy.deepcopy(staf).double()
        self.dtype = dtype
        self.radius = float(own.basis.centers.radius(own.state).detach())
        # Neither buffers nor a submodule: all of this is constant, and a state dict or `.float()` that
        # changed a part of it would make another function of the whole.
        self.state = own.state.detach()
        self._space = own.basis.local(self.state)
        self._coefficients = own.coefficients.detach()

    def forward(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """V^ and grad V^: (B, n) -> (B,), (B, n)."""
        z = y.double() - self.state
        value, gradient = self._value(z), grad(lambda at: self._value(at).sum())(z)
        return value.to(self.dtype), gradient.to(self.dtype)

    def _value(self, z: Tensor) -> Tensor:
        return self._space.evaluate(z, self._coefficients)


Approximator = RidgeApproximator | LocalApproximator


def approximator(staf: StaF, dtype: torch.dtype = torch.float64, reach: float = 10.0) -> Approximator:
    """The leanest module for V^ and its gradient around the one state of a fitted `StaF`.

    Example:
        >>> basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), radius=0.1))
        >>> x = torch.tensor([1.0, 0.0], dtype=torch.float64)
        >>> value, gradient = deploy.approximator(StaF(basis).fit_(x, targets.Paper()))(x[None])
        >>> value.shape, gradient.shape
        (torch.Size([1]), torch.Size([1, 2]))

        Shown by `staf-export RUN --to c`.

    Args:
        staf: fitted, of one state.
        dtype: of what comes in and goes out, and of the arithmetic where that keeps its digits.
        reach: as in `RidgeApproximator`.

    Raises:
        ValueError: if the approximation is of a batch of states, or ``reach`` is not positive.
    """
    space = staf.basis.local(staf.state.detach())
    graded = isinstance(space, GradedSpace) and space.rate.dim() == space.radius.dim() == 0
    if staf.state.dim() == 1 and graded:
        return RidgeApproximator(staf, dtype, reach)
    return LocalApproximator(staf, dtype)


def _expand(space: GradedSpace, beta: Tensor, eps: float, reach: float) -> Tensor:
    """c_ip = sum_{k <= p} (q_ij / sigma_j) beta_j k! r^(2 (p - k)) / p!, j of degree k: (P + 1, M)."""
    basis, nu = space.basis, float(space.radius)
    r2 = float(space.rate) * nu**2
    apart = (beta @ basis.weights.flatten(0, 1).mT).unflatten(-1, basis.weights.shape[:2])  # (M, K)
    terms: list[Tensor] = []
    for p in range(_HIGHEST + 1):
        shares = [
            apart[:, at] * (math.factorial(k) / math.factorial(p) * r2 ** (p - k))
            for at, k in enumerate(basis.degrees)
            if k <= p
        ]
        terms.append(torch.stack(shares).sum(0) if shares else torch.zeros_like(apart[:, 0]))
        if p > basis.degrees[-1] and _negligible(terms, eps, reach):
            return torch.stack(terms)
    raise ValueError(
        f"`RidgeApproximator(reach=...)` must be smaller: over {reach:g} radii of {nu:g} the kernel's series "
        f"needs more than {_HIGHEST} terms; got {reach!r}."
    )


def _negligible(terms: list[Tensor], eps: float, reach: float) -> bool:
    """Return whether the last term and its slope are below the rounding of the value at |tau| <= reach."""
    last, p = float(terms[-1].abs().sum()), len(terms) - 1
    for at in (1.0, reach):
        size = max(float(term.abs().sum()) * at**q for q, term in enumerate(terms))
        if last * p * at**p > 0.25 * eps * size:
            return False
    return True


def _derivative(c: Tensor) -> Tensor:
    """Coefficients of the derivative, padded: (P + 1, M) -> (P + 1, M)."""
    power = torch.arange(1, len(c), dtype=c.dtype, device=c.device).unsqueeze(-1)
    return torch.cat((power * c[1:], torch.zeros_like(c[:1])))
