"""What a controller of an episode carries, what it draws, and how an episode counts its steps."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

pytest.importorskip("gymnasium")

from staf_torch import adp, envs, systems
from staf_torch.envs.episodes import Episodes, _Held, holding


def test_a_held_control_is_all_that_is_carried() -> None:
    u = uniform(3, 2, seed=1)
    carried = holding(u)
    assert carried.actor is u
    assert [tuple(part.shape) for part in carried] == [(3, 0), (3, 2), (3, 0, 0), (3, 0)]
    empty = _Held().init(uniform(4, 2))
    assert [tuple(part.shape) for part in empty] == [(4, 0), (4, 0), (4, 0, 0), (4, 0)]
    out, after = _Held().step(uniform(3, 2), carried, uniform(3, 0, 2), 0.1)
    assert out is u
    assert after is carried


def test_ages_are_whole_numbers_and_a_new_episode_begins_at_0() -> None:
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    episodes = Episodes(systems.TwoState(), cost, 2, dt=0.1, horizon=0.3, limit=10.0, penalty=1.0)
    assert episodes.steps == 3
    assert episodes.age.dtype == torch.int64
    episodes.begin(torch.tensor([True, True]), tensor([[0.1, 0.2], [0.3, 0.4]]))
    over = [episodes.step(torch.zeros(2, 1).double())[2].tolist() for _ in range(2)]
    episodes.begin(torch.tensor([False, True]), torch.zeros(2, 2).double())
    over += [episodes.step(torch.zeros(2, 1).double())[2].tolist() for _ in range(3)]
    assert over == [[False, False], [False, False], [True, False], [True, False], [True, True]]
    assert episodes.age.tolist() == [5, 3]
    assert episodes.state[1].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("draws", [0, 2])
def test_a_controller_gets_as_many_points_a_row_as_it_asks_for(draws: int) -> None:
    seen: list[Tensor] = []

    class Drawing(adp.Controller):
        def init(self, x0: Tensor) -> Any:
            return torch.zeros_like(x0[:, 0])

        def step(self, x: Tensor, carried: Any, uniform: Tensor, dt: float) -> Any:
            seen.append(uniform)
            return x[:, :1], carried

    Drawing.draws = draws
    agent = envs.Agent(Drawing(), seed=4)
    for _ in range(2):
        agent(uniform(3, 2, seed=2))
    assert [tuple(each.shape) for each in seen] == [(3, draws, 2)] * 2
    assert seen[0].dtype == torch.float64
    for row in range(3):
        generator = torch.Generator().manual_seed(4 + row)
        for each in seen:
            drawn = torch.rand(draws, 2, dtype=torch.float64, generator=generator) if draws else each[row]
            assert torch.equal(each[row], 2 * drawn - 1 if draws else drawn)
