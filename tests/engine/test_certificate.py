"""The one-step bound and the a-priori radius, on every system and kernel."""

from __future__ import annotations

import functools
import itertools
import math

import pytest
import torch
from helpers_laws import TARGET, basis, states
from variants import LAWS, PREDICTORS, RATED, SMOOTH_KERNELS, SYSTEMS

from staf_torch import StaFBasis, StateFollowingCenters, StateRadius, chase, optim, rings, theory
from staf_torch.engine import ChaseResult


def certified(
    law: str, steps: int, *, kernel: str = "exponential", system: str = "oscillator", predictor: str = "none"
) -> ChaseResult:
    return chase(
        states(batch=2, steps=30, dt=0.02, system=system),
        basis(SMOOTH_KERNELS[kernel].make()),
        TARGET,
        LAWS[law],
        inner_steps=steps,
        predictor=PREDICTORS[predictor],
        certificate=True,
    )


TURNS = zip(*map(itertools.cycle, (RATED, SMOOTH_KERNELS, SYSTEMS, PREDICTORS)), strict=True)


@pytest.mark.parametrize(
    ("law", "kernel", "system", "predictor"), [*itertools.islice(TURNS, len(SMOOTH_KERNELS))]
)
def test_the_one_step_bound_holds_on_every_system_and_kernel_by_every_law_with_a_rate_and_every_predictor(
    law: str, kernel: str, system: str, predictor: str
) -> None:
    result = certified(law, 3, kernel=kernel, system=system, predictor=predictor)
    certificate = result.certificate
    assert certificate is not None
    assert not bool(certificate.violated.any())
    assert bool(certificate.bound.isfinite().all())
    rounding = 1e-5 * result.value.abs().amax(1, keepdim=True)
    assert bool((result.excess.clamp(min=0).sqrt() <= certificate.bound * (1 + 1e-9) + rounding).all())


def test_the_one_step_bound_is_tight_for_the_papers_law() -> None:
    result = certified("steepest descent", 10)
    assert result.certificate is not None
    share = result.excess.sqrt() / result.certificate.bound
    assert float(share[0, 20:].median()) > 0.8


def test_a_correction_that_breaks_its_promise_is_counted() -> None:
    class Boastful(optim.SteepestDescent):
        def contraction(self, condition_number: torch.Tensor) -> torch.Tensor:
            return torch.full_like(condition_number, 1e-3)

    result = chase(states(), basis(), TARGET, Boastful(), inner_steps=1, certificate=True)
    assert result.certificate is not None
    assert int(result.certificate.violated.sum()) > 30


def test_a_law_without_a_rate_has_terms_but_no_bound() -> None:
    certificate = certified("heavy ball", 3).certificate
    assert certificate is not None
    assert bool(certificate.bound.isnan().all())
    assert not bool(certificate.violated.any())
    assert bool(certificate.drift.isfinite().all())
    assert bool(certificate.growth.isfinite().all())


def test_the_norm_of_a_translation_invariant_kernel_does_not_change() -> None:
    certificate = certified("exact", 1, kernel="gaussian").certificate
    assert certificate is not None
    torch.testing.assert_close(certificate.growth, torch.ones_like(certificate.growth))


# Every system under both kinds of radius, each with another kernel.
@pytest.mark.parametrize(
    ("kernel", "system", "shrinking"),
    [
        (kernel, list(SYSTEMS)[k % len(SYSTEMS)], bool(k // len(SYSTEMS) % 2))
        for k, kernel in enumerate(SMOOTH_KERNELS)
        if k % 2 == 0
    ],
)
def test_the_a_priori_radius_holds_on_every_system(kernel: str, system: str, shrinking: bool) -> None:
    dt, steps, law = 0.02, 15, optim.SteepestDescent()
    radius = StateRadius(0.3, 0.5) if shrinking else 0.2
    local = StaFBasis(SMOOTH_KERNELS[kernel].make(), StateFollowingCenters(rings(3), radius))
    x = states(batch=2, steps=60, dt=dt, system=system)
    constants = theory.drift_constants(local, TARGET, x, SYSTEMS[system]().drift(x))
    bound = theory.ultimate_bound(constants, law, dt=dt, inner_steps=steps)
    assert math.isfinite(bound.before)
    result = chase(x, local, TARGET, law, inner_steps=steps)
    q = float(law.contraction(torch.tensor(constants.condition_number))) ** (steps / 2)
    left = float(result.excess_before[:, 0].max().sqrt()) * (q * math.exp(constants.growth * dt)) ** 40
    sampling = 1.02  # the constants are taken at the states alone, not between them
    assert float(result.excess_before[:, 40:].max().sqrt()) <= sampling * math.sqrt(bound.before) + left
    assert float(result.excess[:, 40:].max().sqrt()) <= sampling * math.sqrt(bound.after) + left


@functools.cache
def circle() -> tuple[StaFBasis, theory.DriftConstants]:
    x = states(steps=629, dt=0.01)
    return basis(), theory.drift_constants(basis(), TARGET, x, SYSTEMS["oscillator"]().drift(x))


def test_the_a_priori_radius_of_the_papers_simulation() -> None:
    _, constants = circle()
    assert constants.condition_number == pytest.approx(224.82, abs=0.01)
    bound = theory.ultimate_bound(constants, optim.SteepestDescent(), dt=0.01, inner_steps=10)
    assert 0.351 < bound.before < 0.6  # .351 and .288 are measured
    assert 0.288 < bound.after < 0.5
    halved = theory.ultimate_bound(constants, optim.Exact(), dt=0.005, inner_steps=1)
    whole = theory.ultimate_bound(constants, optim.Exact(), dt=0.01, inner_steps=1)
    assert whole.before / halved.before == pytest.approx(4, rel=0.01)
    assert whole.after == 0


def test_the_papers_own_step_is_four_orders_more_cautious() -> None:
    x = states(steps=157, dt=0.04)
    step = theory.paper_step(basis(), TARGET, x, SYSTEMS["oscillator"]().drift(x), excess=0.35)
    assert float(f"{step.dt:.1e}") == 5.2e-7
    assert step.contraction == pytest.approx(0.98237, abs=1e-5)
    assert step.speed == pytest.approx(math.sqrt(3))
    _, constants = circle()
    ours = theory.step_for_bound(constants, optim.SteepestDescent(), excess=0.35, inner_steps=10)
    assert ours > 1e4 * step.dt


def test_rounding_is_no_violation_in_any_unit_of_the_value() -> None:
    where = states(batch=3, steps=1)[:, :1].expand(-1, 8, -1)  # at rest: the bound goes to zero
    plain, scaled = (
        chase(
            *(where, basis(), lambda x, u=u: u * TARGET(x), LAWS["steepest descent"]),
            inner_steps=100,
            certificate=True,
        ).certificate
        for u in (1.0, 1e-6)
    )
    assert plain is not None
    assert scaled is not None
    assert not bool(scaled.violated.any())
    torch.testing.assert_close(scaled.bound[:, 0], 1e-6 * plain.bound[:, 0], rtol=1e-4, atol=0)
