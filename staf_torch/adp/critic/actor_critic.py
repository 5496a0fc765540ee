"""Actor, critic and the points of Bellman extrapolation: a controller that learns while it controls."""

from __future__ import annotations

import abc
import itertools
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from ...centers import ConstantRadius, Radius
from ...lanes.per_row.objects import OfRows
from ...numerics.checks import choice, fail, hold, integer, number, object_of, positive, trailing, vector
from ...numerics.default_device import device_of
from ...systems import ControlAffineSystem
from ..loop.controller import Controller
from ..problem.cost import Cost
from ..problem.rules import check_objects, regulated
from .bases import ValueBasis
from .laws import ActorCriticLaw, BellmanTerms, Information, Weights, bellman_terms

Initial = float | list[float] | Tensor


class Extrapolation(nn.Module, metaclass=OfRows):
    """N points y_i = x + b(x) z_i of the box [-b, b]^n around the state, with weights that sum to 1.

    Around the ``origin`` they are y_i = b z_i, wherever the state is. That is what a global basis needs: its
    weights hold everywhere, and points around the state alone let it forget the rest, so that it stalls.

    Example:
        >>> isinstance(adp.RandomPoints(1, half_width=0.5), adp.Extrapolation), adp.RandomPoints(3, 0.5).draws
        (True, 3)

        Shown by `staf experiment=adp`.

    Args:
        half_width: b(x), a positive number or a `Radius`, in the units of the state.
        centers: ``moving`` (each point carries its own centers, the published laws) or ``fixed`` (the
            centers of the state serve all points).
        around: ``state`` or ``origin``; the latter needs a constant b.

    Attributes:
        count: N.
        weights: (N,), sum 1.
        draws: random points that a step needs.
    """

    rowwise: ClassVar = {"forward": (1, 2)}
    count: int
    draws: int = 0
    weights: Tensor

    def __init__(self, half_width: float | Radius, centers: str = "moving", *, around: str = "state") -> None:
        super().__init__()
        name = type(self).__name__
        choice(name, "around", around, ("state", "origin"))
        if centers not in ("moving", "fixed"):
            raise ValueError(f"`{name}(centers=...)` must be 'moving' or 'fixed'; got {centers!r}.")
        if not isinstance(half_width, Radius):
            half_width = ConstantRadius(positive(name, "half_width", half_width))
        self.half_width = half_width
        self.moving = centers == "moving"
        self.fixed_box = around == "origin"
        if self.fixed_box and not self.half_width.constant:
            raise ValueError(f"`{name}(half_width=...)` must be constant for a box around the origin.")

    @abc.abstractmethod
    def cube(self, uniform: Tensor) -> Tensor:
        """z in [-1, 1]^n from ``uniform`` numbers of it, (..., draws, n): (..., N, n) or (N, n)."""

    def forward(self, x: Tensor, uniform: Tensor) -> Tensor:
        """y_i: (..., n), (..., draws, n) -> (..., N, n)."""
        width: Tensor = self.half_width(x)
        middle = torch.zeros_like(x) if self.fixed_box else x
        return middle.unsqueeze(-2) + width[..., None, None] * self.cube(uniform).to(x)


class RandomPoints(Extrapolation):
    """N points a step, independent and uniform in the box (the published laws have N = 1).

    Example:
        >>> points = adp.RandomPoints(2, half_width=0.5)
        >>> points(torch.zeros(1, 2).double(), torch.ones(1, 2, 2).double())  # uniform numbers in, points out
        tensor([[[0.5000, 0.5000],
                 [0.5000, 0.5000]]], dtype=torch.float64)

        Shown by `staf experiment=adp adp/extrapolation=random`.

    Args:
        count: N, at least 1.
        half_width, centers, around: as in `Extrapolation`.
        random: ``counter``, numbers of the row's seed and the step, or ``generator``, those of a generator a
            row as before version 0.2, drawn on the CPU ahead of a loop; the latter goes with version 0.3.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        count: int,
        half_width: float | Radius,
        centers: str = "moving",
        *,
        around: str = "state",
        random: str = "counter",
    ) -> None:
        super().__init__(half_width, centers, around=around)
        self.random = choice("RandomPoints", "random", random, ("counter", "generator"))
        self.count = self.draws = integer("RandomPoints", "count", count, least=1)
        self.register_buffer("weights", torch.full((count,), 1 / count, dtype=torch.float64, device="cpu"))

    def cube(self, uniform: Tensor) -> Tensor:
        return uniform


class QuadraturePoints(Extrapolation):
    """The mean over the box itself, by an order^n Gauss-Legendre rule: nothing random is left.

    Example:
        >>> points = adp.QuadraturePoints(3, dim=2, half_width=0.5)
        >>> points(torch.zeros(1, 2).double(), torch.zeros(1, 0, 2).double()).shape  # 3 a coordinate
        torch.Size([1, 9, 2])

        Shown by `staf experiment=adp adp/extrapolation=quadrature`.

    Args:
        order: points a coordinate, at least 1.
        dim: n.
        half_width, centers, around: as in `Extrapolation`.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        order: int,
        dim: int,
        half_width: float | Radius,
        centers: str = "moving",
        *,
        around: str = "state",
    ) -> None:
        super().__init__(half_width, centers, around=around)
        integer("QuadraturePoints", "order", order, least=1)
        integer("QuadraturePoints", "dim", dim, least=1)
        nodes, masses = np.polynomial.legendre.leggauss(order)
        grid = torch.tensor(
            list(itertools.product(nodes.tolist(), repeat=dim)), dtype=torch.float64, device="cpu"
        )
        products = torch.tensor(
            list(itertools.product(masses.tolist(), repeat=dim)), dtype=torch.float64, device="cpu"
        )
        self.grid = hold(self, "grid", grid)  # (N, n)
        self.register_buffer("weights", products.prod(-1) / 2**dim)
        self.count = len(grid)

    def cube(self, uniform: Tensor) -> Tensor:
        return self.grid


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
