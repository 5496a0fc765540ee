"""Plants whose rate is linear in unknown parameters, which may change while they run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from ...lanes.gradients import jacrev
from ...numerics.checks import copied, fail, integer, number
from ...numerics.default_device import device_of
from ...numerics.rows import check_rows
from ...systems import Barrier, Bounds, ControlAffineSystem
from ..problem.cost import Cost

Regressor = Callable[[Tensor, Tensor], Tensor]
"""Y from x and u: (..., n), (..., m) -> (..., n, p)."""
Rate = Callable[[Tensor, Tensor], Tensor]
"""What is known of x': (..., n), (..., m) -> (..., n)."""
_CLOCK = 10.0  # s in which the clock of a changing plant falls to 1/e
_AFFINE = 1e-9  # by which x' may differ from an affine function of u, as a share of its size


class LinearFamily(NamedTuple):
    """x' = A x + B u at a set-point, for every theta: A = A_0 + sum_i theta_i A_i, B likewise."""

    a: Tensor  # A_0, (n, n)
    a_slopes: Tensor  # A_i, (p, n, n)
    b: Tensor  # B_0, (n, m)
    b_slopes: Tensor  # B_i, (p, n, m)

    def at(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """A and B: (..., p) -> (..., n, n), (..., n, m)."""
        weights = theta[..., None, None]
        a = self.a.to(theta) + (weights * self.a_slopes.to(theta)).sum(-3)
        return a, self.b.to(theta) + (weights * self.b_slopes.to(theta)).sum(-3)


class ParametricPlant(ControlAffineSystem):
    """x' = h(x, u) + Y(x, u) theta with unknown parameters theta, in drift, input gain or both.

    Example:
        >>> def regressor(x, u):  # an inverted pendulum whose damping and inertia are not known
        ...     zero = torch.zeros_like(u)
        ...     return torch.stack((torch.cat((zero, -x[..., 1:]), -1), torch.cat((zero, u), -1)), dim=-1)
        >>> def known(x, u):
        ...     return torch.stack((x[..., 1], 9.81 * x[..., 0].sin()), dim=-1)
        >>> plant = adp.ParametricPlant(regressor, known, dim=2, inputs=1, theta=[0.1, 1.0])
        >>> plant.motion(torch.tensor([0.0, 1.0]).double(), torch.tensor([0.5]).double())
        tensor([1.0000, 0.4000], dtype=torch.float64)

        Shown by `staf experiment=faults`.

    Args:
        regressor: Y, (..., n), (..., m) -> (..., n, p).
        known: h, (..., n), (..., m) -> (..., n); None for 0.
        dim: n.
        inputs: m.
        theta: the parameters, (p,), or (..., p), one set a row of states.
        rows: the states whose rates have unknown parts, in order; None for all. The others give no equations.
        periodic: coordinates that are angles.
        bounds: of the inputs.

    Raises:
        ValueError: if Y or h has another shape or is not affine in u, theta is not finite, or Y does not
            vanish in a row that ``rows`` leaves out.
    """

    def __init__(
        self,
        regressor: Regressor,
        known: Rate | None = None,
        *,
        dim: int,
        inputs: int,
        theta: Sequence[float] | Tensor,
        rows: Sequence[int] | None = None,
        periodic: tuple[int, ...] = (),
        bounds: Bounds | None = None,
    ) -> None:
        super().__init__()
        self.dim = integer("ParametricPlant", "dim", dim, least=1)
        self.inputs = integer("ParametricPlant", "inputs", inputs, least=0)
        self.periodic, self.bounds = periodic, bounds
        self.regressor, self.known = regressor, known
        self.rows = list(range(dim)) if rows is None else list(rows)
        if not self.rows or self.rows != sorted(set(self.rows) & set(range(dim))):
            raise fail("ParametricPlant", "rows", f"must be numbers of the {dim} states, in order", rows)
        chosen = torch.as_tensor(theta, dtype=torch.float64, device=getattr(theta, "device", "cpu"))
        number("ParametricPlant", "theta", chosen)
        if chosen.dim() == 0 or chosen.shape[-1] == 0:
            raise fail("ParametricPlant", "theta", "must be (..., p) with p at least 1", tuple(chosen.shape))
        self.register_buffer("theta", chosen)
        self.theta: Tensor
        self._check()

    @classmethod
    def of_effectiveness(cls, plant: ControlAffineSystem) -> ParametricPlant:
        """Return a plant with unknown effectiveness of its actuators: x' = f(x) + g(x) diag(theta) u.

        Example:
            >>> faulty = adp.ParametricPlant.of_effectiveness(systems.Pendulum())
            >>> faulty.theta  # all actuators are healthy
            tensor([1.], dtype=torch.float64)
        """
        return cls(
            lambda x, u: plant.effectiveness(x) * u.unsqueeze(-2),
            lambda x, u: plant.drift(x),
            dim=plant._size(),
            inputs=plant.inputs,
            theta=torch.ones(plant.inputs, dtype=torch.float64, device=device_of(plant)),
            periodic=plant.periodic,
            bounds=plant.bounds,
        )

    @classmethod
    def of_barrier(cls, box: Barrier) -> ParametricPlant:
        """Return the plant of a box in its coordinates s: s' = D(s) (h + Y theta) with D = ds/dx.

        This is the model for a design. The loop runs on the `Barrier`, which keeps its digits beside a wall.

        Example:
            >>> pendulum = adp.ParametricPlant.of_effectiveness(systems.Pendulum())
            >>> box = systems.Barrier(pendulum, low=[-1.0, None], high=[2.0, None])
            >>> model = adp.ParametricPlant.of_barrier(box)
            >>> bool(torch.equal(model.drift(torch.ones(2).double()), box.drift(torch.ones(2).double())))
            True

        Args:
            box: around a `ParametricPlant`.

        Raises:
            ValueError: if the plant in the box is of another kind.
        """
        plant = box.plant
        if not isinstance(plant, ParametricPlant):
            raise fail("ParametricPlant.of_barrier", "box", "must be around a ParametricPlant", plant)
        return cls(
            lambda s, u: box.stretch(s).unsqueeze(-1) * plant.regressor(box.inverse(s), u),
            lambda s, u: box.stretch(s) * plant.rest_of(box.inverse(s), u),
            dim=plant._size(),
            inputs=plant.inputs,
            theta=plant.theta,
            rows=plant.rows,
            periodic=box.periodic,
            bounds=plant.bounds,
        )

    @property
    def parameters_count(self) -> int:
        """p."""
        return self.theta.shape[-1]

    def believing(self, theta: Tensor) -> ParametricPlant:
        """A copy with other parameters, (..., p); not checked, so that a row may go wrong alone."""
        return copied(self, theta=theta)

    def rest_of(self, x: Tensor, u: Tensor) -> Tensor:
        """h(x, u): (..., n), (..., m) -> (..., n)."""
        return torch.zeros_like(x) if self.known is None else self.known(x, u)

    def rate(self, x: Tensor, u: Tensor) -> Tensor:
        """x' = h(x, u) + Y(x, u) theta: (..., n), (..., m) -> (..., n)."""
        return self.rest_of(x, u) + (self.regressor(x, u) * self.theta.to(x).unsqueeze(-2)).sum(-1)

    def drift(self, x: Tensor) -> Tensor:
        return self.rate(x, x.new_zeros(*x.shape[:-1], self.inputs))

    def effectiveness(self, x: Tensor) -> Tensor:
        idle = self.drift(x)
        units = torch.eye(self.inputs, dtype=x.dtype, device=x.device)
        columns = [self.rate(x, unit.expand(*x.shape[:-1], self.inputs)) - idle for unit in units]
        return torch.stack(columns, dim=-1) if columns else x.new_zeros(*x.shape, 0)

    def family(self, x: Tensor | None = None, u: Tensor | None = None) -> LinearFamily:
        """A and B of every theta at a set-point (n,), (m,), by default the equilibrium.

        Raises:
            ValueError: if the set-point is at rest for some theta only: the input that holds it there would
                have to be identified as well.
        """
        at = self.equilibrium() if x is None else x.double()
        held = self.resting_input() if u is None else u.double()
        push = self.regressor(at, held)
        if float(push.abs().max()) > _AFFINE or float(self.rest_of(at, held).abs().max()) > _AFFINE:
            rule = "must vanish at the set-point, so that the plant rests there whatever theta is"
            raise fail("ParametricPlant", "regressor", rule, push)
        slopes = [jacrev(self.rest_of, argnums=k)(at, held).detach() for k in (0, 1)]
        # (n, p, n) and (n, p, m): the parameter to the front.
        more = [jacrev(self.regressor, argnums=k)(at, held).detach().movedim(1, 0) for k in (0, 1)]
        return LinearFamily(slopes[0], more[0], slopes[1], more[1])

    def _check(self) -> None:
        """Refuse a plant that is not affine in u."""
        generator = torch.Generator().manual_seed(0)
        lead = self.theta.shape[:-1] or (4,)
        sizes = [(*lead, self.dim or 0), *((*lead, self.inputs),) * 2]
        x, u, v = (
            torch.rand(size, dtype=torch.float64, generator=generator, device="cpu").to(self.theta) - 0.5
            for size in sizes
        )
        for name, of, shape in (
            ("regressor", self.regressor, (*x.shape, self.parameters_count)),
            ("known", self.rest_of, tuple(x.shape)),
        ):
            got = of(x, u)
            if not self.theta.shape[:-1] and isinstance(got, Tensor) and tuple(got.shape) == shape:
                check_rows(f"ParametricPlant({name}=...)", of, [x[0], u[0]], shape[1:], sizes=(4,))
            if not isinstance(got, Tensor) or tuple(got.shape) != shape:
                shown = tuple(got.shape) if isinstance(got, Tensor) else got
                raise fail("ParametricPlant", name, f"must map {tuple(x.shape)} to {shape}", shown)
            bend = got + of(x, v) - of(x, u + v) - of(x, 0 * u)
            if float(bend.abs().max()) > _AFFINE * (1 + float(got.abs().max())):
                raise fail("ParametricPlant", name, "must be affine in u", bend)
        others = [row for row in range(self.dim or 0) if row not in self.rows]
        if bool((self.regressor(x, u)[..., others, :] != 0).any()):
            raise fail(
                "ParametricPlant", "rows", "must have all states whose regressor does not vanish", self.rows
            )


class ChangingPlant(ControlAffineSystem):
    """A plant with parameters of its own in every row, which may change once:

        state (x, theta_1, theta_2, c),  theta = theta_1 while c > 1 and theta_2 afterwards,  c' = -c / 10 s.

    Example:
        >>> plant = adp.ChangingPlant(adp.ParametricPlant.of_effectiveness(systems.Pendulum()))
        >>> x0 = torch.tensor([[0.3, 0.0]]).double()
        >>> z0 = plant.start(x0, before=[1.0], after=[0.5], at=2.0)
        >>> z0.shape, plant.motion(z0, torch.ones(1, 1).double())[0, 1].round(decimals=3)
        (torch.Size([1, 5]), tensor(3.8990, dtype=torch.float64))

        Shown by `staf experiment=faults`.

    Args:
        model: the plant.
    """

    rowwise: ClassVar = {"start": (1, 1, 1, 0), "theta": (1,)}

    def __init__(self, model: ParametricPlant) -> None:
        super().__init__()
        self.model = model
        self.own, self.count = model._size(), model.parameters_count
        self.size = self.own + 2 * self.count + 1
        self.dim, self.inputs = self.size, model.inputs
        self.periodic, self.bounds = model.periodic, model.bounds

    def start(
        self,
        x0: Tensor,
        before: Sequence[float] | Tensor,
        after: Sequence[float] | Tensor | None = None,
        at: float | Tensor = 0.0,
    ) -> Tensor:
        """The state at time 0, (B, n) -> (B, n + 2 p + 1), with theta_1 and theta_2, by default theta_1,
        (p,) or (B, p), that takes its place ``at`` s, (B,) or one number."""
        first, last = (
            torch.as_tensor(theta, dtype=x0.dtype, device=x0.device).expand(len(x0), self.count)
            for theta in (before, before if after is None else after)
        )
        when = torch.as_tensor(at, dtype=x0.dtype, device=x0.device).expand(len(x0))
        return torch.cat((x0, first, last, (when / _CLOCK).exp().unsqueeze(-1)), dim=-1)

    def theta(self, z: Tensor) -> Tensor:
        """The parameters of the moment: (..., N) -> (..., p)."""
        first, last = z[..., self.own : -1].chunk(2, dim=-1)
        return torch.where(z[..., -1:] > 1, first, last)

    def rate(self, x: Tensor, u: Tensor) -> Tensor:
        moved = self.model.believing(self.theta(x)).rate(x[..., : self.own], u)
        still = torch.zeros_like(x[..., self.own : -1])
        return torch.cat((moved, still, -x[..., -1:] / _CLOCK), dim=-1)

    def drift(self, x: Tensor) -> Tensor:
        return self.rate(x, x.new_zeros(*x.shape[:-1], self.inputs))

    def effectiveness(self, x: Tensor) -> Tensor:
        own = self.model.believing(self.theta(x)).effectiveness(x[..., : self.own])
        rest = x.new_zeros(*x.shape[:-1], self.size - self.own, self.inputs)
        return torch.cat((own, rest), dim=-2)

    def cost(self, cost: Cost) -> Cost:
        """The cost of x alone, for this plant; one with a set-point or an output of its own is refused."""
        if cost.output is not None or cost.target is not None:
            raise fail("ChangingPlant", "cost", "must be of x itself at the origin", cost)
        own, wide = self.own, copied(cost)
        wide.dim, wide.output = self.size, lambda z: z[..., :own]
        wide.periodic = ()  # until it is around this plant
        return wide
