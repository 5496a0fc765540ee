"""Local models kept along the way."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import basis_of, tensor, uniform
from torch import Tensor

import staf_torch as st

V = st.targets.Paper()


def circle(count: int, turns: float = 1.0) -> Tensor:
    angle = turns * 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    return torch.stack((angle.cos(), angle.sin()), dim=-1)


def filled(memory: st.ExperienceMemory, x: Tensor, target: object = V) -> st.ExperienceMemory:
    """With the ideal models at the states (..., T, n)."""
    basis = memory.basis
    for state in x.unbind(-2):
        memory.add(state, basis.local(state).fit(basis.values(state, target)))  # type: ignore[arg-type]
    return memory


@pytest.mark.parametrize("kernel", ["exponential", "matern52", "user_defined"])
def test_stored_state_answers_with_its_own_model(kernel: str) -> None:
    basis = basis_of(kernel, radius=0.1)
    x = circle(20)
    memory = filled(st.ExperienceMemory(basis, 20), x)
    assert int(memory.count) == 20
    local = basis.local(x)
    own = local.evaluate(torch.zeros(20, 1, 2, dtype=torch.float64), local.fit(basis.values(x, V)))
    torch.testing.assert_close(memory.query(x), own.squeeze(-1), rtol=1e-4, atol=1e-4)


def test_weights_are_a_partition_of_unity() -> None:
    """What every local model has exactly, a quadratic, the blend has exactly, with its gradient."""
    basis = basis_of("polynomial", radius=0.1)  # degree 3: six centers fit every quadratic
    basis = st.StaFBasis(st.PolynomialKernel(2), basis.centers)
    target = st.targets.Quadratic([[2.0, 0.5], [0.5, 1.0]])
    memory = filled(st.ExperienceMemory(basis, 40), circle(40), target)
    y = circle(57) * 1.05
    torch.testing.assert_close(memory(y), target(y), rtol=0, atol=1e-9)
    expected = 2 * y @ tensor([[2.0, 0.5], [0.5, 1.0]])
    torch.testing.assert_close(memory.gradient(y), expected, rtol=0, atol=1e-7)


def test_blend_is_smooth() -> None:
    memory = filled(st.ExperienceMemory(basis_of("gaussian", radius=0.1), 30), circle(30))
    y = 1.03 * circle(3)
    assert torch.autograd.gradcheck(memory.query, (y.requires_grad_(),), atol=1e-5)
    line = torch.linspace(0.05, 0.27, 2201, dtype=torch.float64)  # from one model to the next
    path = torch.stack((line.cos(), line.sin()), dim=-1)
    slopes = memory.gradient(path)
    assert float((slopes[1:] - slopes[:-1]).norm(dim=-1).max()) < 0.02  # no jumps where supports begin


def test_places_that_no_model_reaches_are_not_a_number() -> None:
    memory = filled(st.ExperienceMemory(basis_of("exponential", radius=0.1), 8, reach=2.0), circle(1))
    y = tensor([[1.15, 0.0], [1.25, 0.0], [-40.0, 0.0]])
    assert memory.covered(y).tolist() == [True, False, False]
    assert memory.query(y).isnan().tolist() == [False, True, True]
    start = memory.start(y)
    assert start.isnan().all(-1).tolist() == [False, True, True]
    assert not memory.covered(tensor([[0.0, 0.0]])).item()


def test_full_memory_leaves_no_gap_behind() -> None:
    memory = filled(st.ExperienceMemory(basis_of("gaussian", radius=0.1), 24, reach=2.5), circle(250)[:125])
    assert int(memory.count) == 24
    half = circle(700)[:348]
    assert memory.covered(half).all()
    assert float((memory.query(half) - V(half)).abs().max()) < 0.02


def test_every_row_has_a_memory_of_its_own() -> None:
    basis, x = (
        basis_of("exponential", radius=0.1),
        torch.stack((circle(30), 0.5 * circle(30, 0.4), circle(30))),
    )
    x[2, 5] = torch.nan
    together = filled(st.ExperienceMemory(basis, 16, (3,)), x)
    y = x[:, ::7] + 0.01
    for i in range(2):
        alone = filled(st.ExperienceMemory(basis, 16), x[i])
        torch.testing.assert_close(together.states[i], alone.states)
        torch.testing.assert_close(together.query(y)[i], alone.query(y[i]), equal_nan=True)
        torch.testing.assert_close(together.start(x[:, 3])[i], alone.start(x[i, 3]), equal_nan=True)
    assert torch.isfinite(together.states).all()
    assert torch.isfinite(together.coefficients).all()
    without = filled(st.ExperienceMemory(basis, 16), x[2, [k for k in range(30) if k != 5]])
    torch.testing.assert_close(together.states[2], without.states)


def test_start_is_the_ideal_fit_of_what_is_remembered() -> None:
    basis = st.StaFBasis(st.PolynomialKernel(2), st.StateFollowingCenters(st.rings(6), 0.1))
    target = st.targets.Quadratic(1.5)
    memory = filled(st.ExperienceMemory(basis, 40, reach=1.0), circle(40), target)
    x = circle(23)
    ideal = basis.local(x).fit(basis.values(x, target))
    torch.testing.assert_close(memory.start(x), ideal, rtol=0, atol=1e-8)  # also beyond the supports


def noisy_laps(laps: int, scale: float, visits: int = 64) -> float:
    """Error of memories that met two places in turn so often, each model with noise of its own."""
    basis, x = basis_of("gaussian", radius=0.1), circle(30)[:16].view(8, 2, 2)
    memory = st.ExperienceMemory(basis, 4, (8,), visits=visits)
    draw = torch.Generator().manual_seed(0)
    places = [(state, basis.local(state), basis.values(state, V)) for state in x.unbind(1)]
    for _ in range(laps):
        for state, local, values in places:
            noise = scale * torch.randn(values.shape, generator=draw, dtype=torch.float64)
            memory.add(state, local.fit(values + noise))
    return float((memory.query(x) - V(x)).square().mean().sqrt())


def test_noise_goes_down_with_the_root_of_the_visits() -> None:
    once, often = noisy_laps(1, 0.1), noisy_laps(64, 0.1)
    assert often < 0.25 * once  # 1 / 8 (64 visits) but for the scatter of sixteen places
    assert noisy_laps(20, 0.1, visits=1) > 0.5 * once


def test_average_begins_anew_where_the_function_drifts() -> None:
    basis, x = basis_of("gaussian", radius=0.1), circle(30)[:10]
    memory = st.ExperienceMemory(basis, 20)
    for lap in range(12):
        share = 1.0 if lap < 8 else -1.0
        for state in x:
            noise = 1e-3 * uniform(6, seed=lap)
            memory.add(state, basis.local(state).fit(share * basis.values(state, V) + noise))
    assert float((memory.query(x) + V(x)).abs().max()) < 0.01


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


def places(memory: st.ExperienceMemory) -> list[float | None]:
    """The states kept, place by place."""
    pairs = zip(memory.states[:, 0].tolist(), memory.stored.tolist(), strict=True)
    return [round(x, 6) if stored else None for x, stored in pairs]


@pytest.mark.parametrize(
    ("kept", "given_up"),
    [
        ((0.0, 0.06, 0.2), 1),
        ((0.06, 0.0, 0.2), 0),
        ((0.5, 0.0, 0.06, 0.7, 0.2), 2),
        ((0.0, 0.3, 0.36, 0.5), 2),
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
