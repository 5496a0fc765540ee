"""The plants as Gymnasium environments."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from staf_torch import ExponentialKernel, StaFBasis, StateFollowingCenters, StateRadius, adp, rings, systems

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")

from gymnasium.utils import env_checker  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

from staf_torch import AnchoredKernel, envs  # noqa: E402

PLANT = systems.TwoState()
COST = adp.QuadraticCost(1.0, 1.0, 2, 1)
LQR = adp.LQR(PLANT, COST)


def rollout() -> adp.Controller:
    basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), 0.1))
    return adp.Feedback(adp.RolloutPolicy(basis, PLANT, COST, LQR, LQR.value, steps=4))


def learner() -> adp.Controller:
    centers = StateFollowingCenters(rings(3), StateRadius(0.7, 1e-5))
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(ExponentialKernel()), centers))
    return adp.ActorCritic(basis, PLANT, COST, adp.RandomPoints(1, StateRadius(2.1, 1e-5)))


@pytest.mark.parametrize("name", list(envs.PLANTS))
def test_environment_passes_the_checker_of_gymnasium(name: str) -> None:
    with pytest.warns(UserWarning, match="symmetric and normalized"):  # advice on the range of the action
        env_checker.check_env(gymnasium.make(name).unwrapped)


@pytest.mark.parametrize("name", list(envs.PLANTS))
def test_row_of_the_vectorised_environment_is_the_single_one(name: str) -> None:
    many = gymnasium.make_vec(name, num_envs=3, horizon=0.05)
    seen, _ = many.reset(seed=7)
    many.action_space.seed(1)
    actions = [0.1 * many.action_space.sample() for _ in range(5)]
    histories = [(seen, None, None, None), *(many.step(action)[:4] for action in actions)]
    for row in range(3):
        one = gymnasium.make(name, horizon=0.05)
        first, _ = one.reset(seed=7 + row)
        np.testing.assert_array_equal(first, histories[0][0][row])
        for action, expected in zip(actions, histories[1:], strict=True):
            for found, wanted in zip(one.step(action[row])[:4], expected, strict=True):
                np.testing.assert_allclose(found, wanted[row], rtol=1e-14, atol=1e-14)
    assert histories[-1][3].all()  # truncated at the horizon


@pytest.mark.parametrize("make", [lambda: adp.Feedback(LQR), rollout, learner])
def test_rewards_of_an_episode_add_up_to_minus_the_cost_of_the_simulation(make) -> None:  # type: ignore[no-untyped-def]
    steps, x0 = 60, torch.tensor([[-1.0, 1.0], [0.5, 0.7]], dtype=torch.float64)
    wanted = adp.simulate(make(), PLANT, COST, x0, dt=0.01, steps=steps)
    many = gymnasium.make_vec("staf_torch/TwoState-v0", num_envs=2, horizon=100.0, bound=1000.0)
    seen, _ = many.reset(options={"state": x0.numpy()})
    agent, total = envs.Agent(make(), dt=0.01), np.zeros(2)
    for _ in range(steps):
        seen, reward, *_ = many.step(agent(seen))
        total += reward
    np.testing.assert_allclose(-total, wanted.cost.numpy(), rtol=1e-10)
    np.testing.assert_allclose(seen, wanted.state[:, -1].numpy(), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("make", [lambda: adp.Feedback(LQR), rollout])
def test_policy_regulates_the_two_state_plant(make) -> None:  # type: ignore[no-untyped-def]
    many = gymnasium.make_vec("staf_torch/TwoState-v0", num_envs=4, dt=0.05, spread=2.0)
    agent = envs.Agent(make(), dt=0.05)
    seen, _ = many.reset(seed=0)
    for _ in range(120):
        seen, _, terminated, _, _ = many.step(agent(seen))
        assert not terminated.any()
    assert np.linalg.norm(seen, axis=-1).max() < 1e-2


def test_actions_of_torch_and_of_numpy_are_the_same() -> None:
    found = []
    for action in (torch.tensor([0.5]), np.array([0.5]), np.array([0.5], dtype=np.float32)):
        env = gymnasium.make("staf_torch/Pendulum-v0").unwrapped
        env.reset(seed=3)
        found.append(env.step(action))
    for other in found[1:]:
        np.testing.assert_array_equal(other[0], found[0][0])
        assert other[1:] == found[0][1:]


def test_finished_row_begins_anew_and_the_others_go_on() -> None:
    unstable = torch.tensor([[0.0, 99.9], [0.1, 0.1]], dtype=torch.float64)
    away = np.array([[20.0], [0.0]])
    for mode in AutoresetMode:
        many = envs.PlantVectorEnv("VanDerPol", num_envs=2, autoreset_mode=mode)
        many.reset(seed=0, options={"state": unstable})
        seen, reward, terminated, _, info = many.step(away)
        assert terminated.tolist() == [True, False]
        assert reward[0] == -1e4
        if mode is AutoresetMode.SAME_STEP:
            assert np.abs(seen[0]).max() <= 1
            assert info["final_obs"][0].tolist() == [0.0, 99.9]
        else:
            assert seen[0].tolist() == [0.0, 99.9]
        if mode is AutoresetMode.DISABLED:
            seen, _ = many.reset(options={"reset_mask": np.array([True, False])})
            assert np.abs(seen[0]).max() <= 1
        before = seen[1]
        seen, reward, terminated, _, _ = many.step(np.zeros((2, 1)))
        assert not terminated.any()
        assert np.abs(seen[0]).max() <= 1.1
        assert (reward[0] == 0) == (mode is AutoresetMode.NEXT_STEP)
        assert not np.array_equal(seen[1], before)


def test_bad_input_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"`PlantEnv\(plant=...\)` must be one of"):
        envs.PlantEnv("Rocket")
    with pytest.raises(ValueError, match=r"`PlantEnv\(plant=...\)` must be a ControlAffineSystem"):
        envs.PlantEnv(systems.Oscillator())
    env = envs.PlantEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"`step\(action=...\)` must lie in \[-20, 20\]"):
        env.step(np.array([21.0]))
    with pytest.raises(ValueError, match=r"`step\(action=...\)` must have the shape \(1,\)"):
        env.step(np.array([1.0, 2.0]))
    with pytest.raises(ValueError, match=r"must be \(1, 2\) and finite"):
        env.reset(options={"state": [1.0, 2.0, 3.0]})


def test_an_episode_without_a_horizon_of_its_own_takes_ten_seconds() -> None:
    env = gymnasium.make("staf_torch/TwoState-v0", spread=1e-15)  # so near rest that it stays there
    env.reset(seed=0)
    steps, over = 0, False
    while not over:
        *_, ended, over, _ = env.step(np.zeros(env.action_space.shape))
        steps += 1
        assert not ended
        assert steps <= 1000
    assert steps == 1000


def test_every_registered_name_is_of_its_own_plant() -> None:
    for name, plant in envs.PLANTS.items():
        assert gymnasium.registry[name].kwargs == {"plant": plant}
        made = gymnasium.make(name).unwrapped.plant
        assert type(made).__name__ == name.removeprefix("staf_torch/").removesuffix("-v0")
    assert gymnasium.registry[envs.OWN_PLANT].kwargs == {}
