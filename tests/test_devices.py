"""What a run touches is where its tensors are: a device that is pretended refuses a tensor of the CPU."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers_experiments import run, words
from helpers_swingup import double_integrator
from pretend_device import DEVICE, Elsewhere
from torch import Tensor
from variants import ACTOR_CRITIC_LAWS, KERNELS, LAWS, PLANTS, PREDICTORS, VALUE_BASES, by_turns, over

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


@pytest.mark.parametrize("made_there", [False, True])
def test_a_closed_loop_is_where_its_states_are(made_there: bool) -> None:
    def problem() -> tuple[Any, Any]:
        return systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1, low=-5.0, high=5.0)

    plain, (plant, cost) = controllers(*problem()), problem()
    if made_there:
        plant, cost = plant.to(DEVICE), cost.to(DEVICE)
    for name, controller in controllers(plant, cost).items():
        with lanes.compiling("never"):
            wanted = adp.simulate(plain[name], *problem(), X0, dt=0.01, steps=2)
            found = adp.simulate(controller, plant, cost, there(X0), dt=0.01, steps=2)
        agree(found.state, wanted.state)
        agree(found.cost, wanted.cost)


@over(PLANTS)
def test_a_plant_and_its_trajectories_follow_the_states(name: str) -> None:
    plant = PLANTS[name]()
    assert plant.dim is not None
    x0 = 0.1 * torch.ones(2, plant.dim, dtype=torch.float64)
    wanted = systems.simulate(plant, x0, dt=0.01, steps=2)
    moved = PLANTS[name]().to(DEVICE)
    made_here = systems.simulate(plant, there(x0), dt=0.01, steps=2)
    agree(made_here, wanted)
    agree(systems.simulate(moved, there(x0), dt=0.01, steps=2), wanted)
    agree(moved.linearisation().matrix, plant.linearisation().matrix)


@pytest.mark.parametrize(("kernel", "law"), by_turns(KERNELS, list(LAWS)))
def test_a_chase_follows_the_states(kernel: str, law: str) -> None:
    states = systems.simulate(systems.Oscillator(), X0, dt=0.05, steps=3)
    predictor = PREDICTORS["secant"] if law == "steepest descent" else None

    def chased(x: Tensor) -> Tensor:
        centers = st.StateFollowingCenters(st.rings(6), st.StateRadius(0.4, 0.01))
        basis = st.StaFBasis(KERNELS[kernel].make(), centers).to(x.device)
        return st.chase(x, basis, targets.Paper(), LAWS[law], predictor=predictor).estimate

    agree(chased(there(states)), chased(states))


WIDTHS = torch.linspace(0.5, 1.5, 2, dtype=torch.float64)
REGRESSORS: dict[str, Callable[[Tensor, Tensor], Any]] = {
    "filter": lambda x, y: st.StaFRegressor(),
    "numbers of a stream's own": lambda x, y: st.StaFRegressor(
        st.GaussianKernel(st.rows(WIDTHS)), noise=st.rows(WIDTHS)
    ),
    "tuned": lambda x, y: st.StaFRegressor(count=3).tune(x, y),
    "kernel in plain torch": lambda x, y: st.StaFRegressor("matern", count=3),
    "mixture": lambda x, y: online.MixtureRegressor(),
}


@pytest.mark.parametrize("name", REGRESSORS)
def test_streams_take_samples_of_a_device_and_a_copy_goes_on_there(name: str) -> None:
    angle = torch.arange(4, dtype=torch.float64).unsqueeze(-1) + torch.arange(2)
    x = torch.stack((angle.cos(), angle.sin()), -1)

    def predicted(x: Tensor) -> list[Tensor]:
        y = x.sum(-1)
        model = REGRESSORS[name](x, y)
        found = [copy.deepcopy(model.fit(x, y)).partial_fit(x[0], y[0]).predict(x[3])]
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


@pytest.mark.parametrize("name", ["gradient_chase", "faults", "icl"])
def test_an_experiment_runs_on_a_device_with_the_numbers_of_the_cpu(name: str, tmp_path: Path) -> None:
    folders = [tmp_path / "here", tmp_path / "there"]
    for folder in folders:
        folder.mkdir()
    wanted = run(folders[0], *words(name), "figures=false", "history=false").metrics
    found = run(folders[1], *words(name), "figures=false", f"device={DEVICE.type}").metrics
    assert found == {
        key: None if number is None else pytest.approx(number, rel=1e-6, abs=1e-9)
        for key, number in wanted.items()
    }


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


def test_a_memory_of_local_models_is_where_the_first_of_them_was() -> None:
    basis = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.rings(6), 0.1))

    def filled(x: Tensor) -> st.ExperienceMemory:
        memory = st.ExperienceMemory(basis, 2)
        for point in x:
            memory.add(point, basis.local(point).fit(basis.values(point, targets.Paper())))
        return memory

    x = torch.cat((X0, 2 * X0[:1], X0[:1] + 0.07))
    one, other = filled(there(x)), filled(x)
    agree(one(there(x)), other(x))
    agree(one.start(there(x)), other.start(x))
    agree(one.gradient(there(x)), other.gradient(x))
    with pytest.raises(ValueError, match=r"`ExperienceMemory.query\(y=...\)` must be on lazy:0"):
        one(x)
    with pytest.raises(ValueError, match=r"`ExperienceMemory.add\(x=...\)` must be on cpu"):
        other.add(there(x[0]), there(torch.zeros(6, dtype=torch.float64)))
