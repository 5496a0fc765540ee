"""From settings to library objects. Below this layer nothing knows that there are settings."""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
import warnings
from collections.abc import Callable
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn

from .._checks import COMMAND_LINE, choice, fail, flag, integer, positive_real, real, vector
from ..basis import StaFBasis, Target
from ..centers import (
    Radius,
    StateFollowingCenters,
    StateRadius,
    ball,
    cross_polytope,
    polygon,
    rings,
    simplex,
)
from ..chase.predictors import Predictor
from ..optim import UpdateLaw
from ..systems import ControlAffineSystem

_DTYPES = {"float64": torch.float64, "float32": torch.float32}


@dataclasses.dataclass(frozen=True)
class ChaseProblem:
    """Everything a gradient chase needs, checked."""

    system: ControlAffineSystem  # or any module with its methods
    basis: StaFBasis
    target: Target
    law: UpdateLaw
    initial_states: Tensor  # (B, n)
    dt: float  # s
    steps: int  # T - 1
    inner_steps: int
    settle_time: float  # s
    predictor: Predictor | None = None
    certificate: bool = False


def load(path: str, arguments: dict[str, Any] | None = None) -> Any:
    """The object at a dotted path, for classes and functions outside the package.

    A class is called with ``arguments``; anything else is returned as it is.

    Raises:
        ValueError: if nothing is there, or arguments are given to something that is not a class.
    """
    module, _, name = path.rpartition(".") if isinstance(path, str) else ("", "", "")
    if not module:
        raise fail("custom", "path", "must be a dotted path `package.module.name`", path)
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise fail("custom", "path", f"cannot be imported ({error})", path) from error
    if isinstance(found, type):
        return found(**(arguments or {}))
    if arguments:
        raise fail("custom", "arguments", f"needs a class at {path}, which is none", arguments)
    return found


class Parts:
    """Objects of many configurations: equal settings make one object, once.

    What a construction warns of is said again to every configuration that uses the object.
    """

    def __init__(self) -> None:
        self._made: dict[tuple[object, ...], tuple[Any, list[str]]] = {}

    def __call__(self, make: Callable[..., Any], *arguments: Any) -> Any:
        """``make(*arguments)``; arguments are settings, or objects that come from here."""
        key = (make, *map(_key, arguments))
        if key not in self._made:
            with warnings.catch_warnings(record=True) as given:
                warnings.simplefilter("always")
                made = make(*arguments)
            self._made[key] = made, [str(warning.message) for warning in given]
        made, said = self._made[key]
        for message in said:
            warnings.warn(message, stacklevel=2)
        return made


def _key(argument: object) -> object:
    """Equal for equal settings; every other object is itself."""
    if OmegaConf.is_config(argument):
        return json.dumps(OmegaConf.to_container(argument, resolve=True), default=repr)
    return argument if isinstance(argument, int | float | str | None) else id(argument)


def chase_problem(cfg: DictConfig, parts: Parts | None = None) -> ChaseProblem:
    """The gradient chase that the settings describe.

    Args:
        cfg: the settings.
        parts: of other problems of the same batch, to share what is equal.

    Raises:
        ValueError: if a setting breaks its rule; the message names it.
    """
    parts = Parts() if parts is None else parts
    device, dtype = placement(cfg.device, cfg.dtype)
    system = parts(make, cfg.system)
    if not callable(getattr(system, "drift", None)):
        raise fail(COMMAND_LINE, "system", "must be a plant with a method `drift`", system)
    dim = _dimension(system, cfg.initial_state)
    basis = parts(StaFBasis, parts(make, cfg.kernel), parts(make_centers, cfg.centers, dim))
    target = parts(make, cfg.target)
    if not callable(target):
        raise fail(COMMAND_LINE, "target", "must be callable", target)
    dt = positive_real(COMMAND_LINE, "dt", cfg.dt)
    duration = positive_real(COMMAND_LINE, "duration", cfg.duration)
    if duration < dt:
        raise fail(COMMAND_LINE, "duration", f"must be at least one step (dt={dt})", duration)
    law, inner_steps = parts(_law, cfg.optimizer)
    for module in (system, basis, target):
        if isinstance(module, nn.Module):
            module.to(device=device, dtype=dtype)
    return ChaseProblem(
        system=system,
        basis=basis,
        target=target,
        law=law,
        initial_states=initial_states(cfg, dim).to(device=device, dtype=dtype),
        dt=dt,
        steps=math.floor(duration / dt + 1e-9),
        inner_steps=inner_steps,
        settle_time=real(COMMAND_LINE, "settle_time", cfg.settle_time),
        predictor=None if cfg.predictor.get("_target_") is None else parts(make, cfg.predictor),
        certificate=flag(COMMAND_LINE, "certificate", cfg.certificate),
    )


def _dimension(system: ControlAffineSystem, initial_state: object) -> int:
    """n: the system's, or for one that takes any, that of the initial state."""
    stated = getattr(system, "dim", None)
    if stated is not None:
        return integer(type(system).__name__, "dim", stated, least=1)
    entries = OmegaConf.to_container(initial_state) if OmegaConf.is_config(initial_state) else initial_state
    return len(vector(COMMAND_LINE, "initial_state", entries))


def make(cfg: DictConfig) -> Any:
    """The object that a group of settings names."""
    return instantiate(cfg, _convert_="all")


def placement(device: object, dtype: object) -> tuple[torch.device, torch.dtype]:
    choice(COMMAND_LINE, "dtype", dtype, tuple(_DTYPES))
    try:
        place = torch.device(str(device))
        torch.empty(0, device=place)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise fail(COMMAND_LINE, "device", f"cannot be used here ({reason})", device) from error
    return place, _DTYPES[str(dtype)]


def make_centers(cfg: DictConfig, dim: int) -> StateFollowingCenters:
    count, layout = cfg.count, cfg.layout
    planar: dict[str, Callable[[int], Tensor]] = {"rings": rings, "polygon": polygon}
    fixed: dict[str, Callable[[int], Tensor]] = {
        "simplex": simplex,
        "cross_polytope": cross_polytope,
    }
    choice(COMMAND_LINE, "centers.layout", layout, (*planar, *fixed, "ball", "directions"))
    if layout in planar:
        if dim != 2:
            raise ValueError(
                f"`centers={layout}` lies in the plane, but the system has {dim} states: "
                "use simplex, cross_polytope or ball."
            )
        directions = planar[layout](count)
    elif layout in fixed:
        directions = fixed[layout](dim)
        if count is not None and count != len(directions):
            integer(COMMAND_LINE, "centers.count", count, least=1)
            rule = f"must be {len(directions)} (or null) for {layout} with {dim} states"
            raise fail(COMMAND_LINE, "centers.count", rule, count)
    elif layout == "directions":
        listed: Any = OmegaConf.to_container(cfg.directions)
        rows = [vector(COMMAND_LINE, "centers.directions", row, dim) for row in listed]
        directions = torch.tensor(rows, dtype=torch.float64)
    else:
        directions = ball(count, dim)
    return StateFollowingCenters(directions, _radius(cfg))


def _radius(cfg: DictConfig) -> float | Radius:
    if cfg.shrink.offset is None:
        return cfg.radius  # type: ignore[no-any-return]
    return StateRadius(cfg.radius, cfg.shrink.offset, cfg.shrink.gain)


def _law(cfg: DictConfig) -> tuple[UpdateLaw, int]:
    settings = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(settings, dict)
    inner_steps = integer(COMMAND_LINE, "optimizer.inner_steps", settings.pop("inner_steps"), least=1)
    return make(OmegaConf.create(settings)), inner_steps


def initial_states(cfg: DictConfig, dim: int) -> Tensor:
    """The stated initial state first, the others uniform in a box around it: (B, n) float64.

    The generator runs on the CPU in float64, so that one seed means the same states everywhere, and
    the first k of them do not depend on how many follow.
    """
    stated = cfg.initial_state
    stated = OmegaConf.to_container(stated) if OmegaConf.is_config(stated) else stated
    first = torch.tensor(vector(COMMAND_LINE, "initial_state", stated, dim), dtype=torch.float64)
    batch = integer(COMMAND_LINE, "trajectories", cfg.trajectories, least=1)
    spread = positive_real(COMMAND_LINE, "spread", cfg.spread)
    generator = torch.Generator().manual_seed(integer(COMMAND_LINE, "seed", cfg.seed, least=0))
    rows = [torch.rand(dim, dtype=torch.float64, generator=generator) for _ in range(batch - 1)]
    around = [first + spread * (2 * row - 1) for row in rows]
    return torch.stack([first, *around])
