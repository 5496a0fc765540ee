"""A program of every kernel, law, predictor, plant and controller, for `python -m tests.gpu --ptxas`."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from variants import ACTOR_CRITIC_LAWS, KERNELS, LAWS, PLANTS, PREDICTORS, VALUE_BASES

import staf_torch as st
from staf_torch import adp, systems, targets

X0 = torch.tensor([[0.3, -0.2], [-0.1, 0.4]], dtype=torch.float64)


def chased(kernel: str, law: str, predictor: str) -> Tensor:
    centers = st.StateFollowingCenters(st.rings(3), st.StateRadius(1.0, 0.1))
    basis, more = st.StaFBasis(KERNELS[kernel].make(), centers), {"predictor": PREDICTORS[predictor]}
    states = X0.unsqueeze(1).expand(-1, 16, -1)
    return st.chase_weights(states, basis, targets.Paper(), LAWS[law], **more).weights


def moved(name: str) -> Tensor:
    """A plant under a linear feedback."""
    plant = PLANTS[name]()
    start = torch.full((3, plant.equilibrium().numel()), 0.1, dtype=torch.float64)
    cost = adp.QuadraticCost(1.0, 1.0, start.shape[1], plant.inputs)
    feedback = lambda x: -x[..., : plant.inputs]  # noqa: E731
    return adp.simulate(feedback, plant, cost, start, dt=0.01, steps=20, every=2).cost


def looped(name: str) -> Tensor:
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1, low=-5.0, high=5.0)
    controller = _CONTROLLERS[name](plant, cost)
    return adp.simulate(controller, plant, cost, X0, dt=0.01, steps=20, every=2).cost


def _learner(name: str, basis: str, plant: Any, cost: Any) -> Any:
    points = adp.QuadraturePoints(2, 2, 0.5)
    return adp.ActorCritic(VALUE_BASES[basis](), plant, cost, points, ACTOR_CRITIC_LAWS[name]())


_CONTROLLERS: dict[str, Callable[[Any, Any], Any]] = {
    "LQR": adp.LQR,
    "Supervised": lambda p, c: adp.Supervised(adp.Feedback(lambda x: 9 * x[..., 1:]), adp.LQR(p, c), c),
    "RolloutPolicy": lambda p, c: adp.RolloutPolicy.of_lqr(p, c, steps=2, horizon=0.1),
    **{f"{law}, staf": functools.partial(_learner, law, "staf") for law in ACTOR_CRITIC_LAWS},
    **{f"{basis} basis": functools.partial(_learner, "information", basis) for basis in VALUE_BASES},
}
PROGRAMS: dict[str, Callable[[], Any]] = {
    **{f"kernel {k}": functools.partial(chased, k, "conjugate gradient", "none") for k in KERNELS},
    **{f"law {law}": functools.partial(chased, "gaussian", law, "none") for law in LAWS},
    **{f"predictor {k}": functools.partial(chased, "gaussian", "steepest descent", k) for k in PREDICTORS},
    **{f"plant {name}": functools.partial(moved, name) for name in PLANTS},
    **{f"loop with {name}": functools.partial(looped, name) for name in _CONTROLLERS},
}
