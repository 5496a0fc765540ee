"""The a-priori bound and its inverses: the largest step and the fewest iterations that keep it."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import basis_of
from variants import RATED, over

from staf_torch import optim, theory
from staf_torch.targets import Paper
from staf_torch.theory.ultimate_bound import DriftConstants, ultimate_bound

CONSTANTS = [DriftConstants(condition_number=30.0, speed=2.0, growth=growth) for growth in (0.0, 0.7, 40.0)]


def radius(constants: DriftConstants, law: optim.UpdateLaw, dt: float, steps: int, before: bool) -> float:
    return ultimate_bound(constants, law, dt=dt, inner_steps=steps)[0 if before else 1]


@over(RATED, "law")
@pytest.mark.parametrize("constants", CONSTANTS, ids=lambda c: f"growth {c.growth:g}")
@pytest.mark.parametrize("before", [False, True])
def test_fewest_iterations_are_enough_and_one_fewer_is_not(
    law: str, constants: DriftConstants, before: bool
) -> None:
    for excess, dt in ((1e-4, 1e-3), (1e-2, 1e-2), (1.0, 0.3)):
        steps = theory.steps_for_bound(constants, RATED[law], excess=excess, dt=dt, before=before)
        if steps is None:
            assert radius(constants, RATED[law], dt, 10**6, before) > excess
            continue
        assert radius(constants, RATED[law], dt, steps, before) <= excess * (1 + 1e-9)
        assert steps == 1 or radius(constants, RATED[law], dt, steps - 1, before) > excess


@pytest.mark.parametrize("constants", CONSTANTS, ids=lambda c: f"growth {c.growth:g}")
@pytest.mark.parametrize("before", [False, True])
def test_largest_step_meets_the_bound_with_equality(constants: DriftConstants, before: bool) -> None:
    law = optim.SteepestDescent()
    for excess in (1e-6, 1e-2):
        dt = theory.step_for_bound(constants, law, excess=excess, inner_steps=3, before=before)
        assert radius(constants, law, dt, 3, before) == pytest.approx(excess, rel=1e-6)


def test_the_bound_is_the_fixed_point_of_its_recursion() -> None:
    """s+ = q e^{G dt} s + W (e^{G dt} - 1) / G, iterated."""
    constants, law, dt = CONSTANTS[1], optim.SteepestDescent(), 0.05
    q = math.sqrt(float(law.contraction(torch.tensor(30.0, dtype=torch.float64)))) ** 8
    s = 0.0
    for _ in range(2000):
        s = q * math.exp(0.7 * dt) * s + 2.0 * math.expm1(0.7 * dt) / 0.7
    found = ultimate_bound(constants, law, dt=dt, inner_steps=8)
    assert found.before == pytest.approx(s**2, rel=1e-9)
    assert found.after == pytest.approx((q * s) ** 2, rel=1e-9)


def test_a_step_for_no_excess_and_velocities_of_another_shape_are_refused() -> None:
    basis, target = basis_of("gaussian"), Paper()
    states = torch.zeros(4, 2, dtype=torch.float64)
    for excess in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match=r"paper_step\(excess="):
            theory.paper_step(basis, target, states, states, excess=excess)
    with pytest.raises(ValueError, match=r"velocities=\.\.\.\)` must have the shape of the states, \(4, 2\)"):
        theory.drift_constants(basis, target, states, states[:3])
