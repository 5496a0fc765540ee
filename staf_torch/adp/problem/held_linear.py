"""Control that is held for a period: the exact step of the linearised plant, its optimum, its stability."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from ...lanes.gradients import without_gradient
from ...lanes.per_row.objects import made_by_rows
from ...lanes.row_numbers import nonzero
from ...lanes.threads import small
from ...numerics.checks import fail, object_of, positive_real
from ...numerics.default_device import designed_on_cpu
from ...numerics.derivatives import STEP, central_slopes
from ...numerics.linalg import check_modes, discrete_riccati, exponential, unstabilisable_mode
from ...numerics.rows import check_rows, is_ours
from ...numerics.runge_kutta import quadratic_integral
from ...signs import Sign
from ...systems import Clocked, Plant
from .cost import Cost

_PROBE = 1e-5  # of a state around 0, in its own units, at which the policy is asked for its slope
_REACHED, _GROWS = 1e-12, 1e-6  # relative, of a state that inputs reach and of a mode that grows
_STEPS = 1000  # periods of a plant in discrete time that are tried at most
_PERIODS = 100  # tried from a hundredth to a hundred times the time constant of the fastest mode
_REACH = (0.01, 100.0)


class Hold(NamedTuple):
    """The linear plant over one period with u held: x+ = A x + B u, paid z'W z with z = (x, u)."""

    a: Tensor  # A = e^(F dt), (n, n)
    b: Tensor  # B = int_0^dt e^(F s) ds G, (n, m)
    paid: Tensor  # W, (n + m, n + m)


@designed_on_cpu
def exact_hold(f: Tensor, g: Tensor, q: Tensor, r: Tensor, period: float, *, discount: float = 0.0) -> Hold:
    """Return x' = F x + G u, F (n, n) in 1/s, and the integral of x'Qx + u'Ru over one period with u
    held. With a discount rho, 1/s, A and B are those of exp(-rho t / 2) (x, u), and what is paid is
    discounted."""
    positive_real("exact_hold", "period", period)
    n, m = g.shape
    whole = pad(torch.cat((f, g), dim=1).double(), (0, 0, 0, m))
    if nonzero(discount):
        whole = whole - 0.5 * discount * torch.eye(n + m, dtype=torch.float64, device="cpu")
    rate = torch.block_diag(q.double(), r.double())
    flow, paid = quadratic_integral(whole, rate, period)
    return Hold(flow[:n, :n], flow[:n, n:], paid)


def periods(call: str, plant: Plant, dt: float) -> int:
    """Return the number of steps of a plant in discrete time that make ``dt`` seconds, refused unless it
    is whole."""
    assert plant.period is not None
    count = round(dt / plant.period)
    if count < 1 or abs(count * plant.period - dt) > 1e-9 * dt:
        rule = f"must be a multiple of the plant's period of {plant.period:g} s"
        raise fail(call, "dt", rule, dt)
    return count


def linear_hold(plant: Plant, cost: Cost, period: float) -> Hold:
    """Return the linearised plant at the set-point over ``period`` seconds, of a plant in discrete time a
    multiple of its own, with u held, and what it pays. With a discount rho A and B are those of exp(-rho
    t / 2) (x, u)."""
    return _linear_hold(plant, cost, period, *plant.linearisation(cost.target, cost.target_input))


def _linear_hold(plant: Plant, cost: Cost, period: float, f: Tensor, g: Tensor) -> Hold:
    """Return `linear_hold` of a plant that has been linearised."""
    f, g = f.double(), g.double()
    q, r = (t.to(f) for t in (cost.state_curvature(), cost.r))
    if plant.period is None:
        return exact_hold(f, g, q, r, period, discount=cost.discount)
    share = math.exp(-0.5 * cost.discount * plant.period)
    z = _with_input(f, g).unsqueeze(0)  # products of one and of many have the same bits
    flow, paid = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device), torch.zeros_like(z)
    rate = plant.period * torch.block_diag(q, r)
    for _ in range(periods("linear_hold", plant, period)):
        paid = paid + flow.mT @ rate @ flow
        flow = share * z @ flow
    return Hold(flow[0, : len(f), : len(f)], flow[0, : len(f), len(f) :], paid[0])


def held_riccati(plant: Plant, cost: Cost, period: float) -> tuple[Tensor, Tensor]:
    """Return P and K of the best control of the linearised plant that is held: -K e, of the value e'Pe.

    Raises:
        ValueError: if the plant cannot be stabilised, at all or with this period, the cost does not see a
            mode that does not decay, or SciPy is missing.
    """
    name = type(plant).__name__
    f, g = plant.linearisation(cost.target, cost.target_input)
    hold = _linear_hold(plant, cost, period, f, g)
    n = len(hold.a)
    rest = math.exp(-0.5 * cost.discount * plant.period) if plant.period is not None else 1.0
    if plant.period is None and nonzero(cost.discount):
        f = f - 0.5 * cost.discount * torch.eye(n, dtype=f.dtype, device=f.device)
    check_modes(
        rest * f.double(),
        rest * g.double(),
        cost.state_curvature().to(f).double(),
        name=name,
        discrete=plant.period is not None,
    )
    fault = (
        f"The linearisation of {name}, held for {period:g} s, is not stabilisable: a mode repeats itself "
        "within a period where the control cannot see it. Choose another period."
    )
    if unstabilisable_mode(hold.a, hold.b, discrete=True) is not None:
        raise ValueError(fault)
    try:
        return discrete_riccati(hold.a, hold.b, hold.paid)
    except np.linalg.LinAlgError as error:
        raise ValueError(fault) from error


class HeldStability(NamedTuple):
    """The stability of a linearised loop whose control is held."""

    spectral_radius: float  # of one period: below 1 the set-point is asymptotically stable; inf where it
    # overflows, NaN where something has no finite slope
    largest_period: float | None  # s, up to which every period is stable; None: unstable at every period, or
    # not known because something has no finite slope;
    # inf: stable up to 100 time constants of the fastest mode, or 1000 steps of a plant in discrete time


@without_gradient("held_stability", "policy", "system", "at")
@Sign("held_stability")
@small
def held_stability(
    policy: Callable[[Tensor], Tensor], system: Plant, period: float, *, at: Tensor | None = None
) -> HeldStability:
    """Return how stable a set-point is when ``policy`` is held for ``period`` seconds.

    The plant is linearised there under the control that the policy gives, the policy by central differences.
    Modes that no control moves and that do not grow by themselves, such as others' motion that is part of the
    state, are left out.

    Example:
        >>> plant = systems.Pendulum()
        >>> lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1))
        >>> adp.held_stability(lqr, plant, 0.01).spectral_radius < 1
        True

        Shown by `staf experiment=adp adp/policy=lqr`.

    Args:
        policy: u from x, (..., n) -> (..., m).
        system: the plant, in continuous or in discrete time.
        period: s, positive; of a plant in discrete time a multiple of its own.
        at: the set-point, (n,); the plant's equilibrium by default. For a `systems.Clocked` plant the state
            of the path at t = 0, without the time.

    Raises:
        ValueError: if the period breaks its rule, or the plant is clocked and ``at`` is missing.
    """
    object_of("held_stability", Plant, system=system)
    positive_real("held_stability", "period", period)

    def found() -> HeldStability:
        loop = HeldLoop.of(policy, system, at=at)
        return HeldStability(loop.spectral_radius(period), loop.largest_period())

    return made_by_rows(found)


class HeldLoop(NamedTuple):
    """A linearised loop, of which `held_stability` tells all: what is asked for alone is computed."""

    plant: Plant
    f: Tensor  # F, (n, n), of the states that inputs reach
    g: Tensor  # G, (n, m)
    slope: Tensor  # of the policy, (m, n)
    finite: bool  # whether all these are

    @classmethod
    def of(cls, policy: Callable[[Tensor], Tensor], system: Plant, *, at: Tensor | None = None) -> HeldLoop:
        """The loop at a set-point; arguments as those of `held_stability`."""
        if isinstance(system, Clocked):  # whose clock would count as a mode that never decays
            if at is None:
                rule = "must be a state of the path at t = 0, for a clocked plant"
                raise fail("held_stability", "at", rule, at)
            clocked = system
            return cls.of(lambda x: policy(clocked.at(x)), system.plant, at=at)
        at = system.equilibrium() if at is None else at
        if not is_ours(policy):
            known = (system.inputs or 1,)
            check_rows("held_stability(policy=...)", lambda x: policy(x).expand(len(x), -1), [at], known)
        with torch.no_grad():
            slope = central_slopes(
                lambda x: policy(x).double().expand(len(x), -1),
                at.double(),
                torch.full_like(at, _PROBE / STEP),
            )
            held = policy(at.unsqueeze(0)).expand(1, -1)[0].double()
        f, g, slope = (t.double().cpu() for t in (*system.linearisation(at, held), slope))
        if not bool(torch.isfinite(torch.cat((f, g, slope.mT), dim=-1)).all()):
            return cls(system, f, g, slope, False)
        basis = _moved(f, g, discrete=system.period is not None)
        return cls(system, basis.mT @ f @ basis, basis.mT @ g, slope @ basis, True)

    def spectral_radius(self, period: float) -> float:
        """Return the spectral radius over one period; NaN where something has no finite slope."""
        return float(self.radius(period))

    def radius(self, period: float) -> Tensor:
        """Return `spectral_radius`, ()."""
        if not self.finite:
            return torch.full_like(self.f[0, 0], math.nan)
        return self._radius(*_held(self.plant, self.f, self.g, period))

    def fastest(self) -> Tensor:
        """Return the size of the fastest mode without control, 1/s, (); inf where something is not finite."""
        return (
            torch.linalg.eigvals(self.f).abs().max()
            if self.finite
            else torch.full_like(self.f[0, 0], math.inf)
        )

    def largest_period(self) -> float | None:
        """Return the largest stable period, as in `HeldStability`."""
        if not self.finite:
            return None
        if self.plant.period is not None:
            tried = enumerate(islice(_steps(self.f, self.g), _STEPS))
            stable = next((k for k, held in tried if float(self._radius(*held)) >= 1), None)
            if stable is None:
                return math.inf
            return stable * self.plant.period if stable else None
        modes = torch.linalg.eigvals(self.f + self.g @ self.slope)
        if float(modes.real.max()) >= 0:
            return None
        first, last = (math.log10(reach / float(modes.abs().max())) for reach in _REACH)
        periods = torch.logspace(first, last, _PERIODS, dtype=torch.float64, device="cpu").tolist()
        count = next((k for k, dt in enumerate(periods) if self.spectral_radius(dt) >= 1), None)
        if count is None:
            return math.inf
        low, high = periods[count - 1] if count else 0.0, periods[count]
        while high - low > 1e-6 * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.spectral_radius(middle) < 1 else (low, middle)
        return low

    def _radius(self, a: Tensor, b: Tensor) -> Tensor:
        held = a + b @ self.slope
        finite = held.isfinite().all()
        radius = torch.linalg.eigvals(torch.where(finite, held, torch.zeros_like(held))).abs().max()
        return torch.where(finite, radius, math.inf)


def _moved(f: Tensor, g: Tensor, *, discrete: bool) -> Tensor:
    """An orthonormal basis, (n, c), of the states that inputs reach; of all where another mode grows."""
    size, scale = len(f), f.norm() + 1.0
    columns = [g / (g.norm() + torch.finfo(g.dtype).tiny)]
    for _ in range(size - 1):
        columns.append(f @ columns[-1] / scale)
    left, sizes, _ = torch.linalg.svd(torch.cat(columns, dim=-1))
    reached = sizes > _REACHED * sizes.amax()
    if bool(reached.all() | ~reached.any()):
        return torch.eye(size, dtype=f.dtype, device=f.device)
    count = int(reached.sum())
    rest = left[:, count:]
    modes = torch.linalg.eigvals(rest.mT @ f @ rest)
    grows = modes.abs().max() > 1 + _GROWS if discrete else modes.real.max() > _GROWS * scale
    return torch.eye(size, dtype=f.dtype, device=f.device) if bool(grows) else left[:, :count]


def _with_input(f: Tensor, g: Tensor) -> Tensor:
    """The step (x, u) -> (F x + G u, u), (n + m, n + m)."""
    n, m = g.shape
    held = torch.eye(n + m, dtype=f.dtype, device=f.device)[n:]
    return torch.cat((torch.cat((f, g), dim=1), held))


def _held(plant: Plant, f: Tensor, g: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """A and B of the linearised plant over dt seconds with u held."""
    n, m = g.shape
    if plant.period is None:
        flow = exponential(dt * pad(torch.cat((f, g), dim=1), (0, 0, 0, m)))
    else:
        flow = torch.linalg.matrix_power(_with_input(f, g), periods("held_stability", plant, dt))
    return flow[:n, :n], flow[:n, n:]


def _steps(f: Tensor, g: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """A and B of 1, 2, ... steps of a plant in discrete time with u held."""
    a, b = f, g
    while True:
        yield a, b
        a, b = f @ a, f @ b + g
