"""What the experiments on the theorems take from the settings."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from .._checks import COMMAND_LINE, fail, integer, positive_real
from ..basis import Target
from ..kernels import Kernel
from ..systems import trajectory
from .build import chase_problem


class LocalProblem(NamedTuple):
    """A function to approximate around some states of a trajectory."""

    kernel: Kernel
    target: Target
    radius: float  # of the balls
    states: Tensor  # (T, n)
    time: Tensor  # (T,) s


def local_problem(cfg: DictConfig, states: str) -> LocalProblem:
    """The first trajectory that the settings describe, at equally spaced times.

    Args:
        cfg: the settings.
        states: name of the setting that says at how many, `experiment.states`.

    Raises:
        ValueError: if a setting breaks its rule; the message names it.
    """
    problem = chase_problem(cfg)
    if cfg.centers.shrink.offset is not None:
        rule = "must be null here: the experiment is about balls of a constant radius"
        raise fail(COMMAND_LINE, "centers.shrink.offset", rule, cfg.centers.shrink.offset)
    count = integer(COMMAND_LINE, states, OmegaConf.select(cfg, states), least=1)
    pieces = trajectory(problem.system, problem.initial_states[:1], dt=problem.dt, steps=problem.steps)
    path = torch.cat(list(pieces), dim=1)[0]
    # Without the last one: over one period that is the first again.
    index = (torch.arange(min(count, problem.steps)) * problem.steps) // min(count, problem.steps)
    radius = positive_real(COMMAND_LINE, "centers.radius", cfg.centers.radius)
    return LocalProblem(
        problem.basis.kernel, problem.target, radius, path[index], index.to(path) * problem.dt
    )


def numbers(cfg: DictConfig, name: str) -> list[float]:
    """The setting of that name: positive numbers, without repetitions, growing."""
    stated: Any = OmegaConf.select(cfg, name)
    listed = OmegaConf.to_container(stated, resolve=True) if OmegaConf.is_list(stated) else stated
    if not isinstance(listed, list) or not listed:
        raise fail(COMMAND_LINE, name, "must be a list of numbers", listed)
    return sorted({positive_real(COMMAND_LINE, name, number) for number in listed})


def case_name(radius: float, epsilon: float) -> str:
    """Of a metric: the radius and the epsilon that it belongs to."""
    return f"r{radius:g}.eps{epsilon:g}"
