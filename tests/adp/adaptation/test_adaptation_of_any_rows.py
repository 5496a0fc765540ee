"""What is identified, filtered and designed row by row: rows of any dimensions are rows, in their dtype."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import random_positive_definite, uniform
from helpers_adaptation import COST, PENDULUM
from torch import Tensor

from staf_torch import GaussianKernel, adp, rings, systems
from staf_torch.adp.adaptation.adaptive_lqr import Redesign
from staf_torch.adp.adaptation.identification import Equation, Estimate
from staf_torch.adp.estimation import Belief, KalmanFilter
from staf_torch.numerics.riccati import control_rate, riccati_residual, riccati_rows

ROWS = 12
KNOWN = systems.Linear([[0.0, 1.0], [-0.4, 0.2]], [[0.0], [1.0]])
CHANGING = adp.ChangingPlant(PENDULUM)
X, OTHER, U = uniform(ROWS, 2, seed=1), uniform(ROWS, 2, seed=2), uniform(ROWS, 1, seed=3)
SIZES = random_positive_definite(4, ROWS, size=2, log_condition=1.0)
Z = torch.cat((X, uniform(ROWS, 4, seed=5), 1 + 0.5 * uniform(ROWS, 1, seed=6)), dim=-1)
SLOPES, GAINS = uniform(ROWS, 2, 2, seed=7), uniform(ROWS, 2, 1, seed=8)
FOUND = Callable[..., Any]


def windowed(windows: Any) -> FOUND:
    """Three equations of a window, whose states are those given, turned."""

    def found(x: Tensor, other: Tensor, u: Tensor) -> Any:
        now, said = windows.init(x), []
        for k in range(5):
            now, equation = windows.step(now, x + k * other, 0.125)
            now = windows.holding(now, u + k)
            said.append((now.s, now.elapsed, now.length, now.x, *equation))
        return said

    return found


def stacked(x: Tensor, other: Tensor, u: Tensor) -> Any:
    stack = adp.HistoryStack(1, 2, size=2, novelty=0.0)
    now, ready = stack.init(x), torch.ones_like(x[..., 0]).bool()
    for k in range(7):
        s = torch.stack((x[..., 0] + k, other[..., 1] * (k % 3)), dim=-1).unsqueeze(-2)
        now = stack.step(now, Equation(s, s.sum(-1) + u, u[..., 0], ready))
    return now


def squares(x: Tensor, other: Tensor, u: Tensor) -> Any:
    law = adp.LeastSquares([0.3, -0.2], deviation=[0.5, 2.0], floor=0.1, forgetting=0.3, alarm=2.0)
    now = law.init(x)
    for k in range(3):
        s = torch.stack((x + k, other), dim=-2)
        now = law.step(now, Equation(s, s.sum(-1), u[..., 0].square(), u[..., 0] > -0.5), 0.1)
    return now


def plants(x: Tensor, other: Tensor, u: Tensor) -> Any:
    family = PENDULUM.family()
    mine = PENDULUM.believing(other)
    return mine.rate(x, u), mine.drift(x), mine.effectiveness(x), family.at(other)


def filtered(kind: type[KalmanFilter]) -> FOUND:
    filter = kind(PENDULUM, lambda x: x[..., :1].sin(), noise=[0.1], process=[0.2, 0.3])

    def found(x: Tensor, sizes: Tensor, u: Tensor) -> Any:
        belief = Belief(x, sizes, u)
        return filter.step(belief, u, 0.1, u[..., 0] > 0), filter.predicted(belief, 0.1)

    return found


def considered(x: Tensor, sizes: Tensor, u: Tensor) -> Any:
    filter = adp.ConsiderFilter(PENDULUM, noise=[0.1, 0.3], process=0.2)
    estimate = Estimate(x, sizes, u[..., 0], u[..., 0])
    now = filter.init(x)
    for k in range(3):
        now = filter.step(now, x + 0.1 * k, u, estimate, 0.1)
    return now


def drifts(x: Tensor, other: Tensor, u: Tensor) -> Any:
    drift = adp.StreamDrift(
        KNOWN, GaussianKernel(2.0), 0.5 * rings(3), rows=[1], deviation=3.0, length=0.1, forgetting=0.2
    )
    now, window = drift.init(x), drift.windows.init(x)
    for k in range(5):
        windows, at = drift.window_of(now), x + 0.1 * k * other
        window, equation = windows.step(window, at, 0.05)
        window = windows.holding(window, u)
        now = drift.step(now, equation, at, 0.05)
    return now, drift.predict(now, other), drift.slopes(now, other), drift.matrix(now, other)


def designed(slopes: Tensor, gains: Tensor, _: Tensor) -> Any:
    q, r = COST.q.to(slopes), COST.r.to(slopes)
    p = riccati_rows(slopes, gains, q, r, doublings=6)
    made = Redesign("here", COST, 4)
    second = made.step(0 * p, slopes, gains)
    residual = riccati_residual(p, slopes, control_rate(gains, r), q)
    return p, second, residual, made.solved(second, slopes, gains)


CASES: dict[str, tuple[FOUND, tuple[Tensor, Tensor, Tensor]]] = {
    "smooth windows": (
        windowed(adp.IntegralWindows(PENDULUM, 0.5, shape="smooth", first=0.25, noise=0.1)),
        (X, OTHER, U),
    ),
    "a stack": (stacked, (X, OTHER, U)),
    "least squares": (squares, (X, OTHER, U)),
    "a plant": (plants, (X, OTHER, U)),
    "a changing plant": (
        lambda z, _, u: (
            CHANGING.theta(z),
            CHANGING.rate(z, u),
            CHANGING.drift(z),
            CHANGING.effectiveness(z),
        ),
        (Z, X, U),
    ),
    "an extended filter": (filtered(adp.ExtendedKalman), (X, SIZES, U)),
    "an unscented filter": (filtered(adp.UnscentedKalman), (X, SIZES, U)),
    "a filter that considers": (considered, (X, SIZES, U)),
    "a drift": (drifts, (X, OTHER, U)),
    "a design": (designed, (SLOPES, GAINS, U)),
}


def leaves(found: Any) -> list[Tensor]:
    if isinstance(found, Tensor):
        return [found]
    return [leaf for part in found for leaf in leaves(part)]


@pytest.mark.parametrize("name", CASES)
def test_rows_of_any_dimensions_one_row_and_none_are_those_rows_and_single_stays_single(name: str) -> None:
    of, given = CASES[name]
    flat = leaves(of(*given))
    deep = leaves(of(*(part.unflatten(0, (3, 2, 2)) for part in given)))
    alone, bare = (leaves(of(*(part[at] for part in given))) for at in (slice(7, 8), 7))
    single = leaves(of(*(part.float() for part in given)))
    for one, *others in zip(flat, deep, alone, bare, single, strict=True):
        assert others[0].shape == (3, 2, 2, *one.shape[1:])
        for found, wanted in ((others[0].flatten(0, 2), one), (others[1], one[7:8]), (others[2], one[7])):
            torch.testing.assert_close(found, wanted, rtol=1e-10, atol=1e-11)
        assert others[3].dtype == (torch.float32 if one.is_floating_point() else one.dtype)
        torch.testing.assert_close(others[3].to(one), one, rtol=2e-3, atol=2e-3)
