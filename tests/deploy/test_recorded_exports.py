"""What is written of controllers and approximations, recorded: the text, and the size of its numbers."""

from __future__ import annotations

import copy
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from deploy.test_deploy import CONTROLLERS, LQR, PLANT, fitted
from helpers import tensor
from helpers_swingup import double_integrator
from recorded import Record
from variants import SMOOTH_KERNELS

from staf_torch import adp, deploy, systems

VERSION = ".".join(torch.__version__.split(".")[:2])
X = tensor([[0.4, -0.3]])
NUMBER = re.compile(r"(?<![\w.])\d+\.\d*(?:e[+-]?\d+)?f?")


COMPUTED = ("rollout_twice", "rollout_of_moving_radius", "of bounds")
"""What has numbers that are computed while it is written: which are equal is for a processor to say."""


def said(path: Path, source: Any, computed: bool) -> Any:
    """The source as it counts itself, the length of the text, a sum over it without its numbers, and theirs.

    Apart, since the last digits of a number are a processor's own.
    """
    if computed:
        return {"flops": source.flops, "functions": source.functions}
    text = path.read_text()
    size = sum(abs(float(each.rstrip("f"))) for each in NUMBER.findall(text))
    return source, {
        "lines": text.count("\n"),
        "sum": zlib.crc32(NUMBER.sub("#", text).encode()),
        "size": size,
    }


def rounded(module: torch.nn.Module) -> torch.nn.Module:
    """With four digits of every number: the last ones are a processor's, and decide which are equal."""
    for part in (*module.parameters(), *module.buffers()):
        if part.is_floating_point():
            digits = [0.0 if abs(each) < 1e-9 else float(f"{each:.4g}") for each in part.flatten().tolist()]
            part.detach().copy_(torch.tensor(digits, dtype=part.dtype).view(part.shape))
    return module


def of_a_module(module: torch.nn.Module, outputs: list[str], path: Path, computed: bool = False) -> Any:
    source = deploy.export_c(module, X, path, outputs, note="A note.")
    return said(path, source, computed), module.state_dict()


def of_a_plan(controller: adp.Controller, path: Path, computed: bool) -> Any:
    return said(path, deploy.export_learning_c(controller, X, path, dt=0.1), computed)


def guarded() -> torch.nn.Module:
    return deploy.policy_of(
        adp.SafetyFilter(LQR, PLANT, lambda x, t: 1.0 - x[:, 0], dt=0.1, low=-2.0, high=2.0, decay=3.0)
    )


PLANS: dict[str, Callable[[], adp.Controller]] = {
    "followed": lambda: adp.RecedingHorizon(
        double_integrator(-1.0, 1.0), steps=6, iterations=0, compile=False
    ),
    "improved": lambda: adp.RecedingHorizon(
        double_integrator(-1.0, 1.0), steps=4, iterations=1, compile=False
    ),
    "sampled": lambda: adp.PathIntegral(
        double_integrator(-1.0, 1.0), steps=4, samples=3, knots=2, compile=False
    ),
    "learned": lambda: adp.ActorCritic(
        adp.QuadraticBasis(2), PLANT, adp.QuadraticCost(1.0, 1.0, 2, 1), adp.RandomPoints(1, 0.5)
    ),
    "of bounds": lambda: adp.near_optimal(
        systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]),
        adp.QuadraticCost(1.0, 1.0, 2, 1),
        dt=0.5,
        low=-1.0,
        high=1.0,
        horizon=2.0,
    ).controller(),
}


def skip_unless_known(record: Record) -> None:
    if record.known().get("torch", VERSION) != VERSION:
        pytest.skip("torch takes functions apart in its own way in every version")


@pytest.mark.parametrize("name", CONTROLLERS)
def test_what_is_written_of_a_policy_is_the_recorded(name: str, record: Record, tmp_path: Path) -> None:
    skip_unless_known(record)
    policy = rounded(deploy.policy_of(copy.deepcopy(CONTROLLERS[name])))
    said = of_a_module(policy, ["u"], tmp_path / "p.h", name in COMPUTED)
    record({"torch": VERSION, "said": said}, rtol=1e-5)


@pytest.mark.parametrize("name", SMOOTH_KERNELS)
def test_what_is_written_of_an_approximation_is_the_recorded(
    name: str, record: Record, tmp_path: Path
) -> None:
    skip_unless_known(record)
    found = rounded(deploy.approximator(fitted(SMOOTH_KERNELS[name].make(), 0.1)))
    record({"torch": VERSION, "said": of_a_module(found, ["value", "gradient"], tmp_path / "a.h")}, rtol=1e-5)


@pytest.mark.parametrize("name", PLANS)
def test_what_is_written_of_a_plan_is_the_recorded(name: str, record: Record, tmp_path: Path) -> None:
    skip_unless_known(record)
    said = of_a_plan(PLANS[name](), tmp_path / "plan.h", name in COMPUTED)
    record({"torch": VERSION, "said": said}, rtol=1e-5)


def test_what_is_written_of_a_filter_is_the_recorded(record: Record, tmp_path: Path) -> None:
    skip_unless_known(record)
    record({"torch": VERSION, "said": of_a_module(rounded(guarded()), ["u"], tmp_path / "f.h")}, rtol=1e-5)
