"""One step of every plant of classic control, over all of its states, beside the real environment."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")

from staf_torch import envs  # noqa: E402

# inputs in [-most, most], period, angles, where it rests
SIZES = {
    "Pendulum-v1": (2.0, 0.05, (0,), [0.0, 0.0]),
    "CartPole-v1": (10.0, 0.02, (2,), [0.0, 0.0, 0.0, 0.0]),
    "Acrobot-v1": (1.0, 0.2, (0, 1), [math.pi, 0.0, 0.0, 0.0]),
    "MountainCarContinuous-v0": (1.0, 1.0, (), [0.45, 0.0]),
}
# spread of states around a middle, levels of the input, what an environment makes of them, tolerance
STATES = {
    "Pendulum-v1": ([3.0, 9.0], [0.0, 0.0], [-5.0, -1.0, 0.0, 0.7, 3.0], lambda u: np.array([u]), 1e-13),
    "CartPole-v1": ([2.0, 3.0, 0.2, 3.0], [0.0] * 4, [-10.0, 10.0], lambda u: int(u > 0), 1e-13),
    "Acrobot-v1": ([3.0, 3.0, 13.0, 29.0], [0.0] * 4, [-1.0, 0.0, 1.0], lambda u: int(u) + 1, 1e-11),
    "MountainCarContinuous-v0": (
        [0.95, 0.09],  # its state is kept in float32
        [-0.3, 0.0],
        [-3.0, -1.0, 0.0, 0.3, 2.0],
        lambda u: np.array([u]),
        2e-7,
    ),
}


@pytest.mark.parametrize("name", SIZES)
def test_a_plant_of_classic_control_has_the_sizes_of_its_environment(name: str) -> None:
    most, period, periodic, rest = SIZES[name]
    plant = envs.classic_control(name)
    assert (plant.dim, plant.inputs, plant.period, plant.periodic) == (len(rest), 1, period, periodic)
    assert plant.bounds is not None
    assert plant.bounds.low.tolist() == [-most]
    assert plant.bounds.high.tolist() == [most]
    torch.testing.assert_close(plant.equilibrium(), torch.tensor(rest, dtype=torch.float64))
    at_rest, held = plant.equilibrium()[None], plant.resting_input()[None]
    torch.testing.assert_close(plant.step(at_rest, held), at_rest, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", STATES)
def test_every_state_steps_as_in_the_real_environment(name: str) -> None:
    spread, middle, levels, act, tolerance = STATES[name]
    draw = np.random.default_rng(0)
    starts = middle + spread * draw.uniform(-1, 1, (40, len(spread)))
    pushes = np.array([levels[k % len(levels)] for k in range(40)])
    env, wanted = gymnasium.make(name).unwrapped, []
    env.reset(seed=0)
    for start, push in zip(starts, pushes, strict=True):
        env.state = np.array(start)
        env.steps_beyond_terminated = None
        env.step(act(push))
        wanted.append(np.array(env.state, dtype=np.float64))
    plant = envs.classic_control(name)
    found = plant.step(torch.from_numpy(starts), torch.from_numpy(pushes)[:, None])
    assert found.dtype == torch.float64
    apart = plant.difference(found, torch.from_numpy(np.stack(wanted)))
    assert float(apart.abs().max()) < tolerance
    single = plant.step(torch.from_numpy(starts).float(), torch.from_numpy(pushes)[:, None].float())
    assert single.dtype == torch.float32


def test_a_car_at_the_wall_stops_there_and_one_that_leaves_keeps_its_speed() -> None:
    plant = envs.classic_control("MountainCarContinuous-v0")
    x = torch.tensor([[-1.19, -0.05], [-1.3, 0.05], [-1.19, 0.05], [0.59, 0.06]], dtype=torch.float64)
    after = plant.step(x, torch.zeros(4, 1, dtype=torch.float64))
    slope = -0.0025 * (3 * x[:, 0]).cos()
    torch.testing.assert_close(after[:, 0], torch.tensor([-1.2, -1.2, float(after[2, 0]), 0.6]).double())
    wanted = torch.where(torch.arange(4) == 0, 0.0, x[:, 1] + slope)
    torch.testing.assert_close(after[:, 1], wanted, rtol=0, atol=1e-15)


@pytest.mark.parametrize("push", [-10.0, -3.0, 0.0, 10.0])
def test_a_cart_and_its_pole_keep_their_equations_of_motion(push: float) -> None:
    """Of a pole of 0.1 kg and 1 m on a cart of 1 kg, by Lagrange, at any force."""
    x = torch.tensor([[0.3, -0.4, 0.7, 1.3], [0.0, 0.5, -2.0, -0.6]], dtype=torch.float64)
    u = torch.full((2, 1), push, dtype=torch.float64)
    rate = (envs.classic_control("CartPole-v1").step(x, u) - x) / 0.02
    torch.testing.assert_close(rate[:, [0, 2]], x[:, [1, 3]], rtol=1e-10, atol=1e-12)
    sine, cosine, turning = x[:, 2].sin(), x[:, 2].cos(), x[:, 3]
    speeding, bending = rate[:, 1], rate[:, 3]
    force = 1.1 * speeding + 0.05 * (bending * cosine - turning.square() * sine)
    torch.testing.assert_close(force, u[:, 0], rtol=1e-9, atol=1e-10)
    torque = 0.1 * 0.5 * (4 / 3 * 0.5 * bending + speeding * cosine)
    torch.testing.assert_close(torque, 0.1 * 0.5 * 9.8 * sine, rtol=1e-9, atol=1e-10)
