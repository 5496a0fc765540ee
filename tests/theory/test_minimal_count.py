"""The smallest counts of centers: the reference numbers, and what must hold."""

from __future__ import annotations

import math

import pytest
import torch
from helpers_theory import random_offsets

from staf_torch import (
    ExponentialKernel,
    GaussianKernel,
    MaternKernel,
    StaFBasis,
    StateFollowingCenters,
    ball,
    polygon,
    rings,
    targets,
    theory,
)

PAPER = targets.Paper()
CIRCLE_ANGLES = torch.arange(32, dtype=torch.float64) * (2 * math.pi / 32)
CIRCLE = torch.stack((CIRCLE_ANGLES.cos(), -CIRCLE_ANGLES.sin()), dim=-1)

REFERENCE_COUNTS = {0.05: (2, 6, 6, 10, 15), 0.1: (3, 6, 10, 10, 21), 0.2: (6, 10, 15, 15, 28)}
EPSILONS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)


@pytest.mark.parametrize("radius", REFERENCE_COUNTS)
def test_smallest_counts_along_the_unit_circle_are_the_reference(radius: float) -> None:
    counts = [
        theory.minimal_count(PAPER, ExponentialKernel(), CIRCLE, radius, epsilon).count
        for epsilon in EPSILONS
    ]
    assert tuple(counts) == REFERENCE_COUNTS[radius]


def test_errors_of_layouts_are_the_reference() -> None:
    """MATH.md section 1, worst of six states (which are not stated: hence 10 %)."""
    layouts = [rings(3), rings(6), rings(10), rings(15)]
    with pytest.warns(UserWarning, match="conic"):
        layouts += [polygon(6), polygon(10), polygon(15)]
    angle = torch.arange(6, dtype=torch.float64) * (math.pi / 3)
    states = torch.stack((angle.cos(), angle.sin()), dim=-1)
    errors = theory.layout_errors(PAPER, ExponentialKernel(), states, 0.1, layouts).amax(-1)
    reference = torch.tensor([5.2e-2, 2.4e-3, 7.1e-5, 1.1e-6, 2.35e-2, 2.35e-2, 2.35e-2]).double()
    torch.testing.assert_close(errors, reference, rtol=0.1, atol=0)
    torch.testing.assert_close(errors[-1], errors[-2], rtol=1e-3, atol=0)  # more corners gain nothing


@pytest.mark.parametrize("kernel", [ExponentialKernel(), GaussianKernel(0.7), MaternKernel(2.5)])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_errors_of_layouts_bound_the_error_at_random_points(kernel: torch.nn.Module, dim: int) -> None:
    target, radius = targets.Cosine(1.5), 0.3
    states = theory.disc(1.0, dim=dim, count=4)
    layout = ball(math.comb(dim + 2, 2), dim)
    error = theory.layout_errors(target, kernel, states, radius, [layout])[0]  # type: ignore[arg-type]
    space = StaFBasis(kernel, StateFollowingCenters(layout, radius)).local(states)  # type: ignore[arg-type]
    coefficients = space.fit(target(states.unsqueeze(-2) + radius * layout))
    z = random_offsets(radius, 4, 1000, dim)
    found = (target(states.unsqueeze(-2) + z) - space.evaluate(z, coefficients)).abs().amax(-1)
    assert (found <= error * 1.001).all()
    assert (found > 0.5 * error).all()


def test_pointwise_counts_are_the_smallest_at_each_state() -> None:
    found = theory.minimal_count(PAPER, ExponentialKernel(), CIRCLE[:12].reshape(3, 4, 2), 0.1, 1e-3)
    assert found.pointwise.shape == (3, 4)
    assert found.errors.shape == (len(found.counts), 3, 4)
    for b in range(3):
        for t in range(4):
            enough = found.counts[found.errors[:, b, t] <= 1e-3]
            assert found.pointwise[b, t] == enough[0] <= found.count
    alone = theory.minimal_count(PAPER, ExponentialKernel(), CIRCLE[5], 0.1, 1e-3)
    assert alone.pointwise == found.pointwise[1, 1]


def test_layouts_of_a_users_own_are_tried_from_the_fewest_centers_on() -> None:
    own = [ball(10, 2), ball(3, 2), ball(6, 2)]
    found = theory.minimal_count(PAPER, ExponentialKernel(), CIRCLE, 0.1, 1e-2, own)
    assert found.counts.tolist() == [3, 6, 10]
    assert found.count == 6


def test_standard_layouts_grow_and_start_below_a_triangle() -> None:
    assert [len(layout) for layout in theory.standard_layouts(2)] == [1, 2, 3, 6, 10, 15, 21, 28]
    assert [len(layout) for layout in theory.standard_layouts(3)][:4] == [1, 4, 10, 20]


def test_state_with_nan_spoils_its_own_error_only() -> None:
    states = CIRCLE[:4].clone()
    clean = theory.layout_errors(PAPER, ExponentialKernel(), states, 0.1, [rings(6)])
    states[2] = torch.nan
    errors = theory.layout_errors(PAPER, ExponentialKernel(), states, 0.1, [rings(6)])
    assert errors.isnan().tolist() == [[False, False, True, False]]
    torch.testing.assert_close(errors[:, [0, 1, 3]], clean[:, [0, 1, 3]], rtol=0, atol=1e-14)


FINE = {"target": PAPER, "kernel": ExponentialKernel(), "states": CIRCLE[:4], "radius": 0.1, "epsilon": 1e-2}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"epsilon": 0.0}, r"minimal_count\(epsilon=\.\.\.\)` must be positive; got 0.0"),
        ({"radius": -0.1}, r"radius=\.\.\.\)` must be positive; got -0.1"),
        ({"epsilon": 1e-18}, r"in the reach of a layout.*got 1e-18"),
        ({"layouts": []}, "at least one layout"),
        ({"layouts": [ball(4, 3)]}, r"minimal_count\(layouts=\.\.\.\)` must have 2 entries"),
        ({"states": CIRCLE.long()}, "floating-point"),
        ({"target": lambda y: y}, r"must map points of shape \(\.\.\., n\)"),
        ({"kernel": "exponential"}, "must be a Kernel"),
    ],
)
def test_bad_arguments_of_the_smallest_count_are_named(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        theory.minimal_count(**(FINE | wrong))  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", [{"radius": 0}, {"dim": 0}, {"count": 1}, {"center": [0.0]}])
def test_bad_arguments_of_the_domain_are_named(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"disc\("):
        theory.disc(**wrong)  # type: ignore[arg-type]
