"""What kernels, bases, plants, chases and bounds give at a few states, recorded."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import basis_of, tensor, uniform
from recorded import Record
from torch import Tensor
from variants import (
    COSTS,
    KERNELS,
    LAWS,
    LAYOUTS,
    PAIRS,
    PLANTS,
    PREDICTORS,
    RATED,
    SMOOTH_KERNELS,
    TARGETS,
    VALUE_BASES,
    directions_of,
    over,
)

import staf_torch as st
from staf_torch import adp, centers, systems, theory
from staf_torch.approximation import conditioning, sensitivity
from staf_torch.engine import chase_weights
from staf_torch.metrics.ball_error import StateErrorPass
from staf_torch.metrics.chase import ChaseMetrics
from staf_torch.optim import SteepestDescent
from staf_torch.targets import Paper
from staf_torch.theory.uniform_approximation import ball_grid, near_best, supremum

X = tensor([[1.0, 0.0], [0.3, -0.9], [-1.2, 0.4]])
MOVING = st.StateRadius(0.7, 0.05, gain=1.5)


def of_layouts() -> Any:
    found = {name: directions_of(name) for name in LAYOUTS}
    return found, {(k, n): centers.probe_points(k, n) for k in (5, 40) for n in (1, 2, 3, 4)}


def of_kernels(name: str) -> Any:
    kernel, z = KERNELS[name].make(), X + 0.2 * uniform(3, 2, seed=1)
    basis = basis_of(name, 6, MOVING)
    given = targets(Paper())
    found = [kernel(X, z), kernel(X[:, :1], z[:, :1]), basis(z, X), basis.ideal_weights(X, given)]
    found += [conditioning.conditioning(basis, X), conditioning.lebesgue_constant(basis, X, 60)]
    found += [conditioning.sup_error(basis, X, given, 60), conditioning.cardinal_functions(basis, X, z)]
    if name in SMOOTH_KERNELS:
        found += [sensitivity.weight_jacobian(basis, X, given), sensitivity.state_jacobian(basis, X, given)]
        found += [theory.power_function(basis, X, z), theory.power_function(basis, X, z, relative=True)]
    return found


def targets(target: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    return lambda x: target(x) + 0.3 * x[..., 0].sin()


def of_plants(name: str) -> Any:
    plant = PLANTS[name]()
    x = 0.6 * uniform(4, plant.dim, seed=2)
    u = uniform(4, plant.inputs, seed=3)
    found = [plant.drift(x), plant.effectiveness(x), plant.rate(x, u), plant.spread, plant.equilibrium()]
    q, r = torch.eye(plant.dim).double(), torch.eye(plant.inputs).double()
    found += [plant.linearisation(), plant.optimal_value(x, q, r)]
    found += [systems.runge_kutta_step(lambda y: plant.rate(y, u), x, 0.05), plant.period, plant.traceable]
    if isinstance(plant, systems.Barrier):
        inside = plant.inverse(x)
        found += [inside, plant.transform(inside), plant.margin(x), plant.stretch(x)]
    return found


def of_chases(law: str, predictor: str) -> Any:
    states = systems.simulate(systems.Oscillator(), X, dt=0.05, steps=12)
    basis = basis_of("gaussian", 6, 0.3)
    given = {"inner_steps": 3, "predictor": PREDICTORS[predictor]}
    found = st.chase(states, basis, Paper(), LAWS[law], certificate=law in RATED, **given)  # type: ignore[arg-type]
    start = uniform(6, seed=4)
    others = chase_weights(states.float(), basis.float(), Paper(), LAWS[law], weights=start, history=False)
    return found, others.diverged_at


def of_metrics() -> Any:
    basis, law = basis_of("gaussian", 6, MOVING), SteepestDescent()
    states = systems.simulate(systems.Oscillator(), X, dt=0.05, steps=30)
    metrics = ChaseMetrics(basis, Paper(), law, inner_steps=2, dt=0.05, settle_time=0.5)
    result = st.chase(states, basis, Paper(), law, inner_steps=2, certificate=True)
    metrics.add(result)
    errors = StateErrorPass(basis, Paper(), expected=3)
    ideal = basis.ideal_weights(X, Paper())
    at = errors(X.unsqueeze(1), result.coefficients[:, 5:6], ideal.unsqueeze(1))
    return metrics.summary(), at


def of_bounds() -> Any:
    domain = theory.disc(0.7, count=9)
    basis = basis_of("exponential", 6, 0.3)
    velocities = systems.Oscillator().drift(X)
    constants = theory.drift_constants(basis, Paper(), X, velocities)
    found: list[Any] = [domain, theory.disc(dim=3, count=20, center=[0.1, 0.2, 0.3]), constants]
    for law in RATED.values():
        found.append(theory.ultimate_bound(constants, law, dt=1e-3, inner_steps=20))
        found.append(theory.step_for_bound(constants, law, excess=0.1, inner_steps=20))
        found.append(theory.steps_for_bound(constants, law, excess=0.1, dt=1e-3))
    found.append(theory.paper_step(basis, Paper(), X, velocities, excess=0.1))
    found.append(theory.paper_step(basis, Paper(), X, velocities, excess=0.5, initial_weights=uniform(6)))
    found.append(theory.exponential_bound(Paper(), domain, 0.1, 0.03))
    found.append(theory.one_polynomial_bound(targets(Paper()), 0.5 * domain, 0.3, 0.01))
    kernel = st.ExponentialKernel()
    found.append(theory.minimal_count(Paper(), kernel, X, 0.1, 0.02))
    found.append(theory.layout_errors(Paper(), kernel, X, 0.2, theory.standard_layouts(2)[:5]))
    return found


def of_polynomials() -> Any:
    found: list[Any] = []
    for dim, degree in ((1, 4), (2, 3), (3, 2)):
        z = ball_grid(dim, 4, 16)
        f = torch.stack([(z @ (torch.arange(dim) + k + 0.3).double()).sin() for k in range(3)])
        weight = 1 + f.square()
        found += [z, near_best(z, degree, f, weight, tensor([1e-9, 1e-2, 1.0]))]
        waves = tensor([1.0, 3.0, 7.0])[:, None]
        found.append(supremum(lambda y, a=waves: (a * y.sum(-1)).sin() - y[..., 0].square(), 0.7 * z, 0.7))  # type: ignore[misc]
    return found


def of_costs() -> Any:
    x, u = uniform(5, 2, seed=5), uniform(5, 1, seed=6)
    g, slope = uniform(5, 2, 1, seed=7), uniform(5, 2, seed=8)
    found: dict[str, Any] = {}
    for name, make in COSTS.items():
        cost = make()
        y, across, gradient = x, g, slope
        if name == "tracking":
            y, across, gradient = (
                torch.cat((x, x[:, :1]), -1),
                *(torch.cat((part, part[:, :1]), 1) for part in (g, slope)),
            )
        found[name] = (cost.rate(y, u), cost.state_rate(y), cost.policy(across, gradient), cost.bounds)
    for name, value in VALUE_BASES.items():
        basis = value()
        found[name] = basis(x, x), adp.value_gradient(lambda y, b=basis: b(y, x).sum(-1), x)  # type: ignore[misc]
    return found


CASES: dict[str, Callable[[], Any]] = {
    "layouts": of_layouts,
    "metrics": of_metrics,
    "bounds": of_bounds,
    "polynomials": of_polynomials,
    "costs": of_costs,
    "radii": lambda: [MOVING(X), MOVING(X[:, :1]), st.StateRadius(0.3, 0.01)(X), st.ConstantRadius(0.2)(X)],
    "targets": lambda: {name: make()(X) for name, (make, _) in TARGETS.items()},
}


@pytest.mark.parametrize("name", CASES)
def test_what_a_room_gives_is_the_recorded(name: str, record: Record) -> None:
    record(CASES[name]())


@over(KERNELS)
def test_what_a_kernel_gives_is_the_recorded(name: str, record: Record) -> None:
    record(of_kernels(name), rtol=1e-5)


@over(PLANTS)
def test_what_a_plant_gives_is_the_recorded(name: str, record: Record) -> None:
    record(of_plants(name))


@pytest.mark.parametrize(("law", "predictor"), PAIRS)
def test_what_a_chase_gives_is_the_recorded(law: str, predictor: str, record: Record) -> None:
    record(of_chases(law, predictor), rtol=1e-5)
