"""The actor-critic laws row by row beside loops that are written out, and their reference numbers."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import changed, tensor, uniform
from helpers_adp import BOX, COST, LAWS, PLANT, learner
from torch import Tensor

from staf_torch import adp, rows, systems
from staf_torch.adp.critic.laws import ActorCriticLaw, BellmanTerms, Weights, solve_definite
from staf_torch.numerics.runge_kutta import runge_kutta_step

GAINS = {
    "critic": 0.3,
    "critic_extrapolated": 0.7,
    "actor": 1.3,
    "actor_decay": 0.2,
    "forgetting": 0.4,
    "normalisation": 0.6,
    "information": 1.7,
    "information_extrapolated": 0.9,
}
B, P, M = 3, 4, 3
TERMS = BellmanTerms(
    uniform(B, P, 1, seed=1), uniform(B, P, M, seed=2), uniform(B, P, seed=3).abs(), uniform(B, P, M, seed=4)
)
MASSES = tensor([0.5, 0.3, 0.2])
ROOT = uniform(B, M, M, seed=5)
WEIGHTS = Weights(uniform(B, M, seed=6), uniform(B, M, seed=7), ROOT @ ROOT.mT + torch.eye(M).double())


def gains_of(own: bool) -> tuple[adp.Gains, list[dict[str, float]]]:
    """The same for all rows, or of each row its own, as the library and as dictionaries."""
    if not own:
        return adp.Gains(**GAINS), [GAINS] * B
    each = [{name: value * (1 + 0.3 * b) for name, value in GAINS.items()} for b in range(B)]
    columns = {name: rows(tensor([row[name] for row in each])) for name in GAINS}
    return adp.Gains(**columns), each


def summed(b: int, g: dict[str, float]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    critic = WEIGHTS.critic[b]
    force, actor = torch.zeros(M).double(), torch.zeros(M).double()
    curvature, information = torch.zeros(M, M).double(), torch.zeros(M, M).double()
    for j in range(P):
        a = g["critic"] if j == 0 else g["critic_extrapolated"] * float(MASSES[j - 1])
        k = g["information"] if j == 0 else g["information_extrapolated"] * float(MASSES[j - 1])
        w = TERMS.regressor[b, j]
        rho = 1 + g["normalisation"] * float(w @ w)
        delta = float(TERMS.rate[b, j] + w @ critic)
        force = force + a * w * delta / rho
        curvature = curvature + a * torch.outer(w, w) / rho
        information = information + k * torch.outer(w, w) / rho**2
        actor = actor + a * TERMS.push[b, j] * float(w @ critic) / (4 * rho)
    return force, curvature, information, actor


@pytest.mark.parametrize("rows", [False, True])
@pytest.mark.parametrize("kind", [adp.Information, adp.Published, adp.PolicyIteration])
def test_laws_are_their_equations_row_by_row(kind: type[ActorCriticLaw], rows: bool) -> None:
    gains, each = gains_of(rows)
    law = kind(gains)
    sums = law.sums(TERMS, MASSES, WEIGHTS)
    h = 0.05
    rates, after = law.rates(sums, WEIGHTS), law.step(sums, WEIGHTS, h)
    for b, g in enumerate(each):
        force, curvature, information, push = summed(b, g)
        for found, wanted in zip(sums, (force, curvature, information, push), strict=True):
            torch.testing.assert_close(found[b], wanted)
        critic, actor, gain = (part[b] for part in WEIGHTS)
        pull = -g["actor"] * (actor - critic) - g["actor_decay"] * actor
        one = torch.eye(M).double()
        if kind is adp.Published:
            wanted = (
                -gain @ force,
                pull + push,
                g["forgetting"] * gain - gain @ information @ gain,
            )
            stepped = tuple(w + h * rate for w, rate in zip((critic, actor, gain), wanted, strict=True))
        elif kind is adp.Information:
            wanted = (
                -torch.linalg.solve(gain, force),
                pull + push,
                information - g["forgetting"] * gain,
            )
            kept = math.exp(-g["forgetting"] * h) * gain + h * information
            moved = critic - torch.linalg.solve(kept + h * curvature, h * force)
            followed = (actor + h * (g["actor"] * moved + push)) / (1 + h * (g["actor"] + g["actor_decay"]))
            stepped = (moved, followed, kept)
        else:
            newton = -torch.linalg.solve(curvature + 1e-3 * one, force)
            wanted = (newton / 0.01, pull, 0 * gain)
            moved = critic + h / (0.01 + h) * newton
            followed = (actor + h * g["actor"] * moved) / (1 + h * (g["actor"] + g["actor_decay"]))
            stepped = (moved, followed, gain)
        for found, right in ((rates, wanted), (after, stepped)):
            for part, other in zip(found, right, strict=True):
                torch.testing.assert_close(part[b], other, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", [adp.Information, adp.Published, adp.PolicyIteration, adp.Frozen])
def test_weights_are_projected_onto_a_ball_and_what_is_inside_is_left(kind: type[ActorCriticLaw]) -> None:
    gains, _ = gains_of(False)
    free, bounded = kind(gains), kind(gains, 1.0)
    sums = free.sums(TERMS, MASSES, WEIGHTS)
    start = changed(WEIGHTS, critic=WEIGHTS.critic * tensor([[0.1], [1.0], [9.0]]))
    for found, wanted in zip(
        bounded.step(sums, start, 0.01)[:2], free.step(sums, start, 0.01)[:2], strict=True
    ):
        for row, other in zip(found, wanted, strict=True):
            size = float(other.norm())
            torch.testing.assert_close(row, other / max(size, 1.0))
    assert torch.equal(bounded.step(sums, start, 0.01).gain, free.step(sums, start, 0.01).gain)
    if kind is adp.Frozen:
        assert all(torch.equal(a, b) for a, b in zip(free.step(sums, start, 0.01), start, strict=True))
        assert not any(part.any() for part in free.rates(sums, start))
        assert all(torch.equal(a, b) for a, b in zip(free.init(*start), start, strict=True))


def test_gains_begin_as_published() -> None:
    start = uniform(2, 3, seed=1), uniform(2, 3, seed=2), 4 * torch.eye(3).double().expand(2, 3, 3)
    assert torch.equal(adp.Published().init(*start).gain, start[2])
    torch.testing.assert_close(adp.Information().init(*start).gain, start[2] / 16)
    assert torch.equal(adp.PolicyIteration().init(*start).gain, start[2])


@pytest.mark.parametrize("size", [1, 5, 12, 13])
def test_definite_systems_are_solved_in_every_size(size: int) -> None:
    root = uniform(4, 2, size, size, seed=size)
    matrix, right = root @ root.mT + torch.eye(size).double(), uniform(4, 2, size, seed=1)
    found = solve_definite(matrix, right)
    torch.testing.assert_close((matrix @ found.unsqueeze(-1)).squeeze(-1), right, rtol=1e-9, atol=1e-10)
    matrix[0, 0] = torch.nan
    spoiled = solve_definite(matrix, right)
    assert not bool(torch.isfinite(spoiled[0, 0]).any())
    torch.testing.assert_close(spoiled[1:], found[1:])


def continuous(law: ActorCriticLaw, duration: float) -> tuple[Tensor, Weights, Tensor]:
    """The laws and the plant as one differential equation, by Runge-Kutta on steps that start short."""
    controller = learner(law, adp.QuadraturePoints(7, 2, BOX))
    x = tensor([[-1.0, 1.0]])
    none, sizes = x.new_zeros(1, 0, 2), (2, 3, 3, 9, 1)

    def parts(y: Tensor) -> tuple[Tensor, Weights, Tensor]:
        x, critic, actor, gain, paid = y.split(sizes, dim=-1)
        return x, Weights(critic, actor, gain.unflatten(-1, (3, 3))), paid

    def field(y: Tensor) -> Tensor:
        x, weights, _ = parts(y)
        terms = controller.terms(x, weights.actor, none)
        sums = law.sums(terms, controller.extrapolation.weights, weights)
        moved = [PLANT.motion(x, terms.control[:, 0]), *law.rates(sums, weights), terms.rate[:, :1]]
        return torch.cat([part.flatten(1) for part in moved], dim=-1)

    y = torch.cat([part.flatten(1) for part in (x, *controller.init(x)[:3], x.new_zeros(1, 1))], dim=-1)
    time = 0.0
    while time < duration - 1e-12:
        h = min(0.1, 1e-3 + 0.05 * time, duration - time)
        y, time = runge_kutta_step(field, y, h), time + h
    return parts(y)


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
    short = [continuous(law, 0.02) for law in LAWS]
    torch.testing.assert_close(short[0][1].critic, short[1][1].critic, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(short[0][1].actor, short[1][1].actor, rtol=1e-3, atol=1e-4)
    product = short[0][1].gain @ short[1][1].gain
    torch.testing.assert_close(product, torch.eye(3, dtype=torch.float64).expand(1, 3, 3), rtol=0, atol=1e-3)


def test_information_matrix_stays_positive_definite() -> None:
    controller, x, uniforms = (
        learner(adp.Information()),
        uniform(20, 2, seed=0),
        uniform(60, 20, 1, 2, seed=1),
    )
    memory = controller.init(x)
    with torch.no_grad():
        for each in uniforms:
            _, memory = controller.step(x, memory, each, 0.05)
            assert (torch.linalg.eigvalsh(memory.gain)[:, 0] > 0).all()


# --- policy iteration ---------------------------------------------------------------------------------------


def iterating(
    plant: systems.ControlAffineSystem, critic: list[float], law: ActorCriticLaw
) -> adp.ActorCritic:
    points = adp.QuadraturePoints(3, 2, half_width=0.5)
    return adp.ActorCritic(adp.QuadraticBasis(2), plant, COST, points, law, critic=critic, actor=critic)


def held(control: adp.ActorCritic, x: Tensor, steps: int) -> Tensor:
    """The critic weights after so many steps at a state that does not move."""
    carried = control.init(x)
    for _ in range(steps):
        carried = control.step(x, carried, x.new_zeros(len(x), 0, 2), 0.01)[1]
    return carried.critic


def test_weights_that_solve_the_hjb_equation_stay() -> None:
    exact = [0.5, 0.0, 1.0]  # of V*
    x = uniform(40, 2, low=-2, high=2, seed=3)
    found = held(iterating(PLANT, exact, adp.PolicyIteration()), x, 20)
    torch.testing.assert_close(found, torch.tensor(exact).double().expand(len(x), 3), rtol=0, atol=1e-10)


@pytest.mark.parametrize("start", [[3.0, 2.0, 2.0], [1.0, 2.0, 4.0]])
def test_a_linear_plant_gets_the_riccati_value_from_any_stabilising_start(start: list[float]) -> None:
    plant = systems.Linear([[0.0, 1.0], [0.3, 0.2]], [[0.0], [1.0]])
    p = adp.LQR(plant, COST).p
    wanted = torch.stack((p[0, 0], 2 * p[0, 1], p[1, 1]))
    found = held(
        iterating(plant, start, adp.PolicyIteration(damping=1e-9, settling=1e-9)), uniform(5, 2, seed=0), 40
    )
    torch.testing.assert_close(found, wanted.expand(5, 3), rtol=1e-6, atol=1e-6)
