"""Where a memory keeps what: how models are weighed, replaced, averaged and given up."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor
from torch import Tensor

import staf_torch as st

RADIUS = 0.1
BASIS = st.StaFBasis(st.PolynomialKernel(2), st.StateFollowingCenters(st.rings(6), RADIUS))


def at(*places: float) -> Tensor:
    """States on the first axis."""
    return torch.stack([tensor([place, 0.0]) for place in places])


def model(x: Tensor, values: Tensor | float) -> Tensor:
    """Coefficients whose values at the centers of x are these."""
    return BASIS.local(x).fit(torch.zeros(6, dtype=torch.float64) + values)


def memory_of(*places: float, capacity: int = 5, **given: float) -> st.ExperienceMemory:
    """Constants 1, 2, ... at these places."""
    memory = st.ExperienceMemory(BASIS, capacity, **given)  # type: ignore[arg-type]
    for value, x in enumerate(at(*places), 1):
        memory.add(x, model(x, float(value)))
    return memory


@pytest.mark.parametrize("reach", [1.0, 2.0, 3.5])
def test_models_are_weighed_by_their_distance(reach: float) -> None:
    memory = memory_of(0.0, 0.08, 0.3, reach=reach)
    y = torch.cat((at(0.0, 0.01, 0.05, 0.0801, 0.15), tensor([[0.02, 0.06]])))
    t = (y[:, None] - at(0.0, 0.08, 0.3)).square().sum(-1) / (reach * RADIUS) ** 2
    weights = (1 - t).clamp(min=0.0) ** 3 / (t + 1e-4) ** 2
    wanted = (weights * tensor([1.0, 2.0, 3.0])).sum(-1) / weights.sum(-1)
    torch.testing.assert_close(memory.query(y), wanted, rtol=1e-9, atol=1e-9, equal_nan=True)
    assert memory.covered(y).tolist() == (t < 1).any(-1).tolist()
    edge = at(-reach * RADIUS * (1 - 1e-12), -reach * RADIUS * (1 + 1e-12))
    assert memory.covered(edge).tolist() == [True, False]
    assert memory.query(edge).isnan().tolist() == [False, True]
    assert torch.equal(memory(y), memory.query(y)) or bool(memory.query(y).isnan().any())


def places(memory: st.ExperienceMemory) -> list[float | None]:
    """The states kept, place by place."""
    pairs = zip(memory.states[:, 0].tolist(), memory.stored.tolist(), strict=True)
    return [round(x, 6) if stored else None for x, stored in pairs]


def test_a_model_follows_the_state_for_half_of_the_spacing_and_is_left_alone_then() -> None:
    memory = memory_of(0.0)  # models are at least .05 apart
    for place, kept in (
        (0.0249, [0.0249]),  # still
        (0.0251, [0.0249]),  # left alone
        (-0.0249, [-0.0249]),
        (0.0, [0.0]),
        (0.0499, [0.0]),
        (0.0501, [0.0, 0.0501]),
        (0.0749, [0.0, 0.0749]),
        (0.0001, [0.0, 0.0749]),  # a revisit: a fresher model at the old state
        (0.0252, [0.0, 0.0749]),
    ):
        x = at(place)[0]
        memory.add(x, model(x, 5.0))
        assert [each for each in places(memory) if each is not None] == kept, place
    assert int(memory.count) == 2
    assert places(memory)[2:] == [None] * 3
    before = places(memory)
    memory.add(tensor([9.0, torch.nan]), model(at(0.0)[0], 1.0))
    memory.add(tensor([9.0, 0.0]), torch.full((6,), torch.inf, dtype=torch.float64))
    assert places(memory) == before
    assert int(memory.latest) == 0


@pytest.mark.parametrize(
    ("kept", "given_up"),
    [
        ((0.0, 0.06, 0.2), 1),
        ((0.06, 0.0, 0.2), 0),
        ((0.2, 0.0, 0.06), 2),
        ((0.5, 0.0, 0.06, 0.7, 0.2), 2),
        ((0.0, 0.3, 0.36, 0.5), 2),
        ((0.0, 0.2, 0.26, 0.5), 1),
    ],
)
def test_of_the_closest_pair_the_one_with_the_closer_second_neighbour_is_given_up(
    kept: tuple[float, ...], given_up: int
) -> None:
    memory = memory_of(*kept, capacity=len(kept))
    assert places(memory) == list(kept)
    x = at(3.0)[0]
    memory.add(x, model(x, 9.0))
    assert places(memory) == [3.0 if slot == given_up else place for slot, place in enumerate(kept)]
    two = memory_of(0.0, 1.0, capacity=2).add(x, model(x, 9.0))
    assert sorted(each for each in places(two) if each is not None)[-1] == 3.0


def rms(one: Tensor, other: Tensor) -> float:
    return float((one - other).square().mean().sqrt())


@pytest.mark.parametrize("visits", [2, 64])
def test_revisits_are_averaged_until_the_function_drifts(visits: int) -> None:
    memory = st.ExperienceMemory(BASIS, 3, visits=visits)
    here, there = at(0.0, 1.0)
    draw = torch.Generator().manual_seed(0)
    values = [torch.randn(6, generator=draw, dtype=torch.float64) for _ in range(4)]

    def visit(value: Tensor) -> tuple[Tensor, int, float]:
        memory.add(here, model(here, value)).add(there, model(there, 0.0))
        offsets = BASIS.centers(here) - here
        kept = BASIS.local(here).evaluate(offsets, memory.coefficients[0])
        return kept, int(memory.averaged[0]), float(memory.scatter[0])

    def check(found: tuple[Tensor, int, float], mean: Tensor, count: int, usual: float) -> None:
        torch.testing.assert_close(found[0], mean, rtol=1e-7, atol=1e-8)
        assert found[1] == count
        assert found[2] == pytest.approx(usual, rel=1e-6, abs=1e-9)

    first, second, third, fourth = values
    check(visit(first), first, 1, 0.0)
    usual = rms(second, first)
    check(visit(second), second, 1, usual)  # takes the place, and tells how far apart models are
    distance = rms(third, second)
    assert distance < 4 * usual
    mean, usual = second + (third - second) / 2, usual + (distance - usual) / 2
    check(visit(third), mean, 2, usual)
    share = min(3, visits)
    distance = rms(fourth, mean)
    mean, usual = mean + (fourth - mean) / share, usual + (distance - usual) / share
    check(visit(fourth), mean, share, usual)
    step = torch.ones(6, dtype=torch.float64)
    near = mean + 3.99 * usual * step
    share = min(4, visits)
    moved, usual_then = mean + (near - mean) / share, usual + 2.99 * usual / share
    check(visit(near), moved, share, usual_then)
    far = moved + 4.01 * usual_then * step
    check(visit(far), far, 1, usual_then)  # has drifted: begins anew, as far apart as before
    again = far + 4.01 * usual_then * step
    check(visit(again), again, 1, 4.01 * usual_then)  # nothing was averaged: it is the distance


def test_a_start_is_nothing_where_nothing_is_remembered_and_the_nearest_beyond_a_support() -> None:
    memory = memory_of(0.0, 0.3, reach=1.0)
    x = at(0.0, 0.09, 0.15, 0.25)
    found = memory.start(x)
    assert found.isnan().all(-1).tolist() == [False, False, True, False]
    for state, coefficients, value in zip(x, found, (1.0, 1.0, None, 2.0), strict=True):
        if value is not None:
            torch.testing.assert_close(coefficients, model(state, value), rtol=1e-6, atol=1e-6)
            torch.testing.assert_close(memory.start(state), coefficients, rtol=1e-9, atol=1e-9)
    slope = memory.gradient(at(0.02))
    torch.testing.assert_close(slope, torch.zeros_like(slope), rtol=0, atol=1e-7)


def test_the_same_model_twice_is_no_average_and_what_is_not_finite_moves_nothing() -> None:
    memory = st.ExperienceMemory(BASIS, 3)
    here, there = at(0.0, 1.0)
    values = torch.arange(6.0, dtype=torch.float64)
    for _ in range(2):
        memory.add(here, model(here, 0.0)).add(there, model(there, values))
    assert memory.averaged.tolist() == [1, 1, 0]
    assert memory.scatter.tolist()[0] == 0.0
    origin = memory.origin.clone()
    assert torch.equal(origin, there)
    for x, coefficients in (
        (here, torch.full((6,), torch.nan).double()),
        (here * torch.nan, model(here, 1.0)),
    ):
        memory.add(x, coefficients)
        assert torch.equal(memory.origin, origin)
        assert int(memory.latest) == 1
    memory.add(here, model(here, values))
    assert memory.averaged.tolist() == [1, 1, 0]
    assert float(memory.scatter[0]) == pytest.approx(rms(values, torch.zeros(6)))


def test_points_of_another_shape_are_refused_by_name() -> None:
    memory = memory_of(0.0)
    for wrong in (torch.zeros(3).double(), torch.zeros(4, 3).double(), torch.zeros(()).double()):
        with pytest.raises(ValueError, match=r"`ExperienceMemory.start\(x=...\)` must"):
            memory.start(wrong)
    for wrong in (torch.zeros(2).double(), torch.zeros(4, 3).double(), torch.zeros(()).double()):
        for call in (memory.query, memory.covered):
            with pytest.raises(ValueError, match=r"`ExperienceMemory\(y=...\)` must"):
                call(wrong)
    assert memory.start(torch.zeros(2).double()).shape == (6,)
    assert memory.query(torch.zeros(1, 2).double()).shape == (1,)
