"""Bases of a value function: the StaF basis, and global ones to compare it with."""

from __future__ import annotations

import abc
import itertools
from typing import ClassVar

import torch
from torch import Tensor, nn

from ...approximation.basis import StaFBasis
from ...centers import StateRadius
from ...kernels import AnchoredKernel, ExponentialKernel
from ...lanes.per_row.objects import OfRows
from ...numerics.checks import choice, flag, hold, integer, positive_real
from ...numerics.default_device import device_of
from ...numerics.derivatives import jacobian


class ValueBasis(nn.Module, metaclass=OfRows):
    """V^(y) = W's(y; x): M functions, whose centers may stand around a state x.

    Example:
        >>> x = torch.tensor([1.0, 2.0]).double()
        >>> adp.QuadraticBasis(2).value(torch.tensor([1.0, 0.0, 1.0]).double(), x)  # W's(x)
        tensor(5., dtype=torch.float64)

        Shown by `staf experiment=adp_comparison`.

    Attributes:
        count: M.
        dim: n.
        follows_state: whether the functions stand around the state x; those of a global basis ignore x.
    """

    rowwise: ClassVar = {"forward": (1, 1), "gradient": (1, 1), "value": (1, 1)}
    count: int
    dim: int
    follows_state: bool = False

    @abc.abstractmethod
    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        """s(y; x): (..., n), (..., n) -> (..., M)."""

    @abc.abstractmethod
    def gradient(self, y: Tensor, x: Tensor) -> Tensor:
        """Ds, the rows grad s_i(y; x)': (..., n), (..., n) -> (..., M, n)."""

    def value(self, weights: Tensor, x: Tensor) -> Tensor:
        """V^(x) = W's(x; x): (..., M), (..., n) -> (...)."""
        values: Tensor = (weights * self(x, x)).sum(-1)
        return values

    def weights_near_square(self) -> list[float]:
        """W with which V^ is nearest to y'y over [-1, 1]^n: a start that often stabilises."""
        generator = torch.Generator().manual_seed(0)
        uniform = torch.rand(1000, self.dim, dtype=torch.float64, generator=generator, device="cpu")
        y = 2 * uniform.to(device_of(self)) - 1
        square = y.square().sum(-1, keepdim=True)
        fitted: list[float] = torch.linalg.lstsq(self(y, y), square, driver="gelsd").solution[:, 0].tolist()
        return fitted


class StaFValueBasis(ValueBasis):
    """s_i(y; x) = k(y, c_i(x)).

    Its gradient at y = x is either of two, which differ by O(1):
        ``partial``: d/dy with the centers frozen;
        ``total``: d/dx of k(x, c_i(x)), the centers moving with the state (the published laws). At
        points y other than x the centers move along, y - x staying what it is.

    For the anchored exponential kernel exp(y'c) - 1 both are in closed form, with c_i = x + nu(x) u_i:

        partial = e^{y'c_i} c_i,   total = e^{y'c_i} (c_i + y + grad nu(x) u_i'y);

    every other kernel is differentiated automatically. A basis whose value at its own state is the same
    everywhere is warned of (`StaFBasis.check_own_value`): its total gradient is zero, and so is the policy.

    Example:
        >>> centers = StateFollowingCenters(rings(3), StateRadius(0.7, offset=1e-5))
        >>> basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(ExponentialKernel()), centers))
        >>> x = torch.tensor([1.0, 0.5]).double()
        >>> basis(x, x).shape, basis.gradient(x, x).shape
        (torch.Size([3]), torch.Size([3, 2]))

        Shown by `staf experiment=adp adp/basis=staf`.

    Args:
        basis: kernel and centers.
        gradient: ``total`` or ``partial``.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    follows_state = True

    def __init__(self, basis: StaFBasis, gradient: str = "total") -> None:
        super().__init__()
        if not isinstance(basis, StaFBasis):
            raise ValueError(f"`StaFValueBasis(basis=...)` must be a StaFBasis; got {basis!r}.")
        choice("StaFValueBasis", "gradient", gradient, ("total", "partial"))
        basis.check_own_value(basis.centers.directions.new_zeros(basis.dim), stacklevel=3)
        self.basis = basis
        self.mode = gradient
        self.count, self.dim = basis.count, basis.dim
        kernel, radius = basis.kernel, basis.centers.radius
        closed = isinstance(kernel, AnchoredKernel) and isinstance(kernel.kernel, ExponentialKernel)
        self._closed = closed and (
            gradient == "partial" or radius.constant or isinstance(radius, StateRadius)
        )

    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        if self._closed:
            return (y.unsqueeze(-2) * self._centers(x)).sum(-1).expm1()
        values: Tensor = self.basis(y.unsqueeze(-2), x)
        return values.squeeze(-2)

    def gradient(self, y: Tensor, x: Tensor) -> Tensor:
        if self._closed:
            return self._closed_form(y, x)
        if self.mode == "partial":
            return jacobian(lambda at: self(at, x), y)
        # y and x move together: the derivative along y = y0 + h, x = x0 + h.
        return jacobian(lambda h: self(y + h, x + h), torch.zeros_like(y))

    def _centers(self, x: Tensor) -> Tensor:
        return x.unsqueeze(-2) + self.basis.centers.offsets(x)

    def _closed_form(self, y: Tensor, x: Tensor) -> Tensor:
        c = self._centers(x)
        size = (y.unsqueeze(-2) * c).sum(-1, keepdim=True).exp()  # (..., M, 1)
        if self.mode == "partial":
            return size * c
        along = c + y.unsqueeze(-2)
        radius = self.basis.centers.radius
        if isinstance(radius, StateRadius):
            directions = self.basis.centers.directions.to(x)
            reach = (directions * y.unsqueeze(-2)).sum(-1, keepdim=True)  # u_i'y, (..., M, 1)
            along = along + reach * _slope(radius, x).unsqueeze(-2)
        return size * along


def _slope(radius: StateRadius, x: Tensor) -> Tensor:
    """grad nu = 2 radius (1 - gain offset) x / (1 + gain x'x)^2: (..., n)."""
    one = 1 + radius.gain * x.square().sum(-1, keepdim=True)
    return 2 * radius.radius * (1 - radius.gain * radius.offset) / one.square() * x


class QuadraticBasis(ValueBasis):
    """s_k(y) = y_i y_j for i <= j: n (n + 1) / 2 functions without centers.

    Example:
        >>> adp.QuadraticBasis(2)(torch.tensor([2.0, 3.0]).double(), torch.zeros(2).double())
        tensor([4., 6., 9.], dtype=torch.float64)

        Shown by `staf experiment=adp adp/basis=quadratic`.

    Args:
        dim: n, at least 1.

    Raises:
        ValueError: if ``dim`` is not a positive integer.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.dim = integer("QuadraticBasis", "dim", dim, least=1)
        rows, columns = torch.triu_indices(dim, dim, device="cpu")
        identity = torch.eye(dim, dtype=torch.float64, device="cpu")
        self.left = hold(self, "left", identity[rows])  # (M, n)
        self.right = hold(self, "right", identity[columns])
        self.count = len(rows)

    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        at = y.unsqueeze(-2)
        return (at * self.left.to(y)).sum(-1) * (at * self.right.to(y)).sum(-1)

    def gradient(self, y: Tensor, x: Tensor) -> Tensor:
        at, left, right = y.unsqueeze(-2), self.left.to(y), self.right.to(y)
        return left * (at * right).sum(-1, keepdim=True) + right * (at * left).sum(-1, keepdim=True)


class RBFGridBasis(ValueBasis):
    """s_i(y) = k_i(y) - k_i(0) - grad k_i(0)'y with k_i(y) = exp(-|y - c_i|^2 / (2 width^2)).

    V^ and its gradient vanish at 0 whatever the weights are, as those of V* do. Without the last term
    (``flat=False``) the control does not vanish at 0, and the state settles beside the origin. The centers
    stand on a regular grid over the box [-half_width, half_width]^n.

    Example:
        >>> basis = adp.RBFGridBasis(2, points=3)
        >>> basis.count, float(basis(torch.zeros(2).double(), torch.zeros(2).double()).abs().max())
        (9, 0.0)

        Shown by `staf experiment=adp adp/basis=rbf_grid`.

    Args:
        dim: n.
        points: a side of the grid, at least 2: M = points^n.
        half_width: positive, in the units of the state.
        width: positive; the spacing of the grid by default.
        flat: whether the gradient at 0 is taken off too.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        dim: int,
        points: int = 5,
        half_width: float = 2.0,
        width: float | None = None,
        *,
        flat: bool = True,
    ) -> None:
        super().__init__()
        self.dim = integer("RBFGridBasis", "dim", dim, least=1)
        integer("RBFGridBasis", "points", points, least=2)
        side = positive_real("RBFGridBasis", "half_width", half_width)
        spacing = 2 * side / (points - 1)
        self.width = spacing if width is None else positive_real("RBFGridBasis", "width", width)
        line = torch.linspace(-side, side, points, dtype=torch.float64, device="cpu").tolist()
        grid = torch.tensor(list(itertools.product(line, repeat=dim)), dtype=torch.float64, device="cpu")
        self.centers = hold(self, "centers", grid)  # (M, n)
        self.anchor: Tensor
        self.register_buffer("anchor", (-0.5 * grid.square().sum(-1) / self.width**2).exp())
        slope = self.anchor.unsqueeze(-1) * grid / self.width**2  # grad k_i(0), (M, n)
        self.slope = hold(self, "slope", slope if flag("RBFGridBasis", "flat", flat) else 0 * slope)
        self.count = len(grid)

    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        at = y.unsqueeze(-2)
        return self._bumps(at - self.centers.to(y)) - self.anchor.to(y) - (at * self.slope.to(y)).sum(-1)

    def gradient(self, y: Tensor, x: Tensor) -> Tensor:
        apart = y.unsqueeze(-2) - self.centers.to(y)
        return -self._bumps(apart).unsqueeze(-1) * apart / self.width**2 - self.slope.to(y)

    def _bumps(self, apart: Tensor) -> Tensor:
        bumps: Tensor = (-0.5 * apart.square().sum(-1) / self.width**2).exp()
        return bumps


class LeadingCoordinates(ValueBasis):
    """s(y) = s_inner(y_1, ..., y_k), constant in the other coordinates.

    In tracking the value must vanish wherever the error does, whatever the desired state is; a basis of the
    error alone does, and its weights follow the desired state in time.

    Example:
        >>> basis = adp.LeadingCoordinates(adp.QuadraticBasis(2), dim=4)  # of the first two
        >>> basis(torch.ones(4).double(), torch.ones(4).double())
        tensor([1., 1., 1.], dtype=torch.float64)

        Shown by `staf experiment=adp_tracking`.

    Args:
        basis: of the first k coordinates.
        dim: n >= k.

    Raises:
        ValueError: if ``dim`` is less than k.
    """

    def __init__(self, basis: ValueBasis, dim: int) -> None:
        super().__init__()
        self.basis = basis
        self.dim = integer("LeadingCoordinates", "dim", dim, least=basis.dim)
        self.count, self.follows_state = basis.count, basis.follows_state

    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        values: Tensor = self.basis(y[..., : self.basis.dim], x[..., : self.basis.dim])
        return values

    def gradient(self, y: Tensor, x: Tensor) -> Tensor:
        inner = self.basis.gradient(y[..., : self.basis.dim], x[..., : self.basis.dim])
        rest = inner.new_zeros(*inner.shape[:-1], self.dim - self.basis.dim)
        return torch.cat((inner, rest), dim=-1)
