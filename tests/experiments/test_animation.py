"""`staf animation=...`: the first trajectory in motion, as a GIF or as a page."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from composing import settings as composed
from PIL import Image
from recorded import Record

import staf_torch
from staf_torch.experiments.registry import experiment
from staf_torch.figures.animation import Scene

BARE = ("figures=false", "history=false")
SHORT = ("duration=0.02", "settle_time=0", *BARE)
LINE = ("system=linear", "system.matrix=[[-1.0]]")
SPACE = ("target=quadratic", "system=three_state", "initial_state=[1.0,0.0,0.0]", "centers=simplex")


def drawn(directory: Path, *settings: str) -> Path:
    """The one file that an animated run left in its figures."""
    (path,) = (staf_torch.run(*settings, directory=directory).directory / "figures").iterdir()
    return path


@pytest.mark.parametrize("settings", [(), SPACE], ids=["plane", "space"])
def test_an_animation_has_a_frame_a_time_and_what_moves_moves(
    settings: tuple[str, ...], tmp_path: Path
) -> None:
    path = drawn(tmp_path / "run", *SHORT, *settings, "animation=true")
    assert path.name == "chase.gif"
    with Image.open(path) as picture:
        assert picture.n_frames == 3
        assert picture.size[0] > 500
        first = np.asarray(picture.convert("RGB"))
        picture.seek(2)
        last = np.asarray(picture.convert("RGB"))
    assert 20 < (first != last).any(-1).sum() < 0.2 * first[..., 0].size


def test_a_page_holds_its_frames_and_asks_no_server(tmp_path: Path) -> None:
    text = drawn(tmp_path / "run", *SHORT, "animation=html").read_text()
    assert "http" not in text
    frames = json.loads(re.search(r"const pictures = (.*);", text)[1])
    assert len(frames) == 3
    whole, *changes = (Image.open(io.BytesIO(base64.b64decode(frame))).convert("RGBA") for frame in frames)
    assert whole.getextrema()[3][0] >= 254  # opaque, but for the palette's rounding
    assert all(picture.getextrema()[3] == (0, 255) for picture in changes)  # mostly transparent
    assert max(map(len, frames[1:])) < 0.3 * len(frames[0])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ((*SHORT, "animation=mp4"), r"`staf animation=...` must be one of True, False, 'gif', 'html'"),
        (
            ("experiment=laws", "animation=true"),
            r"`staf animation=...` must be false for the task laws, which has no animation; got True",
        ),
        (
            (*SHORT, "animation=true", "initial_state=[1.0]", "centers=simplex", *LINE),
            r"`staf animation=...` needs a state of two coordinates or more; got 1",
        ),
    ],
)
def test_what_cannot_be_animated_is_refused(settings: tuple[str, ...], words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words):
        staf_torch.run(*settings, directory=tmp_path / "run")


SCENES: dict[str, tuple[tuple[str, ...], bool]] = {
    "a chase of the plane": ((), True),
    "a chase in space": (SPACE, False),
    "a loop": (("experiment=adp",), True),
    "a tracked path": (("experiment=adp_tracking",), False),
    "discs": (("experiment=avoidance", "adp.compile=false"), False),
}


@pytest.mark.parametrize("name", SCENES)
def test_what_moves_in_an_animation_is_the_recorded(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record: Record
) -> None:
    settings, plane = SCENES[name]
    short = ("duration=0.2", "dt=0.05", "trajectories=2", "figures=false", "animation=gif")
    seen: list[Scene] = []

    def animated(scene: Scene, kind: str) -> dict[str, bytes]:
        seen.append(scene)
        return {"gif": kind.encode()}

    for experiment_ in ("gradient_chase", "adp", "adp_tracking", "avoidance"):
        monkeypatch.setattr(f"staf_torch.experiments.{experiment_}.animate", animated)
    monkeypatch.setattr("staf_torch.experiments.adp_tracking._optimal_cost", lambda *given: None)  # not shown
    cfg = composed(*settings, *short, *(() if "experiment" in str(settings) else ("settle_time=0",)))
    experiment(cfg.task)(cfg, tmp_path)
    (scene,) = seen
    assert ("level lines" in scene.title) is plane
    record(scene, rtol=1e-4)
