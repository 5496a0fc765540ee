"""Compiled calls under torch's modes: a default device, inference mode."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

import staf_torch as st
from staf_torch import adp, lanes, online, optim, systems

X = torch.tensor([[0.3, 0.0], [-0.2, 0.5]], dtype=torch.float64)
STATES = torch.rand(3, 20, 2, dtype=torch.float64)
PLANT = systems.Pendulum()
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)


def policy() -> Any:
    return adp.near_optimal(PLANT, COST, dt=0.05, reach="local")


def calls() -> dict[str, Callable[[], Tensor]]:
    """One of every kind of compiled call, of objects that are made here."""
    made = policy()
    lanes.ready(made, X)
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(6), 0.1))
    drift = lanes.Program(lambda x, u, row: (x + 0.1 * (u - x.sin()), x))
    regressors = [
        kind().fit(STATES[0], STATES[0].sum(-1)) for kind in (st.StaFRegressor, online.MixtureRegressor)
    ]
    problem = adp.SampledProblem.of(PLANT, COST, dt=0.05)
    return {
        "policy": lambda: made(X),
        "plan": lambda: adp.BoxDDP(problem, steps=2, compile=False).solve(X).control,
        "chase": lambda: (
            st.chase(STATES, basis, lambda x: x.square().sum(-1), optim.SteepestDescent()).estimate
        ),
        "simulation": lambda: systems.simulate(PLANT, X, dt=0.05, steps=300)[:, -1],
        "program": lambda: drift(X, STATES[:2])[1],
        **{type(one).__name__: lambda one=one: one.predict(STATES[1]) for one in regressors},
    }


@contextmanager
def default_device(name: str) -> Iterator[None]:
    torch.set_default_device(name)
    try:
        yield
    finally:
        torch.set_default_device(None)


def test_a_default_device_reaches_no_call_and_nothing_that_is_made() -> None:
    expected = {name: (call, call()) for name, call in calls().items()}
    with default_device("meta"):
        for name, call in calls().items():
            for found in (call(), expected[name][0]()):
                assert found.device.type == "cpu", name
                assert found.equal(expected[name][1]), name


def test_a_program_compiled_under_a_default_device_is_that_of_the_inputs_device() -> None:
    def step(x: Tensor, now: Any, row: Any) -> tuple[Tensor, Tensor]:
        x = x + torch.tensor(0.25, dtype=torch.float64) * x.cos()
        return x, x

    with default_device("meta"):
        program = lanes.Program(step)
        found, _ = program(X, steps=5)
    assert program.compiled
    torch.testing.assert_close(found, lanes.Program(step, compile=False)(X, steps=5)[0], rtol=1e-12, atol=0)


def test_what_is_made_in_inference_mode_compiles_and_is_never_stale() -> None:
    with torch.inference_mode():
        inside = calls()
        found = {name: call() for name, call in inside.items()}
        gain = torch.tensor([[1.0, 0.5]], dtype=torch.float64)
        program = lanes.Program(lambda x, now, row: (x - 0.1 * (x * gain).sum(-1, keepdim=True), ()))
        first, _ = program(X.clone(), steps=4)
        gain *= 2
        second, _ = program(X.clone(), steps=4)
    assert program.compiled
    for name, call in calls().items():
        torch.testing.assert_close(found[name], call(), rtol=1e-9, atol=1e-12)
    for factor, moved in (0.5, first), (1.0, second):
        expected = X.clone()
        for _ in range(4):
            expected = expected - 0.1 * (expected * factor * gain).sum(-1, keepdim=True)
        torch.testing.assert_close(moved, expected, rtol=1e-12, atol=0)
