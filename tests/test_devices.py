"""What a run touches is where its tensors are: a device that is pretended refuses a tensor of the CPU."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers_experiments import run, words
from helpers_swingup import double_integrator
from pretend_device import DEVICE, Elsewhere
from torch import Tensor
from variants import (
    ACTOR_CRITIC_LAWS,
    COSTS,
    KERNELS,
    LAWS,
    PLANTS,
    PREDICTORS,
    RADII,
    TARGETS,
    VALUE_BASES,
    over,
)

import staf_torch as st
from staf_torch import adp, lanes, online, systems, targets

X0 = torch.tensor([[0.3, -0.2], [-0.1, 0.4]], dtype=torch.float64)


def there(tensor: Tensor) -> Tensor:
    return tensor.to(DEVICE)


def agree(found: Tensor, wanted: Tensor) -> None:
    assert isinstance(found, Elsewhere)
    torch.testing.assert_close(found.cpu(), wanted, rtol=1e-9, atol=1e-12, equal_nan=True)


def test_a_device_that_is_pretended_refuses_tensors_of_the_cpu() -> None:
    with pytest.raises(RuntimeError, match="same device"):
        there(X0) + X0


def controllers(plant: Any, cost: Any) -> dict[str, Any]:
    points = adp.RandomPoints(1, st.StateRadius(2.1, 1e-5)), adp.QuadraturePoints(2, 2, 0.5)
    lqr = adp.LQR(plant, cost)
    found = {"lqr": lqr, "held": adp.LQR(plant, cost, period=0.01), "function": lambda x: -3 * x[..., 1:]}
    found["supervised"] = adp.Supervised(adp.Feedback(lambda x: 9 * x[..., 1:]), lqr, cost)
    found["rollout"] = adp.RolloutPolicy.of_lqr(plant, cost, steps=2, horizon=0.1)
    for k, (name, law) in enumerate(ACTOR_CRITIC_LAWS.items()):
        basis = list(VALUE_BASES.values())[k % len(VALUE_BASES)]()
        found[name] = adp.ActorCritic(basis, plant, cost, points[k % 2], law())
    return found


WIDTHS = torch.linspace(0.5, 1.5, 2, dtype=torch.float64)
REGRESSORS: dict[str, Callable[[Tensor, Tensor], Any]] = {
    "tuned, by numbers of a stream's own": lambda x, y: st.StaFRegressor(
        st.GaussianKernel(st.rows(WIDTHS)), noise=st.rows(WIDTHS), count=3
    ).tune(x, y),
    "mixture": lambda x, y: online.MixtureRegressor(),
}


@pytest.mark.parametrize("name", REGRESSORS)
def test_streams_take_samples_of_a_device_and_a_copy_goes_on_there(name: str) -> None:
    angle = torch.arange(3, dtype=torch.float64).unsqueeze(-1) + torch.arange(2)
    x = torch.stack((angle.cos(), angle.sin()), -1)

    def predicted(x: Tensor) -> list[Tensor]:
        y = x.sum(-1)
        model = REGRESSORS[name](x, y)
        found = [copy.deepcopy(model.fit(x, y)).partial_fit(x[0], y[0]).predict(x[2])]
        return [*found, model.forecast(x, y).mean] if hasattr(model, "forecast") else found

    for one, other in zip(predicted(there(x)), predicted(x), strict=True):
        agree(one, other)


def test_a_design_of_a_device_is_that_of_the_cpu() -> None:
    plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, 2, 1, low=-3.0, high=3.0)
    wanted = adp.DirectShooting(plant, cost, horizon=0.5, intervals=4, starts=1).solve(X0[:1])
    plant, cost = plant.to(DEVICE), cost.to(DEVICE)
    agree(
        adp.DirectShooting(plant, cost, horizon=0.5, intervals=4, starts=1).solve(there(X0[:1])).value,
        wanted.value,
    )


@pytest.mark.parametrize(("name", "duration"), [("gradient_chase", 0.5), ("icl", 0.1)])
def test_an_experiment_runs_on_a_device_with_the_numbers_of_the_cpu(
    name: str, duration: float, tmp_path: Path
) -> None:
    folders = [tmp_path / "here", tmp_path / "there"]
    for folder in folders:
        folder.mkdir()
    line = [*words(name), f"duration={duration}", "figures=false"]
    wanted = run(folders[0], *line, "history=false").metrics
    found = run(folders[1], *line, f"device={DEVICE.type}").metrics
    assert found == {
        key: None if number is None else pytest.approx(number, rel=1e-6, abs=1e-9)
        for key, number in wanted.items()
    }


def test_an_experiment_of_the_cpu_says_so_where_a_device_is_asked_for(tmp_path: Path) -> None:
    line = "experiment=flat_limit flat_limit.radii.smallest=0.1 flat_limit.counts=[3] figures=false"
    found = run(tmp_path, *line.split(), f"device={DEVICE.type}")
    assert "the task flat_limit computes on the CPU and not on lazy" in found.log


def test_what_was_made_on_the_cpu_serves_states_that_are_elsewhere() -> None:
    masses = st.rows(torch.tensor([0.5, 2.0], dtype=torch.float64))
    plant, cost = systems.Pendulum(mass=masses), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    policy = adp.LQR(systems.Pendulum(), cost)
    basis = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.rings(6), 0.1))

    def found(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        loop = adp.simulate(policy, plant, cost, x, dt=0.01, steps=2)
        states = systems.simulate(plant, x, dt=0.01, steps=3)
        return loop.cost, states, st.chase(states, basis, targets.Paper(), st.optim.Exact()).estimate

    with lanes.compiling("never"):
        for there_, here in zip(found(there(X0)), found(X0), strict=True):
            agree(there_, here)


def test_planners_and_memories_that_were_made_on_the_cpu_take_states_of_a_device(
    caplog: pytest.LogCaptureFixture,
) -> None:
    problem = double_integrator(-1.0, 1.0)
    memory = adp.GlobalValue(problem, adp.BoxDDP(problem, steps=30, compile=False).solve(X0), [3.0, 3.0])
    plans = adp.RecedingHorizon(problem, steps=3, memory=memory, compile=False)
    sampled = adp.PathIntegral(problem, steps=3, knots=2, samples=4, compile=False)
    moved = copy.deepcopy(memory).to(DEVICE)

    def planned(x: Tensor) -> list[Tensor]:
        drawn = 0.5 * torch.ones(len(x), sampled.draws, 2, dtype=x.dtype, device=x.device)
        found = [each.step(x, each.init(x), drawn, 0.1)[0] for each in (plans, sampled)]
        held = memory if x.device.type == "cpu" else moved
        return [*found, memory(x[:1]), memory.value(x), held(x), held.gradient(x), held.bellman_residual(x)]

    for one, other in zip(planned(there(X0)), planned(X0), strict=True):
        agree(one, other)
    assert "`.to('lazy:0')` before compute there" in caplog.text


# The meta device: shapes, dtypes and structure of what a call returns, and nothing is computed.

META = torch.device("meta")


def form(result: Any, device: torch.device) -> Any:
    """What a result is but for its numbers, all of which are on a device."""
    if isinstance(result, Tensor):
        assert result.device == device
        return tuple(result.shape), result.dtype
    if dataclasses.is_dataclass(result) and not isinstance(result, type):
        fields = (f.name for f in dataclasses.fields(result) if f.compare and f.name != "time")
        result = {name: getattr(result, name) for name in fields}
    if isinstance(result, dict):
        return {name: form(part, device) for name, part in result.items()}
    parts = result if isinstance(result, tuple | list) else ()
    return type(result), *(form(part, device) for part in parts)


def around(state: Tensor, kernel: str, radius: str) -> Any:
    centers = st.StateFollowingCenters(st.rings(6), RADII[radius][0]())
    return st.StaFBasis(KERNELS[kernel].make(), centers).to(state.device)


def evaluated(x: Tensor, kernel: str, radius: str, target: str) -> Any:
    basis, function = around(x, kernel, radius), TARGETS[target][0]()
    fitted, y = st.StaF(basis, (len(x),)).fit_(x, function), x.unsqueeze(-2) + 0.01
    smooth = KERNELS[kernel].derivatives
    slopes = (
        [fitted.gradient(y, mode) for mode in ("partial", "total_frozen_weights", "total")] if smooth else []
    )
    bent = [fitted.hessian(y)] if smooth > 1 else []
    weights = basis.ideal_weights(x, function)
    return fitted(y), fitted.weights, *slopes, *bent, basis.gram(x), basis.excess(weights, x, function)


def chased(x: Tensor, law: str, kernel: str, predictor: str, times: int = 5) -> Any:
    states, basis = x.unsqueeze(1).expand(-1, times, -1), around(x, kernel, "shrinking")
    more: dict[str, Any] = {"predictor": PREDICTORS[predictor]}
    result = st.chase(states, basis, targets.Paper(), LAWS[law], certificate=True, **more)
    return result, st.chase_weights(states, basis, targets.Paper(), LAWS[law], history=False, **more)


def moving(x: Tensor, name: str, steps: int = 4) -> Any:
    plant = PLANTS[name]().to(x.device)
    start = x.new_full((3, plant.equilibrium().numel()), 0.1)
    cost = adp.QuadraticCost(1.0, 1.0, start.shape[1], plant.inputs).to(x.device)
    loop = adp.simulate(lambda x: -x[..., : plant.inputs], plant, cost, start, dt=0.01, steps=steps, every=2)
    here = systems.simulate(PLANTS[name](), start, dt=0.01, steps=steps)  # of a plant that was not moved
    return systems.simulate(plant, start, dt=0.01, steps=steps), here, loop


def paid(x: Tensor, name: str) -> Tensor:
    cost = COSTS[name]().to(x.device)
    return cost.rate(x.new_ones(3, cost.dim), x.new_ones(3, cost.inputs))


def streamed(x: Tensor) -> Any:
    states = x.expand(3, -1, -1)
    y = states.sum(-1)
    model = st.StaFRegressor(count=3).fit(states, y).partial_fit(x, y[0], lapse=0.5)
    return model.predict(x, return_std=True), model.forecast(states, y).mean, model.smooth(states, y)


def looped(x: Tensor, name: str) -> Any:
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1, low=-5.0, high=5.0)
    controller = controllers(plant, cost)[name]
    kept = adp.simulate(controller, plant, cost, x, dt=0.01, steps=2)
    assert not any(each.is_meta for each in (*plant.buffers(), *cost.buffers()))
    if isinstance(controller, adp.Controller):  # and where all of it is on the device
        controller, plant, cost = (copy.deepcopy(part).to(x.device) for part in (controller, plant, cost))
    return kept, adp.simulate(controller, plant, cost, x, dt=0.01, steps=2)


def turns(*tables: Any) -> list[tuple[str, ...]]:
    """Variants of several kinds, each in its turn beside one of the others."""
    return [tuple(list(each)[k % len(each)] for each in tables) for k in range(max(map(len, tables)))]


def held(x: Tensor, policy: str) -> Any:
    plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-3.0, high=3.0)
    made = {
        "a filter": lambda: adp.SafetyFilter(
            adp.LQR(plant, cost), plant, lambda x, t: 1 - x.square().sum(-1), dt=0.01
        ),
        "near_optimal": lambda: adp.near_optimal(plant, cost, dt=0.05, reach="local"),
    }[policy]()
    return copy.deepcopy(made).to(x.device)(x)


BASES = turns(("gaussian", "matern12"), RADII, TARGETS)[:4]
CHASES = [*turns(LAWS, KERNELS, ("none", "secant")), ("exact", "gaussian", "tangent, order 2")]
LOOPS = list(controllers(systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1)))
FORMAL: dict[str, Callable[[Tensor], Any]] = {
    **{f"basis of {', '.join(c)}": lambda x, c=c: evaluated(x, *c) for c in BASES},
    **{f"chase by {', '.join(c)}": lambda x, c=c: chased(x, *c) for c in CHASES},
    **{f"plant {name}": lambda x, n=name: moving(x, n) for name in PLANTS},
    **{f"cost {name}": lambda x, n=name: paid(x, n) for name in COSTS},
    **{f"value basis {name}": lambda x, n=name: VALUE_BASES[n]().to(x.device)(x, x) for name in VALUE_BASES},
    "stream": streamed,
    **{f"loop with {name}": lambda x, n=name: looped(x, n) for name in LOOPS},
    **{f"policy {name}": lambda x, n=name: held(x, n) for name in ("a filter", "near_optimal")},
}


@over(FORMAL)
def test_on_the_meta_device_a_call_returns_all_but_the_numbers(name: str) -> None:
    with lanes.compiling("never"):
        wanted = FORMAL[name](X0)
    found = FORMAL[name](X0.to(META))
    assert form(found, META) == form(wanted, X0.device)
    assert repr(found)


def test_on_the_meta_device_a_million_steps_are_one() -> None:
    x, steps = X0.to(META).requires_grad_(), 10**6
    plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    states = systems.simulate(plant, x, dt=0.01, steps=steps)
    loop = adp.simulate(adp.LQR(plant, cost), plant, cost, x, dt=0.01, steps=steps, compile=True)
    basis = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.rings(6), 0.1))
    chase = st.chase(states, basis, targets.Paper(), LAWS["exact"], inner_steps=steps)
    assert states.shape == loop.state.shape == (2, steps + 1, 2)
    assert chase.weights.shape == (2, steps + 1, 6)
    (slope,) = torch.autograd.grad(chase.excess.sum() + loop.cost.sum(), x)
    assert (slope.shape, slope.device) == (x.shape, META)


def decided(name: str) -> Any:
    x, plant, cost = X0.to(META), systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    there_, cost_there = copy.deepcopy(plant).to(META), copy.deepcopy(cost).to(META)
    problem = adp.SampledProblem.of(plant, cost, dt=0.05)
    return {
        "near_optimal": lambda: adp.near_optimal(there_, cost_there, dt=0.05),
        "BoxDDP": lambda: adp.BoxDDP(problem, steps=3).solve(x),
        "StaFRegressor.tune": lambda: st.StaFRegressor().tune(x, x[:, 0]),
        "MixtureRegressor": lambda: online.MixtureRegressor().fit(x, x[:, 0]),
        "simulate": lambda: adp.simulate(
            lambda x: x[:, :1] if x.sum() else x, plant, cost, x, dt=1.0, steps=1
        ),
    }[name]()


@pytest.mark.parametrize(
    "name",
    ["near_optimal", "BoxDDP", "StaFRegressor.tune", "MixtureRegressor", "simulate"],
)
def test_what_numbers_decide_is_refused_on_the_meta_device(name: str) -> None:
    with pytest.raises(ValueError, match=rf"`{name}.*must have numbers, which decide .* meta"):
        decided(name)
