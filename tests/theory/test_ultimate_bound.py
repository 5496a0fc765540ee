"""The a-priori bound and its inverses: the largest step and the fewest iterations that keep it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import basis_of, tensor
from torch import Tensor
from variants import RATED, by_turns

import staf_torch as st
from staf_torch import optim, systems, theory
from staf_torch.targets import Paper
from staf_torch.theory.ultimate_bound import DriftConstants, PaperStep, ultimate_bound

FLAT, SLOW, MOVING, RAPID = CONSTANTS = [
    DriftConstants(condition_number=30.0, speed=2.0, growth=growth) for growth in (0.0, 1e-3, 0.7, 40.0)
]


def radius(constants: DriftConstants, law: optim.UpdateLaw, dt: float, steps: int, before: bool) -> float:
    return ultimate_bound(constants, law, dt=dt, inner_steps=steps)[0 if before else 1]


@pytest.mark.parametrize(("law", "constants"), by_turns(RATED, CONSTANTS))
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


@pytest.mark.parametrize(("law", "constants"), by_turns(RATED, [MOVING, FLAT, SLOW]))
@pytest.mark.parametrize("before", [False, True])
def test_the_largest_step_is_as_large_as_the_bound_allows(
    law: str, constants: DriftConstants, before: bool
) -> None:
    for excess, steps in ((1e-4, 1), (0.3, 4), (9.0, 11)):
        dt = theory.step_for_bound(constants, RATED[law], excess=excess, inner_steps=steps, before=before)
        if math.isinf(dt):
            assert isinstance(RATED[law], optim.Exact)
            assert not before
            continue
        assert radius(constants, RATED[law], dt, steps, before) == pytest.approx(excess, rel=1e-8)


def test_the_bound_is_the_fixed_point_of_its_recursion() -> None:
    """s+ = q e^{G dt} s + W (e^{G dt} - 1) / G, iterated."""
    constants, law, dt = MOVING, optim.SteepestDescent(), 0.05
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


STATES = tensor([[1.0, 0.2], [0.4, -0.9], [-0.7, 0.5], [0.1, 0.3], [1.2, -0.2], [-0.3, -0.6]])
SPIN, FALL = systems.Oscillator().drift(STATES), -0.5 * STATES


def by_differences(basis: st.StaFBasis, x: Tensor, v: Tensor) -> tuple[float, float, float]:
    """Kappa, W and G of one state, K' and w' as differences of what the basis gives nearby."""
    h = 1e-5

    def gram(at: Tensor) -> np.ndarray:
        return basis.gram(at).numpy()

    def ideal(at: Tensor) -> np.ndarray:
        return basis.ideal_weights(at, Paper()).numpy()

    matrix, rate = gram(x), (gram(x + h * v) - gram(x - h * v)) / (2 * h)
    speed = (ideal(x + h * v) - ideal(x - h * v)) / (2 * h)
    growth = np.linalg.eigvals(np.linalg.solve(matrix, rate)).real.max() / 2
    return float(np.linalg.cond(matrix)), math.sqrt(speed @ matrix @ speed), float(growth)


SHRINKING = st.StateRadius(0.7, 0.3, gain=1.5)


@pytest.mark.parametrize(
    ("kernel", "velocities", "radius"),
    [
        ("exponential", -FALL, 0.5),
        ("exponential", SPIN, SHRINKING),
        ("gaussian", FALL, SHRINKING),
        ("matern52", SPIN, 0.5),
        ("matern52", -FALL, SHRINKING),
    ],
)
def test_constants_are_the_worst_of_differences(kernel: str, velocities: Tensor, radius: object) -> None:
    basis = basis_of(kernel, 3, radius)
    found = theory.drift_constants(basis, Paper(), STATES, velocities)
    kappa, speed, growth = zip(
        *(by_differences(basis, x, v) for x, v in zip(STATES, velocities, strict=True)), strict=True
    )
    assert found.condition_number == pytest.approx(max(kappa), rel=1e-6)
    assert found.speed == pytest.approx(max(speed), rel=1e-5)
    assert found.growth == pytest.approx(max(0.0, *growth), rel=1e-5, abs=1e-6)
    again = theory.drift_constants(basis, Paper(), STATES.view(2, 3, 2), velocities.view(2, 3, 2))
    assert again == pytest.approx(found, rel=1e-8)


def test_states_whose_matrix_is_singular_are_refused() -> None:
    toward = tensor([[1.0, 0.0], [0.0, 1.0]])  # one center at the origin, where this kernel is 0
    kernel = st.AnchoredKernel(st.ExponentialKernel())
    basis, x = st.StaFBasis(kernel, st.StateFollowingCenters(toward, 0.5)), tensor([[-0.5, 0.0]])
    with pytest.raises(ValueError, match=r"drift_constants\(states=...\)` must have a positive definite K"):
        theory.drift_constants(basis, Paper(), x, torch.ones_like(x))


STEEP = DriftConstants(condition_number=1e20, speed=2.0, growth=0.0)  # no iteration gains anything


def test_where_nothing_contracts_nothing_is_promised() -> None:
    law = optim.SteepestDescent()
    assert ultimate_bound(STEEP, law, dt=0.1, inner_steps=3) == (math.inf, math.inf)
    for before in (False, True):
        assert theory.steps_for_bound(STEEP, law, excess=0.1, dt=1e-3, before=before) is None
        assert theory.step_for_bound(STEEP, law, excess=0.1, inner_steps=3, before=before) == 0.0
    growing = DriftConstants(condition_number=30.0, speed=1.0, growth=-2 * math.log(29 / 31))
    assert ultimate_bound(growing, law, dt=1.01, inner_steps=2) == (math.inf, math.inf)
    assert math.isfinite(ultimate_bound(growing, law, dt=0.99, inner_steps=2).before)
    with pytest.raises(ValueError, match=r"law=...\)` must have a known contraction an iteration.*HeavyBall"):
        theory.step_for_bound(MOVING, optim.HeavyBall(), excess=0.1, inner_steps=1)


# --- the paper's own step -----------------------------------------------------------------------------------


def step_of(states: Tensor, velocities: Tensor, **given: object) -> PaperStep:
    return theory.paper_step(basis_of("exponential", 3), Paper(), states, velocities, **given)  # type: ignore[arg-type]


def test_constants_of_the_papers_step_are_written_out() -> None:
    basis = basis_of("exponential", 3)
    found = step_of(STATES, SPIN, excess=0.35)
    weights = basis.ideal_weights(STATES, Paper())
    assert found.radius == pytest.approx(max(math.sqrt(float(w @ w)) for w in weights))
    assert found.speed == pytest.approx(math.sqrt(3) * float(SPIN.norm(dim=-1).max()))
    kappa = max(np.linalg.cond(basis.gram_structure(x).scaled().numpy()) for x in STATES)
    assert found.contraction == pytest.approx(((kappa - 1) / (kappa + 1)) ** 2)
    h, slopes = 1e-5, []
    for x, a in zip(STATES, weights, strict=True):
        centers = basis.centers(x)

        def error(c: Tensor, a: Tensor = a) -> float:
            return float(a @ basis.kernel(c, c) @ a - 2 * a @ Paper()(c))

        moves = torch.eye(6, dtype=torch.float64).view(6, 3, 2) * h
        slopes.append(
            math.hypot(*((error(centers + move) - error(centers - move)) / (2 * h) for move in moves))
        )
    assert found.ideal_gradient == pytest.approx(max(slopes), rel=1e-4)
    assert found.gradient >= found.ideal_gradient
    worst = max(found.gradient, found.ideal_gradient)
    assert found.dt == pytest.approx(0.35 * (1 - found.contraction) / (2 * found.speed * worst))
    far = step_of(STATES, SPIN, excess=0.35, initial_weights=tensor([0.0, 3e4, 4e4]))
    assert far.radius == pytest.approx(max(5e4, found.radius))
    near = step_of(STATES, SPIN, excess=0.35, initial_weights=tensor([0.0, 3e-4, 4e-4]))
    assert near == found


def test_states_that_stand_still_may_take_any_step_and_slow_ones_a_long_one() -> None:
    assert step_of(STATES[:2], 0 * SPIN[:2], excess=0.35).dt == math.inf
    quick, slow = (step_of(STATES[:2], rate * SPIN[:2], excess=0.35) for rate in (1.0, 0.01))
    assert slow.dt == pytest.approx(100 * quick.dt)
