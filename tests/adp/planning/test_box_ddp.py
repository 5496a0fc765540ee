"""Box-constrained DDP: the linear plant exactly, bounds by their conditions, models by differences."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from helpers import uniform
from helpers_swingup import cost_of, double_integrator, pendulum
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.planning.trajectories import Reference, rows_of
from staf_torch.numerics.derivatives import use_forward_mode

use_forward_mode()

X0 = torch.tensor([[5.0, 0.0], [-1.0, 2.0]], dtype=torch.float64)
BOUNDED = double_integrator(-1.0, 1.0)


def still(rows: int, steps: int, inputs: int = 1) -> Tensor:
    return torch.zeros(rows, steps, inputs, dtype=torch.float64)


def inward(problem: adp.SampledProblem, u: Tensor, slope: Tensor) -> Tensor:
    """The projected gradient at an admissible u: 0 where it points out of the box at a bound."""
    out = ((u <= problem.bounds.low) & (slope > 0)) | ((u >= problem.bounds.high) & (slope < 0))
    return torch.where(out, 0.0, slope)


def two_inputs(low: Tensor | None = None, high: Tensor | None = None) -> adp.SampledProblem:
    """A point mass in the plane with drag, whose two coupled inputs have bounds of their own."""
    mixed = torch.tensor([[1.0, 0.4], [0.0, 1.0]], dtype=torch.float64)

    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        speed = x[..., 2:]
        pushed = (mixed * u.unsqueeze(-2)).sum(-1)
        after = speed + 0.1 * (pushed - 0.1 * speed * speed.square().sum(-1, keepdim=True))
        paid = 0.1 * (x.square().sum(-1) + 0.5 * u.square().sum(-1))
        return torch.cat((x[..., :2] + 0.1 * speed, after), dim=-1), paid

    return adp.SampledProblem(step, dim=4, inputs=2, low=low, high=high)


def test_linear_plant_without_bounds_gives_the_regulator_everywhere() -> None:
    problem = double_integrator()
    found = adp.BoxDDP(problem, steps=30, compile=False).solve(X0, still(2, 30))
    states = found.state[:, :-1]
    torch.testing.assert_close(found.cost, problem.terminal(X0), rtol=1e-10, atol=0)
    torch.testing.assert_close(found.gradient[:, 0], 2 * X0 @ problem.p, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(found.curvature[0, 7], 2 * problem.p, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(found.feedback[1, 3], -problem.k, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(found.control, -states @ problem.k.mT, rtol=1e-7, atol=1e-8)
    assert bool(found.converged.all())


@pytest.mark.parametrize(
    ("make", "x0"),
    [
        (lambda: BOUNDED, X0),
        (
            lambda: two_inputs(torch.tensor([-0.2, -1.0]), torch.tensor([0.7, torch.inf])),
            torch.tensor([[2.0, -1.0, 0.5, 1.0], [-3.0, 1.0, 0.0, 0.0]], dtype=torch.float64),
        ),
    ],
    ids=["double integrator", "two inputs"],
)
def test_bounded_control_satisfies_the_optimality_conditions(
    make: Callable[[], adp.SampledProblem], x0: Tensor
) -> None:
    problem = make()
    search = adp.BoxDDP(problem, steps=15, tolerance=1e-11, compile=False)
    found = search.solve(x0, still(2, 15, problem.inputs))
    assert bool(found.converged.all())
    control = found.control.clone().requires_grad_()
    cost = cost_of(problem, x0, control)
    torch.testing.assert_close(cost.detach(), found.cost, rtol=1e-12, atol=0)
    (slope,) = torch.autograd.grad(cost.sum(), control)
    projected = inward(problem, found.control, slope)
    assert float(projected.abs().max()) < 1e-5 * float(found.cost.max())
    assert bool(problem.bounds.contain(found.control).all())
    held = (found.control == problem.bounds.low) | (found.control == problem.bounds.high)
    assert bool(held.any())
    assert not bool(found.feedback[held].any())  # it does not answer a change of the state
    assert bool((found.feedback[~held] != 0).any(-1).all())


def test_models_are_the_derivatives_of_the_optimal_cost() -> None:
    problem = pendulum()
    search = adp.BoxDDP(problem, steps=30, tolerance=1e-13, compile=False)
    center, h = torch.tensor([0.08, -0.15], dtype=torch.float64), 1e-3
    x0 = center + h * torch.tensor([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=torch.float64)
    found = search.solve(x0)
    assert bool(found.converged.all())
    middle, right, left, up, down = found.cost
    gradient = torch.stack((right - left, up - down)) / (2 * h)
    torch.testing.assert_close(found.gradient[0, 0], gradient, rtol=1e-4, atol=1e-4)
    bent = torch.stack((right + left - 2 * middle, up + down - 2 * middle)) / h**2
    torch.testing.assert_close(found.curvature[0, 0].diagonal(), bent, rtol=1e-2, atol=1e-3)


WAVED_X, WAVED_U = 2 * uniform(8, 2, seed=1), 1.4 * uniform(8, 3, 2, seed=2)
WAVED_AROUND = Reference(WAVED_X.unsqueeze(1).expand(-1, 3, -1), 0.3 * uniform(8, 3, 2, 2, seed=3))


def waved(low: float | None = None, high: float | None = None) -> adp.SampledProblem:
    """A plant that is not linear, of two inputs whose cost bends down in places: many steps do not pay."""

    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        push = x[..., 0].sin() + u[..., 0] + u[..., 1] * x[..., 0]
        after = torch.stack((x[..., 0] + 0.3 * x[..., 1], x[..., 1] + 0.3 * push), dim=-1)
        waves = u.square() + 0.8 - 0.8 * (3 * u).cos()
        return after, 0.3 * (x.square().sum(-1) + waves.sum(-1))

    return adp.SampledProblem(step, dim=2, inputs=2, low=low, high=high)


def test_no_iteration_raises_a_cost_and_what_is_called_converged_is_stationary() -> None:
    problem = waved(-0.6, 0.9)
    costs = []
    for iterations in (1, 4, 30):
        search = adp.BoxDDP(problem, steps=3, iterations=iterations, tolerance=1e-10, compile=False)
        found = search.solve(WAVED_X, WAVED_U, WAVED_AROUND)
        torch.testing.assert_close(cost_of(problem, WAVED_X, found.control), found.cost)
        torch.testing.assert_close(found.value[:, -1], problem.terminal(found.state[:, -1]))
        costs.append(found.cost)
    assert bool((torch.stack(costs).diff(dim=0) <= 0).all())
    assert bool(found.converged.any())
    slope = torch.func.grad(lambda u: cost_of(problem, WAVED_X, u).sum())(found.control)
    free = inward(problem, found.control, slope)[found.converged]
    assert float(free.abs().max()) < 1e-3


def test_a_row_is_found_alike_alone_and_beside_one_that_is_no_number() -> None:
    x0 = torch.tensor([[torch.nan, 0.0], [5.0, 0.0], [-1.0, 2.0]], dtype=torch.float64)
    search = adp.BoxDDP(BOUNDED, steps=12, compile=False)
    whole, some = search.solve(x0, still(3, 12)), search.solve(x0[1:2], still(1, 12))
    assert whole.converged.tolist() == [False, True, True]
    assert not math.isfinite(float(whole.cost[0]))
    for one, other in zip(some, rows_of(whole, torch.tensor([1])), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


@torch.no_grad()
@pytest.mark.compiled
@pytest.mark.needs_compiler
def test_compiled_passes_find_what_plain_torch_finds() -> None:
    problem, x = waved(-0.6, 0.9), WAVED_X.clone()
    start, around = WAVED_U[:, :2], Reference(*(part[:, :2] for part in WAVED_AROUND))
    x[5] = torch.nan
    found, passes = (
        adp.BoxDDP(problem, steps=2, iterations=12, **settings).solve(x, start, around)
        for settings in ({"compile": False}, {})
    )
    fine = torch.arange(8) != 5
    for name in ("state", "control", "feedback", "cost"):
        torch.testing.assert_close(getattr(passes, name)[fine], getattr(found, name)[fine], rtol=0, atol=1e-8)
    assert torch.equal(passes.converged, found.converged)
    assert bool(found.converged.any())


def numpy_plant() -> systems.StepPlant:
    return systems.StepPlant(lambda x, u: x + 0.1 * np.tanh(np.asarray(u)), dim=1, inputs=1, dt=0.1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: adp.SampledProblem(lambda x, u: (x, u), dim=2, inputs=1),
            r"`step\(x, u\)\[1\]` must map rows .5, 2., .5, 1. to .5,.",
        ),
        (lambda: adp.BoxDDP(BOUNDED, steps=5).solve(X0, still(2, 6)), r"must have the shape \(2, 5, 1\)"),
        (
            lambda: adp.SampledProblem.of(numpy_plant(), adp.QuadraticCost(1.0, 1.0, 1, 1)),
            "must be in torch all through",
        ),
    ],
)
def test_bad_input_is_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_a_plan_where_the_cost_is_concave_in_the_control_leads_to_a_minimum() -> None:
    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        waved = u.square() + 1 - (3 * u).cos()  # its second derivative is -7 at a third of pi
        return 0.9 * x + 0.1 * u, 0.1 * (x.square() + waved).sum(-1)

    problem = adp.SampledProblem(step, dim=1, inputs=1)
    x0 = torch.tensor([[1.0], [0.2]], dtype=torch.float64)
    start = torch.full((2, 10, 1), 1.0, dtype=torch.float64)
    found = adp.BoxDDP(problem, steps=10, compile=False).solve(x0, start)
    assert bool(found.converged.all())
    control = found.control.clone().requires_grad_()
    bent = torch.func.hessian(lambda u: cost_of(problem, x0[:1], u[None]).sum())(control[0].detach())
    assert float(torch.linalg.eigvalsh(bent.reshape(10, 10)).min()) > 0
    (slope,) = torch.autograd.grad(cost_of(problem, x0, control).sum(), control)
    assert float(slope.abs().max()) < 1e-4
