"""Every variant of the library stands in `variants.py`, and declares what others ask of it."""

from __future__ import annotations

import inspect
import itertools
from types import ModuleType

import torch
from helpers import basis_of
from variants import (
    ACTOR_CRITIC_LAWS,
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
from staf_torch.experiments.laws import cases
from staf_torch.systems import Units

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
ELSEWHERE = {"LeadingCoordinates"}  # a wrapper of the tracking problem, which its own tests build


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


def test_work_is_what_the_comparison_of_laws_counts() -> None:
    """Ten iterations and one product to begin; a filter's matrices; K^-1 beside K; nothing."""
    found = {case.key: case.products for case in cases(11, 3)}
    assert found["steepest_descent_x10"] == 11
    assert found["recursive_least_squares_x1"] == 18
    assert found["preconditioned_descent_core_x1"] == 3
    assert found["normalised_lms_x1"] == 0
    assert found["exact_x1_tangent_order_2"] == 1 + 2 * 3 + 2


@over(PLANTS)
def test_a_plant_declares_units_for_each_coordinate_or_for_all(name: str) -> None:
    plant = PLANTS[name]()
    assert isinstance(plant.units, Units)
    assert len(plant.units.state.split(", ")) in (1, plant.dim)
    assert plant.spread > 0


@over(KERNELS)
def test_the_space_of_a_kernel_with_a_polynomial_degree_has_that_rank(name: str) -> None:
    kernel = KERNELS[name].make()
    degree = kernel.polynomial_degree()
    if degree is None:
        assert basis_of(name, 3).kernel.polynomial_degree() is None
    else:
        assert kernel.rank(2) == (degree + 1) * (degree + 2) // 2
