"""Somebody else's Hydra application: our groups on its search path, our launcher or Hydra's own."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import os
import re
import runpy
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import ROOT, in_a_child
from composing import HYDRA
from hydra import compose, initialize
from hydra.utils import instantiate

from staf_torch import Kernel, StateFollowingCenters, optim, systems

APP = ROOT / "tests" / "examples" / "own_app.py"


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, str]]:
    """What the application said under each launcher; all in one process, where every warning is an error."""
    place = tmp_path_factory.mktemp("own_app")
    common = ["kernel=gaussian,matern", "steps=20"]
    launchers = [["basic"], ["batched"], ["batched", "hydra.launcher.foreign=refuse"]]
    if importlib.util.find_spec("hydra_plugins.hydra_joblib_launcher") is not None:
        launchers.append(["joblib", "hydra.launcher.n_jobs=1"])
    lines = [["-m", f"hydra/launcher={name}", *more, *common] for name, *more in launchers]
    lines.append(["-m", "hydra/launcher=batched", "hydra.launcher.foreign=run", "steps=1"])
    said = in_a_child(lambda: [swept(place, line) for line in lines], place)
    return [{"line": " ".join(line), **text} for line, text in zip(lines, said, strict=True)]


def swept(place: Path, line: list[str]) -> dict[str, str]:
    """Run the application; return what it printed and logged, and the error that ended it."""
    os.chdir(place)
    said, error = io.StringIO(), ""
    sys.argv = [str(APP), *line]
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            runpy.run_path(str(APP), run_name="__main__")
        except (Exception, SystemExit) as raised:
            error = str(raised)
    logging.getLogger().handlers.clear()  # which would write to a stream that is gone
    return {"out": said.getvalue(), "error": error}


@pytest.mark.parametrize("launcher", ["basic", "batched", "joblib"])
def test_an_application_of_ones_own_sweeps_our_groups_without_a_warning(
    launcher: str, sweeps: list[dict[str, str]]
) -> None:
    found = [each for each in sweeps if f"hydra/launcher={launcher} " in each["line"]]
    if not found:
        pytest.skip("hydra-joblib-launcher (extra `joblib`) is not installed")
    said = found[0]
    assert said["error"] == ""
    assert "not available" not in said["out"]
    losses = [float(loss) for loss in re.findall(r"loss=(\S+)", said["out"])]
    assert len(losses) == 2
    assert max(losses) < 1
    reference = re.findall(r"loss=(\S+)", sweeps[0]["out"])
    assert re.findall(r"loss=(\S+)", said["out"]) == reference


def test_our_launcher_says_that_it_cannot_batch_another_program(sweeps: list[dict[str, str]]) -> None:
    _, told, refused, *_, quiet = sweeps
    words = "jobs of this program cannot share tensor batches"
    assert told["out"].count(words) == 1
    assert refused["error"] == "1"  # Hydra's exit code
    assert f"`hydra.launcher.foreign=refuse`: the {words}" in refused["out"]
    assert "loss=" not in refused["out"]
    assert quiet["error"] == ""
    assert words not in quiet["out"]


CHOSEN = {
    "kernel=gaussian": Kernel,
    "centers=ball": StateFollowingCenters,
    "optimizer=steepest_descent": optim.UpdateLaw,
    "system=custom": systems.ControlAffineSystem,
    "target=paper": Callable,
}


def test_an_option_of_each_group_instantiates_in_an_application_that_has_our_search_path() -> None:
    lines = [*(f"+{option}" for option in CHOSEN), "system.path=staf_torch.systems.Pendulum"]
    with initialize(config_path=None, **HYDRA):
        cfg = compose(overrides=["hydra.searchpath=[pkg://staf_torch.conf]", *lines])
    for option, kind in CHOSEN.items():
        more = {"dim": 3} if option == "centers=ball" else {}
        assert isinstance(instantiate(cfg[option.partition("=")[0]], **more), kind), option
