"""The paper's simulation against the reference numbers of MATH.md, section 2."""

from __future__ import annotations

import functools
import math

import pytest
import torch
from helpers import tensor, uniform

import staf_torch as st
from staf_torch import systems
from staf_torch.engine import ChaseResult
from staf_torch.numerics.linalg import condition_number
from staf_torch.optim import SteepestDescent
from staf_torch.targets import Paper

pytestmark = pytest.mark.compiled

END = 5 + 2 * math.pi
BASIS = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(3), radius=0.1))


@functools.cache
def simulation(dt: float = 0.01, inner_steps: int = 10) -> ChaseResult:
    """The whole run from a = 0 at x = (1, 0), in rows that are alike: the program of 32 parts serves."""
    steps = math.floor(END / dt)
    states = systems.simulate(systems.Oscillator(), tensor([[1.0, 0.0]]), dt=dt, steps=steps)
    states = states.expand(32, -1, -1)
    return st.chase(states, BASIS, Paper(), SteepestDescent(), inner_steps=inner_steps)


def settled(dt: float = 0.01, inner_steps: int = 10) -> dict[str, float]:
    """The worst over t in [5, 5 + 2 pi] of the whole run."""
    result = simulation(dt, inner_steps)
    at = slice(math.ceil(5 / dt - 1e-9), None)
    value = result.value[0, at]
    return {
        "after": float((value - result.estimate[0, at]).abs().max()),
        "before": float((value - result.estimate_before[0, at]).abs().max()),
        "floor": float((value - result.ideal_estimate[0, at]).abs().max()),
        "excess": float(result.excess[0, at].max()),
        "excess_before": float(result.excess_before[0, at].max()),
        "kappa": float(condition_number(BASIS.gram(result.state[0, at])).max()),
    }


def settled_in_parts(dt: float, inner_steps: int, parts: int = 32) -> tuple[float, float]:
    """The same from 32 overlapping parts of the window run side by side, each from ideal weights.

    The start of a part is forgotten at the rate delta an iteration, 0.982^700 = 3e-6 in the excess; a
    run of 565 000 iterations one after the other becomes one of a few thousand.
    """
    warm = math.ceil(700 / inner_steps)
    first, last = math.ceil(5 / dt - 1e-9), math.floor(END / dt)
    length = math.ceil((last - first + 1) / parts)
    index = first + torch.arange(parts)[:, None] * length + torch.arange(-warm, length)[None]
    angle = index.double() * dt
    states = torch.stack((angle.cos(), -angle.sin()), dim=-1)
    weights = BASIS.ideal_weights(states[:, 0], Paper())
    result = st.chase(states, BASIS, Paper(), SteepestDescent(), inner_steps=inner_steps, weights=weights)
    window = (index >= first) & (index <= last) & (torch.arange(-warm, length) >= 0)
    error = (result.value - result.estimate).abs()
    return float(error[window].max()), float(result.excess_before[window].max())


def test_numbers_of_the_first_time_are_the_reference_to_twelve_digits() -> None:
    x, start = tensor([1.0, 0.0]), simulation()
    weights = [3.2344146293230450, 0.6054736198914902, -3.8367772718434189]
    kappa = condition_number(BASIS.gram(x))
    assert BASIS.ideal_weights(x, Paper()).tolist() == pytest.approx(weights, rel=1e-12)
    assert start.ideal_weights[0, 0].tolist() == pytest.approx(weights, rel=1e-12)
    assert float(kappa) == pytest.approx(223.83332500173, rel=1e-12)
    assert float(SteepestDescent().contraction(kappa)) == pytest.approx(0.982288172613885, rel=1e-12)
    assert float(start.ideal_estimate[0, 0]) == pytest.approx(1.0225559019279473, rel=1e-12)
    estimate = st.StaF(BASIS).fit_(x, Paper())(x[None]).detach()
    assert float(estimate) == pytest.approx(1.0225559019279473, rel=1e-12)
    assert float(start.excess_before[0, 0]) == pytest.approx(1.33423395750151, rel=1e-12)
    assert float(BASIS.excess(torch.zeros(3).double(), x, Paper())) == pytest.approx(
        1.33423395750151, rel=1e-12
    )


@pytest.mark.parametrize(
    ("name", "reference", "half_digit"),
    [
        ("after", 0.0612, 5e-5),
        ("before", 0.0712, 5e-5),
        ("floor", 0.02422, 5e-6),
        ("excess", 0.288, 5e-4),
        ("excess_before", 0.351, 5e-4),
        ("kappa", 224.82, 5e-3),
    ],
)
def test_numbers_of_the_settled_window_are_the_reference_to_their_last_digit(
    name: str, reference: float, half_digit: float
) -> None:
    assert settled()[name] == pytest.approx(reference, abs=half_digit)


TABLE = {  # (dt, inner_steps): (error at the state after correction, excess before it)
    (0.05, 1): (2.10, 16.8),
    (0.05, 2): (1.30, 8.5),
    (0.05, 5): (0.532, 3.1),
    (0.05, 10): (0.310, 2.0),
    (0.05, 20): (0.153, 1.2),
    (0.05, 50): (0.043, 0.51),
    (0.01, 1): (0.665, 1.06),
    (0.01, 2): (0.344, 1.72),
    (0.01, 5): (0.177, 0.23),
    (0.01, 10): (0.0612, 0.351),
    (0.01, 20): (0.0243, 0.117),
    (0.01, 50): (0.0237, 0.0195),
    (0.001, 1): (0.095, 0.087),
    (0.001, 2): (0.025, 0.10),
    (0.001, 5): (0.043, 0.0125),
    (0.001, 10): (0.024, 0.0020),
    (0.001, 20): (0.0237, 4.5e-4),
    (0.001, 50): (0.0241, 9.8e-5),
}


CHAOTIC = [(0.05, 1), (0.05, 5), (0.01, 1), (0.01, 5), (0.001, 1)]
"""One or five iterations a step: the recursion forgets nothing. Starts 1e-12 apart end up to 60 % apart
over the window, and 60, 120 and 250 digits agree on .681 and 3.10 for (0.05, 5), on .808 and 1.11 for
(0.01, 1), on .165 and .257 for (0.01, 5). The table has one realisation in float64, so that what can be
held against it is the range of many: .532 is near the edge, 6 to 8 % of the runs are below it or within
3 % (of 4096 with the fused recursion and as many with the reference), so that 32 of them all miss it once
in ten times and 128 hardly ever. Even numbers of iterations agree to all digits."""


@pytest.mark.parametrize(("dt", "inner_steps"), [entry for entry in TABLE if entry not in CHAOTIC])
def test_table_of_step_and_iterations_is_the_reference_to_three_percent(dt: float, inner_steps: int) -> None:
    if dt == 0.001 or (dt == 0.01 and inner_steps >= 20):
        found = settled_in_parts(dt, inner_steps)
    else:
        worst = settled(dt, inner_steps)
        found = worst["after"], worst["excess_before"]
    assert found == pytest.approx(TABLE[dt, inner_steps], rel=0.03)


@pytest.mark.parametrize(("dt", "inner_steps"), CHAOTIC)
def test_chaotic_entries_of_the_table_are_among_the_runs_that_rounding_tells_apart(
    dt: float, inner_steps: int
) -> None:
    states = systems.simulate(systems.Oscillator(), tensor([[1.0, 0.0]]), dt=dt, steps=math.floor(END / dt))
    weights = 1e-12 * uniform(128, 3, seed=1)
    result = st.chase(
        states.expand(128, -1, 2), BASIS, Paper(), SteepestDescent(), inner_steps=inner_steps, weights=weights
    )
    at = slice(math.ceil(5 / dt - 1e-9), None)
    after = (result.value - result.estimate)[:, at].abs().amax(1)
    excess_before = result.excess_before[:, at].amax(1)
    for found, reference in zip((after, excess_before), TABLE[dt, inner_steps], strict=True):
        assert 0.97 * float(found.min()) <= reference <= 1.03 * float(found.max())
        assert float(found.quantile(0.95) / found.quantile(0.05)) < 2.0


def test_window_in_parts_is_the_window_of_the_whole_run() -> None:
    whole = settled(0.01, 10)
    assert settled_in_parts(0.01, 10) == pytest.approx((whole["after"], whole["excess_before"]), rel=1e-3)


def test_contraction_inequality_never_fails_over_the_whole_run() -> None:
    result = simulation()
    rate = SteepestDescent().contraction(condition_number(BASIS.gram(result.state)))
    assert (result.excess <= rate**10 * result.excess_before * (1 + 1e-9)).all()


def test_settled_excess_is_of_second_order_in_the_step() -> None:
    """sqrt(e) = O(dt) with fifty iterations, better than the paper's theorem says."""
    coarse, fine = settled_in_parts(0.01, 50)[1], settled_in_parts(0.001, 50)[1]
    assert math.log10(coarse / fine) > 1.9
