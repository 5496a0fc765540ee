"""Settings of every experiment that break a rule: refused by their name before anything is computed.

Which there are is read from the source, `positive_real(COMMAND_LINE, "avoidance.radius", ...)`.
"""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from composing import settings
from omegaconf import OmegaConf

import staf_torch
from staf_torch.experiments.registry import experiment

ROOT = Path(staf_torch.__file__).parent
ROOMS = {
    "adp_loop": "adp",
    "adp_comparison": "adp_initial_weights",
    "theorems": "exponential_bound",
    **dict.fromkeys(("chase", "gradient_chase", "registry", "scenes")),
}
"""The experiment that a file's settings are tried with, where it is not of its name; none, where it is the
first one."""

OTHERS: dict[tuple[str, str], tuple[str, ...]] = {
    ("avoidance", "avoidance.ahead"): ("experiment=avoidance", "avoidance.vehicle=unicycle"),
    ("chase", "centers.count"): ("centers=simplex",),
    ("chase", "centers.directions"): ("centers=directions", "centers.directions=[[0.0, 0.0]]"),
}
"""Settings that are read beside others."""

WRONG: dict[str, tuple[object, ...]] = {
    "positive_real": (0, "no"),
    "non_negative": (-1e-9, "no"),
    "real": ("no", float("nan")),
    "integer": (2.5, True),
    "flag": (1, "yes"),
    "choice": ("no such choice",),
    "vector": ("no", [float("nan"), 1.0]),
}
SHORT = {"duration": 0.02, "figures": False, "history": False, "animation": False}


class Setting(NamedTuple):
    """A rule about a setting, in the source."""

    file: str
    name: str
    kind: str
    least: int | None

    def __str__(self) -> str:
        return f"{self.file}-{self.name}-{self.kind}"


def stated() -> Iterator[Setting]:
    for path in sorted([*(ROOT / "experiments").glob("*.py"), *(ROOT / "settings").glob("*.py")]):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name) or len(node.args) < 3:
                continue
            call, name, least = node.args[0], node.args[1], None
            if node.func.id not in WRONG or not isinstance(call, ast.Name) or call.id != "COMMAND_LINE":
                continue
            if not isinstance(name, ast.Constant):
                continue  # a name that is put together: OTHERS
            numbers = [*node.args[3:], *(word.value for word in node.keywords)]
            if node.func.id == "integer" and isinstance(numbers[0], ast.Constant):
                least = numbers[0].value
            yield Setting(path.stem, name.value, node.func.id, least)


SAID_BEFORE = {("chase", "centers.radius")}  # by the radius itself
STATED = sorted({setting for setting in stated() if setting[:2] not in SAID_BEFORE}, key=str)


def refused(given: tuple[str, ...], name: str, value: Any, directory: Path) -> None:
    cfg = settings(*given)
    for key, short in SHORT.items():
        if key in cfg and key != name:
            cfg[key] = short
    if name == "centers.directions":
        value = [value]
    listed = OmegaConf.is_list(OmegaConf.select(cfg, name)) and not isinstance(value, list) and value != "no"
    OmegaConf.update(cfg, name, [value] if listed else value, force_add=True)
    directory.mkdir()
    with pytest.raises(ValueError, match=re.escape(f"`staf {name}=...` must ")):
        experiment(cfg.task)(cfg, directory)
    assert not (directory / "metrics.json").exists()


@pytest.mark.parametrize("setting", STATED, ids=str)
def test_a_setting_that_breaks_its_rule_is_refused_by_name(setting: Setting, tmp_path: Path) -> None:
    wrong = list(WRONG[setting.kind])
    if setting.least is not None:
        wrong.append(setting.least - 1)
    room = ROOMS.get(setting.file, setting.file)
    given = OTHERS.get(setting[:2], () if room is None else (f"experiment={room}",))
    for value, number in zip(wrong, itertools.count()):
        refused(given, setting.name, value, tmp_path / str(number))


PUT_TOGETHER = [
    ("experiment=icl", "icl.gain", [1.0]),
    ("experiment=icl", "icl.rate", ["no", 1.0]),
    ("experiment=icl", "icl.rate", [2.0, 1.0]),
    ("experiment=icl", "settle_time", 5.0),
    ("experiment=laws", "laws.steps", [0.01]),
    ("experiment=memory", "settle_time", 1.0),
    ("experiment=adp_initial_weights", "initial_weights", []),
    ("experiment=exponential_bound", "exponential_bound.domain", 0.0),
    ("experiment=exponential_bound", "exponential_bound.states", 1),
    ("experiment=exponential_bound", "exponential_bound.max_degree", -1),
    ("experiment=adp_initial_weights", "adp.critic", 0.0),
    ("experiment=adp_initial_weights", "adp.actor", -1.0),
]
"""Rules of names that are put together, and of more settings than one."""


@pytest.mark.parametrize(("given", "name", "value"), PUT_TOGETHER)
def test_a_setting_whose_name_is_put_together_is_refused_by_it(
    given: str, name: str, value: object, tmp_path: Path
) -> None:
    refused((given,), name, value, tmp_path / "run")


def stepped() -> staf_torch.systems.Plant:
    """A plant in steps, which has no rate."""
    return staf_torch.systems.StepPlant(lambda x, u: 0.9 * x + u, dim=2, inputs=1, dt=0.1)


@pytest.mark.parametrize(
    ("given", "name", "target", "words"),
    [
        (["experiment=safe_box"], "system", f"{__name__}.stepped", "must be a ControlAffineSystem"),
        ([], "metric", "staf_torch.systems.TwoState", "must be a `staf_torch.metrics.Metric`, or several"),
    ],
)
def test_a_part_of_another_kind_is_refused(
    given: list[str], name: str, target: str, words: str, tmp_path: Path
) -> None:
    cfg = settings(*given)
    cfg[name] = {"_target_": target}
    with pytest.raises(ValueError, match=words):
        experiment(cfg.task)(cfg, tmp_path)
