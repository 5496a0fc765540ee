"""Actor, critic and extrapolation together: a controller that learns while it controls."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ...numerics.checks import fail, number, object_of, positive, trailing, vector
from ...numerics.default_device import device_of
from ...systems import ControlAffineSystem
from ..loop.controller import Controller
from ..problem.cost import Cost
from ..problem.rules import check_objects, regulated
from .bases import ValueBasis
from .bellman import BellmanTerms, bellman_terms
from .extrapolation import Extrapolation
from .laws import ActorCriticLaw, Information, Weights

Initial = float | list[float] | Tensor


class ActorCritic(Controller):
    """u = -1/2 R^-1 g' Ds' Wa, with Wc and Wa moved by a law on the Bellman error at the state and at
    extrapolated points.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> centers = StateFollowingCenters(rings(3), StateRadius(0.7, offset=1e-5))
        >>> basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(ExponentialKernel()), centers))
        >>> learner = adp.ActorCritic(basis, plant, cost, adp.RandomPoints(1, half_width=0.5))
        >>> x0 = torch.tensor([[-1.0, 1.0]]).double()
        >>> adp.simulate(learner, plant, cost, x0, dt=0.01, steps=20).critic_weights.shape  # (B, T, M)
        torch.Size([1, 21, 3])

        Shown by `staf experiment=adp`.

    Args:
        basis: of V^.
        model: what the controller believes the plant to be.
        cost: the cost rate, with or without bounds; the actor's force is that of the bounded input.
        extrapolation: the points.
        law: `Information` by default.
        critic: Wc(0): a number for all, M numbers, or a tensor (M,) or (B, M), a row a trajectory.
        actor: Wa(0), likewise.
        gain: gamma > 0 in Gam(0) = gamma I, a number or a tensor (B,).

    Raises:
        ValueError: if sizes do not fit together, or an argument breaks its rule.

    Source: Kamalapurkar, Rosenfeld and Dixon, via MATH.md section 4 (its defaults: two states).
    """

    def __init__(
        self,
        basis: ValueBasis,
        model: ControlAffineSystem,
        cost: Cost,
        extrapolation: Extrapolation,
        law: ActorCriticLaw | None = None,
        *,
        critic: Initial = 0.4,
        actor: Initial = 0.28,
        gain: float | Tensor = 250.0,
    ) -> None:
        super().__init__()
        object_of("ActorCritic", ValueBasis, "`StaFValueBasis(basis)` is one", basis=basis)
        check_objects("ActorCritic", model=model, cost=cost)
        if not isinstance(model, ControlAffineSystem):
            raise fail(
                "ActorCritic", "model", "must be a ControlAffineSystem; `near_optimal` takes others", model
            )
        if model.dim != basis.dim:
            raise ValueError(
                f"`ActorCritic(basis=...)` has {basis.dim} states, but the plant has {model.dim}."
            )
        _check_points(extrapolation, basis.dim)
        cost = regulated("ActorCritic", model, cost)
        if cost.target is not None or cost.discount:
            what = "discount" if cost.discount else "target"
            rule = f"must have no {what}: the laws regulate to the origin without a discount"
            raise fail("ActorCritic", "cost", rule, getattr(cost, what))
        self.basis, self.model, self.cost, self.extrapolation = basis, model, cost, extrapolation
        self.law = Information() if law is None else law
        self.draws = extrapolation.draws
        self.register_buffer("critic", _weights("critic", critic, basis.count))
        self.register_buffer("actor", _weights("actor", actor, basis.count))
        self.critic: Tensor
        self.actor: Tensor
        self.register_buffer("gain", positive("ActorCritic", "gain", gain))
        self.gain: Tensor

    @property
    def label(self) -> str:
        return f"actor-critic ({type(self.law).__name__})"

    def init(self, x0: Tensor) -> Weights:
        trailing(type(self).__name__, "x0", x0, 2)
        rows = (x0.shape[0], self.basis.count)
        one = torch.eye(self.basis.count, dtype=x0.dtype, device=x0.device)
        gain = self.gain.to(x0)[..., None, None] * one
        critic, actor, gain = self.law.init(self.critic.to(x0), self.actor.to(x0), gain)
        wide = Weights(critic.expand(rows), actor.expand(rows), gain.expand(len(x0), -1, -1))
        return (
            Weights(*map(Tensor.clone, wide)) if x0.is_cpu else wide
        )  # a kernel reads them by their strides

    def recorded(self, carried: Weights) -> dict[str, Tensor]:
        return {"actor_weights": carried.actor, "critic_weights": carried.critic}

    def terms(
        self, x: Tensor, actor: Tensor, uniform: Tensor, model: ControlAffineSystem | None = None
    ) -> BellmanTerms:
        """The Bellman terms at the state (first) and at the extrapolated points, by ``model`` if given."""
        points = self.points(x, uniform)
        return bellman_terms(
            self.basis, model or self.model, self.cost, points, self._followed(points), actor
        )

    def points(self, x: Tensor, uniform: Tensor) -> Tensor:
        """The state, its angles in [-pi, pi], and the extrapolated points, (..., P, n)."""
        x = self.cost.deviation(x)
        return torch.cat((x.unsqueeze(-2), self.extrapolation(x, uniform)), dim=-2)

    def value_gradient(self, x: Tensor, critic: Tensor, uniform: Tensor) -> Tensor:
        """grad V^ at these points, (..., P, n)."""
        points = self.points(x, uniform)
        gradient = self.basis.gradient(points, self._followed(points))  # (..., P, M, n)
        return (gradient * critic[..., None, :, None]).sum(-2)

    def _followed(self, points: Tensor) -> Tensor:
        """The states around which the centers of the points stand, (..., P, n)."""
        return points if self.extrapolation.moving else points[..., :1, :].expand(points.shape)

    def step(self, x: Tensor, carried: Weights, uniform: Tensor, dt: float) -> tuple[Tensor, Weights]:
        terms = self.terms(x, carried.actor, uniform)
        return terms.control[..., 0, :], self.moved(terms, carried, dt)

    def moved(self, terms: BellmanTerms, weights: Weights, dt: float) -> Weights:
        """The weights after ``dt`` seconds with the Bellman terms of now."""
        return self.law.step(self.law.sums(terms, self.extrapolation.weights, weights), weights, dt)

    def value(self, x: Tensor, recorded: Mapping[str, Tensor]) -> Tensor:
        return self.basis.value(recorded["critic_weights"], self.cost.deviation(x))


def _weights(name: str, value: Initial, count: int) -> Tensor:
    if isinstance(value, Tensor):
        number("ActorCritic", name, trailing("ActorCritic", name, value, dims=1, last=count))
        return value
    if isinstance(value, int | float):
        value = [value] * count
    return torch.tensor(vector("ActorCritic", name, value, count), dtype=torch.float64, device="cpu")


def _check_points(extrapolation: Extrapolation, dim: int) -> None:
    """Refuse points of another space than the plant's, which would fail within the loop."""
    x, uniform = (
        torch.zeros(1, *rows, dim, dtype=torch.float64, device=device_of(extrapolation))
        for rows in ((), (extrapolation.draws,))
    )
    try:
        shape = tuple(extrapolation(x, uniform).shape)
    except RuntimeError as error:
        shape, said = (), f" ({error})"
    else:
        said = ""
    if len(shape) != 3 or (shape[0], shape[2]) != (1, dim):
        rule = f"must make points (B, N, {dim}) around states (B, {dim}){said}"
        raise fail("ActorCritic", "extrapolation", rule, shape or extrapolation)
