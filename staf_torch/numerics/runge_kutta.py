"""Runge-Kutta steps of fourth order: the classical one, for whatever has sums and products with numbers, the
exponential one, exact where x' = A x + c, and the fewest steps that are accurate enough.

A classical step multiplies a mode of 1/tau by a polynomial of h/tau, and is wrong or unstable where h > tau.
In an exponential step the linear part A of the rate is solved by its exponential and only the remainder
N(x) = x' - A x is approximated, by a quadratic through its values at the
stages. With A = 0 the step is the classical one.

Source: Krogstad, "Generalized integrating factor methods for stiff PDEs", J. Comput. Phys. 203 (2005);
Cox and Matthews, J. Comput. Phys. 176 (2002), for the weights.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, bmm
from torch.nn.functional import pad

from ..lanes import scan
from ..lanes.per_row.decisions import in_any_row, is_of_rows
from ..lanes.row_numbers import nonzero
from .default_device import designed_on_cpu
from .linalg import exponential as matrix_exponential
from .rows import known_quantile

TOLERANCE = 1e-6  # error of a hold or a step of a trajectory, relative to the state
GRACE = 10.0  # times the tolerance: more steps are tried, and what is left above it is a warning
BENT = 3e-3  # of the state: more bending is looked at; of a mode (h / tau)^3 / 4, beside an error of 5e-6
TRIED, MOST = 16, 1024  # holds of a row that are repeated; steps of one at most
_NEAR = 4.0  # an error that doubling the steps divides by less is one of rounding, or of a rate with corners
_MOSTLY, _DOUBLINGS, _BOUNDED = 0.75, 2, 0.5  # share of the samples; doublings since; relative error
_SMALL = 1e-3  # relative errors above which more steps are tried all the same
SHARES = (0.0, 0.5, 0.5, 1.0)
"""Of the step, at which its four stages stand."""


def runge_kutta_step(
    field: Callable[[Tensor], Tensor],
    x: Tensor,
    dt: float | Tensor,
    displaced: Callable[[Tensor, Tensor], Tensor] = operator.add,
) -> Tensor:
    """Classical fourth-order Runge-Kutta step: (..., n) -> (..., n).

    Example:
        >>> x = systems.runge_kutta_step(lambda x: -x, torch.ones(1).double(), dt=0.1)
        >>> round(float(x), 6)  # exp(-0.1) = 0.904837
        0.904837

        Shown by `staf system=van_der_pol`.

    Args:
        field: x' from x.
        x: (..., n).
        dt: length of the step, a number or (..., 1).
        displaced: the state that a step leads to, as `systems.Plant.displaced`; by default the sum.
    """
    _, slopes = runge_kutta_stages(lambda at, share: field(at), x, dt, displaced)
    return displaced(x, runge_kutta_mean(slopes, dt))


def runge_kutta_stages(
    field: Callable[[Tensor, float], Tensor],
    x: Tensor,
    dt: float | Tensor,
    displaced: Callable[[Tensor, Tensor], Tensor] = operator.add,
) -> tuple[list[Tensor], list[Tensor]]:
    """The four states at which a step from x (..., n) asks the field, and its answers there: x' from x
    and the share of the step that has passed, one of `SHARES`."""
    states, slopes = [x], [field(x, SHARES[0])]
    for share in SHARES[1:]:
        states.append(displaced(x, share * dt * slopes[-1]))
        slopes.append(field(states[-1], share))
    return states, slopes


def runge_kutta_mean(values: Sequence[Tensor], dt: float | Tensor) -> Tensor:
    """The integral over a step of what has these values at its four stages (Simpson's rule)."""
    first, second, third, last = values
    return (dt / 6) * (first + 2 * (second + third) + last)


def exponential(exponent: float | Tensor) -> float | Tensor:
    """e^exponent."""
    return exponent.exp() if isinstance(exponent, Tensor) else math.exp(exponent)


def stage_weights(length: float | Tensor, discount: float, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return where the stages stand, and weights of slopes and costs, s: (4, ..., 1) twice, (4, ...)."""
    if not isinstance(length, Tensor):
        h = length
        # What the middle still counts; the end, squared.
        counts = exponential(-0.5 * discount * h) if nonzero(discount) else 1.0
        left = 1.0 if isinstance(counts, Tensor) else counts
        between = (h / 2, h / 3, left * h / 3)
        table = ((0.0, h / 6, h / 6), between, between, (h, h / 6, left**2 * h / 6))
        # Not `torch.tensor`, which torch.func does not take on the meta device.
        asked, counted, worth = torch.as_tensor(table, dtype=like.dtype, device=like.device).unbind(-1)
        if isinstance(counts, Tensor):  # of a row's own, or of the table
            shares = torch.stack((torch.ones_like(counts), counts, counts, counts.square()))
            worth = counted * shares.to(like)
        return asked.unsqueeze(-1), counted.unsqueeze(-1), worth
    half = torch.exp(-0.5 * discount * length)
    ends, middle = length / 6, length / 3
    asked = torch.stack((torch.zeros_like(length), 0.5 * length, 0.5 * length, length))
    counted = torch.stack((ends, middle, middle, ends))
    worth = torch.stack((ends, middle * half, middle * half, ends * half.square()))
    # A number of the table is on the CPU in float64.
    return asked.to(like).unsqueeze(-1), counted.to(like).unsqueeze(-1), worth.to(like)


RungeKuttaSums = tuple[Tensor, Tensor, Tensor]
"""The slope of the last stage, the sum of what the slopes count, and what was paid."""


def runge_kutta_loop(
    displaced: Callable[[Tensor, Tensor], Tensor],
    field: Callable[[Tensor], tuple[Tensor, Tensor]],
    x: Tensor,
    length: float | Tensor,
    discount: float = 0.0,
    watch: bool = False,
) -> tuple[Tensor, ...]:
    """`runge_kutta_step` with what is paid, as a loop over the stages, of which a program then contains one.

    Returns x+ (..., n) and what was paid, (...), discounted by ``discount``, 1/s; with ``watch`` also how
    much the field bends within the step, h |k_3 - k_2|, the largest. The field is the velocity and the cost
    rate at a state, the length in s a number or one a row, ``displaced`` as `systems.Plant.displaced`.
    """

    def stage(now: RungeKuttaSums, share: tuple[Tensor, Tensor, Tensor]) -> tuple[RungeKuttaSums, Any]:
        slope, moved, paid = now
        ahead, count, value = share
        slope, rate = field(displaced(x, ahead * slope))
        return (slope, moved + count * slope, paid + value * rate), slope if watch else ()

    start = torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x[..., 0])
    (_, moved, paid), slopes = scan(stage, start, stage_weights(length, discount, x), dim=0)
    after = displaced(x, moved)
    return (after, paid, length * (slopes[2] - slopes[1]).abs().amax(-1)) if watch else (after, paid)


class ExponentialStep(NamedTuple):
    """Matrices of a step of one length h; displacements are those from the state at the start."""

    linear: Tensor  # A, (n, n)
    begun: Tensor  # (4, n, n) displacement of a stage by N at the start
    before: Tensor  # (4, n, n) displacement of a stage by N of the stage before
    weight: Tensor  # (4, n, n) displacement of the step by N of each stage
    starts: Tensor  # (4, 1) 1 at the first stage
    paid: Tensor | None  # (4 n, 4 n) W of z'Wz = int d'Q d e^(-rho s) ds, z = (d, N first, middle, last)


def quadratic_integral(matrix: Tensor, rate: Tensor, length: float) -> tuple[Tensor, Tensor]:
    """Return e^(M t) and int_0^t e^(M s)' R e^(M s) ds, (n, n) float64 each, R symmetric.

    The exponential of a short step is doubled: e^(M 2h) = (e^(M h))^2, W(2h) = W(h) + e^(M h)' W(h) e^(M h).

    Source: Van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23 (1978).
    """
    size = (torch.linalg.matrix_norm(matrix, 1) * length).clamp(min=1e-9)
    doublings = (2 + size.log2().ceil()).clamp(min=0)  # of a row of `torch.func.vmap` its own
    h, n = length * torch.exp2(-doublings), len(matrix)
    rows = torch.cat((-matrix.mT, rate), dim=1), torch.cat((torch.zeros_like(matrix), matrix), dim=1)
    step = matrix_exponential(h * torch.cat(rows)).unsqueeze(0)  # one and many products have the same bits
    flow = step[:, n:, n:]
    paid = flow.mT @ step[:, :n, n:]
    done, several = 0, is_of_rows(doublings)
    while in_any_row(more := doublings > done):
        longer, further = paid + bmm(bmm(flow.mT, paid), flow), bmm(flow, flow)
        paid = torch.where(more, longer, paid) if several else longer
        flow = torch.where(more, further, flow) if several else further
        done += 1
    return flow[0], 0.5 * (paid + paid.mT)[0]


@designed_on_cpu
def exponential_step(
    linear: Tensor, h: float, curvature: Tensor | None = None, discount: float = 0.0
) -> ExponentialStep:
    """Return the matrices of steps of h seconds for A (n, n), 1/s; with Q (n, n) those of the integral of
    d'Qd, discounted by rho, 1/s."""
    a = linear.double()
    n, zero = len(a), torch.zeros_like(a)
    (one, two, three), (half_one, half_two, _) = _phi(a, h), _phi(a, 0.5 * h)
    begun = torch.stack((zero, zero, h * (0.5 * half_one - half_two), h * (one - 2 * two)))
    before = torch.stack((zero, 0.5 * h * half_one, h * half_two, 2 * h * two))
    middle = h * (2 * two - 4 * three)
    weight = torch.stack((h * (one - 3 * two + 4 * three), middle, middle, h * (4 * three - two)))
    starts = torch.tensor([[1.0], [0.0], [0.0], [0.0]], dtype=torch.float64, device="cpu")
    paid = None
    if curvature is not None:
        # (moved, N, N', N'', d at the start): moved' = A moved + N.
        whole = pad(_chain(a), (0, n, 0, n))
        both = torch.zeros(n, 5 * n, dtype=torch.float64, device="cpu")
        both[:, :n] = both[:, 4 * n :] = torch.eye(n, dtype=torch.float64, device="cpu")
        rate = both.mT @ curvature.double() @ both
        _, integral = quadratic_integral(
            whole - 0.5 * discount * torch.eye(5 * n, dtype=torch.float64, device="cpu"), rate, h
        )
        rows = (1.0, 0.0, 0.0), (-3 / h, 4 / h, -1 / h), (4 / h**2, -8 / h**2, 4 / h**2)
        stages = torch.tensor(rows, dtype=torch.float64, device="cpu")
        basis = torch.zeros(5, 4, dtype=torch.float64, device="cpu")
        basis[1:4, 1:], basis[4, 0] = stages, 1.0
        turned = torch.kron(basis, torch.eye(n, dtype=torch.float64, device="cpu"))
        paid = turned.mT @ integral @ turned
    return ExponentialStep(a, begun, before, weight, starts, paid)


def _phi(a: Tensor, h: float) -> tuple[Tensor, Tensor, Tensor]:
    """phi_1, phi_2, phi_3 of h A, (n, n) each."""
    n = len(a)
    found = matrix_exponential(_chain(h * a))[:n]
    return found[:, n : 2 * n], found[:, 2 * n : 3 * n], found[:, 3 * n :]


def _chain(a: Tensor) -> Tensor:
    """A, and three integrators after it: (n, n) -> (4 n, 4 n)."""
    n = len(a)
    after = torch.diag(torch.ones(3 * n, dtype=torch.float64, device="cpu"), n)
    return after + pad(a, (0, 3 * n, 0, 3 * n))


def times(matrix: Tensor, x: Tensor) -> Tensor:
    """M x of every row: (k, n), (..., n) -> (..., k), of the same bits in every batch."""
    return (matrix * x.unsqueeze(-2)).sum(-1)


def exponential_stages(
    table: ExponentialStep, field: Callable[[Tensor], tuple[Tensor, Tensor]], x: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Take one step from x (..., n), read for its shape, dtype and device: the displacement (..., n), N
    (4, ..., n) and what else the field gives, (4, ...). The field is x' and another number at a
    displacement from x."""

    def stage(
        now: tuple[Tensor, Tensor, Tensor], share: tuple[Tensor, Tensor, Tensor, Tensor]
    ) -> tuple[tuple[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]:
        first, last, moved = now
        begun, before, weight, starts = share
        away = times(begun, first) + times(before, last)
        velocity, number = field(away)
        rest = velocity - times(linear, away)
        return (first + starts * rest, rest, moved + times(weight, rest)), (rest, number)

    linear, zero = table.linear.to(x), torch.zeros_like(x)
    shares = tuple(part.to(x) for part in (table.begun, table.before, table.weight, table.starts))
    (_, _, moved), (rests, numbers) = scan(stage, (zero, zero, zero), shares, dim=0)
    return moved, rests, numbers


class StepCount(NamedTuple):
    """A number of steps and the relative error that is left with it."""

    number: int
    error: float | Tensor  # a tensor () of a search


def fewest_steps(errors: Callable[[int], Tensor], tolerance: float, most: int) -> StepCount:
    """Return the fewest steps of fourth order, up to ``most``, for which all samples are accurate, by the
    errors (P,) of so many steps.

    An error that no longer falls with the steps is one of rounding or of a rate with corners: the search
    ends there. Nor do more steps help where most samples are accurate long since and others, which cross a
    jump of the rate, are not.
    """
    count, served = 1, 0
    last: float | Tensor = math.inf
    while True:
        each = errors(count)
        error = each.max() if len(each) else each.new_zeros(())
        served += bool(len(each)) and bool(known_quantile(each, _MOSTLY, lower=True) <= tolerance)
        if bool(error <= tolerance):
            if bool(last < math.inf):  # perhaps fewer: the error falls with the fourth power of the steps
                least, count = count * (error / tolerance) ** 0.25, count // 2 + 1
                while bool(least > count):  # rows with numbers of their own part here
                    count += 1
            return StepCount(count, error)
        jumps = served > _DOUBLINGS and bool(error <= _BOUNDED) and bool(error * _NEAR > last)
        if jumps or stalls(error, last) or 2 * count > most:
            return StepCount(count, error)
        count, last = 2 * count, error


def stalls(error: float | Tensor, last: float | Tensor) -> bool:
    """Return whether twice the steps were of no use, because of rounding or corners of the rate."""
    return bool(error <= _SMALL) and bool(error * _NEAR > last)


class StepsNeeded(NamedTuple):
    """Steps and orders that rows need."""

    factor: Tensor  # (R,) int64, times the steps
    error: Tensor  # (R,) float64, that is left with them


def needed_steps(
    errors: Callable[[Tensor, int], Tensor], most: Tensor, tolerance: float, enough: float
) -> StepsNeeded:
    """Return how many times more steps every row needs, by doubling: nothing of another row is looked at."""
    count, most = len(most), most.cpu()
    factor, error = (
        torch.ones(count, dtype=torch.int64, device="cpu"),
        torch.full((count,), math.inf, dtype=torch.float64, device="cpu"),
    )
    rows, last, times = torch.arange(count, device="cpu"), error.clone(), 1
    while len(rows):
        now = errors(rows, times).double().cpu()
        factor[rows], error[rows] = times, now
        pairs = zip(now.tolist(), last.tolist(), strict=True)
        stalled = torch.tensor([stalls(one, before) for one, before in pairs], dtype=torch.bool, device="cpu")
        further = (now > (enough if times == 1 else tolerance)) & ~stalled & (2 * times <= most[rows])
        rows, last, times = rows[further], now[further], 2 * times
    return StepsNeeded(factor, error)
