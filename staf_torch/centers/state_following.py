"""Centers that move with the state, and how far they stand from it."""

from __future__ import annotations

import abc
from typing import ClassVar

import torch
from torch import Tensor, nn

from ..lanes.per_row.objects import OfRows
from ..lanes.row_numbers import RowNumbers
from ..numerics.checks import fail, hold, kept, non_negative, positive, shown, trailing, values_of
from ..numerics.rows import check_radius


class Radius(nn.Module, metaclass=OfRows):
    """nu(x) >= 0, the radius of the ball of centers at the state x.

    Example:
        >>> isinstance(StateRadius(0.7, offset=0.01), Radius), StateRadius(0.7, offset=0.01).constant
        (True, False)

        Shown by `staf centers.shrink.offset=0.01`.
    """

    rowwise: ClassVar = {"forward": (1,)}
    constant: bool = False

    def bound(self) -> Tensor | None:
        """sup nu(x) over all states, () or a batch entry; None where it is not known."""
        return None

    @abc.abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """nu(x): (..., n) -> (...), or what broadcasts to it where it does not depend on x."""

    def extra_repr(self) -> str:
        return shown(self)


class ConstantRadius(Radius):
    """nu(x) = radius.

    Example:
        >>> ConstantRadius(0.1)(torch.zeros(4, 2).double())
        tensor(0.1000, dtype=torch.float64)

        Shown by `staf centers.radius=0.2`.

    Args:
        radius: positive, in the units of the state.

    Raises:
        ValueError: if ``radius`` is not positive and finite.
    """

    constant = True

    def __init__(self, radius: float | Tensor) -> None:
        super().__init__()
        self.radius = hold(self, "radius", positive("ConstantRadius", "radius", radius))

    def bound(self) -> Tensor:
        return kept(self, "radius")

    def forward(self, x: Tensor) -> Tensor:
        radius = kept(self, "radius").to(x)
        return radius.expand(x.shape[:-1]) if isinstance(self.radius, RowNumbers) else radius  # a row's own


class StateRadius(Radius):
    """nu(x) = radius (x'x + offset) / (1 + gain x'x): centers that close in on the origin.

    Example:
        >>> StateRadius(0.7, offset=0.01)(torch.tensor([[0.0, 0.0], [1.0, 1.0]]).double())
        tensor([0.0070, 0.4690], dtype=torch.float64)

        Shown by `staf centers.shrink.offset=0.01`.

    Args:
        radius: positive; the radius far from the origin is radius / gain.
        offset: not negative; radius * offset is the radius at the origin, where a zero offset lets
            all centers meet.
        gain: positive.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: the paper's appendix has radius 0.7, offset 0.01, gain 1.
    """

    def __init__(self, radius: float | Tensor, offset: float | Tensor, gain: float | Tensor = 1.0) -> None:
        super().__init__()
        self.radius = hold(self, "radius", positive("StateRadius", "radius", radius))
        self.offset = hold(self, "offset", non_negative("StateRadius", "offset", offset))
        self.gain = hold(self, "gain", positive("StateRadius", "gain", gain))

    def bound(self) -> Tensor:
        # nu is monotone in x'x, between radius * offset at the origin and radius / gain far out.
        radius, offset, gain = self._numbers()
        return radius * torch.maximum(offset, 1 / gain)

    def forward(self, x: Tensor) -> Tensor:
        square = x.square().sum(-1)
        radius, offset, gain = (number.to(x) for number in self._numbers())
        return radius * (square + offset) / (1 + gain * square)

    def _numbers(self) -> tuple[Tensor, Tensor, Tensor]:
        return kept(self, "radius"), kept(self, "offset", zero=True), kept(self, "gain")


class StateFollowingCenters(nn.Module, metaclass=OfRows):
    """c_i(x) = x + nu(x) u_i with directions u_i in the closed unit ball.

    Example:
        >>> centers = StateFollowingCenters(rings(6), radius=0.1)
        >>> centers(torch.tensor([1.0, 0.0], dtype=torch.float64)).shape
        torch.Size([6, 2])

        Shown by `staf experiment=gradient_chase`.

    Args:
        directions: u, (M, n), distinct, |u_i| <= 1; learned where it is an `nn.Parameter`.
        radius: a positive number (`ConstantRadius`) or a `Radius`, in the units of the state.

    Raises:
        ValueError: if the directions are not an (M, n) tensor of distinct points of the closed unit
            ball, or the radius breaks its own rule; later, if a `Radius` of your own returns a negative one.

    Source: Rosenfeld et al., section 2.
    """

    rowwise: ClassVar = {"forward": (1,)}

    def __init__(self, directions: Tensor, radius: float | Tensor | Radius) -> None:
        super().__init__()
        self.directions = hold(self, "directions", _checked(directions))
        self.radius = radius if isinstance(radius, Radius) else ConstantRadius(radius)
        if not isinstance(
            self.radius, ConstantRadius | StateRadius
        ):  # a user's: those two check what they hold
            check_radius(self.radius, self.directions)
            self.radius.register_forward_hook(_not_negative)

    @property
    def count(self) -> int:
        """M, the number of centers."""
        return self.directions.shape[0]

    @property
    def dim(self) -> int:
        """n, the dimension of the state."""
        return self.directions.shape[1]

    def offsets(self, x: Tensor) -> Tensor:
        """d_i(x) = nu(x) u_i: (..., n) -> (..., M, n); (M, n) alone where the radius is constant.

        What follows from unbatched offsets, like the Gram core of a state-free kernel, is then computed
        once for all states.
        """
        nu: Tensor = self.radius(x)
        return nu[..., None, None] * self.directions.to(x)

    def forward(self, x: Tensor) -> Tensor:
        """c_i(x): (..., n) -> (..., M, n)."""
        trailing("StateFollowingCenters", "x", x, dims=1, last=self.dim)
        return x.unsqueeze(-2) + self.offsets(x)

    def extra_repr(self) -> str:
        return f"count={self.count}, dim={self.dim}"


def _not_negative(radius: nn.Module, _: object, nu: Tensor) -> None:
    """Refuse a negative nu(x), which would turn the centers around; NaN at a state of NaN passes."""
    plain = values_of(nu)
    rule = f"`{type(radius).__name__}` must return radii that are not negative"
    if plain is not None and bool((plain < 0).any()):
        raise ValueError(f"{rule}; got {float(plain.min()):.6g}.")
    if torch.compiler.is_dynamo_compiling():
        torch._assert_async((~(nu < 0)).all(), f"{rule}.")


def _checked(given: Tensor) -> Tensor:
    call, name = "StateFollowingCenters", "directions"
    directions = trailing(call, name, given, dims=2).detach()
    if directions.dim() != 2 or 0 in directions.shape:
        raise fail(call, name, "must have the shape (M, n)", tuple(directions.shape))
    if directions.is_meta:
        return given  # there are no values to look at
    if not bool(torch.isfinite(directions).all()):
        raise fail(call, name, "must be finite", directions)
    norms = directions.norm(dim=-1)
    if bool((norms > 1 + 16 * torch.finfo(directions.dtype).eps).any()):
        worst = int(norms.argmax())
        raise fail(
            call,
            name,
            f"must lie in the closed unit ball (scale the radius up instead), "
            f"but direction {worst} has the norm {float(norms[worst]):.6g}",
            directions,
        )
    gaps = torch.cdist(directions, directions, compute_mode="donot_use_mm_for_euclid_dist")
    gaps.fill_diagonal_(torch.inf)
    if bool((gaps == 0).any()):
        first = int((gaps == 0).any(-1).nonzero()[0])
        raise fail(call, name, f"must be distinct, but direction {first} is repeated", directions)
    return given
