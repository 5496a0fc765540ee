"""Control that is held for a period: the exact step of the linearised plant, its optimum, its stability."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..numerics.checks import positive_real
from ..numerics.linalg import riccati, unstabilisable_mode
from ..systems import ControlAffineSystem
from .cost import Cost

_PROBE = 1e-5  # of a state around 0, in its own units, at which the policy is asked for its slope
_PERIODS = 100  # tried from a hundredth to a hundred times the time constant of the fastest mode
_REACH = (0.01, 100.0)


class Hold(NamedTuple):
    """The linear plant over one period with u held: x+ = A x + B u, paid z'W z with z = (x, u)."""

    a: Tensor  # A = e^(F dt), (n, n)
    b: Tensor  # B = int_0^dt e^(F s) ds G, (n, m)
    paid: Tensor  # W, (n + m, n + m)


def exact_hold(f: Tensor, g: Tensor, q: Tensor, r: Tensor, period: float, *, discount: float = 0.0) -> Hold:
    """Return x' = F x + G u and the integral of x'Qx + u'Ru over one period with u held.

    The exponential of a short step is doubled: e^(M 2h) = (e^(M h))^2, W(2h) = W(h) + e^(M h)' W(h) e^(M h).

    Args:
        f: F, (n, n), in 1/s.
        g: G, (n, m).
        q: Q, (n, n).
        r: R, (m, m).
        period: dt, s, positive.
        discount: rho, 1/s: A and B are then those of exp(-rho t / 2) (x, u), and what is paid is discounted.

    Raises:
        ValueError: if the period is not positive.

    Source: Van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23 (1978).
    """
    positive_real("exact_hold", "period", period)
    n, m = g.shape
    whole = torch.zeros(n + m, n + m, dtype=torch.float64)
    whole[:n, :n], whole[:n, n:] = f, g
    whole = whole - 0.5 * discount * torch.eye(n + m, dtype=torch.float64)
    length = float(torch.linalg.matrix_norm(whole, 1)) * period
    doublings = max(0, 2 + math.ceil(math.log2(max(length, 1e-9))))
    h = period / 2**doublings
    rate = torch.block_diag(q.double(), r.double())
    rows = torch.cat((-whole.mT, rate), dim=1), torch.cat((torch.zeros_like(whole), whole), dim=1)
    step = torch.linalg.matrix_exp(h * torch.cat(rows))
    flow = step[n + m :, n + m :]
    paid = flow.mT @ step[: n + m, n + m :]
    for _ in range(doublings):
        paid = paid + flow.mT @ paid @ flow
        flow = flow @ flow
    return Hold(flow[:n, :n], flow[:n, n:], 0.5 * (paid + paid.mT))


def held_riccati(f: Tensor, g: Tensor, cost: Cost, period: float, *, name: str) -> tuple[Tensor, Tensor]:
    """Return P and K of the best control that is held: u = -K x, of the value x'Px.

    Args:
        f: F, (n, n), in 1/s.
        g: G, (n, m).
        cost: the cost rate.
        period: dt, s.
        name: of the plant, for the message.

    Raises:
        ValueError: if the plant cannot be stabilised, at all or with this period, or SciPy is missing.
    """
    q = cost.state_curvature()
    rest = 0.5 * cost.discount * torch.eye(len(f), dtype=f.dtype)
    riccati(f - rest, g, q, cost.r, name=name)  # says why there is none
    from scipy.linalg import (  # here: half a second that no other import need pay
        LinAlgError,
        solve_discrete_are,
    )

    hold, n = exact_hold(f, g, q, cost.r, period, discount=cost.discount), len(f)
    q, s, r = hold.paid[:n, :n], hold.paid[:n, n:], hold.paid[n:, n:]
    fault = (
        f"The linearisation of {name}, held for {period:g} s, is not stabilisable: a mode repeats itself "
        "within a period where the control cannot see it. Choose another period."
    )
    if unstabilisable_mode(hold.a, hold.b, discrete=True) is not None:
        raise ValueError(fault)
    try:
        solved = solve_discrete_are(*(t.numpy() for t in (hold.a, hold.b, q, r)), s=s.numpy())
    except LinAlgError as error:
        raise ValueError(fault) from error
    p = 0.5 * torch.from_numpy(solved + solved.T)
    k = torch.linalg.solve(r + hold.b.mT @ p @ hold.b, hold.b.mT @ p @ hold.a + s.mT)
    return p, k


class HeldStability(NamedTuple):
    """The stability of a linearised loop whose control is held."""

    spectral_radius: float  # of one period: below 1 the origin is asymptotically stable
    largest_period: float | None  # s, up to which every period is stable; None: unstable without holding too,
    # inf: stable up to 100 time constants of the fastest mode


def held_stability(
    policy: Callable[[Tensor], Tensor], system: ControlAffineSystem, period: float
) -> HeldStability:
    """Return how stable the origin is when ``policy`` is held for ``period`` seconds.

    The plant is linearised by its own derivative, the policy by central differences at 0.

    Example:
        >>> plant = systems.Pendulum()
        >>> lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1))
        >>> adp.held_stability(lqr, plant, 0.01).spectral_radius < 1
        True

    Args:
        policy: u from x, (..., n) -> (..., m), with u(0) = 0.
        system: the plant.
        period: s, positive.

    Raises:
        ValueError: if the period is not positive.
    """
    f, g = (t.double() for t in system.linearisation())
    probes = _PROBE * torch.eye(len(f), dtype=torch.float64)
    with torch.no_grad():
        slope = (policy(probes) - policy(-probes)).double().mT / (2 * _PROBE)  # du/dx, (m, n)

    def radius(dt: float) -> float:
        hold = exact_hold(f, g, 0 * f, torch.zeros(g.shape[1], g.shape[1]), dt)
        return float(torch.linalg.eigvals(hold.a + hold.b @ slope).abs().max())

    modes = torch.linalg.eigvals(f + g @ slope)
    if float(modes.real.max()) >= 0:
        return HeldStability(radius(period), None)
    first, last = (math.log10(reach / float(modes.abs().max())) for reach in _REACH)
    tried = torch.logspace(first, last, _PERIODS, dtype=torch.float64).tolist()
    count = next((k for k, dt in enumerate(tried) if radius(dt) >= 1), None)
    if count is None:
        return HeldStability(radius(period), math.inf)
    stable, unstable = tried[count - 1] if count else 0.0, tried[count]
    while unstable - stable > 1e-6 * unstable:
        middle = 0.5 * (stable + unstable)
        stable, unstable = (middle, unstable) if radius(middle) < 1 else (stable, middle)
    return HeldStability(radius(period), stable)
