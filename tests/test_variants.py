"""Every variant stands in `variants.py`, and declares what others ask of it; targets are what they say."""

from __future__ import annotations

import inspect
import itertools
from types import ModuleType

import torch
from helpers import basis_of, tensor, uniform
from variants import (
    ACTOR_CRITIC_LAWS,
    CONTROLLERS,
    COSTS,
    KERNELS,
    LAWS,
    PLANTS,
    PREDICTORS,
    RADII,
    SYSTEMS,
    TARGETS,
    VALUE_BASES,
    over,
)

from staf_torch import adp, centers, kernels, optim, predictors, systems, targets
from staf_torch.adp import ActorCriticLaw

MADE = {
    "kernels": (kernels, kernels.Kernel, [case.make() for case in KERNELS.values()]),
    "laws": (optim, optim.UpdateLaw, list(LAWS.values())),
    "predictors": (predictors, predictors.Predictor, list(PREDICTORS.values())),
    "radii": (centers, centers.Radius, [make() for make, _ in RADII.values()]),
    "plants": (
        systems,
        systems.ControlAffineSystem,
        [make() for make in (*SYSTEMS.values(), *PLANTS.values())],
    ),
    "targets": (targets, torch.nn.Module, [make() for make, _ in TARGETS.values()]),
    "costs": (adp, adp.Cost, [make() for make in COSTS.values()]),
    "value bases": (adp, adp.ValueBasis, [make() for make in VALUE_BASES.values()]),
    "actor-critic laws": (adp, ActorCriticLaw, [make() for make in ACTOR_CRITIC_LAWS.values()]),
}
ELSEWHERE = {"LeadingCoordinates", "TwoStateTracking"}  # of the tracking problem, whose own tests build them


def final(room: ModuleType, base: type) -> set[type]:
    """The classes of a room that can be made."""
    found = (c for c in vars(room).values() if isinstance(c, type) and issubclass(c, base) and c is not base)
    return {c for c in found if not inspect.isabstract(c) and c.__name__ not in ELSEWHERE}


@over(MADE, "kind")
def test_every_variant_of_the_package_is_listed(kind: str) -> None:
    room, base, made = MADE[kind]
    missing = final(room, base) - {type(variant) for variant in made}
    assert missing == set()


@over(LAWS)
def test_the_work_of_a_law_grows_with_its_iterations(name: str) -> None:
    law = LAWS[name]
    work = [law.products(6, iterations) for iterations in range(1, 12)]
    assert all(later >= earlier for earlier, later in itertools.pairwise(work))
    assert law.title == law.title.strip() != ""


@over(CONTROLLERS)
def test_a_control_is_the_same_alone_and_beside_others(name: str) -> None:
    controller, x = CONTROLLERS[name](), uniform(4, 2)
    drawn = uniform(4, controller.draws, 2)
    u, _ = controller.step(x, controller.init(x), drawn, 0.01)
    for k in range(4):
        own = slice(k, k + 1)
        alone, _ = controller.step(x[own], controller.init(x[own]), drawn[own], 0.01)
        torch.testing.assert_close(u[own], alone)


@over(KERNELS)
def test_the_space_of_a_kernel_with_a_polynomial_degree_has_that_rank(name: str) -> None:
    kernel = KERNELS[name].make()
    degree = kernel.polynomial_degree()
    if degree is None:
        assert basis_of(name, 3).kernel.polynomial_degree() is None
    else:
        assert kernel.rank(2) == (degree + 1) * (degree + 2) // 2


@over(TARGETS)
def test_target_equals_its_formula_in_either_precision(name: str) -> None:
    (make, formula), batch = TARGETS[name], (2, 3)
    x = uniform(*batch, 2, low=-2, high=2)
    values = make()(x)
    assert values.shape == batch
    expected = tensor([formula(point) for point in x.reshape(-1, 2).tolist()]).reshape(batch)
    torch.testing.assert_close(values, expected, rtol=1e-14, atol=1e-14)
    single = make()(x.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), values, rtol=1e-5, atol=1e-5)


@over(TARGETS)
def test_gradient_of_the_target_is_right(name: str) -> None:
    assert torch.autograd.gradcheck(TARGETS[name][0](), (uniform(4, 2).requires_grad_(),))
