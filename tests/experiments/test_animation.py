"""`staf animation=true`: the chase as a GIF."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

import staf_torch

SHORT = ("duration=0.05", "settle_time=0", "figures=false", "history=false", "animation=true")


def test_an_animation_is_a_gif_with_a_frame_a_time(tmp_path: Path) -> None:
    found = staf_torch.run(*SHORT, directory=tmp_path / "run")
    with Image.open(found.directory / "figures" / "chase.gif") as picture:
        assert picture.n_frames == 6
        assert picture.size[0] > 500
    assert [path.name for path in (found.directory / "figures").iterdir()] == ["chase.gif"]


def test_a_state_outside_the_plane_is_refused(tmp_path: Path) -> None:
    space = ("system=three_state", "initial_state=[1.0,0.0,0.0]", "centers=simplex")
    with pytest.raises(ValueError, match=r"`staf animation=...` needs a state in the plane, not in R\^3"):
        staf_torch.run(*SHORT, *space, directory=tmp_path / "run")
