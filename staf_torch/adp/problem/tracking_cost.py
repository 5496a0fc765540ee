"""Cost of following a path: the distance from a state that moves with the time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

import torch
from torch import Tensor

from ...lanes.per_row.objects import by_rows
from ...numerics.angles import wrap
from ...numerics.checks import copied, fail
from ...numerics.linalg import Matrix
from ...numerics.rows import check_rows
from ...systems import Clocked, Plant
from ...systems.base import Limit
from .cost import Cost, QuadraticCost

Path = Callable[[Tensor], Tensor]
"""x_d from t: (...) -> (..., n)."""


class TrackingCost(QuadraticCost):
    """(x - x_d(t))'Q (x - x_d(t)) + (u - u_s)'R (u - u_s), of the state (x, t) of a `systems.Clocked` plant.

    u_s holds the plant at its equilibrium. The path need not be one that the plant can follow: what is
    cheapest then lies beside it.

    Example:
        >>> plant = systems.Clocked(systems.Pendulum())
        >>> def swings(t):  # angle and rate
        ...     return torch.stack((0.3 * t.sin(), 0.3 * t.cos()), dim=-1)
        >>> cost = adp.TrackingCost(10.0, 0.1, dim=2, inputs=1, path=swings)
        >>> lqr = adp.LQR(plant, cost, period=0.05)
        >>> x0 = plant.at(torch.tensor([[0.0, 0.3]]).double())
        >>> run = adp.simulate(adp.Feedback(lqr), plant, cost, x0, dt=0.05, steps=40)

        Shown by `staf_torch/adp/README.md`.

    Args:
        state: Q, (n, n), positive semidefinite, or a number q for q I.
        control: R, (m, m), positive definite, or a number.
        dim: n, of the plant without its clock.
        inputs: m.
        path: x_d from t, (...) -> (..., n), in torch, with two derivatives where trajectories are optimised.
        low, high: of the inputs, as in `systems.Bounds`; both None for the bounds of the plant.
        target_input: u_s, m numbers; None for the input that holds the plant at its equilibrium.

    Raises:
        ValueError: as in `Cost`, or if the path returns another shape.
    """

    def __init__(
        self,
        state: Matrix,
        control: Matrix,
        dim: int,
        inputs: int,
        *,
        path: Path,
        low: Limit = None,
        high: Limit = None,
        target_input: list[float] | Tensor | None = None,
    ) -> None:
        still = QuadraticCost(state, control, dim, inputs, low=low, high=high, target_input=target_input)
        q = torch.nn.functional.pad(still.q, (0, 1, 0, 1))
        super().__init__(q, still.r, dim + 1, inputs, low=low, high=high, target_input=target_input)
        self.still, self.path = still, path
        now = torch.zeros((), dtype=torch.float64, device="cpu")
        check_rows("TrackingCost(path=...)", path, [now], (dim,), sizes=(inputs,))

    @by_rows
    def around(self, plant: Plant) -> Self:
        """This cost with the plant's bounds, periodic coordinates and resting input where it has none.
        Refused if the plant has no clock, the sizes differ, or it has no rest under the input."""
        if not isinstance(plant, Clocked):
            raise fail("TrackingCost", "plant", "must have a clock: `systems.Clocked(plant)`", plant)
        placed = copied(self)
        placed.still = self.still.around(plant.plant)
        placed.target_input, placed.bounds = placed.still.target_input, placed.still.bounds
        placed.periodic = plant.periodic
        placed._prepare()
        return placed

    def bounded(self, low: Limit, high: Limit) -> Self:
        other = super().bounded(low, high)
        if other is not self:
            other.still = self.still.bounded(low, high)
        return other

    def regulated(self, plant: Plant) -> tuple[Plant, Cost]:
        """The plant without its clock and the cost of a distance from its equilibrium."""
        assert isinstance(plant, Clocked)
        return plant.plant, self.still

    def set_point(self) -> Tensor:
        """The path at t = 0, without the time, (n,)."""
        return self.path(self.r.new_zeros(()))

    def deviation(self, x: Tensor) -> Tensor:
        """(x - x_d(t), 0), angles in [-pi, pi]: (..., n + 1) -> (..., n + 1)."""
        away = wrap(x[..., :-1] - self.path(x[..., -1]), self.periodic)
        return torch.cat((away, torch.zeros_like(x[..., -1:])), dim=-1)


def tracking_cost(error: Matrix, control: Matrix) -> QuadraticCost:
    """e'Qe + mu'R mu in the state (e, xd): nothing is paid for xd itself.

    Example:
        >>> adp.tracking_cost(10.0, 1.0).q.diagonal()  # of the error alone
        tensor([10., 10.,  0.,  0.], dtype=torch.float64)

        Shown by `staf experiment=adp_tracking`.

    Args:
        error: Q, (2, 2) or a number.
        control: R, (1, 1) or a number.

    Raises:
        ValueError: if Q or R is not symmetric positive definite.
    """
    q = QuadraticCost(error, control, 2, 1).q
    return QuadraticCost(torch.block_diag(q, torch.zeros_like(q)), control, 4, 1)
