"""The plants as Gymnasium environments."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from staf_torch import (
    AnchoredKernel,
    ExponentialKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    rings,
    rows,
    systems,
)
from staf_torch.lanes.trace import philox

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")

from gymnasium import spaces  # noqa: E402
from gymnasium.utils import env_checker  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

from staf_torch import envs  # noqa: E402

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


@pytest.mark.parametrize("name", list(envs.PLANTS)[:2])
def test_environment_passes_the_checker_of_gymnasium(name: str) -> None:
    with pytest.warns(UserWarning, match="symmetric and normalized"):  # advice on the range of the action
        env_checker.check_env(gymnasium.make(name).unwrapped)


@pytest.mark.parametrize("name", list(envs.PLANTS))
def test_row_of_the_vectorised_environment_is_the_single_one(name: str) -> None:
    many = gymnasium.make_vec(name, num_envs=2, horizon=0.02)
    seen, _ = many.reset(seed=7)
    many.action_space.seed(1)
    actions = [0.1 * many.action_space.sample() for _ in range(2)]
    histories = [(seen, None, None, None), *(many.step(action)[:4] for action in actions)]
    for row in range(2):
        one = gymnasium.make(name, horizon=0.02)
        first, _ = one.reset(seed=7 + row)
        np.testing.assert_array_equal(first, histories[0][0][row])
        for action, expected in zip(actions, histories[1:], strict=True):
            for found, wanted in zip(one.step(action[row])[:4], expected, strict=True):
                np.testing.assert_allclose(found, wanted[row], rtol=1e-14, atol=1e-14)
    assert histories[-1][3].all()  # truncated at the horizon


def test_environments_of_plants_with_numbers_of_their_own_are_single_ones() -> None:
    numbers = {"mass": [0.5, 1.0, 2.0], "weight": [1.0, 2.0, 3.0], "high": [1.0, 2.0, math.inf]}

    def made(mass: Any, weight: Any, high: Any, count: int = 1) -> Any:
        cost = adp.QuadraticCost(weight, 1.0, 2, 1, low=-1.0, high=high)
        plant = systems.Pendulum(mass=mass)
        environment = gymnasium.make_vec(envs.OWN_PLANT, num_envs=count, plant=plant, cost=cost)
        return environment, envs.Agent(adp.LQR(plant, cost))

    def played(environment: Any, agent: Any, seed: int) -> list[Any]:
        seen, _ = environment.reset(seed=seed)
        action = np.clip(agent(seen), -0.9, 0.9)
        return [seen, action, *environment.step(action)[:2]]

    own = {name: rows(torch.tensor(column).double()) for name, column in numbers.items()}
    many = made(**own, count=3)
    for row, each in enumerate(zip(*numbers.values(), strict=True)):
        for found, wanted in zip(played(*many, 7), played(*made(*each), 7 + row), strict=True):
            np.testing.assert_array_equal(found[row], wanted[0])
    with pytest.raises(ValueError, match=r"must lie in \[-1, 1\]"):
        many[0].step(np.full((3, 1), 1.5))
    with pytest.raises(ValueError, match=r"must be 3, as many rows as plant and cost .*; got 2"):
        made(**own, count=2)


@pytest.mark.parametrize("make", [lambda: adp.Feedback(LQR), rollout, learner])
def test_rewards_of_an_episode_add_up_to_minus_the_cost_of_the_simulation(make) -> None:  # type: ignore[no-untyped-def]
    steps, x0 = 10, torch.tensor([[-1.0, 1.0], [0.5, 0.7]], dtype=torch.float64)
    wanted = adp.simulate(make(), PLANT, COST, x0, dt=0.01, steps=steps)
    many = gymnasium.make_vec("staf_torch/TwoState-v0", num_envs=2, horizon=100.0, bound=1000.0)
    seen, _ = many.reset(options={"state": x0.numpy()})
    agent, total = envs.Agent(make(), dt=0.01), np.zeros(2)
    for _ in range(steps):
        seen, reward, *_ = many.step(agent(seen))
        total += reward
    np.testing.assert_allclose(-total, wanted.cost.numpy(), rtol=1e-10)
    np.testing.assert_allclose(seen, wanted.state[:, -1].numpy(), rtol=1e-9, atol=1e-12)


class Recorder(adp.Controller):
    """Says what it was asked with, and counts its steps in what it carries."""

    def __init__(self, draws: int) -> None:
        super().__init__()
        self.draws = draws
        self.seen: list[tuple[Tensor, Tensor, float]] = []

    def init(self, x0: Tensor) -> Any:
        return torch.zeros(len(x0), dtype=x0.dtype)

    def step(self, x: Tensor, carried: Any, uniform: Tensor, dt: float) -> tuple[Tensor, Any]:
        self.seen.append((x, uniform, dt))
        return torch.stack((carried, x[:, 0], x[:, 1]), -1), carried + 1


def test_rows_of_an_agent_draw_from_their_own_seeds() -> None:
    controller = Recorder(draws=3)
    agent = envs.Agent(controller, dt=0.5, seed=5)
    observation = np.array([[1.0, 2.0], [3.0, 4.0]], dtype=np.float32)
    parts, rounds = philox.seed_parts([5, 6], torch.empty(0, dtype=torch.float64)), []
    for at in range(2):
        np.testing.assert_array_equal(agent(observation), [[at, 1.0, 2.0], [at, 3.0, 4.0]])
        step = torch.full((2,), float(at), dtype=torch.float64)
        rounds.append(philox.uniform(parts, step, 6).view(2, 3, 2))
    agent.begin()
    np.testing.assert_array_equal(agent(torch.from_numpy(observation))[:, 0], 0.0)
    for (x, uniform, dt), wanted in zip(controller.seen, [*rounds, rounds[0]], strict=True):
        assert (x.dtype, dt) == (torch.float64, 0.5)
        assert torch.equal(uniform, wanted)


@pytest.mark.parametrize(("horizon", "steps"), [(0.6 + 2e-16, 6), (0.25, 3), (0.1 * (3 + 1.5e-9), 4)])
def test_an_episode_is_truncated_at_its_horizon_and_not_before(horizon: float, steps: int) -> None:
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1)
    episodes = envs.Episodes(plant, cost, 2, dt=0.1, horizon=horizon, limit=9.0, penalty=7.0)
    episodes.begin(torch.tensor([True, True]), torch.zeros(2, 2, dtype=torch.float64))
    for at in range(1, steps + 1):
        reward, terminated, truncated = episodes.step(torch.zeros(2, 1, dtype=torch.float64))
        assert episodes.age.tolist() == [at, at]
        assert truncated.tolist() == [at == steps] * 2
        assert terminated.tolist() == [False, False]
        assert reward.tolist() == [0.0, 0.0]
    assert episodes.age.dtype == torch.int64
    assert episodes.state.dtype == torch.float64
    episodes.begin(torch.tensor([False, True]), torch.ones(2, 2))
    assert episodes.age.tolist() == [steps, 0]
    assert episodes.state.tolist() == [[0.0, 0.0], [1.0, 1.0]]


def test_leaving_the_limit_ends_an_episode_and_costs_the_penalty() -> None:
    plant, cost = systems.VanDerPol(), adp.QuadraticCost(1.0, 1.0, 2, 1)
    episodes = envs.Episodes(plant, cost, 3, dt=0.1, horizon=9.0, limit=2.0, penalty=7.0)
    x0 = torch.tensor([[0.0, 1.99], [0.1, 0.1], [0.0, -1.99]], dtype=torch.float64)
    episodes.begin(torch.ones(3, dtype=torch.bool), x0)
    u = torch.tensor([[20.0], [0.0], [-20.0]], dtype=torch.float64)
    reward, terminated, _ = episodes.step(u)
    assert terminated.tolist() == [True, False, True]
    assert reward[[0, 2]].tolist() == [-7.0, -7.0]
    assert -0.1 < float(reward[1]) < 0
    assert torch.equal(episodes.state[[0, 2]], x0[[0, 2]])
    with pytest.raises(ValueError, match=r"`Episodes\(penalty=...\)` must be positive"):
        envs.Episodes(plant, cost, 3, dt=0.1, horizon=9.0, limit=2.0, penalty=0.0)
    with pytest.raises(ValueError, match=r"`Episodes\(horizon=...\)` must be positive"):
        envs.Episodes(plant, cost, 3, dt=0.1, horizon=-1.0, limit=2.0, penalty=1.0)


def box(space: Any) -> tuple[Any, ...]:
    assert isinstance(space, spaces.Box)
    return space.low.tolist(), space.high.tolist(), space.dtype


def test_spaces_are_the_limit_of_states_and_the_bounds_of_inputs() -> None:
    env = envs.PlantEnv("TwoState")
    assert box(env.observation_space) == ([-100.0] * 2, [100.0] * 2, np.float64)
    assert box(env.action_space) == ([-20.0], [20.0], np.float64)
    assert (env.cost.q.tolist(), env.cost.r.tolist()) == ([[1.0, 0.0], [0.0, 1.0]], [[1.0]])
    many = envs.PlantVectorEnv("Pendulum", num_envs=3, bound=2.5, limit=7.0)
    assert box(many.single_observation_space) == ([-7.0] * 2, [7.0] * 2, np.float64)
    assert box(many.action_space) == ([[-2.5]] * 3, [[2.5]] * 3, np.float64)
    assert (many.num_envs, many.spread.tolist()) == (3, [systems.Pendulum.spread] * 2)
    bounded = adp.BoundedInputCost(1.0, 1.0, dim=2, inputs=1, bound=3.0)
    assert box(envs.PlantEnv("TwoState", bounded).action_space)[:2] == ([-3.0], [3.0])
    assert box(envs.PlantEnv("TwoState", bounded, bound=2.0).action_space)[:2] == ([-2.0], [2.0])


def test_seeds_are_one_a_row_and_go_on_without_new_ones() -> None:
    def fresh() -> envs.PlantVectorEnv:
        return envs.PlantVectorEnv("TwoState", num_envs=3)

    first, second = fresh(), fresh()
    a, _ = first.reset(seed=4)
    b, _ = second.reset(seed=[4, 5, 6])
    np.testing.assert_array_equal(a, b)
    after = [env.reset()[0] for env in (first, second)]
    np.testing.assert_array_equal(*after)
    assert not np.array_equal(after[0], a)
    masked, _ = first.reset(options={"reset_mask": np.array([0, 1, 0])})
    np.testing.assert_array_equal(masked[[0, 2]], after[0][[0, 2]])
    assert not np.array_equal(masked[1], after[0][1])
    none, _ = first.reset(options={"reset_mask": np.zeros(3)})
    np.testing.assert_array_equal(none, masked)
    assert not np.array_equal(fresh().reset()[0], fresh().reset()[0])
    single = envs.PlantEnv("TwoState")
    np.testing.assert_array_equal(single.reset(seed=5)[0], a[1])


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_rows_that_are_truncated_begin_anew_as_their_mode_says(mode: AutoresetMode) -> None:
    many = envs.PlantVectorEnv("TwoState", num_envs=2, dt=0.1, horizon=0.3, autoreset_mode=mode.value)
    assert many.metadata == {"render_modes": [], "autoreset_mode": mode}
    assert envs.PlantVectorEnv().metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    idle = np.zeros((2, 1))
    many.reset(seed=1)
    many.step(idle)
    many.reset(options={"reset_mask": np.array([False, True])})
    many.step(idle)
    seen, reward, terminated, truncated, info = many.step(idle)  # the third of row 0
    assert (terminated.tolist(), truncated.tolist()) == ([False, False], [True, False])
    assert (reward < 0).all()
    same = mode is AutoresetMode.SAME_STEP
    assert many.episodes.age.tolist() == [0 if same else 3, 2]
    assert ("final_obs" in info) == same
    if same:
        assert info["_final_obs"].tolist() == info["_final_info"].tolist() == [True, False]
        assert (info["final_info"], info["final_obs"][1]) == ({}, None)
        assert not np.array_equal(info["final_obs"][0], seen[0])
    before = seen.copy()
    seen, reward, terminated, truncated, info = many.step(idle)
    assert not terminated.any()
    assert truncated.tolist() == [mode is AutoresetMode.DISABLED, True]
    assert (reward == 0).tolist() == [mode is AutoresetMode.NEXT_STEP, False]
    assert not (before == seen).all(1).any()
    if mode is AutoresetMode.NEXT_STEP:
        assert many.episodes.age.tolist() == [0, 3]
        many.reset(options={"reset_mask": np.array([False, True])})
        reward = many.step(idle)[1]
        assert (reward < 0).all()  # what was begun by hand does not begin once more


def test_stated_states_begin_the_masked_rows_alone() -> None:
    many = envs.PlantVectorEnv("TwoState", num_envs=3)
    before, _ = many.reset(seed=0)
    stated = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    options = {"state": stated, "reset_mask": np.array([True, False, True])}
    seen, info = many.reset(options=options)
    np.testing.assert_array_equal(seen[[0, 2]], stated[[0, 2]])
    np.testing.assert_array_equal(seen[1], before[1])
    assert info == {}
    kept = seen.copy()
    many.step(np.ones((3, 1)))
    np.testing.assert_array_equal(seen, kept)  # what was shown is a copy
    with pytest.raises(ValueError, match=r"`step\(action=...\)` must have the shape \(3, 1\)"):
        many.step(np.zeros(3))
    actions = np.zeros((3, 1))
    actions[1] = np.nextafter(20.0, 21.0)
    with pytest.raises(ValueError, match=r"must lie in \[-20, 20\]"):
        many.step(actions)
    actions[1] = 20.0
    many.step(actions)
    with pytest.raises(ValueError, match=r"must lie in \[-1, 1\]"):
        envs.PlantVectorEnv("TwoState", bound=1.0).step(torch.full((1, 1), torch.nan))
