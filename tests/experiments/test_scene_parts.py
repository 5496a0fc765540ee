"""Parts of what moves in an animation, by formulas of their own."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers import tensor, uniform
from torch import Tensor

import staf_torch as st
from staf_torch import adp
from staf_torch.experiments import adp_tracking, scenes
from staf_torch.settings.adp import adp_problem
from staf_torch.settings.chase import chase_problem

PLANT, COST = st.systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)


def test_what_an_animation_may_be_called() -> None:
    for wanted, kind in ((False, None), (True, "gif"), ("gif", "gif"), ("html", "html")):
        assert scenes.animation_kind({"animation": wanted}) == kind  # type: ignore[arg-type]
    assert scenes.animation_kind({}) is None  # type: ignore[arg-type]
    moving: Any = {"animation": True}
    assert scenes.animation_kind(moving, 2) == "gif"
    assert scenes.animation_kind({"animation": False}, 1) is None  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="needs a state of two coordinates or more; got 1"):
        scenes.animation_kind(moving, 1)


def test_the_way_through_a_ball_is_along_the_path() -> None:
    path = tensor([[0.0, 0.0], [3.0, 4.0], [6.0, 8.0], [6.0, 8.0], [6.0, 8.0]])
    at = np.array([0, 1, 4])
    along, points = scenes._across(path, at, tensor([0.5, 2.0, 1.0]))
    assert along.tolist() == pytest.approx(np.linspace(-1, 1, 41).tolist(), abs=1e-6)
    direction = tensor([0.6, 0.8])
    for k, radius in enumerate((0.5, 2.0)):
        torch.testing.assert_close(points[k], path[at[k]] + radius * along[:, None] * direction)
    torch.testing.assert_close(points[2], path[4].expand(41, 2))  # at rest there is no way
    assert scenes._across(path.float(), at, tensor([0.5, 2.0, 1.0]).float())[1].dtype == torch.float32


def test_level_lines_have_rows_along_the_second_coordinate() -> None:
    first, second, level = scenes._levels(lambda x: x[:, 0] + 10 * x[:, 1], 2.0, torch.zeros(1).double())
    line = np.linspace(-2, 2, 81)
    for each in (first, second):
        np.testing.assert_allclose(each, line, atol=1e-6)
    np.testing.assert_allclose(level, line[None, :] + 10 * line[:, None], atol=1e-5)
    assert scenes._levels(lambda x: x[:, 0], 2.0, torch.zeros(1))[0].dtype == np.float32


def test_a_state_moves_until_it_stays_within_a_hundredth_of_its_way() -> None:
    path = tensor([[3.0, 4.0], [0.06, 0.0], [0.04, 0.03], [0.03, 0.0], [0.0, 0.0501], [0.01, 0.0]])
    assert scenes._moves_until(path) == 4
    assert scenes._moves_until(path[:4]) == 1  # exactly a hundredth is within
    assert scenes._moves_until(path[[0, 5, 5]]) == 1  # one frame at least
    assert scenes._moves_until(-path.flip(0)) == 5


def rounded(numbers: np.ndarray) -> np.ndarray:
    return np.unique(numbers.round().astype(int))


def loop(times: int, dim: int = 2, weights: int = 0) -> Any:
    time = torch.arange(times).double()
    state = (-0.1 * time)[:, None].exp() * uniform(dim, low=1, high=2, seed=1)
    return SimpleNamespace(
        time=0.1 * time,
        state=torch.stack((state, 2 * state)),
        control=uniform(2, times, 1, seed=2),
        critic_weights=uniform(2, times, weights, seed=3),
    )


def test_what_follows_the_state_is_found_in_a_controller() -> None:
    supervised = adp_problem(settings("experiment=adp", "adp.trust=0.5")).controller
    assert isinstance(supervised, adp.Supervised)
    learner: Any = scenes._inner(supervised)
    assert learner is supervised.controller
    assert isinstance(learner, adp.ActorCritic)
    basis = learner.basis.basis
    assert scenes._moving(supervised) is scenes._moving(learner) is basis
    critic, points, x = uniform(3, basis.count, seed=1), uniform(3, 4, 2, seed=2), uniform(3, 2, seed=3)
    found = scenes._estimate(supervised, points, x, critic)
    assert found is not None
    for k in range(3):
        each = learner.basis(points[k], x[k].expand(4, 2)) @ critic[k]
        torch.testing.assert_close(found[k], each)
    grid = adp_problem(settings("experiment=adp", "adp/basis=rbf_grid", "adp.rbf_grid.points=3")).controller
    assert scenes._moving(grid) is None
    rollout = adp_problem(settings("experiment=adp", "adp/policy=rollout", "adp.rollout.depth=1")).controller
    assert isinstance(scenes._moving(rollout), st.StaFBasis)
    cfg = settings("experiment=adp_tracking")
    trackers = adp_tracking._controllers(cfg, adp.TwoStateTracking(), adp_tracking.tracking_cost(10.0, 1.0))
    known: Any = trackers["known"]
    assert scenes._inner(trackers["identified"]) is known
    assert scenes._moving(trackers["identified"]) is known.basis.basis.basis
    plain: Any = adp.Feedback(adp.LQR(PLANT, COST))
    assert scenes._moving(plain) is None
    assert scenes._inner(plain) is plain
    carried: Any = adp.Feedback(lambda x: x)
    carried.policy = SimpleNamespace(basis=basis)
    assert scenes._moving(carried) is basis
    carried.policy = SimpleNamespace(basis="another")
    assert scenes._moving(carried) is None


def test_the_scene_of_a_policy_without_weights_shows_its_control_and_a_tenth_of_its_way() -> None:
    lqr = adp.LQR(PLANT, COST)
    controller, result = adp.Feedback(lqr), loop(50)
    at = np.array([0, 3, 7])
    scene = scenes._scene(controller, result, at, lambda x: x.square().sum(-1))
    path = result.state[0]
    assert scene.title == "level lines of $V^*$"
    assert scene.relative is True
    np.testing.assert_allclose(scene.time, 0.1 * at)
    np.testing.assert_array_equal(scene.state, path[at].numpy())
    radius = 0.1 * float(path.norm(dim=-1).max())
    np.testing.assert_allclose(scene.radius, [radius] * 3)
    assert scene.centers.shape == (3, 0, 2)
    assert scene.curves[0] == "control"
    np.testing.assert_array_equal(scene.curves[1], result.control[0, at].numpy())
    along, points = scenes._across(path, at, torch.full((3,), radius).double())
    np.testing.assert_allclose(scene.value, points.square().sum(-1).numpy())
    np.testing.assert_allclose(scene.along, along.numpy())
    reach = float(path[at].abs().max()) + 1.4 * radius
    assert scene.grid is not None
    assert scene.grid[0][-1] == pytest.approx(reach)
    other = scenes._scene(controller, result, at, None)
    assert (other.title, other.value, other.grid) == ("the state", None, None)
    space = scenes._scene(controller, loop(50, dim=3), at, None)
    assert (space.title, space.state.shape) == ("the state", (3, 2))


def test_a_loop_is_shown_from_its_first_quarter_on_and_a_tracked_path_evenly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[np.ndarray] = []
    scene = scenes._scene(adp.Feedback(adp.LQR(PLANT, COST)), loop(50), np.array([0, 1]), None)

    def scened(controller: object, result: Any, at: np.ndarray, optimum: Any) -> Any:
        seen.append(at)
        assert (optimum is None) == (len(seen) > 1)
        if optimum is not None:
            assert optimum(tensor([[2.0, 1.0]])).tolist() == [[2.0, 1.0]]
        shape = (len(at), 2)
        return scene._replace(state=np.zeros(shape), centers=np.zeros((len(at), 3, 2)))

    monkeypatch.setattr(scenes, "_scene", scened)
    monkeypatch.setattr(scenes, "known_value", lambda problem, x: x if problem.known else None)
    result = loop(200)
    problem: Any = SimpleNamespace(controller=None, initial_states=result.state[:, 0], known=True)
    scenes.loop_scene(problem, result)
    until = scenes._moves_until(result.state[0])
    np.testing.assert_array_equal(seen[0], rounded(np.linspace(0, 1, 60) ** 2 * until))
    problem.known = False
    scenes.loop_scene(problem, result)
    tracked = loop(200, dim=4)
    controller: Any = None
    found = scenes.tracking_scene(controller, tracked)
    at = rounded(np.linspace(0, 199, 60))
    np.testing.assert_array_equal(seen[2], at)
    desired = tracked.state[0, at, 2:4].numpy()
    np.testing.assert_array_equal(found.followed, desired)
    np.testing.assert_array_equal(found.state, desired)
    np.testing.assert_array_equal(found.centers, np.repeat(desired[:, None], 3, axis=1))
    assert found.title == "the state, the desired one (dotted), and the centers"


SPACE = ("target=quadratic", "system=three_state", "initial_state=[1.0,0.0,0.0]", "centers=simplex")


@pytest.mark.parametrize("dim", [2, 3])
def test_the_scene_of_a_chase_is_of_its_own_basis_target_and_weights(dim: int) -> None:
    problem = chase_problem(settings(*(SPACE if dim == 3 else ())))
    count, times = problem.basis.count, 100
    time = np.arange(times) * 0.1
    state = np.exp(-time)[:, None] * np.linspace(1, 2, dim)
    drawn = {
        "time": time,
        "state": state,
        "weights": np.cos(time[:, None] + np.arange(count)),
        "ideal_weights": np.sin(time[:, None] + np.arange(count)),
    }
    scene = scenes.chase_scene(problem, drawn)
    at = rounded(np.linspace(0, times - 1, 60))
    plane = dim == 2
    assert scene.title == ("level lines of $V$; " if plane else "") + "the centers move with the state"
    np.testing.assert_array_equal(scene.time, time[at])
    np.testing.assert_array_equal(scene.state, state[at, :2])
    x = torch.as_tensor(state[at])
    np.testing.assert_allclose(scene.centers, problem.basis.centers(x)[..., :2].numpy())
    radius = problem.basis.centers.radius(x).expand(len(at))
    np.testing.assert_allclose(scene.radius, radius.numpy())
    np.testing.assert_array_equal(scene.curves[1], drawn["weights"][at])
    np.testing.assert_array_equal(scene.curves[2], drawn["ideal_weights"][at])
    along, points = scenes._across(torch.as_tensor(state), at, radius)
    np.testing.assert_allclose(scene.along, along.numpy())
    np.testing.assert_allclose(scene.value, problem.target(points).numpy())
    k = 17
    values: Tensor = problem.basis(points[k], x[k]) @ torch.as_tensor(drawn["weights"][at[k]])
    np.testing.assert_allclose(scene.estimate[k], values.detach().numpy(), rtol=1e-9, atol=1e-12)
    assert (scene.grid is not None) == plane
    if scene.grid is not None:
        assert scene.grid[0][-1] == pytest.approx(float(x.abs().max() + 1.4 * radius.max()))
        corner = problem.target(tensor([[scene.grid[0][3], scene.grid[1][70]]]))
        assert scene.grid[2][70, 3] == pytest.approx(float(corner))
    assert scene.relative is False
    assert not math.isnan(scene.value.sum())
