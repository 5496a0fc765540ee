"""The chase by its equations alone: row by row, time by time, in the paper's weights, K formed and solved.

Every way of the library must find the same: the definition in one piece and in pieces, and what is compiled
(`test_compiled.py`).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import tensor
from helpers_chase import LAW, circles
from torch import Tensor

import staf_torch as st
from staf_torch import chase, chase_weights, optim, predictors
from staf_torch.engine import ChaseResult, chase_pieces
from staf_torch.engine.result import concatenate
from staf_torch.targets import Paper

ITERATIONS, FIRST = 2, tensor([[0.3, -0.2, 0.5], [0.0, 0.1, -0.4]])
TIMES = 7
STATES = torch.stack((circles(1, TIMES)[0], 0.7 * circles(3, TIMES)[2].flip(-1)))
STATES = STATES * torch.linspace(1.0, 1.3, TIMES)[:, None]  # spirals: the gain of a kernel, e^|x|^2, changes
CENTERS = st.StateFollowingCenters(st.rings(3), st.StateRadius(0.7, 0.3))
BASES = {
    "exponential": st.StaFBasis(st.ExponentialKernel(), CENTERS),
    "gaussian": st.StaFBasis(st.GaussianKernel(0.8), st.StateFollowingCenters(st.rings(3), 0.6)),
    "polynomial": st.StaFBasis(st.PolynomialKernel(2), CENTERS),
}
PREDICTORS: dict[str, Any] = {
    "none": None,
    "secant": predictors.Secant(),
    "guarded": predictors.Secant(guarded=True),
    "first order": predictors.Tangent(1),
    "second order": predictors.Tangent(2),
}
NAMES = (
    "weights",
    "ideal_weights",
    "value",
    "estimate",
    "estimate_before",
    "ideal_estimate",
    "excess",
    "excess_before",
)
TERMS = ("rate", "growth", "drift", "bound")


def scaled_gram(basis: st.StaFBasis, x: Tensor) -> Tensor:
    """e^{-g} K, whose weights are e^g times the paper's."""
    gain = basis.kernel.log_gain(x)
    return basis.gram(x) * (1.0 if gain is None else (-gain).exp())


def gain(basis: st.StaFBasis, x: Tensor) -> Tensor:
    found = basis.kernel.log_gain(x)
    return torch.ones(x.shape[:-1]).double() if found is None else found.exp()


def tangent(basis: st.StaFBasis, at: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
    """K^-1 dV and K^-1 dK, by central differences."""
    step = 1e-4 * dx
    rates = [
        (8 * (f(at + step) - f(at - step)) - (f(at + 2 * step) - f(at - 2 * step))) / (12 * 1e-4)
        for f in (lambda x: basis.values(x, Paper()), lambda x: scaled_gram(basis, x))
    ]
    gram = scaled_gram(basis, at)
    return torch.linalg.solve(gram, rates[0]), torch.linalg.solve(gram, rates[1])


def predicted(basis: st.StaFBasis, name: str, k: int, x: Tensor, path: list[Tensor]) -> Tensor:
    """The paper's weights brought to time k, of those corrected before."""
    held = path[-1]
    if name == "none" or k == 0:
        return held
    if name in ("secant", "guarded"):
        guess = 2 * held - (path[-2] if k > 1 else held)
        if name == "guarded":
            gram, values = basis.gram(x[k]), basis.values(x[k], Paper())
            cost = [float(0.5 * a @ gram @ a - a @ values) for a in (guess, held)]
            guess = guess if cost[0] <= cost[1] else held
        return guess
    a = gain(basis, x[k - 1]) * held
    if name == "first order":
        dx = (x[k] - x[k - 2]) / 2 if k > 1 else x[k] - x[k - 1]
        u, j = tangent(basis, x[k - 1], dx)
        a = a + u - j @ a
    else:
        u, j = tangent(basis, (x[k - 1] + x[k]) / 2, x[k] - x[k - 1])
        a = a + u - j @ (a + (u - j @ a) / 2)
    return a / gain(basis, x[k])


@functools.cache
def by_hand(kind: str, name: str, row_number: int) -> dict[str, Tensor]:
    """One row."""
    basis, x, first = BASES[kind], STATES[row_number], FIRST[row_number]
    found: dict[str, list[Tensor]] = {each: [] for each in (*NAMES, *TERMS)}
    path, past = [first], None
    for k in range(len(x)):
        gram, values = basis.gram(x[k]), basis.values(x[k], Paper())
        ideal, row = torch.linalg.solve(gram, values), basis.kernel(x[k][None], basis.centers(x[k]))[0]
        before = after = predicted(basis, name, k, x, path)
        for _ in range(ITERATIONS):
            g = values - gram @ after
            after = after + (g @ g) / (g @ gram @ g) * g
        path = [*path, after] if k else [after]

        def length(v: Tensor, K: Tensor = gram) -> Tensor:
            return (v @ K @ v).sqrt()

        rate = LAW.contraction(torch.linalg.cond(gram)) ** ITERATIONS
        growth, drift, last = torch.ones(()).double(), length(before - ideal), torch.zeros(()).double()
        if past is not None:
            old, ideal_before = past
            growth = torch.linalg.eigvals(torch.linalg.solve(old, gram)).real.max().sqrt()
            drift = length((before - path[-2]) - (ideal - ideal_before))
            last = ((path[-2] - ideal_before) @ old @ (path[-2] - ideal_before)).sqrt()
        numbers = (after, ideal, Paper()(x[k]), row @ after, row @ before, row @ ideal)
        terms = (rate, growth, drift, rate.sqrt() * (growth * last + drift))
        excesses = (length(after - ideal).square(), length(before - ideal).square())
        for each, number in zip((*NAMES, *TERMS), (*numbers, *excesses, *terms), strict=True):
            found[each].append(number)
        past = gram, ideal
    return {each: torch.stack(parts) for each, parts in found.items()}


def in_pieces(states: Tensor, *given: Any, **options: Any) -> ChaseResult:
    return concatenate(list(chase_pieces(states.split([1, 2, 1, TIMES - 4], 1), *given, **options)))


PAIRS = [
    *(("exponential", name) for name in ("none", "guarded", "second order")),
    ("gaussian", "secant"),
    ("gaussian", "first order"),
    ("polynomial", "none"),
]


@pytest.mark.parametrize(("name", "predictor"), PAIRS)
def test_a_chase_is_what_its_equations_say(name: str, predictor: str) -> None:
    basis = BASES[name]
    result = chase(
        STATES,
        basis,
        Paper(),
        LAW,
        inner_steps=ITERATIONS,
        weights=FIRST,
        predictor=PREDICTORS[predictor],
        certificate=True,
    )
    found = {each: getattr(result, each) for each in NAMES} | {
        each: getattr(result.certificate, each) for each in TERMS
    }
    for row in range(2):
        wanted = by_hand(name, predictor, row)
        for each in (*NAMES, *TERMS):
            scale = float(wanted[each].abs().max())
            torch.testing.assert_close(
                found[each][row], wanted[each], rtol=0, atol=2e-6 * scale, msg=lambda m, e=each: f"{e}: {m}"
            )
    assert torch.equal(result.state, STATES)
    assert result.diverged_at.tolist() == [-1, -1]
    assert not result.certificate.violated.any()
    scale = 1.0 if basis.gram_structure(STATES).scale is None else basis.gram_structure(STATES).scale
    gains = gain(basis, STATES).unsqueeze(-1)
    torch.testing.assert_close(result.coefficients, scale * gains * result.weights, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("run", [chase, in_pieces])
@pytest.mark.parametrize(("name", "predictor"), [("exponential", "none"), ("gaussian", "secant")])
def test_a_row_that_is_lost_keeps_its_last_weights_and_its_neighbour_sees_nothing(
    name: str, predictor: str, run: Callable[..., Any]
) -> None:
    options = {
        "inner_steps": ITERATIONS,
        "weights": FIRST,
        "predictor": PREDICTORS[predictor],
        "certificate": True,
    }
    whole = run(STATES, BASES[name], Paper(), LAW, **options)
    for first in (1, TIMES - 1) if name == "exponential" else (0, 4):
        spoilt = STATES.clone()
        spoilt[1, first] = torch.nan
        found = run(spoilt, BASES[name], Paper(), LAW, **options)
        assert found.diverged_at.tolist() == [-1, first]
        assert found.diverged.tolist() == [False, True]
        for each in (*NAMES, "coefficients"):
            one, other = getattr(found, each), getattr(whole, each)
            torch.testing.assert_close(one[0], other[0], rtol=1e-9, atol=1e-12)
            torch.testing.assert_close(one[1, :first], other[1, :first], rtol=1e-9, atol=1e-12)
            assert each == "weights" or bool(one[1, first:].isnan().all())
        last = whole.weights[1, first - 1] if first else FIRST[1]
        torch.testing.assert_close(
            found.weights[1, first:], last.expand(TIMES - first, 3), rtol=1e-9, atol=1e-12
        )
        for term in found.certificate[:-1]:
            assert torch.equal(term.isnan(), torch.arange(TIMES) >= torch.tensor([[TIMES], [first]]))
        assert not found.certificate.violated.any()


LAWS = {
    "steepest descent": LAW,
    "exact": optim.Exact(),
    "nesterov": optim.Nesterov(0.9),
    "heavy ball": optim.HeavyBall(),
    "fixed step": optim.FixedStep(),
    "normalised LMS": optim.NormalisedLMS(0.7),
    "preconditioned": optim.PreconditionedDescent(),
    "least squares": optim.RecursiveLeastSquares(),
}


@pytest.mark.parametrize(("law", "name"), [*zip(LAWS, itertools.cycle(BASES), strict=False)])
def test_every_way_of_a_chase_finds_the_same(name: str, law: str) -> None:
    """Of all results and of the weights alone, every time and the last, lost or not."""
    given, options = (BASES[name], Paper(), LAWS[law]), {"inner_steps": ITERATIONS, "weights": FIRST}
    spoilt = STATES.clone()
    spoilt[1, 4] = torch.inf
    whole = chase(spoilt, *given, **options)
    found = in_pieces(spoilt, *given, **options)
    for each in ("weights", "estimate", "estimate_before", "value", "coefficients"):
        one, other = getattr(found, each), getattr(whole, each)
        torch.testing.assert_close(one, other, rtol=1e-7, atol=1e-9, equal_nan=True)
    assert torch.equal(found.diverged_at, whole.diverged_at)
    for pieces in (spoilt, iter(spoilt.split([1, 2, 4], 1))):
        alone = chase_weights(pieces, *given, **options)
        torch.testing.assert_close(alone.weights, whole.weights, rtol=1e-8, atol=1e-10)
        assert torch.equal(alone.diverged_at, whole.diverged_at)
    last = chase_weights(spoilt.split([2, 5], 1), *given, **options, history=False)
    torch.testing.assert_close(last.weights, whole.weights[:, -1:], rtol=1e-8, atol=1e-10)
