"""Base class of plants, and the bounds of their inputs."""

from __future__ import annotations

import abc
import copy
import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from ..lanes.gradients import refuse_gradient
from ..lanes.per_row.decisions import in_any_row
from ..lanes.per_row.objects import OfRows, by_rows
from ..lanes.row_numbers import RowNumbers, all_rows, value_of
from ..numerics.angles import wrap
from ..numerics.checks import check_shared, fail, trailing
from ..numerics.default_device import device_of
from ..numerics.derivatives import point_jacobian
from ..numerics.repr_text import limits, settings, sizes

Limit = float | Sequence[float | None] | Tensor | None
_HERE = torch.empty(0, dtype=torch.float64, device="cpu")
Number = float | Tensor
"""A number, as a tensor without dimensions one of a table, or by `staf_torch.rows` one a row."""


class Bounds:
    """The box low <= u <= high, in the units of the inputs.

    Example:
        >>> bounds = systems.Bounds([0.0, -1.0], [20.0, 1.0], inputs=2)
        >>> bounds.clip(torch.tensor([-3.0, 0.5], dtype=torch.float64))
        tensor([0.0000, 0.5000], dtype=torch.float64)

        Shown by `staf experiment=adp adp/cost=bounded_input adp/policy=rollout`.

    Args:
        low, high: a number for all inputs, or one an input; None or infinite for none.
        inputs: m.

    Raises:
        ValueError: if a bound has another length or is NaN, or one is not below the other.
    """

    def __init__(self, low: Limit, high: Limit, inputs: int) -> None:
        # Not a module: a class of plants may have its bounds as a class attribute.
        self.low = limit_of_each("Bounds", "low", low, -math.inf, inputs, "inputs")  # (m,)
        self.high = limit_of_each("Bounds", "high", high, math.inf, inputs, "inputs")  # (m,)
        if not bool((self.low < self.high).all()):
            raise fail("Bounds", "low", f"must be below high, {self.high.tolist()}", self.low.tolist())

    def on(self, device: torch.device) -> Bounds:
        """Return these bounds with tensors of a device; themselves where they are there."""
        if self.low.device == device:
            return self
        moved = copy.copy(self)
        moved.low, moved.high = self.low.to(device), self.high.to(device)
        return moved

    @property
    def present(self) -> bool:
        """Return whether any input is bounded, of numbers of rows in any row."""
        return self.low.is_meta or any(in_any_row(torch.isfinite(limit)) for limit in (self.low, self.high))

    def clip(self, u: Tensor) -> Tensor:
        """The nearest admissible input: (..., m) -> (..., m)."""
        return torch.minimum(torch.maximum(u, self.low.to(u)), self.high.to(u))

    def contain(self, u: Tensor) -> Tensor:
        """Return whether u is admissible: (..., m) -> (...) bool."""
        return ((u >= self.low.to(u)) & (u <= self.high.to(u))).all(-1)

    def measured_from(self, u: Tensor) -> Bounds:
        """The box of u' - u for every admissible u': the bounds of a deviation from u (m,)."""
        there = self.on(u.device)
        return Bounds(there.low - u, there.high - u, len(u))

    def __repr__(self) -> str:
        low, high = all_rows(self.low).tolist(), all_rows(self.high).tolist()
        return f"Bounds(low={low}, high={high})"


def limit_of_each(call: str, name: str, given: Limit, none: float, count: int, what: str) -> Tensor:
    """Return a limit for each of so many inputs or states, (count,) float64; ``none`` is -inf or inf."""
    rule = f"must be a number or one for each of the {count} {what}"
    if isinstance(given, Tensor):
        check_shared(call, name, given)
    refuse_gradient(call, **{name: given})
    if isinstance(given, Sequence) and not isinstance(given, str):
        given = [none if one is None else one for one in given]
    entries = given if isinstance(given, list) else [none if given is None else given]
    if any(isinstance(one, bool) or not isinstance(one, int | float | Tensor) for one in entries):
        raise fail(call, name, rule, given)
    limit = torch.as_tensor(none if given is None else given, dtype=torch.float64, device="cpu").detach()
    limit = limit.repeat(count) if limit.dim() == 0 else limit
    if limit.shape != (count,):
        raise fail(call, name, rule, given)
    if bool(torch.isnan(limit).any()) or bool((limit == -none).any()):
        raise fail(call, name, f"must be finite or {none}", given)
    return limit


class Linearisation(NamedTuple):
    """x' = A x + B u near the equilibrium 0.

    Example:
        >>> systems.Pendulum(damping=0.0, gravity=1.0).linearisation().matrix
        tensor([[0., 1.],
                [1., 0.]], dtype=torch.float64)

        Shown by `staf experiment=adp adp/policy=lqr`.
    """

    matrix: Tensor  # A, (n, n), 1/s
    input_matrix: Tensor  # B, (n, m)


class Units(NamedTuple):
    """Units of a plant's quantities, entry by entry where they differ: ``rad, rad/s``.

    Example:
        >>> systems.Units("rad, rad/s", "N m")
        Units(state='rad, rad/s', input='N m')

        Shown by `staf-export RUN --to c`.
    """

    state: str = "1"
    input: str = "1"

    def of_states(self, count: int) -> tuple[str, ...]:
        """Return the unit of each of so many states, "" for none; of another number, all each."""
        return _each(self.state, count)

    def of_inputs(self, count: int) -> tuple[str, ...]:
        """Return the unit of each of so many inputs, likewise."""
        return _each(self.input, count)


def _each(units: str, count: int) -> tuple[str, ...]:
    words = tuple("" if (word := part.strip()) == "1" else word for part in units.split(","))
    return words if len(words) == count else (words * count if len(words) == 1 else (units,) * count)


class Plant(nn.Module, metaclass=OfRows):
    """A plant with inputs, batched: what the ones in continuous and in discrete time have in common.

    Example:
        >>> isinstance(systems.Pendulum(), systems.Plant), systems.Pendulum().dim
        (True, 2)

        Shown by `staf system=pendulum`.

    Attributes:
        dim: n, the number of states; None where the plant takes any.
        inputs: m, the number of inputs.
        units: of states and inputs, for figures, reports and the sheet of `staf-export`.
        spread: half the width of the box of usual states around the equilibrium, in units of the state: one
            number, or one a coordinate, (n,). Episodes of `envs` begin in it unless told otherwise.
        periodic: coordinates that are angles in rad: x and x + 2 pi are the same state there. Costs, the LQR,
            metrics and plots take their differences in [-pi, pi].
        bounds: of the inputs; None for none. A cost that states no bounds of its own takes these.
        period: time that a control is held at least, s: the step of a plant in discrete time, else None.
    """

    rowwise: ClassVar = {
        **dict.fromkeys(("drift", "effectiveness", "smooth_drift"), (1,)),
        **dict.fromkeys(
            ("rate", "motion", "velocity", "displaced", "step_limit", "step", "difference"), (1, 1)
        ),
        "flow": (1, 9),  # the times are for all rows
    }
    dim: int | None = None
    inputs: int = 0
    units: Units = Units()
    spread: float | Sequence[float] | Tensor = 1.0
    periodic: tuple[int, ...] = ()
    bounds: Bounds | None = None
    period: float | None = None

    def __init__(self) -> None:
        super().__init__()
        self._buffers["_where"] = _HERE  # the device of a plant without numbers, and not persistent
        self._non_persistent_buffers_set.add("_where")

    @property
    def traceable(self) -> bool:
        """Return whether the plant is torch all through, so that it can be differentiated and compiled."""
        return True

    def equilibrium(self) -> Tensor:
        """The state at which the plant rests under `resting_input`, (n,): zeros unless it says else."""
        return torch.zeros(self._size(), dtype=torch.float64, device=device_of(self))

    def resting_input(self) -> Tensor:
        """The input that holds the plant at its equilibrium, (m,): zeros unless it says else."""
        return torch.zeros(self.inputs, dtype=torch.float64, device=device_of(self))

    @abc.abstractmethod
    def motion(self, x: Tensor, u: Tensor) -> Tensor:
        """x' in continuous time, x+ - x in discrete time: (..., n), (..., m) -> (..., n)."""

    def velocity(self, x: Tensor, u: Tensor) -> Tensor:
        """Return the velocity that a loop integrates and passes to `displaced`; by default the motion."""
        return self.motion(x, u)

    def displaced(self, x: Tensor, step: Tensor) -> Tensor:
        """The state that is a ``step`` of the velocity further on: (..., n), (..., n) -> (..., n)."""
        return x + step

    def step_limit(self, x: Tensor, u: Tensor) -> Tensor | None:
        """The longest integration step at a state, s, for substeps of a row's own lengths:
        (..., n), (..., m) -> (...). None, unless a plant knows better: any length will do."""
        return None

    @abc.abstractmethod
    def linearisation(self, x: Tensor | None = None, u: Tensor | None = None) -> Linearisation:
        """A and B near a state (n,) and an input (m,) at rest, by default the equilibrium.

        Raises:
            ValueError: if ``dim`` is None.
        """

    def difference(self, x: Tensor, y: Tensor) -> Tensor:
        """x - y, of the periodic coordinates in [-pi, pi]: (..., n), (..., n) -> (..., n)."""
        return wrap(x - y, self.periodic)

    def optimal_value(self, x: Tensor, state_cost: Tensor, input_cost: Tensor) -> Tensor | None:
        """V*(x) for the cost x'Qx + u'Ru, (..., n), (n, n), (m, m) -> (...); None where it is not known."""
        return None

    def extra_repr(self) -> str:
        """`2 states, 1 input, mass=1`: sizes, what else is declared, and numbers that were given."""
        parts = [sizes(self.dim, self.inputs), *settings(self, "dim", "inputs", "dt")]
        parts += [f"period={self.period:g} s"] if self.period else []
        parts += [f"periodic={list(self.periodic)}"] if self.periodic else []
        return ", ".join([*parts, *limits(self.bounds)])

    def _size(self) -> int:
        if self.dim is None:
            raise ValueError(f"`{type(self).__name__}.dim` must be the number of states; got None.")
        return self.dim


def spread_of(plant: Plant, like: Tensor) -> float | Tensor:
    """Return a plant's ``spread`` as a factor of states (..., n): a number, or (n,), one a coordinate."""
    spread = plant.spread
    if isinstance(spread, int | float | RowNumbers):
        return spread
    return torch.as_tensor(spread, dtype=torch.float64, device="cpu").to(like)


class ControlAffineSystem(Plant):
    """x' = f(x) + g(x) u, batched. A plant of your own is a subclass with `drift` and, where it has
    inputs, `effectiveness`; its trajectories then come from a fourth-order Runge-Kutta method.

    It is regulated to the origin without control unless `Plant.equilibrium` and `Plant.resting_input` say
    else.

    Example:
        >>> class Trolley(systems.ControlAffineSystem):
        ...     dim, inputs = 2, 1
        ...     def drift(self, x):
        ...         return torch.stack((x[..., 1], -0.2 * x[..., 1]), dim=-1)
        ...     def effectiveness(self, x):
        ...         return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape[:-1], 2, 1)
        >>> Trolley().rate(torch.tensor([0.0, 1.0]), torch.tensor([0.5]))
        tensor([1.0000, 0.3000])

        Shown by `tests/examples/own/trolley.py`.
    """

    @abc.abstractmethod
    def drift(self, x: Tensor) -> Tensor:
        """f(x): (..., n) -> (..., n)."""

    def effectiveness(self, x: Tensor) -> Tensor:
        """g(x): (..., n) -> (..., n, m). Without inputs, m = 0."""
        return x.new_zeros(*x.shape, 0)

    def rate(self, x: Tensor, u: Tensor) -> Tensor:
        """x' = f(x) + g(x) u: (..., n), (..., m) -> (..., n)."""
        trailing(type(self).__name__, "x", x, 1, self.dim)
        # Not a matrix product: a compiler fuses this where it would call a library for that.
        return self.drift(x) + (self.effectiveness(x) * u.unsqueeze(-2)).sum(-1)

    def flow(self, x: Tensor, time: Tensor) -> Tensor | None:
        """x(t) from x(0) without control, (..., n), (T,) -> (..., T, n), where it is known in closed
        form; None elsewhere, where it is integrated. The times are in s, float64 on the CPU whatever x
        is."""
        return None

    def smooth_drift(self, x: Tensor) -> Tensor:
        """f without the terms that have no derivative at 0; what `Plant.linearisation` differentiates."""
        return self.drift(x)

    def motion(self, x: Tensor, u: Tensor) -> Tensor:
        return self.rate(x, u)

    @by_rows
    def linearisation(self, x: Tensor | None = None, u: Tensor | None = None) -> Linearisation:
        """A = d(f + g u)/dx and B = g at rest, by automatic differentiation."""
        at = value_of(self.equilibrium() if x is None else x)
        resting = self.resting_input() if u is None else u
        matrix = point_jacobian(self.smooth_drift, at, len(at))
        g = self.effectiveness(at).detach()
        if in_any_row(resting != 0):
            pushed = point_jacobian(self.effectiveness, at, g.numel())  # (n, m, n)
            matrix = matrix + (pushed * resting.to(at)[:, None]).sum(-2)
        return Linearisation(matrix, g)
