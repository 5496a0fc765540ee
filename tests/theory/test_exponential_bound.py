"""The bound for the exponential kernel: the reference numbers, and what must hold."""

from __future__ import annotations

import math

import pytest
import torch
from helpers_theory import random_offsets
from variants import by_turns

from staf_torch import targets, theory

PAPER = targets.Paper()


@pytest.mark.parametrize(
    ("radius", "epsilon", "N", "S", "count", "one"),
    [
        (0.1, 1e-2, 2, 2, 15, 6),
        (0.1, 1e-3, 3, 2, 21, 10),
        (0.1, 1e-4, 3, 3, 28, 10),
        (0.5, 1e-2, 5, 4, 55, 15),
        (0.5, 1e-4, 8, 5, 105, 28),
    ],
)
def test_bound_of_the_paper_example_is_the_reference(
    radius: float, epsilon: float, N: int, S: int, count: int, one: int
) -> None:
    bound = theory.exponential_bound(PAPER, theory.disc(1.0, count=9), radius, epsilon)
    assert (bound.N, bound.S, bound.count, bound.one_polynomial_count) == (N, S, count, one)
    assert bound.two_polynomials.degree == N + S


DOMAINS = {
    "paper": (PAPER, theory.disc(1.0, count=17), 0.2),
    "line": (targets.Cosine(2.0), theory.disc(1.5, dim=1, count=5), 0.3),
    "space": (targets.Cosine([1.0, 2.0, -1.0]), theory.disc(1.0, dim=3, count=7), 0.3),
    "aside": (PAPER, theory.disc(0.5, count=7, center=[0.8, -0.6]), 0.2),
}


@pytest.mark.parametrize(("name", "epsilon"), by_turns(DOMAINS, [1e-3, 1e-1]))
def test_verified_error_bounds_the_error_at_random_points_and_is_within_epsilon(
    name: str, epsilon: float
) -> None:
    target, domain, radius = DOMAINS[name]
    bound = theory.exponential_bound(target, domain, radius, epsilon)
    z = random_offsets(radius, len(domain), 500, domain.shape[-1])
    for built in (bound.two_polynomials, bound.one_polynomial):
        worst = float((target(domain.unsqueeze(-2) + z) - built(z)).abs().max())
        assert worst <= built.error <= epsilon
        assert worst > 0.5 * built.error  # and it is no empty bound


@pytest.mark.parametrize("name", DOMAINS)
def test_construction_is_a_combination_of_kernels_with_centers_in_the_ball(name: str) -> None:
    """The binomial sum over the centers x + l/m is the product form, where it can still be computed."""
    target, domain, radius = DOMAINS[name]
    built = theory.one_polynomial_bound(target, domain, radius, 0.3)
    dim, m = domain.shape[-1], built.m
    assert built.degree / m < radius
    assert built.count == math.comb(dim + built.degree, dim)
    index = torch.cartesian_prod(*[torch.arange(built.degree + 1)] * dim).reshape(-1, dim)
    index = index[index.sum(-1) <= built.degree].double()
    z = random_offsets(radius, 1, 4 * built.count, dim)[0]
    span = torch.exp(z @ (index / m).mT)  # e^{z'l/m}, |l| <= degree
    scaled = built(z) * torch.exp(-domain @ z.mT)
    assert span.shape[1] == built.count
    fitted = span @ torch.linalg.lstsq(span, scaled.mT, driver="gelsd").solution
    assert (fitted - scaled.mT).abs().max() < 1e-7 * scaled.abs().max()


def test_construction_takes_offsets_of_each_state_or_of_all() -> None:
    domain = theory.disc(1.0, count=5)
    built = theory.one_polynomial_bound(PAPER, domain, 0.1, 1e-2)
    z = random_offsets(0.1, 1, 10, 2)[0]
    torch.testing.assert_close(built(z), built(z.expand(5, 20, 2)))
    for wrong in (torch.zeros(3), torch.zeros(4, 3), torch.zeros(4, 6, 2), torch.zeros(1, 5, 6, 2)):
        with pytest.raises(ValueError, match="Construction"):
            built(wrong)


def test_one_polynomial_holds_far_from_the_origin() -> None:
    far = theory.disc(0.5, count=5, center=[4.0, 3.0])
    assert theory.one_polynomial_bound(PAPER, far, 0.1, 1e-2).error <= 1e-2
    with pytest.raises(ValueError, match=r"exponential_bound\(epsilon=.*degree 16"):
        theory.exponential_bound(PAPER, far, 0.1, 1e-2)


GOOD = {"target": PAPER, "domain": theory.disc(1.0, count=5), "radius": 0.1, "epsilon": 1e-2}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"domain": torch.zeros(1, 3, 2).double()}, r"must have the shape \(D, n\)"),
        ({"domain": torch.tensor([[math.inf, 0.0]])}, r"domain=\.\.\.\)` must be finite"),
        ({"domain": [[0.0, 0.0]]}, "must be a tensor"),
        ({"target": lambda y: y}, r"must map points of shape \(\.\.\., n\)"),
        ({"target": lambda y: y[..., 0] / 0}, "must be finite on the balls"),
    ],
)
def test_bad_arguments_of_the_bound_are_named(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        theory.exponential_bound(**(GOOD | wrong))  # type: ignore[arg-type]


STATES = theory.disc(1.0, count=5)


def test_the_last_degree_that_is_allowed_is_tried_and_a_polynomial_needs_its_own() -> None:
    assert theory.exponential_bound(PAPER, STATES, 0.1, 1e-2, max_degree=2).N == 2
    with pytest.raises(ValueError, match=r"polynomials of degree 1 \(3 terms\)"):
        theory.exponential_bound(PAPER, STATES, 0.1, 1e-2, max_degree=1)
    bound = theory.exponential_bound(lambda y: 0 * y[..., 0], STATES.float(), 0.1, 1e-3, max_degree=0)
    assert (bound.N, bound.S, bound.count, bound.one_polynomial.error) == (0, 0, 1, 0.0)
    bound = theory.exponential_bound(targets.Quadratic(), torch.zeros(1, 2).double(), 0.5, 1e-9)
    assert (bound.N, bound.S, bound.one_polynomial.degree) == (2, 0, 2)
