"""torch's default dtype belongs to the caller: no number of the library depends on it, in no bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from composing import settings
from helpers import basis_of
from helpers_chase import BASES, LAW, circles
from recorded import leaves
from test_modules import MODULES, X
from torch import Tensor
from variants import DESCENDING, KERNELS, LAYOUTS, PLANTS, PREDICTORS, TARGETS, over

import staf_torch as st
from staf_torch import adp, optim, predictors, systems, theory
from staf_torch.adp.planning.shooting.starts import guesses
from staf_torch.experiments import avoidance
from staf_torch.experiments.rival_plants import CASES


@contextmanager
def default(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def numbers(thing: Any) -> list[Tensor]:
    """Every number of a result, with its dtype."""
    parts = (part for _, part in leaves(thing) if not isinstance(part, str))
    kinds = ((part, torch.float64 if isinstance(part, float) else None) for part in parts)
    return [torch.as_tensor(part, dtype=dtype).detach() for part, dtype in kinds]


def shooting() -> Any:
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1, low=-1.0, high=1.0)
    return [(each.knots, each.until) for each in guesses(cost, adp.LQR(plant, cost), X, 3.0, 4, seed=1)]


def chased(law: optim.UpdateLaw, predictor: predictors.Predictor | None = None) -> Any:
    target = TARGETS["paper"][0]()
    found = st.chase(circles(2, 6), BASES["gaussian"], target, law, inner_steps=2, predictor=predictor)
    return vars(found) if hasattr(found, "__dict__") else tuple(found)


def held(name: str) -> Any:
    plant = PLANTS[name]()
    x = 0.3 * torch.ones(3, plant.dim, dtype=torch.float64)
    u = 0.2 * torch.ones(3, plant.inputs, dtype=torch.float64)
    return plant.motion(x, u), plant.linearisation() if name != "three_state" else ()


TIME = np.arange(80) * 0.1
STREAM = np.stack((np.cos(TIME), np.sin(TIME)), -1)


def learned() -> Any:
    return st.StaFRegressor().fit(STREAM, STREAM[:, 0] ** 2 + STREAM[:, 1]).predict(STREAM[-1])


THINGS: dict[str, Callable[[], Any]] = {
    **{f"module {k}": lambda c=c: (m := c.make(0.9), c.call(m, X)) for k, c in MODULES.items()},
    **{f"directions {k}": c.make for k, c in LAYOUTS.items() if c.dim < 4},
    **{f"weights {k}": lambda k=k: basis_of(k).ideal_weights(X, TARGETS["paper"][0]()) for k in KERNELS},
    **{f"law {k}": lambda law=law: chased(law) for k, law in DESCENDING.items()},
    **{f"predictor {k}": lambda p=p: chased(LAW, p) for k, p in PREDICTORS.items()},
    **{f"plant {k}": lambda k=k: held(k) for k in PLANTS},
    **{f"states of {k}": lambda c=c: (c.goal(), c.states(4, 1), c.cost()) for k, c in CASES.items()},
    "guesses": shooting,
    "stream": learned,
    "scenarios": lambda: avoidance.scenarios(settings("experiment=avoidance", "trajectories=3")),
    "minimal count": lambda: theory.minimal_count(
        TARGETS["paper"][0](), st.ExponentialKernel(), X, radius=0.3, epsilon=1e-2
    ),
    "sensitivity": lambda: (
        st.StaF(basis_of("gaussian"), (3,)).fit_(X, TARGETS["paper"][0]()).hessian(X[:, None])
    ),
}


@over(THINGS)
def test_no_number_depends_on_the_default_dtype(name: str) -> None:
    found = []
    for dtype in (torch.float32, torch.float64):
        torch.manual_seed(0)
        with default(dtype):
            found.append(numbers(THINGS[name]()))
    single, double = found
    assert len(single) == len(double) > 0
    for one, two in zip(single, double, strict=True):
        assert one.dtype == two.dtype
        torch.testing.assert_close(one, two, rtol=0, atol=0, equal_nan=True)
