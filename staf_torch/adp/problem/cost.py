"""Cost rates, and the policy that a value gradient implies."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from ...lanes.gradients import jacrev
from ...lanes.per_row.decisions import in_any_row
from ...lanes.per_row.objects import OfRows, by_rows
from ...lanes.row_numbers import nonzero, value_of
from ...numerics.angles import periods_of, turned, wrap, wrap_each
from ...numerics.box import LARGEST, box_minimum, face_inverses
from ...numerics.checks import (
    copied,
    fail,
    non_negative,
    one_or_each,
    real,
    trailing,
)
from ...numerics.default_device import beside, device_of, without_numbers
from ...numerics.linalg import Matrix, positive_definite, positive_semidefinite, square
from ...numerics.repr_text import limits, shown, sizes
from ...numerics.rows import check_rows
from ...systems import Bounds, Plant
from ...systems.base import Limit
from ...systems.equilibria import resting_input_at

EndValue = Callable[[Tensor], Tensor]
"""V_T from x: (..., n) -> (...)."""
Output = Callable[[Tensor], Tensor]
"""y from x: (..., n) -> (..., p)."""


class Cost(nn.Module, metaclass=OfRows):
    """The cost rate e'Qe + U(u) of an infinite horizon, with U convex and 0 at the input that holds the plant
    at the set-point. e is the state measured from there, angles in [-pi, pi], or an output of it.

    Example:
        >>> isinstance(adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1), adp.Cost)
        True

        Shown by `staf experiment=adp`.

    Args:
        state: Q, (n, n), positive semidefinite, or its diagonal (n,); a number q stands for q I.
        control: R, (m, m), positive definite; a number likewise.
        dim: n.
        inputs: m.
        low, high: of the inputs, as in `systems.Bounds`; both None for the bounds of the plant.
        target: the set-point, n numbers; None for the equilibrium of the plant.
        target_input: the input there, m numbers; None for the one that holds the plant there.
        output: y(x), (..., n) -> (..., p), in place of x: e = y(x) - y(target), and Q is (p, p) or a matrix.
            x is turned to within pi of the target before; what turns with it is an angle itself.
        discount: rho in 1/s: what is paid at t counts exp(-rho t).
        terminal: paid where plans, shooting and rollouts end, in place of the LQR's value: V_T, (..., n) ->
            (...) with two derivatives, or S of e'Se, (n, n), its diagonal or a number, 0 allowed. None for an
            endless horizon, which all else is for. Not with a discount, S not with an output.

    Raises:
        ValueError: if Q is not positive semidefinite or R not positive definite of its size, or another
            argument breaks its rule.
    """

    rowwise: ClassVar = {
        **dict.fromkeys(("state_rate", "outputs", "error", "terminal", "deviation"), (1,)),
        **dict.fromkeys(("input_rate", "saturate", "admissible", "unsaturated", "effort", "input_of"), (1,)),
        "rate": (1, 1),
        "policy": (2, 1),
    }

    none_is_zero = ("target", "target_input")  # where other rows have one

    @beside
    def __init__(
        self,
        state: Matrix,
        control: Matrix,
        dim: int,
        inputs: int,
        *,
        low: Limit = None,
        high: Limit = None,
        target: Sequence[float] | Tensor | None = None,
        target_input: Sequence[float] | Tensor | None = None,
        output: Output | None = None,
        discount: float | Tensor = 0.0,
        terminal: Matrix | EndValue | None = None,
    ) -> None:
        super().__init__()
        name = type(self).__name__
        self.dim, self.inputs, self.output = dim, inputs, output
        device = device_of(state, control, target, terminal)
        point = _point(name, "target", target, dim)
        self.target = None if point is None else point.to(device)
        tried = torch.zeros(dim, dtype=torch.float64, device=device) if self.target is None else self.target
        seen = dim if output is None else _outputs(name, output, tried, inputs)
        q = positive_semidefinite(name, "state", square(name, "state", state, seen), seen)
        self.register_buffer("q", q.to(device))
        r = positive_definite(name, "control", square(name, "control", control, inputs), inputs)
        self.register_buffer("r", r.to(device))
        self.register_buffer("r_inverse", torch.linalg.inv(r.to(device)))
        self.q: Tensor
        self.r: Tensor
        self.r_inverse: Tensor
        point = _point(name, "target_input", target_input, inputs)
        self.target_input = None if point is None else point.to(device)
        non_negative(name, "discount", discount)
        self.discount = real(name, "discount", discount)
        if terminal is not None and (self.discount or (output is not None and not callable(terminal))):
            raise fail(name, "terminal", "must be None beside an output or a discount", terminal)
        self.end_value = terminal if callable(terminal) else None
        if self.end_value is not None:
            check_rows(f"{name}(terminal=...)", self.end_value, [tried], sizes=(inputs,))
        end = None if terminal is None or callable(terminal) else square(name, "terminal", terminal, dim)
        end = None if end is None else positive_semidefinite(name, "terminal", end, dim)
        self.register_buffer("end", end)
        self.end: Tensor | None  # S
        self.periodic: tuple[int, ...] = ()
        self._periods: tuple[float, ...] = ()  # of the outputs
        self.bounds: Bounds | None = None
        if low is not None or high is not None:
            bounds = Bounds(low, high, inputs).on(device)
            self.bounds = bounds if bounds.present else None
        self._prepare()

    @by_rows
    @beside
    def around(self, plant: Plant) -> Self:
        """This cost with a plant's equilibrium, periodic coordinates and bounds where it states none of its
        own; itself where there is nothing to add.

        The plant need not rest at the set-point: whoever regulates asks `problem.rules` for that. Where no
        input holds it there, effort is measured from the one that comes nearest to it.

        Raises:
            ValueError: if the sizes differ.
        """
        if self.q.device != (device := device_of(plant)):  # a cost around a plant is where the plant is
            return copied(self).to(device).around(plant)
        name = type(plant).__name__
        if (plant.dim or self.dim) != self.dim or plant.inputs not in (0, self.inputs):
            raise ValueError(
                f"`{type(self).__name__}` is for {self.dim} states and {self.inputs} inputs; "
                f"{name} has {plant.dim} and {plant.inputs}."
            )
        placed = copied(self)
        if not without_numbers(self, plant):  # of which nobody can tell where it rests
            placed.target, placed.target_input = self._rest(plant)
        placed.periodic = plant.periodic
        if self.output is not None and self.periodic != plant.periodic:
            placed._periods = periods_of(self.output, self.dim, plant.periodic)
        placed.bounds = (
            self.bounds if plant.bounds is None or self.bounds is not None else plant.bounds.on(device)
        )
        same = all(getattr(placed, k) is getattr(self, k) for k in ("target", "target_input", "bounds"))
        if same and self.periodic == plant.periodic:
            return self
        placed._prepare()
        return placed

    def _rest(self, plant: Plant) -> tuple[Tensor | None, Tensor | None]:
        """The state and the input from which this cost around a plant is measured, None for zeros."""
        if self.target is None:
            x = plant.equilibrium()
            u = plant.resting_input() if self.target_input is None else self.target_input
        else:
            x = self.target
            u = resting_input_at(plant, x) if self.target_input is None else self.target_input
        if in_any_row(~torch.isfinite(u)):
            u = torch.where(torch.isfinite(u).all(), u, plant.resting_input())
        # An origin that the plant does not take by itself is kept: `around` may be asked again.
        stated = self.target is not None and in_any_row(plant.equilibrium() != 0)
        return x if stated or in_any_row(x != 0) else None, u if in_any_row(u != 0) else None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the bounds and the set-point, too: no step of a loop should copy them to its device."""
        moved: Self = super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        device = self.q.device
        self.bounds = None if self.bounds is None else self.bounds.on(device)
        self.target = None if self.target is None else self.target.to(device)
        self.target_input = None if self.target_input is None else self.target_input.to(device)
        return moved

    @by_rows
    def bounded(self, low: Limit, high: Limit) -> Self:
        """This cost with other bounds of the inputs; the same where both are None."""
        if low is None and high is None:
            return self
        other = copied(self)
        other.bounds = Bounds(low, high, self.inputs).on(self.q.device)
        other._prepare()
        return other

    def extra_repr(self) -> str:
        given: dict[str, Any] = {"target": self.target, "target_input": self.target_input}
        given |= {
            "output": self.output,
            "discount": self.discount if nonzero(self.discount) else None,
            "terminal": self.ending,
        }
        parts = [f"{name}={shown(value)}" for name, value in given.items() if value is not None]
        rates = f"state={shown(self.q)}, control={shown(self.r)}"
        return ", ".join([sizes(self.dim, self.inputs), rates, *limits(self.bounds), *parts])

    def set_point(self) -> Tensor | None:
        """The state that the LQR is a feedback around, (n,); None for the origin."""
        return self.target

    def regulated(self, plant: Plant) -> tuple[Plant, Cost]:
        """The plant and the cost, around it, whose LQR is that of this cost: themselves."""
        return plant, self

    @property
    def plain(self) -> bool:
        """True where this is x'Qx + U(u) at the origin: no set-point, output, bounds or discount."""
        stated = (self.target, self.target_input, self.output, self.bounds)
        return all(one is None for one in stated) and not nonzero(self.discount)

    def deviation(self, x: Tensor) -> Tensor:
        """x - target, angles in [-pi, pi]: (..., n) -> (..., n)."""
        return wrap(x if self.target is None else x - self.target.to(x), self.periodic)

    def state_rate(self, x: Tensor) -> Tensor:
        """e'Qe: (..., n) -> (...)."""
        trailing(type(self).__name__, "x", x, 1, self.dim)
        return quadratic(self.q, self.error(self.outputs(x)))

    def outputs(self, x: Tensor) -> Tensor:
        """y(x), of x turned to within pi of the target, or without an output x: (..., n) -> (..., p)."""
        if self.output is None:
            return x
        target = x.new_zeros(x.shape[-1]) if self.target is None else self.target.to(x)
        return self.output(turned(x, target, self.periodic))  # the output of an angle may be no angle

    def error(self, y: Tensor) -> Tensor:
        """e = y - y(target), angles by the shorter way around: (..., p) -> (..., p)."""
        if self.output is None:
            return self.deviation(y)
        target = y.new_zeros(self.dim) if self.target is None else self.target.to(y)
        return wrap_each(y - self.output(target), self._periods)

    @property
    def ending(self) -> Tensor | EndValue | None:
        """The terminal cost as it was given: S or V_T; None for an endless horizon."""
        return self.end if self.end_value is None else self.end_value

    def terminal(self, x: Tensor) -> Tensor:
        """e'Se or V_T, of a cost with a terminal cost: (..., n) -> (...)."""
        if self.end_value is not None:
            return self.end_value(x)
        assert self.end is not None
        return quadratic(self.end, self.deviation(x))

    def state_curvature(self) -> Tensor:
        """Half the second derivative of e'Qe at the set-point, (n, n): Q, or C'QC with C = dy/dx."""
        if self.output is None:
            return self.q
        at = self.q.new_zeros(self.dim) if self.target is None else self.target
        slope: Tensor = jacrev(self.output)(value_of(at)).detach()
        return slope.mT @ self.q @ slope

    def rate(self, x: Tensor, u: Tensor) -> Tensor:
        """e'Qe + U(u): (..., n), (..., m) -> (...)."""
        trailing(type(self).__name__, "u", u, 1, self.inputs)
        return self.state_rate(x) + self.input_rate(u)

    @abc.abstractmethod
    def input_rate(self, u: Tensor) -> Tensor:
        """U(u): (..., m) -> (...)."""

    @abc.abstractmethod
    def policy(self, effectiveness: Tensor, gradient: Tensor) -> Tensor:
        """argmin_u of U(u) + p'g u, for g (..., n, m) and the value gradient p (..., n): (..., m)."""

    @abc.abstractmethod
    def saturate(self, v: Tensor) -> Tensor:
        """The admissible input that a free one stands for: (..., m) -> (..., m)."""

    def admissible(self, u: Tensor) -> Tensor:
        """Return u within the bounds, as an actuator applies it: (..., m) -> (..., m)."""
        return u if self.bounds is None else self.bounds.clip(u)

    def unsaturated(self, u: Tensor) -> Tensor:
        """A free input that `saturate` maps to u, or near to it at the edge: (..., m) -> (..., m)."""
        return u

    @abc.abstractmethod
    def _prepare(self) -> None:
        """Check and compute what depends on the bounds and the set-point: when made, and around a plant."""

    def effort(self, u: Tensor) -> Tensor:
        """u - target_input: (..., m) -> (..., m)."""
        return u if self.target_input is None else u - self.target_input.to(u)

    def input_of(self, effort: Tensor) -> Tensor:
        """effort + target_input: (..., m) -> (..., m)."""
        return effort if self.target_input is None else effort + self.target_input.to(effort)

    def _unconstrained(self, pull: Tensor) -> Tensor:
        """-1/2 R^-1 g'p: (..., m)."""
        return -0.5 * matvec(self.r_inverse, pull)


class QuadraticCost(Cost):
    """x'Qx + u'Ru, whose policy is u = -1/2 R^-1 g(x)' grad V, or with bounds the exact minimum over the box:
    that clipped where R is diagonal, else the best face of the box (4 inputs at most).

    The appendix of the paper loses the minus of the policy.

    Example:
        >>> bounded = adp.QuadraticCost(1.0, 0.1, dim=6, inputs=2, low=[-9.81, -1.0], high=[9.81, 1.0])
        >>> cost = adp.QuadraticCost(2.0, 0.5, dim=2, inputs=1)  # Q = 2 I, R = 0.5
        >>> float(cost.rate(torch.tensor([1.0, 1.0]).double(), torch.tensor([2.0]).double()))
        6.0

        Shown by `staf experiment=adp adp/cost=quadratic`.

    Args: see `Cost`.

    Raises:
        ValueError: as in `Cost`, and if more than 4 bounded inputs have an R that is not diagonal.
    """

    def _prepare(self) -> None:
        self._coupled = not self.r.is_meta and in_any_row(self.r != torch.diag(self.r.diagonal()))
        if self.bounds is None or not self._coupled:
            return
        if self.inputs > LARGEST:
            rule = f"must be diagonal for more than {LARGEST} bounded inputs"
            raise fail("QuadraticCost", "control", rule, self.r)
        self.register_buffer("_faces", face_inverses(2 * self.r), persistent=False)

    def input_rate(self, u: Tensor) -> Tensor:
        return quadratic(self.r, self.effort(u))

    def policy(self, effectiveness: Tensor, gradient: Tensor) -> Tensor:
        pull = pulled(effectiveness, gradient)
        if self.bounds is None or not self._coupled:
            return self.saturate(self.input_of(self._unconstrained(pull)))
        rest = torch.zeros_like(self.bounds.low) if self.target_input is None else self.target_input
        low, high = (limit.to(pull) - rest.to(pull) for limit in (self.bounds.low, self.bounds.high))
        faces = self.get_buffer("_faces").to(pull)
        return self.input_of(box_minimum(2 * self.r.to(pull), pull, low, high, faces))

    def saturate(self, v: Tensor) -> Tensor:
        return self.admissible(v)


def quadratic(matrix: Tensor, x: Tensor) -> Tensor:
    """x'Mx: (n, n), (..., n) -> (...)."""
    return (matvec(matrix, x) * x).sum(-1)


def matvec(matrix: Tensor, x: Tensor) -> Tensor:
    """M x by broadcasting, which a compiler fuses where it would call a library for a product:
    (..., k, n), (..., n) -> (..., k)."""
    return (matrix.to(x) * x.unsqueeze(-2)).sum(-1)


def pulled(effectiveness: Tensor, gradient: Tensor) -> Tensor:
    """g'p: (..., m)."""
    return (effectiveness * gradient.unsqueeze(-1)).sum(-2)


def _point(call: str, name: str, value: Sequence[float] | Tensor | None, size: int) -> Tensor | None:
    if value is None:
        return None
    if not isinstance(value, Tensor | Sequence):
        raise fail(call, name, "must be a list of numbers", value)
    if (value.numel() if isinstance(value, Tensor) else len(value)) != size:
        raise fail(call, name, f"must have {size} numbers", value)
    return one_or_each(call, name, value, size)


def _outputs(call: str, output: Output, x: Tensor, inputs: int) -> int:
    """p: the size of the output, the same for any number of rows."""
    seen = output(x.unsqueeze(0))
    count = seen.shape[-1] if isinstance(seen, Tensor) and seen.dim() == 2 else 1
    check_rows(f"{call}(output=...)", output, [x], (count,), sizes=(inputs,))
    return count
