"""Laws, bases, points and feedbacks beside loops over rows and points that are written out."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

import staf_torch as st
from staf_torch import adp, systems
from staf_torch.adp.bases import ValueBasis
from staf_torch.adp.bellman import BellmanTerms
from staf_torch.adp.laws import ActorCriticLaw, solve_definite
from staf_torch.adp.rollout import ball_directions
from staf_torch.centers import Radius

PLANT, COST = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
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
WEIGHTS = adp.Weights(uniform(B, M, seed=6), uniform(B, M, seed=7), ROOT @ ROOT.mT + torch.eye(M).double())


def gains_of(rows: bool) -> tuple[adp.Gains, list[dict[str, float]]]:
    """The same for all rows, or of each row its own, as the library and as dictionaries."""
    if not rows:
        return adp.Gains(**GAINS), [GAINS] * B
    each = [{name: value * (1 + 0.3 * b) for name, value in GAINS.items()} for b in range(B)]
    columns = {name: tensor([[row[name]] for row in each]) for name in GAINS}
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
    start = WEIGHTS._replace(critic=WEIGHTS.critic * tensor([[0.1], [1.0], [9.0]]))
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
    for wrong in (0.0, -1.0):
        with pytest.raises(ValueError, match=rf"`{kind.__name__}\(bound=...\)` must be positive"):
            kind(gains, wrong)


def test_gains_begin_as_published_and_a_law_keeps_what_it_is_given() -> None:
    start = uniform(2, 3, seed=1), uniform(2, 3, seed=2), 4 * torch.eye(3).double().expand(2, 3, 3)
    assert torch.equal(adp.Published().init(*start).gain, start[2])
    torch.testing.assert_close(adp.Information().init(*start).gain, start[2] / 16)
    assert torch.equal(adp.PolicyIteration().init(*start).gain, start[2])
    usual = adp.PolicyIteration().gains
    assert (usual.critic, usual.critic_extrapolated, usual.actor) == (1.0, 1.0, 100.0)
    assert (usual.actor_decay, usual.normalisation) == (0.0, 0.0)
    for name in GAINS:
        assert getattr(adp.Gains(**{name: 0.0}), name) == 0.0
        for wrong in (-1e-9, tensor([[1.0], [-1.0]])):
            with pytest.raises(ValueError, match=rf"`Gains\({name}=...\)` must not be negative"):
                adp.Gains(**{name: wrong})
        with pytest.raises(ValueError, match=rf"`Gains\({name}=...\)` must be finite"):
            adp.Gains(**{name: math.inf})


@pytest.mark.parametrize("size", [1, 2, 5, 12, 13, 20])
def test_definite_systems_are_solved_in_every_size(size: int) -> None:
    root = uniform(4, 2, size, size, seed=size)
    matrix, right = root @ root.mT + torch.eye(size).double(), uniform(4, 2, size, seed=1)
    found = solve_definite(matrix, right)
    torch.testing.assert_close((matrix @ found.unsqueeze(-1)).squeeze(-1), right, rtol=1e-9, atol=1e-10)
    matrix[0, 0] = torch.nan
    spoiled = solve_definite(matrix, right)
    assert not bool(torch.isfinite(spoiled[0, 0]).any())
    torch.testing.assert_close(spoiled[1:], found[1:])


# --- bases --------------------------------------------------------------------------------------------------


def test_quadratic_functions_are_the_products_of_the_coordinates() -> None:
    y = uniform(4, 3, seed=1)
    pairs = list(itertools.combinations_with_replacement(range(3), 2))
    basis = adp.QuadraticBasis(3)
    assert (basis.count, basis.dim, basis.follows_state) == (6, 3, False)
    torch.testing.assert_close(basis(y, 9 * y), torch.stack([y[:, i] * y[:, j] for i, j in pairs], -1))
    torch.testing.assert_close(
        basis.value(torch.arange(6).double(), y), (torch.arange(6) * basis(y, y)).sum(-1)
    )
    weights = dict(zip(pairs, basis.weights_near_square(), strict=True))
    for (i, j), weight in weights.items():
        assert weight == pytest.approx(float(i == j), abs=1e-9)


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("width", [None, 0.7])
def test_bumps_on_a_grid_are_those_of_the_formula(width: float | None, flat: bool) -> None:
    basis = adp.RBFGridBasis(2, 3, 1.5, width, flat=flat)
    wide = 1.5 if width is None else width
    y = uniform(4, 2, seed=1)
    columns = []
    for c in itertools.product((-1.5, 0.0, 1.5), repeat=2):
        center = tensor(c)
        zero = math.exp(-float(center @ center) / (2 * wide**2))
        bump = (-(y - center).square().sum(-1) / (2 * wide**2)).exp()
        columns.append(bump - zero - ((y @ center) * zero / wide**2 if flat else 0.0))
    torch.testing.assert_close(basis(y, y), torch.stack(columns, -1))
    slopes = torch.func.vmap(torch.func.jacrev(lambda at: basis(at, at)))(y)
    torch.testing.assert_close(basis.gradient(y, y), slopes)
    usual = adp.RBFGridBasis(2)
    assert (usual.count, usual.width, float(usual.centers.max())) == (25, 1.0, 2.0)
    assert bool(usual.slope.any())
    assert adp.RBFGridBasis(1, 2, 1.0).count == 2


class Growing(Radius):
    """A user's radius: of its slope the library knows nothing."""

    def forward(self, x: Tensor) -> Tensor:
        return 0.2 + 0.3 * x[..., 0].square()


@pytest.mark.parametrize("mode", ["total", "partial"])
@pytest.mark.parametrize(
    "radius", [0.4, st.StateRadius(0.7, 0.2, gain=1.5), Growing()], ids=["constant", "shrinking", "own"]
)
@pytest.mark.parametrize(
    "kernel",
    [st.AnchoredKernel(st.ExponentialKernel()), st.GaussianKernel(0.8)],
    ids=["anchored", "gaussian"],
)
def test_functions_around_the_state_and_their_slopes(kernel: st.Kernel, radius: Any, mode: str) -> None:
    centers = st.StateFollowingCenters(st.rings(3), radius)
    basis = adp.StaFValueBasis(st.StaFBasis(kernel, centers), mode)
    x, y = uniform(4, 2, seed=1), uniform(4, 2, seed=2)
    assert basis.follows_state
    torch.testing.assert_close(basis(y, x), kernel(y.unsqueeze(-2), centers(x)).squeeze(-2))
    for at in (x, y):
        found, h = basis.gradient(at, x), 1e-6
        for k in range(2):
            move = h * torch.eye(2)[k].double()
            along = move if mode == "total" else 0 * move
            slope = (basis(at + move, x + along) - basis(at - move, x - along)) / (2 * h)
            torch.testing.assert_close(found[..., k], slope, rtol=1e-6, atol=1e-8)
    assert basis.gradient(y, x).shape == (4, 3, 2)


def test_leading_coordinates_are_those_of_the_error() -> None:
    basis = adp.LeadingCoordinates(adp.QuadraticBasis(2), 4)
    y, x = uniform(3, 4, seed=1), uniform(3, 4, seed=2)
    inner = adp.QuadraticBasis(2)
    torch.testing.assert_close(basis(y, x), inner(y[:, :2], x[:, :2]))
    found = basis.gradient(y, x)
    torch.testing.assert_close(found[..., :2], inner.gradient(y[:, :2], x[:, :2]))
    assert not found[..., 2:].any()
    assert adp.LeadingCoordinates(adp.QuadraticBasis(2), 2).dim == 2
    with pytest.raises(ValueError, match=r"`LeadingCoordinates\(dim=...\)` must be at least 2"):
        adp.LeadingCoordinates(adp.QuadraticBasis(2), 1)


def test_a_start_near_the_square_is_of_a_thousand_points_of_a_seed() -> None:
    class Asked(adp.QuadraticBasis):
        seen: Tensor

        def forward(self, y: Tensor, x: Tensor) -> Tensor:
            self.seen = y
            return super().forward(y, x)

    basis: ValueBasis = Asked(2)
    basis.weights_near_square()
    draw = torch.rand(1000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(basis.seen, 2 * draw - 1)


# --- extrapolated points ------------------------------------------------------------------------------------


@pytest.mark.parametrize("around", ["state", "origin"])
def test_points_are_the_cube_scaled_around_the_state_or_the_origin(around: str) -> None:
    x = uniform(3, 2, seed=1)
    middle = x if around == "state" else 0 * x
    drawn = uniform(3, 4, 2, seed=2)
    points = adp.RandomPoints(4, 0.3, around=around)
    torch.testing.assert_close(points(x, drawn), middle.unsqueeze(1) + 0.3 * drawn)
    assert (points.count, points.draws, points.moving, points.weights.tolist()) == (4, 4, True, [0.25] * 4)
    rule = adp.QuadraturePoints(3, 2, 0.3, "fixed", around=around)
    node = math.sqrt(0.6)
    grid = tensor(list(itertools.product((-node, 0.0, node), repeat=2)))
    torch.testing.assert_close(rule(x, x.new_zeros(3, 0, 2)), middle.unsqueeze(1) + 0.3 * grid)
    masses = [a * b / 4 for a, b in itertools.product((5 / 9, 8 / 9, 5 / 9), repeat=2)]
    torch.testing.assert_close(rule.weights, tensor(masses))
    assert (rule.count, rule.draws, rule.moving) == (9, 0, False)
    if around == "state":
        shrinking = st.StateRadius(0.5, 0.1)
        found = adp.RandomPoints(4, shrinking)(x, drawn)
        torch.testing.assert_close(found, x.unsqueeze(1) + shrinking(x)[:, None, None] * drawn)
    else:
        with pytest.raises(
            ValueError, match=r"\(half_width=...\)` must be constant for a box around the origin"
        ):
            adp.RandomPoints(4, st.StateRadius(0.5, 0.1), around="origin")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: adp.RandomPoints(1, 0.3, around="here"), r"`RandomPoints\(around=...\)` must be one of"),
        (lambda: adp.QuadraturePoints(0, 2, 0.3), r"`QuadraturePoints\(order=...\)` must be at least 1"),
        (lambda: adp.QuadraturePoints(1, 0, 0.3), r"`QuadraturePoints\(dim=...\)` must be at least 1"),
        (lambda: adp.QuadraturePoints(1, 1, 0.3, "x"), r"`QuadraturePoints\(centers=...\)` must be 'moving'"),
        (lambda: adp.StaFValueBasis(3), r"`StaFValueBasis\(basis=...\)` must be a StaFBasis; got 3"),  # type: ignore[arg-type]
        (lambda: adp.PolicyIteration(damping=0.0), r"`PolicyIteration\(damping=...\)` must be positive"),
        (lambda: adp.PolicyIteration(settling=0.0), r"`PolicyIteration\(settling=...\)` must be positive"),
    ],
)
def test_points_bases_and_laws_refuse_what_they_are_not(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


# --- feedbacks ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("trust", [0.5, 1.0])
def test_a_supervised_control_is_drawn_to_the_lqr_by_the_norm_of_its_cost(trust: float) -> None:
    r = tensor([[1.0, 0.3], [0.3, 2.0]])
    plant = systems.Linear([[0.0, 1.0], [1.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]])
    cost = adp.QuadraticCost(1.0, r, 2, 2, target=[0.5, 0.0])
    lqr = adp.LQR(plant, cost)
    guard = adp.Supervised(adp.Feedback(lambda x: 9 * x), lqr, cost, trust)
    x, u = uniform(6, 2, seed=1), 3 * uniform(6, 2, seed=2)
    u[0] = lqr(x[0]) * 1.01
    rest = tensor([0.0, -0.5])  # holds the plant at (0.5, 0)
    found = guard.restrain(x, u)
    for row in range(6):
        base = lqr(x[row])
        apart, effort = u[row] - base, base - rest
        allowed, wanted = trust * math.sqrt(effort @ r @ effort), math.sqrt(apart @ r @ apart)
        share = min(1.0, allowed / wanted)
        torch.testing.assert_close(found[row], base + share * apart)
    assert guard.label == "supervised <lambda>"
    carried = guard.init(x)
    torch.testing.assert_close(guard.step(x, carried, x.new_zeros(6, 0, 2), 0.1)[0], guard.restrain(x, 9 * x))
    for wrong in (0.0, 1.0 + 1e-9):
        with pytest.raises(ValueError, match=r"`Supervised\(trust=...\)` must be in \(0, 1\]"):
            adp.Supervised(adp.Feedback(lqr), lqr, cost, wrong)


def test_a_feedback_has_the_name_the_period_and_the_value_of_its_policy() -> None:
    lqr = adp.LQR(PLANT, COST, period=0.2)
    assert (adp.Feedback(lqr).label, adp.Feedback(lqr).period) == ("LQR", 0.2)
    plain = adp.Feedback(np.negative)
    assert (plain.label, plain.period) == ("negative", None)
    x = uniform(3, 2, seed=1)
    assert plain.value(x, plain.init(x)) is None
    torch.testing.assert_close(adp.Feedback(lqr, lqr.value).value(x, plain.init(x)), lqr.value(x))
    assert [tuple(part.shape) for part in plain.init(x)] == [(3, 0), (3, 0), (3, 0, 0), (3, 0)]
    guarded = adp.Supervised(adp.Feedback(lqr, lqr.value), lqr, COST)
    assert (guarded.period, guarded.draws) == (0.2, 0)
    torch.testing.assert_close(guarded.value(x, plain.init(x)), lqr.value(x))


def test_directions_of_a_rollout_are_as_many_as_quadratics_need() -> None:
    for given, dim, count in (
        (None, 1, 3),
        (None, 2, 6),
        (None, 3, 10),
        (None, 4, 9),
        (None, 6, 13),
        (5, 2, 5),
        (7, 4, 7),
    ):
        assert ball_directions(given, dim).shape == (count, dim)
    assert torch.equal(ball_directions(None, 2), st.rings(6))
    assert not ball_directions(None, 5)[-1].any()


def test_a_rollout_costs_the_integral_along_its_way_and_the_end() -> None:
    """Of a linear plant under a linear policy, whose integral is known."""
    plant = systems.Linear([[0.0, 1.0], [-1.0, -0.5]], [[0.0], [1.0]])
    gain = tensor([[0.3, 0.4]])
    basis = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.rings(6), 0.2))
    cost = adp.QuadraticCost(2.0, 0.5, dim=2, inputs=1)
    end = tensor([[3.0, 0.5], [0.5, 1.0]])
    policy = adp.RolloutPolicy(
        basis, plant, cost, lambda x: -x @ gain.mT, lambda x: ((x @ end) * x).sum(-1), horizon=0.8, steps=9
    )
    closed = plant.matrix - plant.input_matrix @ gain
    paid = torch.eye(2).double() * 2.0 + 0.5 * gain.mT @ gain
    times = torch.linspace(0, 0.8, 4001, dtype=torch.float64)
    flows = torch.linalg.matrix_exp(times[:, None, None] * closed)
    kernel = torch.trapezoid(flows.mT @ paid @ flows, dx=0.8 / 4000, dim=0) + flows[-1].mT @ end @ flows[-1]
    x = uniform(3, 4, 2, seed=1)
    torch.testing.assert_close(policy.rollout(x), ((x @ kernel) * x).sum(-1), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(policy.rollout(x[0, 0]), policy.rollout(x)[0, 0])
    at = x[0]
    torch.testing.assert_close(policy.value(at), ((at @ kernel) * at).sum(-1), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(policy.gradient(at), 2 * at @ kernel, rtol=2e-2, atol=2e-2)
    torch.testing.assert_close(policy.control(at), -policy.gradient(at) @ plant.input_matrix / (2 * 0.5))
