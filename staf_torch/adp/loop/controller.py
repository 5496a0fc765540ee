"""The interface of controllers in a closed loop; feedback laws, the LQR, the supervisor."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from ...lanes.dependencies.contents import Writes
from ...lanes.dependencies.walk import is_users
from ...lanes.gradients import gradients_of, marked
from ...lanes.per_row.objects import OfRows
from ...lanes.row_numbers import over_rows
from ...lanes.threads import small
from ...lanes.trace.loops import where_rows
from ...numerics.checks import fail, hold, real, trailing
from ...numerics.default_device import beside
from ...numerics.linalg import riccati
from ...numerics.repr_text import limits, shown
from ...systems import Plant
from ..problem.cost import Cost, matvec, quadratic
from ..problem.held_linear import held_riccati
from ..problem.rules import check_objects, regulated

Policy = Callable[[Tensor], Tensor]
"""u from x: (..., n) -> (..., m)."""
Value = Callable[[Tensor], Tensor]
"""V from x: (..., n) -> (...)."""


Carried = Any
"""What a controller carries from step to step: a tensor (B, ...), or tuples, dictionaries and named tuples of
such; () where it carries nothing."""


class Controller(nn.Module, metaclass=OfRows):
    """u and what the controller carries on, from the state and what it carried until then.

    Example:
        >>> class Integral(adp.Controller):  # carries the integral of x_1, (B,)
        ...     def init(self, x0):
        ...         return torch.zeros_like(x0[:, 0])
        ...     def step(self, x, carried, uniform, dt):
        ...         carried = carried + dt * x[:, 0]
        ...         return -(x.sum(-1) + 0.5 * carried).unsqueeze(-1), carried
        ...     def recorded(self, carried):  # what the result keeps of it, by name
        ...         return {"integral": carried}
        >>> cost, x0 = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1), torch.ones(3, 2).double()
        >>> adp.simulate(Integral(), systems.TwoState(), cost, x0, dt=0.01, steps=10)["integral"].shape
        torch.Size([3, 11])

        Shown by `staf experiment=adp_comparison`.

    Attributes:
        draws: uniform random points of [-1, 1]^n that a step needs, a row.
        period: least time for which a control is held, s; None where any time will do.
        label: a few words for a log or a sheet.
        costly: whether a program of a step takes a compiler so long that a loop is compiled where that is
            asked for alone.
        work: steps of a feedback law that a control takes, about: such a loop pays for its compiler sooner.
    """

    draws: int = 0
    period: float | None = None
    costly: bool = False
    work: float = 1.0

    @property
    def label(self) -> str:
        return type(self).__name__

    @abc.abstractmethod
    def init(self, x0: Tensor) -> Carried:
        """Return the carried state for the first step, a row each of the states x0 (B, n)."""

    @abc.abstractmethod
    def step(self, x: Tensor, carried: Carried, uniform: Tensor, dt: float) -> tuple[Tensor, Carried]:
        """Return the control u (B, m) to hold for ``dt`` seconds, and the carried state after them.

        Args:
            x: (B, n).
            carried: from the step before, or from `init`.
            uniform: (B, draws, n), uniform on [-1, 1].
            dt: s.
        """

    def recorded(self, carried: Carried) -> dict[str, Tensor]:
        """Name what `LoopResult` keeps of what is carried, tensors (B, ...); by default nothing.

        A controller that holds another one passes on what that records.
        """
        return {}

    def value(self, x: Tensor, recorded: Mapping[str, Tensor]) -> Tensor | None:
        """Return V^(x), (..., n) -> (...), by what was recorded then; None where nothing estimates V."""
        return None


class Feedback(Controller):
    """u = policy(x), which carries nothing.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> policy = adp.Feedback(lambda x: -3.0 * x[..., 1:])
        >>> x0 = torch.tensor([[0.5, 0.5]]).double()
        >>> bool(adp.simulate(policy, plant, cost, x0, dt=0.01, steps=100).diverged.any())
        False

        Shown by `staf experiment=adp adp/policy=lqr`.

    Args:
        policy: (..., n) -> (..., m), a function of x alone: what has a memory is a `Controller`.
        value: of the policy or of its design, (..., n) -> (...), for the record.

    Raises:
        ValueError: of `check`, at the start of a run.
    """

    def __init__(self, policy: Policy, value: Value | None = None) -> None:
        super().__init__()
        if not callable(policy) or isinstance(policy, type):
            raise fail("Feedback", "policy", "must be a function of x, or a module: u = policy(x)", policy)
        self.policy = policy
        self.period = getattr(policy, "period", None)
        self._value = value

    @property
    def label(self) -> str:
        return getattr(self.policy, "__name__", type(self.policy).__name__)

    def init(self, x0: Tensor) -> tuple[()]:
        return ()

    def step(self, x: Tensor, carried: Carried, uniform: Tensor, dt: float) -> tuple[Tensor, Carried]:
        return self.policy(x), carried

    def check(self, x0: Tensor) -> None:
        """Refuse a policy of a user that has a memory, by a call at x0 (B, n) that changes a tensor which
        it holds: it would remember every check that asks it, too."""
        if not is_users(type(self.policy)):
            return
        before = _tensors_of(self.policy)
        writes = {name: Writes((tensor,)) for name, tensor in before.items()}
        with torch.no_grad():
            over_rows(self.policy, x0)
        for name, tensor in _tensors_of(self.policy).items():
            if name not in before or tensor is not before[name] or not writes[name].none():
                raise ValueError(
                    f"`Feedback(policy=...)` must be a function of the state; a call of {self.label} changed "
                    f"its `{name}`. Write a policy with a memory as a `Controller`, with `init` and `step`."
                )

    def value(self, x: Tensor, recorded: Mapping[str, Tensor]) -> Tensor | None:
        return None if self._value is None else self._value(x)


def _tensors_of(policy: Any) -> dict[str, Tensor]:
    """Return the tensors that an object holds itself."""
    held = {**getattr(policy, "__dict__", {}), **getattr(policy, "_buffers", {})}
    return {name: x for name, x in held.items() if isinstance(x, Tensor)}


class ControllerOfKinds(Controller):
    """Controllers, of the same sizes, of rows with numbers of their own that are of several kinds: every
    row has that of its ``kind``."""

    def __init__(self, kinds: Sequence[Controller], kind: Tensor) -> None:
        super().__init__()
        self.kinds, self.kind = nn.ModuleList(kinds), kind
        self._each = list(kinds)
        self.draws, self.period = max(each.draws for each in kinds), kinds[0].period
        self.work = max(each.work for each in kinds)

    @property
    def label(self) -> str:
        return self._each[0].label

    def init(self, x0: Tensor) -> Carried:
        return tuple(each.init(x0) for each in self._each)

    def step(self, x: Tensor, carried: Carried, uniform: Tensor, dt: float) -> tuple[Tensor, Carried]:
        u, after = self._each[0].step(x, carried[0], uniform, dt)
        ends = [after]
        for k, each in enumerate(self._each[1:], 1):
            given = x, carried[k], uniform

            def own(now: tuple[Tensor, Carried, Tensor], each: Controller = each) -> tuple[Tensor, Carried]:
                x, carried, uniform = now
                return each.step(x, carried, uniform, dt)

            u, after = where_rows((self.kind == k).expand(len(x)), own, given, (u, carried[k]))
            ends.append(after)
        return u, tuple(ends)


class LQR(nn.Module, metaclass=OfRows):
    """u = u_s - K (x - x_s) with K = R^-1 B'P and P from the Riccati equation of the linearisation at the
    set-point x_s of the cost, where u_s holds the plant; angles are differences in [-pi, pi]. Of a
    `TrackingCost` P and K are those of the plant's equilibrium, and x_s moves along the path.

    With bounds u is clipped to them, with a `BoundedInputCost` smoothly. A control that is held for long
    needs other gains: with a ``period`` P and K are those of the linear plant whose control is held.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> lqr = adp.LQR(plant, cost)
        >>> lqr(torch.tensor([[0.0, 1.0]]).double()).round(decimals=3)  # u = -K x, here -3 x2
        tensor([[-3.]], dtype=torch.float64)

        Shown by `staf experiment=adp adp/policy=lqr`.

    Args:
        system: the plant.
        cost: the cost rate.
        period: s, positive, for which the control will be held; None for one that follows the state, or of a
            plant in discrete time for its step.

    Attributes:
        cost: the cost, measured from the set-point of this plant.
        p: P, (n, n): e'Pe is the value of the linear plant.
        k: K, (m, n).
        layers: tensors in the plant or the cost that require a gradient, as the parameters of networks do;
            P and K have none with respect to them, and what is computed from them refuses to be asked for it.

    Raises:
        ValueError: if the plant does not rest at the set-point under an input within the bounds, its
            linearisation cannot be stabilised, or the cost does not see a mode that does not decay; if either
            holds a tensor that requires a gradient, other than a network's.
    """

    rowwise: ClassVar = {"forward": (1,), "value": (1,)}

    @beside
    @small
    def __init__(self, system: Plant, cost: Cost, period: float | None = None) -> None:
        super().__init__()
        check_objects("LQR", system=system, cost=cost)
        self.layers = gradients_of("LQR", system=system, cost=cost)
        self.cost = regulated("LQR", system, cost)
        self.period = system.period if period is None else period
        system, still = self.cost.regulated(system)
        if self.period is None:
            a, b = system.linearisation(still.target, still.target_input)
            name = type(system).__name__
            rest = 0.5 * cost.discount * torch.eye(len(a), dtype=a.dtype, device=a.device)
            p = riccati(a - rest, b, still.state_curvature(), cost.r, name=name)
            # As of many rows, to the bit.
            k = (self.cost.r_inverse.to(p).unsqueeze(0) @ b.to(p).mT @ p)[0]
        else:
            p, k = held_riccati(system, still, self.period)
        if clock := self.cost.dim - len(p):
            p, k = pad(p, (0, clock, 0, clock)), pad(k, (0, clock))
        self.p = hold(self, "p", p)
        self.k = hold(self, "k", k)
        self._size = k.shape[-1]

    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n) -> (..., m)."""
        trailing("LQR", "x", x, 1, self._size)
        cost = self.cost
        u = cost.saturate(cost.input_of(-matvec(self.k, cost.deviation(x))))
        return marked("LQR", self.layers, u) if self.layers else u

    def __repr__(self) -> str:
        about = [f"K={shown(self.k)}", *([f"period={self.period:g} s"] if self.period else [])]
        about += [] if self.cost.target is None else [f"target={shown(self.cost.target)}"]
        return f"LQR({', '.join([*about, *limits(self.cost.bounds)])})"

    def value(self, x: Tensor) -> Tensor:
        """e'Pe: (..., n) -> (...)."""
        trailing("LQR.value", "x", x, 1, self._size)
        paid = quadratic(self.p, self.cost.deviation(x))
        return marked("LQR", self.layers, paid) if self.layers else paid


class Supervised(Controller):
    """The control of another controller, drawn towards the LQR just as far as it must be:

        u_applied = u_LQR + s (u - u_LQR),  s <= 1 the largest with |u_applied - u_LQR|_R <= trust |u_LQR|_R.

    For a linear plant and trust <= 1/2 the Riccati value then falls at the rate of x'Qx at least, whatever
    the weights are: V_P' <= -x'Qx - (1 - 2 trust) u_LQR'R u_LQR. It bounds a control that is too weak as
    well as one that is too strong for its time step. The controller learns on as if its own control had
    been applied: the laws ask the model, not the plant.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> wild = adp.Feedback(lambda x: 10 * x[..., 1:])
        >>> safe = adp.Supervised(wild, adp.LQR(plant, cost), cost, trust=0.5)
        >>> x = torch.tensor([[0.0, 1.0]]).double()
        >>> safe.restrain(x, torch.tensor([[10.0]]).double()).round(decimals=3)  # half of the LQR's
        tensor([[-1.5000]], dtype=torch.float64)

        Shown by `staf experiment=adp adp.trust=0.5`.

    Args:
        controller: the controller to supervise.
        lqr: the base feedback, of the same plant and cost.
        cost: the cost rate.
        trust: in (0, 1].

    Raises:
        ValueError: if ``trust`` is not in (0, 1].
    """

    rowwise: ClassVar = {"restrain": (1, 1)}

    def __init__(self, controller: Controller, lqr: LQR, cost: Cost, trust: float = 0.5) -> None:
        super().__init__()
        if not 0 < real("Supervised", "trust", trust) <= 1:
            raise ValueError(f"`Supervised(trust=...)` must be in (0, 1]; got {trust!r}.")
        self.controller, self.lqr, self.trust = controller, lqr, trust
        self.cost = lqr.cost if isinstance(lqr, LQR) else cost
        self.draws, self.period = controller.draws, controller.period

    @property
    def label(self) -> str:
        return f"supervised {self.controller.label}"

    def init(self, x0: Tensor) -> Carried:
        return self.controller.init(x0)

    def recorded(self, carried: Carried) -> dict[str, Tensor]:
        return self.controller.recorded(carried)

    def step(self, x: Tensor, carried: Carried, uniform: Tensor, dt: float) -> tuple[Tensor, Carried]:
        u, after = self.controller.step(x, carried, uniform, dt)
        return self.restrain(x, u), after

    def restrain(self, x: Tensor, u: Tensor) -> Tensor:
        """The control to apply in place of u: (..., n), (..., m) -> (..., m)."""
        base = self.lqr(x)
        apart = u - base
        allowed = self.trust * quadratic(self.cost.r, self.cost.effort(base)).sqrt()
        wanted = quadratic(self.cost.r, apart).sqrt()
        share = torch.where(wanted > allowed, allowed / wanted, 1.0)
        restrained: Tensor = base + share.unsqueeze(-1) * apart
        return restrained

    def value(self, x: Tensor, recorded: Mapping[str, Tensor]) -> Tensor | None:
        return self.controller.value(x, recorded)
