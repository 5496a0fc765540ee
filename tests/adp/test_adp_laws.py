"""The actor-critic laws: their reference numbers, and what makes the information form the default."""

from __future__ import annotations

import pytest
import torch
from helpers_adp import BOX, COST, LAWS, PLANT, learner, staf_basis, uniform
from torch import Tensor

from staf_torch import (
    AnchoredKernel,
    ExponentialKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    systems,
)
from staf_torch.adp.laws import ActorCriticLaw, BellmanSums


def continuous(law: ActorCriticLaw, duration: float) -> tuple[Tensor, adp.Weights, Tensor]:
    """The laws and the plant as one differential equation, by Runge-Kutta on steps that start short."""
    controller = learner(law, adp.QuadraturePoints(7, 2, BOX))
    x = torch.tensor([[-1.0, 1.0]], dtype=torch.float64)
    y = (x, *controller.init(x)[:3], torch.zeros(1, dtype=torch.float64))
    none = x.new_zeros(1, 0, 2)

    def field(y: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        weights = adp.Weights(*y[1:4])
        terms = controller.terms(y[0], weights.actor, none)
        sums = law.sums(terms, controller.extrapolation.weights, weights)
        u = terms.control[:, 0]
        rate = PLANT.drift(y[0]) + (PLANT.effectiveness(y[0]) @ u.unsqueeze(-1)).squeeze(-1)
        return (rate, *law.rates(sums, weights), terms.rate[:, 0])

    def ahead(y: tuple[Tensor, ...], k: tuple[Tensor, ...], h: float) -> tuple[Tensor, ...]:
        return tuple(a + h * b for a, b in zip(y, k, strict=True))

    time = 0.0
    while time < duration - 1e-12:
        h = min(0.1, 1e-3 + 0.02 * time, duration - time)
        k1 = field(y)
        k2 = field(ahead(y, k1, h / 2))
        k3 = field(ahead(y, k2, h / 2))
        k4 = field(ahead(y, k3, h))
        y = tuple(
            a + h / 6 * (p + 2 * q + 2 * r + s) for a, p, q, r, s in zip(y, k1, k2, k3, k4, strict=True)
        )
        time += h
    return y[0], adp.Weights(*y[1:4]), y[4]


@torch.no_grad()
def test_quadrature_reaches_the_reference_weights_and_cost() -> None:
    x, weights, cost = continuous(adp.Information(), 10.0)
    expected = [[0.18516, 0.81528, -0.23605]], [[0.18363, 0.80854, -0.2341]]
    for part, numbers in zip((weights.critic, weights.actor), expected, strict=True):
        torch.testing.assert_close(part, torch.tensor(numbers, dtype=torch.float64), rtol=2e-4, atol=0)
    assert float(cost) == pytest.approx(2.798063, rel=2e-5)
    # The actor settles at ea1/(ea1 + ea2) of the critic, not at the critic.
    torch.testing.assert_close(
        weights.actor / weights.critic, torch.full((1, 3), 1.2 / 1.21).double(), rtol=1e-4, atol=0
    )
    assert x.norm() < 1e-5


@torch.no_grad()
def test_information_and_published_forms_are_one_law_in_continuous_time() -> None:
    short = [continuous(law, 0.05) for law in LAWS]
    torch.testing.assert_close(short[0][1].critic, short[1][1].critic, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(short[0][1].actor, short[1][1].actor, rtol=1e-3, atol=1e-4)
    product = short[0][1].gain @ short[1][1].gain
    torch.testing.assert_close(product, torch.eye(3, dtype=torch.float64).expand(1, 3, 3), rtol=0, atol=1e-3)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)
@torch.no_grad()
def test_step_tends_to_the_rate(law: ActorCriticLaw) -> None:
    generator = torch.Generator().manual_seed(3)
    controller = learner(law, adp.QuadraturePoints(3, 2, BOX))
    x = uniform(5, 1.0, seed=4)
    memory = adp.Weights(*controller.init(x)[:3])
    memory = memory._replace(critic=torch.randn(5, 3, dtype=torch.float64, generator=generator))
    terms = controller.terms(x, memory.actor, x.new_zeros(5, 0, 2))
    sums = law.sums(terms, controller.extrapolation.weights, memory)
    h = 1e-8
    for after, before, rate in zip(law.step(sums, memory, h), memory, law.rates(sums, memory), strict=True):
        torch.testing.assert_close((after - before) / h, rate, rtol=1e-4, atol=1e-3 * float(rate.abs().max()))


@pytest.mark.parametrize("dt", [0.001, 0.005])
def test_information_form_never_diverges_over_seeds(dt: float) -> None:
    x0 = torch.tensor([-1.0, 1.0], dtype=torch.float64).repeat(200, 1)
    duration = 10.0 if dt > 0.001 else 1.0  # whatever diverges does so in the first second
    run = adp.simulate(
        learner(adp.Information()),
        PLANT,
        COST,
        x0,
        dt=dt,
        steps=round(duration / dt),
        every=200,
        compile=True,
    )
    assert not run.diverged.any()
    assert (run.state[:, -1].norm(dim=-1) < (1e-3 if duration > 5 else 0.6)).all()


def test_published_form_loses_some_seeds_that_the_information_form_keeps() -> None:
    x0 = torch.tensor([-1.0, 1.0], dtype=torch.float64).repeat(200, 1)
    run = adp.simulate(
        learner(adp.Published()),
        PLANT,
        COST,
        x0,
        dt=0.001,
        steps=1000,
        every=1000,
        integrator="euler",
        compile=True,
    )
    assert 0.15 <= float(run.diverged.double().mean()) <= 0.35  # MATH.md: 25 %
    assert torch.isfinite(run.state).all()
    assert torch.isfinite(run.critic_weights).all()


def test_all_states_of_the_unit_box_are_regulated() -> None:
    run = adp.simulate(
        learner(adp.Information()), PLANT, COST, uniform(200, 1.0, seed=5), dt=0.005, steps=2000, every=2000
    )
    assert not run.diverged.any()
    assert (run.state[:, -1].norm(dim=-1) < 1e-3).all()


def test_random_extrapolation_costs_what_the_reference_says() -> None:
    x0 = torch.tensor([-1.0, 1.0], dtype=torch.float64).repeat(40, 1)
    run = adp.simulate(
        learner(adp.Information()), PLANT, COST, x0, dt=0.001, steps=2500, every=2500, compile=True
    )
    assert 2.82 <= float(run.cost.median()) <= 2.85
    assert float(run.cost.min()) > 2.79
    assert float(run.cost.max()) < 2.87


def test_information_matrix_stays_positive_definite() -> None:
    law, controller = adp.Information(), learner(adp.Information())
    x = uniform(20, 1.0)
    memory = controller.init(x)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for _ in range(200):
            draw = 2 * torch.rand(20, 1, 2, dtype=torch.float64, generator=generator) - 1
            _, memory = controller.step(x, memory, draw, 0.05)
            assert (torch.linalg.eigvalsh(memory.gain)[:, 0] > 0).all()
    assert law.bound is None


@pytest.mark.parametrize(
    "law", [adp.Information(bound=0.5), adp.Published(bound=0.5)], ids=["information", "published"]
)
def test_projection_keeps_the_weights_in_their_ball(law: ActorCriticLaw) -> None:
    run = adp.simulate(learner(law), PLANT, COST, uniform(10, 1.0), dt=0.01, steps=80, every=1)
    for weights in (run.critic_weights, run.actor_weights):
        norms = weights[:, 1:].norm(dim=-1)
        assert norms.max() <= 0.5 + 1e-12
    assert float(run.critic_weights[:, 1:].norm(dim=-1).max()) == pytest.approx(0.5)


def test_optimal_weights_of_the_quadratic_basis_stay_put_but_for_the_actor_decay() -> None:
    gains = adp.Gains(actor_decay=0.0, critic=0.0, critic_extrapolated=0.25)
    basis = adp.QuadraticBasis(2)
    start = [0.5, 0.0, 1.0]
    controller = adp.ActorCritic(
        basis, PLANT, COST, adp.RandomPoints(1, BOX), adp.Information(gains), critic=start, actor=start
    )
    x = uniform(20, 1.0)
    memory = controller.init(x)
    terms = controller.terms(x, memory.actor, uniform(20, 1.0, seed=2).unsqueeze(1))
    sums = controller.law.sums(terms, controller.extrapolation.weights, adp.Weights(*memory[:3]))
    assert isinstance(sums, BellmanSums)
    assert sums.critic_force.abs().max() < 1e-13


def test_global_basis_needs_points_in_a_fixed_box() -> None:
    x0, start = uniform(40, 2.0, seed=8), [1.0, 0.0, 1.0]
    settings = {"dt": 0.01, "steps": 1000, "every": 1000}
    shares = []
    for points in (adp.RandomPoints(1, 1.0, around="origin"), adp.RandomPoints(1, BOX)):
        basis = adp.QuadraticBasis(2)
        controller = adp.ActorCritic(basis, PLANT, COST, points, critic=start, actor=start)
        run = adp.simulate(controller, PLANT, COST, x0, **settings, compile=True)
        regulated = run.state[:, -1].norm(dim=-1) < 1e-3
        shares.append(float(regulated.double().mean()))
        if len(shares) == 1:
            assert 1.0 < float((run.cost / PLANT.optimal_value(x0, COST.q, COST.r)).median()) < 1.05
    assert shares[0] == 1.0
    assert shares[1] < 0.9


def test_partial_gradient_is_the_same_law_from_twice_the_weights() -> None:
    x0 = uniform(20, 1.0, seed=5)
    costs = []
    for mode, scale in (("total", 1.0), ("partial", 2.0)):
        controller = adp.ActorCritic(
            staf_basis(mode), PLANT, COST, adp.RandomPoints(1, BOX), critic=0.4 * scale, actor=0.28 * scale
        )
        compile = mode == "total"  # the program of other tests
        run = adp.simulate(controller, PLANT, COST, x0, dt=0.01, steps=200, every=200, compile=compile)
        assert not run.diverged.any()
        costs.append(run.cost)
    assert float(costs[1].median()) < 1.3 * float(costs[0].median())


def test_three_states_cost_in_their_first_second_what_the_reference_run_does() -> None:
    directions = torch.tensor(
        [
            [0, 1, 0], [0.8660, -0.5, 1], [-0.8660, -0.5, -0.25], [1, 1, 0],
            [0, 0, 0], [1, 1, 1], [1, 0, 0.5], [-1, 1, -0.25],
        ]
    ).double() / 3**0.5  # fmt: skip
    centers = StateFollowingCenters(directions, StateRadius(0.08 * 3**0.5, 0.0, 2.0))
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(ExponentialKernel()), centers))
    plant, cost = systems.ThreeState(), adp.QuadraticCost(10.0, 1.0, 3, 2)
    gains = adp.Gains(0.001, 10.0, 15.0, 0.001, 1e-4, 0.5)
    points = adp.RandomPoints(1, 0.24)
    law = adp.Information(gains)
    controller = adp.ActorCritic(basis, plant, cost, points, law, critic=1.0, actor=0.85, gain=100.0)
    x0 = torch.tensor([[-0.5, 0.5, -0.25]], dtype=torch.float64).repeat(10, 1)
    run = adp.simulate(controller, plant, cost, x0, dt=0.002, steps=500, every=500, compile=True)
    assert not run.diverged.any()
    # At 1 ms 3.11 to 3.13, of 9.22 after 50 s (MATH.md: 9.18 to 9.30): `staf experiment=adp_three_state`.
    assert float(run.cost.median()) == pytest.approx(3.13, abs=0.03)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: adp.Gains(critic=-1.0), r"`Gains\(critic=...\)` must not be negative; got -1.0"),
        (lambda: adp.RandomPoints(0, 0.1), r"`RandomPoints\(count=...\)` must be at least 1"),
        (
            lambda: adp.RandomPoints(1, 0.1, "still"),
            r"`RandomPoints\(centers=...\)` must be 'moving' or 'fixed'",
        ),
        (lambda: staf_basis("both"), r"`StaFValueBasis\(gradient=...\)` must be one of 'total', 'partial'"),
        (lambda: adp.Information(bound=0.0), r"`Information\(bound=...\)` must be positive"),
        (lambda: adp.RBFGridBasis(2, points=1), r"`RBFGridBasis\(points=...\)` must be at least 2"),
        (
            lambda: adp.ActorCritic(staf_basis(), PLANT, COST, adp.RandomPoints(1, BOX), critic=[1.0]),
            r"`ActorCritic\(critic=...\)` must have 3 entries",
        ),
        (
            lambda: adp.ActorCritic(adp.QuadraticBasis(3), PLANT, COST, adp.RandomPoints(1, BOX)),
            r"`ActorCritic\(basis=...\)` has 3 states, but the plant has 2",
        ),
        (
            lambda: adp.ActorCritic(staf_basis(), PLANT, COST, adp.QuadraturePoints(2, 3, BOX)),
            r"`ActorCritic\(extrapolation=...\)` must make points \(B, N, 2\) around states \(B, 2\)",
        ),
        (
            lambda: adp.ActorCritic(
                staf_basis(), PLANT, adp.QuadraticCost(1.0, 1.0, 2, 1, discount=0.1), adp.RandomPoints(1, BOX)
            ),
            r"`ActorCritic\(cost=...\)` must have no discount",
        ),
    ],
)
def test_bad_arguments_are_refused_by_name(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]


@pytest.mark.parametrize("shape", [(3,), (3, 2), (1, 3, 1)])
def test_gains_of_rows_have_one_number_a_row(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"`Gains\(critic=...\)` must be a number or of the shape \(B, 1\)"):
        adp.Gains(critic=torch.ones(shape))
    assert adp.Gains(critic=torch.ones(3, 1)).critic.shape == (3, 1)


def test_what_an_actor_critic_needs_of_its_plant_is_told() -> None:
    points, basis = adp.QuadraturePoints(3, 2, BOX), adp.QuadraticBasis(2)
    steps = systems.StepPlant(lambda x, u: x + u, dim=2, inputs=1, dt=0.1)
    with pytest.raises(ValueError, match=r"`ActorCritic\(model=...\)` must be a ControlAffineSystem"):
        adp.ActorCritic(basis, steps, COST, points)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"`ActorCritic\(basis=...\)` has 2 states, but the plant has 3"):
        adp.ActorCritic(basis, systems.ThreeState(), COST, points)
