"""Centers that move with the state."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .._checks import fail, trailing
from .._convention import hold
from .radius import ConstantRadius, Radius


class StateFollowingCenters(nn.Module):
    """c_i(x) = x + nu(x) u_i with directions u_i in the closed unit ball.

    Example:
        >>> centers = StateFollowingCenters(rings(6), radius=0.1)
        >>> centers(torch.tensor([1.0, 0.0], dtype=torch.float64)).shape
        torch.Size([6, 2])

    Args:
        directions: u, (M, n), distinct, |u_i| <= 1; learned where it is an `nn.Parameter`.
        radius: a positive number (`ConstantRadius`) or a `Radius`, in the units of the state.

    Raises:
        ValueError: if the directions are not an (M, n) tensor of distinct points of the closed unit
            ball, or the radius breaks its own rule.

    Source: Rosenfeld et al., section 2.
    """

    def __init__(self, directions: Tensor, radius: float | Tensor | Radius) -> None:
        super().__init__()
        hold(self, "directions", _checked(directions))
        self.directions: Tensor
        self.radius = radius if isinstance(radius, Radius) else ConstantRadius(radius)

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


def _checked(given: Tensor) -> Tensor:
    call, name = "StateFollowingCenters", "directions"
    directions = trailing(call, name, given, dims=2).detach()
    if directions.dim() != 2 or 0 in directions.shape:
        raise fail(call, name, "must have the shape (M, n)", tuple(directions.shape))
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
