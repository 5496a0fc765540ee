"""Gymnasium's environments as plants, and policies that drive environments through their observations."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from staf_torch import adp, systems

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")

from staf_torch import envs  # noqa: E402


def test_environment_that_can_be_set_to_a_state_is_the_same_plant_as_its_port() -> None:
    cost = adp.QuadraticCost(1.0, 0.1, dim=2, inputs=1)
    ported, real = envs.classic_control("Pendulum-v1"), envs.EnvironmentPlant("Pendulum-v1", periodic=[0])
    assert (real.period, real.periodic, real.traceable) == (0.05, (0,), False)
    torch.testing.assert_close(adp.LQR(real, cost).k, adp.LQR(ported, cost).k, rtol=1e-6, atol=0)
    x0 = torch.tensor([[0.2, 0.1], [-0.3, 0.0]], dtype=torch.float64)
    runs = [adp.simulate(adp.LQR(ported, cost), p, cost, x0, steps=8, compile=False) for p in (ported, real)]
    torch.testing.assert_close(runs[0].cost, runs[1].cost, rtol=1e-12, atol=0)


def test_policy_swings_through_observations_and_actions_of_another_kind() -> None:
    plant = envs.classic_control("CartPole-v1")
    lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 0.01, dim=4, inputs=1))
    agent = envs.Agent(lqr, dt=0.02, action=lambda u: int(u[0] > 0))
    env = gymnasium.make("CartPole-v1")
    seen, _ = env.reset(seed=0)
    total, over = 0.0, False
    while not over:
        seen, reward, terminated, truncated, _ = env.step(agent(seen))
        total, over = total + reward, terminated or truncated
    assert total == 500

    turning = envs.classic_control("Pendulum-v1")
    held = adp.LQR(turning, adp.QuadraticCost(1.0, 0.01, dim=2, inputs=1))
    agent = envs.Agent(
        held, state=lambda seen: np.stack((np.arctan2(seen[..., 1], seen[..., 0]), seen[..., 2]), axis=-1)
    )
    angle = np.array([[0.1, 0.2], [-0.1, 0.0]])
    shown = np.stack((np.cos(angle[:, 0]), np.sin(angle[:, 0]), angle[:, 1]), axis=-1)
    np.testing.assert_allclose(agent(shown), held(torch.from_numpy(angle)).numpy(), rtol=1e-12)


class Falling(gymnasium.Env):
    """An environment that hides its state in an attribute of its own."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)
    observation_space = gymnasium.spaces.Box(-9.0, 9.0, (1,), np.float64)
    height = 0.0

    def reset(self, *, seed=None, options=None):  # type: ignore[no-untyped-def]
        return np.zeros(1), {}

    def step(self, action):  # type: ignore[no-untyped-def]
        self.height = 1.1 * self.height + 0.1 * float(action[0])
        return np.array([self.height]), 0.0, False, False, {}


def test_environment_of_your_own_says_how_its_state_is_read_and_written() -> None:
    plant = envs.EnvironmentPlant(
        Falling(),
        read=lambda env: np.array([env.height]),
        write=lambda env, x: setattr(env, "height", float(x[0])),
        dt=0.1,
    )
    assert plant.linearisation().matrix.item() == pytest.approx(1.1)
    assert isinstance(plant.bounds, systems.Bounds)
    with pytest.raises(ValueError, match=r"`EnvironmentPlant\(read=...\)` and write must be given"):
        envs.EnvironmentPlant(Falling(), dt=0.1)
    with pytest.raises(ValueError, match=r"`EnvironmentPlant\(dt=...\)` must be given"):
        envs.EnvironmentPlant("MountainCarContinuous-v0")
    with pytest.raises(ValueError, match=r"must have actions that are a vector of numbers.*Discrete"):
        envs.EnvironmentPlant("CartPole-v1")
    with pytest.raises(ValueError, match=r"`classic_control\(name=...\)` must be one of"):
        envs.classic_control("Ant-v5")


class Data:
    def __init__(self) -> None:
        self.qpos, self.qvel = np.zeros(1), np.zeros(1)


class Two(Falling):
    """With its state where classic control has it, or where MuJoCo has."""

    dt = 0.1

    def __init__(self, keeps: str) -> None:
        self.state: tuple[float, float] = (0.0, 0.0)
        if keeps == "mujoco":
            self.data = Data()
            del self.state
        if keeps != "state":
            self.set_state = self.put

    def put(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        assert qpos.shape == qvel.shape == (1,)
        self.data.qpos, self.data.qvel = qpos, qvel

    def step(self, action):  # type: ignore[no-untyped-def]
        if hasattr(self, "data"):
            self.data.qpos = self.data.qpos + 0.1 * self.data.qvel
            self.data.qvel = self.data.qvel + 0.1 * action
        else:
            place, speed = self.state
            self.state = (place + 0.1 * speed, speed + 0.1 * float(action[0]))
        return np.zeros(1), 0.0, False, False, {}


@pytest.mark.parametrize("keeps", ["state", "mujoco", "state, and another method"])
def test_a_state_is_found_where_classic_control_and_mujoco_have_it(keeps: str) -> None:
    plant = envs.EnvironmentPlant(Two(keeps))
    x, u = torch.tensor([[1.0, 2.0], [3.0, -1.0]]).double(), torch.tensor([[0.5], [-1.0]]).double()
    wanted = torch.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), 1)
    torch.testing.assert_close(plant.step(x, u), wanted)


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
    lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=plant.dim, inputs=1))
    assert adp.held_stability(lqr, plant, period, at=plant.equilibrium()).spectral_radius < 1


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


def test_a_cart_and_its_pole_keep_their_equations_of_motion() -> None:
    """Of a pole of 0.1 kg and 1 m on a cart of 1 kg, by Lagrange, at any force."""
    x = torch.tensor([[0.3, -0.4, 0.7, 1.3], [0.0, 0.5, -2.0, -0.6]], dtype=torch.float64).repeat(2, 1)
    u = torch.tensor([[-10.0], [-3.0], [0.0], [10.0]], dtype=torch.float64)
    rate = (envs.classic_control("CartPole-v1").step(x, u) - x) / 0.02
    torch.testing.assert_close(rate[:, [0, 2]], x[:, [1, 3]], rtol=1e-10, atol=1e-12)
    sine, cosine, turning = x[:, 2].sin(), x[:, 2].cos(), x[:, 3]
    speeding, bending = rate[:, 1], rate[:, 3]
    force = 1.1 * speeding + 0.05 * (bending * cosine - turning.square() * sine)
    torch.testing.assert_close(force, u[:, 0], rtol=1e-9, atol=1e-10)
    torque = 0.1 * 0.5 * (4 / 3 * 0.5 * bending + speeding * cosine)
    torch.testing.assert_close(torque, 0.1 * 0.5 * 9.8 * sine, rtol=1e-9, atol=1e-10)
