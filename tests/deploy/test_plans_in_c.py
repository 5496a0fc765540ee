"""Policies that follow plans, as files: a memory, carried and sampled plans; and what is refused."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers_swingup import double_integrator, pendulum
from torch import Tensor

from staf_torch import adp, deploy
from staf_torch.adp.planning.trajectories import Trajectories
from staf_torch.deploy.c_header import runner_c, runner_learning_c

needs_cc = pytest.mark.skipif(
    not any(shutil.which(name) for name in ("cc", "gcc", "g++", "clang")), reason="needs a C compiler"
)


def library_of(problem: adp.SampledProblem, x: Tensor) -> Trajectories:
    """Sixty steps of the linear feedback, instead of a search that takes seconds."""
    states, controls, rows = [x], [], len(x)
    for _ in range(60):
        controls.append(0.98 * problem.linear_feedback(states[-1]))  # told from the feedback of the goal
        states.append(problem.advance(states[-1], controls[-1])[0])
    state, control = torch.stack(states, dim=1), torch.stack(controls, dim=1)
    gains, bent = (-problem.k).expand(rows, 60, 1, 2), (2 * problem.p).expand(rows, 61, 2, 2)
    slope = (bent * problem.away(state).unsqueeze(-2)).sum(-1)
    fine = torch.ones(rows, dtype=torch.bool)
    return Trajectories(state, control, gains, problem.terminal(state), slope, bent, fine)


@pytest.fixture(scope="module")
def memory() -> adp.GlobalValue:
    """Of a pendulum near the top, where the angle may pass a whole turn."""
    problem, turn = pendulum(), 2 * math.pi
    x = torch.tensor([[0.3, 0.0], [-0.2, 0.1], [turn - 0.2, 0.3], [-turn + 0.2, -0.5]], dtype=torch.float64)
    return adp.GlobalValue(problem, library_of(problem, x), [math.pi, 8.0], candidates=12, lookahead=6)


def states(count: int) -> Tensor:
    """Upright give or take a little, some a turn away, and a quarter of them anywhere."""
    generator = torch.Generator().manual_seed(0)
    uniform = 2 * torch.rand(count, 2, dtype=torch.float64, generator=generator) - 1
    turns = torch.randint(-1, 2, (count,), generator=generator)
    x = torch.tensor([0.3, 0.5], dtype=torch.float64) * uniform
    x[::4] *= 20
    return torch.stack((x[:, 0] + 2 * math.pi * turns, x[:, 1]), dim=1)


@needs_cc
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_memory_in_c_has_the_control_of_the_library_and_says_what_a_call_takes(
    dtype: torch.dtype, memory: adp.GlobalValue, tmp_path: Path
) -> None:
    x, path = states(80).to(dtype), tmp_path / "memory.h"
    source = deploy.export_c(deploy.policy_of(memory, dtype=dtype), x, path, ["u"])
    (u,) = runner_c(path, [1], dtype)(x)
    away = (u.double() - memory(x.double())).abs()
    assert float(away.max()) < 1e-12 if dtype == torch.float64 else float(away.median()) < 1e-4
    assert ("rintf(" in path.read_text()) == (dtype == torch.float32)
    assert 0.1 < float((u.abs() < 2).double().mean()) < 1  # not a bound everywhere
    said = f"compares {2 * len(memory.entries)} states and takes at most {source.flops} additions"
    assert said in path.read_text()
    timed = deploy.time_c(path, x, [1])
    assert timed.calls == 80
    assert 0 < timed.median_us <= timed.p99_us <= timed.worst_us


@needs_cc
@pytest.mark.parametrize(("kind", "dtype"), [("followed", torch.float32), ("sampled", torch.float64)])
def test_plan_that_is_carried_is_a_structure_in_c(kind: str, dtype: torch.dtype, tmp_path: Path) -> None:
    problem = double_integrator(-1.0, 1.0)
    make: dict[str, Callable[[], adp.Controller]] = {
        "followed": lambda: adp.RecedingHorizon(problem, steps=12, iterations=0, compile=False),
        "sampled": lambda: adp.PathIntegral(problem, steps=6, samples=4, knots=3, compile=False),
    }
    controller = make[kind]()
    x0 = torch.tensor([[2.0, 0.5]], dtype=torch.float64)
    path = tmp_path / "plan.h"
    deploy.export_learning_c(controller, x0.to(dtype), path, dt=0.1)
    generator = torch.Generator().manual_seed(0)
    x = x0 * torch.linspace(1, 0.1, 16, dtype=torch.float64).unsqueeze(1)  # 4 steps beyond the plan
    uniform = 2 * torch.rand(16, controller.draws, 2, dtype=torch.float64, generator=generator) - 1
    carried, wanted = controller.init(x0), []
    for at, numbers in zip(x.split(1), uniform.split(1), strict=True):
        u, carried = controller.step(at, carried, numbers, 0.1)
        wanted.append(u)
    found = runner_learning_c(path, controller.draws, 1, dtype)(x.to(dtype), uniform.to(dtype))
    away = 1e-9 if dtype == torch.float64 else 1e-4
    torch.testing.assert_close(found, torch.cat(wanted).to(dtype), rtol=0, atol=away)
    assert bool((found.abs() < 1).any())
    with pytest.raises(ValueError, match="carries its plan from control to control"):
        deploy.policy_of(controller)


def test_what_searches_on_the_way_is_refused_with_its_reason(memory: adp.GlobalValue, tmp_path: Path) -> None:
    mpc = adp.RecedingHorizon(memory.problem, steps=5, memory=memory, compile=False)
    with pytest.raises(ValueError, match="must not search a memory and then optimise"):
        deploy.policy_of(mpc)
    with pytest.raises(ValueError, match="must not search a memory and then optimise"):
        deploy.export_learning_c(mpc, states(1), tmp_path / "a.h", dt=0.1)
