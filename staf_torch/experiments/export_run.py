"""From a run directory to what a device needs of it."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.errors import InstantiationException
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import Tensor, nn

from .. import __version__
from .._checks import fail, integer
from ..adp import ActorCritic, Controller, Supervised
from ..deploy import approximator, policy_of
from ..deploy.sheet import Port
from ..deploy.units import units_of
from ..module import StaF
from .build import chase_problem
from .build_adp import adp_problem

_CUSTOM = "staf_torch.experiments.build.load"
_POINTS = 1000


@dataclasses.dataclass(frozen=True)
class Deployable:
    """What is exported of a run."""

    kind: str  # approximator, controller
    what: str  # one sentence
    module: Callable[[torch.dtype], nn.Module]
    points: Tensor  # (P, n) of the region, float64
    input: Port
    outputs: tuple[Port, ...]
    written_by: str | None  # the version that made the run, where it says


def deployable(run: Path, row: int = 0, *, trust: bool = False) -> Deployable:
    """What a device needs of one trajectory of a run: its controller, or its approximation at the last time.

    The objects are built anew from the run's settings, and must reproduce what the run recorded.

    Args:
        run: the directory.
        row: the trajectory.
        trust: whether code of your own that the settings name may be imported.

    Raises:
        ValueError: if the directory is no run, lacks its history, holds another experiment, names foreign
            code, or was written by a version whose numbers this one does not reproduce.
    """
    cfg = _settings(run, trust)
    history = _history(run)
    tasks = {"gradient_chase": _approximation, "adp": _controller}
    if cfg.get("task") not in tasks:
        listed = " or ".join(tasks)
        raise fail("staf-export", "RUN", f"must be a run of {listed}", cfg.get("task"))
    integer("staf-export", "row", row, least=0)
    if row >= len(history["state"]):
        raise fail("staf-export", "row", f"must be below the run's {len(history['state'])} trajectories", row)
    written_by = _written_by(run)
    precise = cfg.dtype == "float64"
    cfg.dtype, cfg.device = "float64", "cpu"
    try:
        return dataclasses.replace(tasks[cfg.task](cfg, history, row, precise), written_by=written_by)
    except (OmegaConfBaseException, InstantiationException, KeyError, AssertionError) as error:
        raise ValueError(
            f"{run} was written by {_version_name(written_by)}, whose settings staf_torch {__version__} does "
            f"not understand ({str(error).splitlines()[0]}): run it anew, or export it with that version."
        ) from error


def _settings(run: Path, trust: bool) -> DictConfig:
    path = run / ".hydra" / "config.yaml"
    if not path.is_file():
        raise fail("staf-export", "RUN", "must be a run directory, with .hydra/config.yaml", str(run))
    cfg = OmegaConf.load(path)
    if not isinstance(cfg, DictConfig):
        raise fail("staf-export", "RUN", "must hold settings in .hydra/config.yaml", str(run))
    for target in _targets(OmegaConf.to_container(cfg)):
        if not trust and (target == _CUSTOM or not _ours(target)):
            raise ValueError(
                f"The settings of {run} run code of your own ({target}): add --trust if you know them."
            )
    OmegaConf.set_struct(cfg, True)  # a setting that is missing is an error, not None
    return cfg


def _ours(target: object) -> bool:
    """Whether a dotted path of the settings leads to the library, and not through it to something else."""
    if not str(target).startswith("staf_torch."):
        return False
    try:
        return str(getattr(get_object(str(target)), "__module__", "")).startswith("staf_torch.")
    except (ImportError, AttributeError, ValueError):
        return True  # a name that this version does not have: building it says so


def _targets(node: Any) -> Iterator[Any]:
    if isinstance(node, dict):
        if node.get("_target_") is not None:
            yield node["_target_"]
        for value in node.values():
            yield from _targets(value)
    elif isinstance(node, list):
        for value in node:
            yield from _targets(value)


def _history(run: Path) -> dict[str, np.ndarray]:
    path = run / "history.npz"
    if not path.is_file():
        raise ValueError(
            f"{run} has no history.npz, which holds the weights: run with history=false, or not ended."
        )
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error


def _written_by(run: Path) -> str | None:
    path = run / "run.json"
    if not path.is_file():
        return None
    said = json.loads(path.read_text(encoding="utf-8"))
    return str(said.get("version")) if isinstance(said, dict) else None


def _version_name(version: str | None) -> str:
    return "another version of staf_torch" if version is None else f"staf_torch {version}"


def _reproduced(name: str, found: Tensor, recorded: np.ndarray, precise: bool) -> None:
    """Whatever wrote the run: what is built from it must give the recorded numbers."""
    wanted = torch.from_numpy(np.asarray(recorded, dtype=np.float64))
    if not bool(torch.isfinite(wanted).all()):
        raise fail(
            "staf-export", "row", "must be a trajectory that did not diverge", f"a recorded {name} of NaN"
        )
    worst = float((found - wanted).abs().max() / wanted.abs().max().clamp(min=1e-3))
    if not worst <= (1e-8 if precise else 1e-3):
        raise ValueError(
            f"The recorded {name} of this run cannot be reproduced: built from its settings it differs by "
            f"{worst:.3g}. Another version of staf_torch wrote it, or a file was changed: run it anew."
        )


def _approximation(cfg: DictConfig, history: dict[str, np.ndarray], row: int, precise: bool) -> Deployable:
    problem = chase_problem(cfg)
    x = torch.from_numpy(history["state"][row, -1].astype(np.float64))
    weights = torch.from_numpy(history["weights"][row, -1].astype(np.float64))
    if not bool(torch.isfinite(weights).all()):
        raise fail("staf-export", "row", "must be a trajectory whose weights can be represented", "NaN")
    staf = StaF(problem.basis)
    with torch.no_grad():
        staf.state.copy_(x)
        staf.coefficients.copy_(problem.basis.local(x).coefficients(weights))
    _reproduced("estimate", staf(x.unsqueeze(0)).detach(), history["estimate"][row, -1:], precise)
    radius = float(problem.basis.centers.radius(x))
    generator = torch.Generator().manual_seed(0)
    inside = torch.randn(_POINTS, len(x), dtype=torch.float64, generator=generator)
    shrink = torch.rand(_POINTS, 1, dtype=torch.float64, generator=generator) ** (1 / len(x))
    points = x + radius * shrink * inside / inside.norm(dim=-1, keepdim=True)
    unit = units_of(problem.system)
    where = ", ".join(f"{v:.6g}" for v in x.tolist())
    return Deployable(
        "approximator",
        f"V^ and its gradient around the state of the last time, {problem.basis.count} centers of "
        f"{type(problem.basis.kernel).__name__}; the gradient is the partial one, centers frozen.",
        lambda dtype: approximator(staf, dtype),
        points,
        Port("state", len(x), unit.state, f"the ball of radius {radius:.6g} around ({where})"),
        (
            Port("value", None, "that of V", "V^; NaN far outside the region, where it has no digits left"),
            Port("gradient", len(x), "that of V per state", "grad V^"),
        ),
        None,
    )


def _controller(cfg: DictConfig, history: dict[str, np.ndarray], row: int, precise: bool) -> Deployable:
    problem = adp_problem(cfg)
    states = torch.from_numpy(history["state"][row].astype(np.float64))
    weights = torch.from_numpy(history["actor_weights"][row].astype(np.float64))
    learns = _learns(problem.controller)
    last = policy_of(problem.controller, weights[-2] if learns else None)
    _reproduced("control", last(states[-2:-1])[0], history["control"][row, -2], precise)
    low, high = states.amin(0), states.amax(0)
    generator = torch.Generator().manual_seed(0)
    points = low + (high - low) * torch.rand(_POINTS, len(low), dtype=torch.float64, generator=generator)
    unit = units_of(problem.system)
    box = " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(low.tolist(), high.tolist(), strict=True))
    policy = cfg.adp.policy
    learned = f", {weights.shape[-1]} actor weights as they were at the end" if learns else ""
    return Deployable(
        "controller",
        f"The control u(x) of {type(problem.system).__name__} by adp.policy={policy}{learned}.",
        lambda dtype: policy_of(problem.controller, weights[-1] if learns else None, dtype),
        points,
        Port("state", len(low), unit.state, f"visited: {box}"),
        (Port("control", history["control"].shape[-1], unit.input, f"to be held for {problem.dt:g} s"),),
        None,
    )


def _learns(controller: Controller) -> bool:
    inner = controller.controller if isinstance(controller, Supervised) else controller
    return isinstance(inner, ActorCritic)
