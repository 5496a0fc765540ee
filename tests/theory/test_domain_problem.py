"""What the proof for the exponential kernel asks of polynomials, piece by piece, and where it gives up."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest
import torch
from helpers import tensor
from torch import Tensor

from staf_torch import targets, theory
from staf_torch.theory.exponential_bound import Construction, DomainProblem, Functions
from staf_torch.theory.uniform_approximation import near_best

PAPER = targets.Paper()
MODULE = DomainProblem.smallest_degree.__globals__
STATES = theory.disc(1.0, count=5)


def problem(
    target: object = PAPER,
    states: Tensor = STATES,
    radius: float = 0.2,
    epsilon: float = 0.05,
    max_degree: int = 16,
) -> DomainProblem:
    return DomainProblem("a test", target, torch.float64, states, radius, epsilon, max_degree)  # type: ignore[arg-type]


@pytest.mark.parametrize("fineness", [1, 2, 3])
@pytest.mark.parametrize("degree", [0, 1, 4, 9])
def test_points_of_a_ball_are_as_many_as_is_said(degree: int, fineness: int) -> None:
    shells = degree + 2 + 2 * fineness
    for dim in (1, 2, 3, 4):
        each = {1: 2, 2: fineness * 12 * (degree + 1)}.get(
            dim, fineness * math.ceil(6 * math.comb(dim + degree, degree) / shells)
        )
        states = torch.zeros(1, dim, dtype=torch.float64)
        assert len(problem(states=states).offsets(degree, fineness)) == 1 + shells * each


def test_the_target_is_asked_on_a_grid_for_its_size_for_the_fit_and_a_finer_one_for_the_error() -> None:
    sizes: list[int] = []

    def target(y: Tensor) -> Tensor:
        sizes.append(y.shape[-2])
        return 1.0 + 0 * y[..., 0]

    built = theory.one_polynomial_bound(target, torch.zeros(1, 2).double(), 0.3, 0.1)
    assert built.degree == 0
    coarse, fine = 1 + 4 * 12, 1 + 8 * 36  # of degree 0
    climbs = [size for size in sizes if size not in (coarse, fine)]
    assert sizes == [coarse, fine, *climbs[:16], fine, *climbs[16:]]
    assert len(climbs) == 32
    sizes.clear()
    problem(target, torch.zeros(1, 2).double()).norms()
    assert sizes == [1 + 10 * 2 * 60]  # of degree 4, twice as fine


@pytest.mark.parametrize("states", [STATES, tensor([[0.3, -0.8]]), theory.disc(0.5, dim=1, count=3)])
@pytest.mark.parametrize("epsilon", [0.01, 0.4])
def test_tolerances_are_those_of_the_proof(states: Tensor, epsilon: float) -> None:
    """eps' / (2 A) and eps' / (2 A |V|), A = sup e^{y'x}, eps' + eps'^2 / (4 A |V|) = epsilon."""
    target = targets.Cosine(2.0) if states.shape[1] == 1 else PAPER
    given = problem(target, states, epsilon=epsilon)
    points = states.unsqueeze(1) + given.offsets(30, 3)
    size = float(target(points).abs().max())
    norms = states.norm(dim=-1)
    A = float((norms * (norms + 0.2)).max().exp())
    split = given.split()
    assert split + split**2 / (4 * A * size) == pytest.approx(epsilon, rel=1e-4)
    assert given.norms()[0] == pytest.approx(size, rel=1e-3)
    value, exponential, product = given.value(), given.exponential(), given.product()
    ones = torch.ones(len(states), dtype=torch.float64)
    torch.testing.assert_close(value.tolerance, split / (2 * A) * ones)
    shrink = (-states.square().sum(-1)).exp()  # e^{-x'x}, which is divided out
    wanted = split / (2 * A * given.norms()[0]) / shrink
    torch.testing.assert_close(exponential.tolerance, wanted)
    torch.testing.assert_close(product.tolerance, epsilon * ones)
    z = given.offsets(1, 1)
    growth = (states @ z.mT).exp()
    for functions, values, weight in (
        (value, target(states.unsqueeze(1) + z), torch.ones_like(growth)),
        (exponential, 1 / growth, torch.ones_like(growth)),
        (product, target(states.unsqueeze(1) + z) / growth, growth),
    ):
        torch.testing.assert_close(functions.evaluate(z), (values, weight))


def test_a_target_of_no_size_divides_nothing() -> None:
    zero = problem(lambda y: 0 * y[..., 0])
    assert zero.norms()[0] == 0.05
    assert bool(torch.isfinite(zero.exponential().tolerance).all())


@pytest.mark.parametrize("degree", [1, 3])
def test_a_degree_is_enough_with_a_hundredth_to_spare_and_not_without(degree: int) -> None:
    """Of what the fit leaves on the finer grid: the tolerance must be one per cent above it."""
    given = problem(states=tensor([[0.9, 0.4]]))
    free = given.product()
    z = given.offsets(degree, 1)
    best = float(near_best(z / 0.2, degree, *free.evaluate(z), tensor([1e-9])).lower)
    for _ in range(20):  # a tolerance that is met, but not well within
        fit = near_best(z / 0.2, degree, *free.evaluate(z), tensor([best]))
        best = 1.1 * float(fit.error)
    left = float(given.largest(free, degree, fit.coefficients))
    for share, found in ((1.005, degree + 1), (1.02, degree)):
        functions = Functions("V", free.evaluate, tensor([share * left]))
        assert given.smallest_degree(functions)[0] == found


def test_the_last_degree_that_is_allowed_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    bound = theory.exponential_bound(PAPER, STATES, 0.1, 1e-2)
    assert (bound.N, bound.S) == (2, 2)
    assert theory.exponential_bound(PAPER, STATES, 0.1, 1e-2, max_degree=2).N == 2
    with pytest.raises(ValueError, match=r"polynomials of degree 1 \(3 terms\)"):
        theory.exponential_bound(PAPER, STATES, 0.1, 1e-2, max_degree=1)
    assert theory.exponential_bound(lambda y: 0 * y[..., 0], STATES, 0.1, 1e-2, max_degree=0).N == 0
    monkeypatch.setitem(MODULE, "_MOST_TERMS", 6)
    assert theory.exponential_bound(PAPER, STATES, 0.1, 1e-2).N == 2
    monkeypatch.setitem(MODULE, "_MOST_TERMS", 5)
    with pytest.raises(ValueError, match=r"polynomials of degree 1 \(3 terms\)"):
        theory.exponential_bound(PAPER, STATES, 0.1, 1e-2)


def test_the_message_says_by_how_much_the_last_degree_fails() -> None:
    """V = y_1 around the origin: a constant leaves its mean square, and eps' / 2 is allowed."""
    split = 0.2 / (1 + math.sqrt(1 + 4 * 0.1 / (4 * 0.5)))
    with pytest.raises(ValueError, match="leave V an error of") as caught:
        theory.exponential_bound(lambda y: y[..., 0], torch.zeros(1, 2).double(), 0.5, 0.1, max_degree=0)
    said = re.search(
        r"of degree 0 \(1 terms\).*of ([0-9.]+) times what is allowed \(([0-9.]+)\)", str(caught.value)
    )
    assert said is not None
    assert float(said[2]) == pytest.approx(split / 2, rel=1e-2)
    z = problem(states=torch.zeros(1, 2).double(), radius=0.5).offsets(0, 1)
    assert float(said[1]) == pytest.approx(float(z[:, 0].square().mean().sqrt()) / (split / 2), rel=1e-2)


def tightest(given: DomainProblem) -> tuple[DomainProblem, Construction]:
    """With an epsilon that the polynomials just meet: exponentials need a large m."""
    degree, g = given.smallest_degree(given.product())
    left = float(given.largest(given.product(), degree, g).max())
    close = given._replace(epsilon=1.01 * left * 1.002)
    return close, close.construct((g,), (degree,))


def test_centers_come_closer_by_halves_until_the_error_is_small_enough(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    close, built = tightest(problem(states=STATES[:2]))
    first = math.floor(built.degree / 0.2) + 1
    halvings = math.log2(built.m / first)
    assert halvings == int(halvings) >= 4
    assert built.m > 200
    grid = close.offsets(built.degree, 3)
    assert close.error_of(built, grid) == built.error <= close.epsilon
    for k in range(int(halvings)):
        assert close.error_of(dataclasses.replace(built, m=first * 2**k), grid) > close.epsilon
    monkeypatch.setitem(MODULE, "_LARGEST_M", built.m // 2)  # past which none is tried
    assert close.construct(built.factors, built.degrees).m == built.m
    monkeypatch.setitem(MODULE, "_LARGEST_M", built.m // 2 - 1)
    with pytest.raises(ValueError, match=rf"met by the polynomials.*but not.*centers 1/{built.m // 2} apart"):
        close.construct(built.factors, built.degrees)


def test_degree_over_radius_that_is_whole_takes_one_more() -> None:
    """|l| / m < r, strictly: the farthest center is in the open ball."""
    built = problem(lambda y: y[..., 0], torch.zeros(1, 2).double(), 0.25, 0.9).construct(
        (tensor([[0.0, 0.25, 0.0]]),), (1,)
    )
    assert built.m == 5


@pytest.mark.parametrize("kind", [Construction, theory.ExponentialBound, theory.MinimalCount])
def test_what_is_found_is_not_changed(kind: type) -> None:
    found = object.__new__(kind)
    for name in kind.__dataclass_fields__:  # type: ignore[attr-defined]
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(found, name, None)


@pytest.mark.parametrize("shape", [(1, 1, 4, 2), (4, 4, 2)])
def test_offsets_of_a_construction_are_of_its_states(shape: tuple[int, ...]) -> None:
    built = theory.one_polynomial_bound(PAPER, STATES, 0.1, 0.1)
    with pytest.raises(
        ValueError, match=r"Construction\(z=...\)` must have the shape \(P, n\) or \(D, P, n\)"
    ):
        built(torch.zeros(shape).double())
    assert built(torch.zeros(5, 4, 2).double()).shape == built(torch.zeros(4, 2).double()).shape == (5, 4)
    assert built(torch.zeros(7, 2).double()).shape == (5, 7)
