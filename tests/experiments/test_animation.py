"""`staf animation=...`: the first trajectory in motion, as a GIF or as a page, and what each scene shows."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from composing import settings as composed
from helpers import tensor
from PIL import Image

import staf_torch
from staf_torch import adp, systems
from staf_torch.experiments import chase_batch, scenes
from staf_torch.settings.adp import adp_problem
from staf_torch.settings.chase import chase_problem

SHORT = ("duration=0.01", "settle_time=0", "figures=false", "history=false")
SPACE = ("target=quadratic", "system=three_state", "initial_state=[1.0,0.0,0.0]", "centers=simplex")
NEAR = ("dt=0.01", "duration=1", "settle_time=0", "centers.radius=0.1")


def drawn(directory: Path, *settings: str) -> Path:
    """The one file that an animated run left in its figures."""
    (path,) = (staf_torch.run(*settings, directory=directory).directory / "figures").iterdir()
    return path


def test_an_animation_has_a_frame_a_time_and_what_moves_moves(tmp_path: Path) -> None:
    path = drawn(tmp_path / "run", *SHORT, *SPACE, "animation=true")
    assert path.name == "chase.gif"
    with Image.open(path) as picture:
        assert picture.n_frames == 2
        assert picture.info["duration"] == 100  # ms
        first = np.asarray(picture.convert("RGB"))
        picture.seek(1)
        last = np.asarray(picture.convert("RGB"))
    assert 20 < (first != last).any(-1).sum() < 0.2 * first[..., 0].size


def test_a_page_holds_its_frames_and_asks_no_server(tmp_path: Path) -> None:
    words = ("experiment=adp", "adp/policy=lqr", "duration=0.01", "dt=0.01", "animation=html", SHORT[2])
    path = drawn(tmp_path / "run", *words)
    assert path.suffix == ".html"
    text = path.read_text()
    assert "http" not in text
    frames = json.loads(re.search(r"const pictures = (.*);", text)[1])
    assert len(frames) == 2
    whole, *changes = (Image.open(io.BytesIO(base64.b64decode(frame))).convert("RGBA") for frame in frames)
    assert whole.getextrema()[3][0] >= 254  # opaque, but for the palette's rounding
    assert all(picture.getextrema()[3] == (0, 255) for picture in changes)  # mostly transparent
    assert max(map(len, frames[1:])) < 0.6 * len(frames[0])


def test_a_state_of_one_coordinate_and_what_does_not_move_are_not_animated(tmp_path: Path) -> None:
    one = ("system=linear", "system.matrix=[[-1.0]]", "initial_state=[1.0]", "centers=simplex")
    with pytest.raises(ValueError, match=r"`staf animation=...` needs a state of two coordinates or more"):
        staf_torch.run(*SHORT, *one, "animation=true", directory=tmp_path / "run")
    with pytest.raises(ValueError, match=r"`staf animation=...` must be false for the task laws"):
        staf_torch.run("experiment=laws", "animation=true", directory=tmp_path / "laws")


@pytest.mark.parametrize("dim", [2, 3])
def test_the_scene_of_a_chase_is_of_its_own_basis_target_and_weights(dim: int) -> None:
    problem = chase_problem(composed(*NEAR, *(SPACE if dim == 3 else ())))
    (outcome,) = chase_batch.simulate([problem], [None], [True])
    scene, given = scenes.chase_scene(problem, outcome.drawn), outcome.drawn
    at, k = np.round(np.linspace(0, 100, 60)).astype(int), 17
    np.testing.assert_array_equal(scene.time, given["time"][at])
    np.testing.assert_array_equal(scene.curves.values, given["weights"][at])
    np.testing.assert_array_equal(scene.curves.ideal, given["ideal_weights"][at])
    x = torch.as_tensor(given["state"][at])
    np.testing.assert_allclose(scene.centers, problem.basis.centers(x)[..., :2].numpy())
    # In the middle of the way through the ball V and V^ are those at the state itself.
    middle = len(scene.along) // 2
    assert scene.value[k, middle] == pytest.approx(float(problem.target(x[k])), rel=1e-5)
    estimate = problem.basis(x[k : k + 1], x[k]) @ torch.as_tensor(given["weights"][at[k]])
    assert scene.estimate[k, middle] == pytest.approx(float(estimate), rel=1e-5)
    assert (scene.grid is not None) == (dim == 2)
    if scene.grid is not None:  # rows along the second coordinate
        corner = problem.target(tensor([[scene.grid[0][3], scene.grid[1][70]]]))
        assert scene.grid[2][70, 3] == pytest.approx(float(corner))


@pytest.mark.parametrize(
    ("policy", "centers", "curves"), [("actor_critic", 3, "weights of the critic"), ("lqr", 0, "control")]
)
def test_the_scene_of_a_loop_has_the_centers_that_follow_it_and_the_optimal_value(
    policy: str, centers: int, curves: str
) -> None:
    problem = adp_problem(composed("experiment=adp", "dt=0.02", "duration=0.1", f"adp/policy={policy}"))
    result = adp.simulate(
        problem.controller, problem.system, problem.cost, problem.initial_states, dt=0.02, steps=5
    )
    scene = scenes.loop_scene(problem, result)
    assert scene.centers.shape[1:] == (centers, 2)
    assert scene.curves.title == curves
    assert scene.relative
    x1, x2 = scene.state[-1]
    optimal = scene.value[-1, len(scene.along) // 2]
    assert optimal == pytest.approx(0.5 * x1**2 + x2**2, rel=1e-5)  # V* of the paper's plant
    assert scene.grid is not None


def test_the_scene_of_a_tracked_path_is_in_the_plane_of_the_path() -> None:
    plant, cost, x0 = systems.TwoStateTracking(), adp.tracking_cost(10.0, 1.0), [[1.0, 0.5, 0.3, -0.2]]
    idle = adp.Feedback(lambda x: torch.zeros_like(x[..., :1]))
    result = adp.simulate(idle, plant, cost, tensor(x0), dt=0.01, steps=5)
    policy = adp.Feedback(adp.LQR(systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1)))
    scene = scenes.tracking_scene(policy, result)
    desired = result.state[0, :, 2:4].numpy()
    np.testing.assert_allclose(scene.followed, desired)
    np.testing.assert_allclose(scene.state, result.state[0, :, :2].numpy() + desired)
