"""From settings to the objects of a closed loop: one config group each, nested under `adp`."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf, open_dict

from .. import adp
from ..adp import LQR, Controller, Cost, Feedback, ValueBasis
from ..adp.loop.simulation import AdpProblem, OptimumSettings
from ..adp.near_optimal_policy import NearOptimal
from ..adp.safety.box_filter import walls
from ..approximation.basis import StaFBasis
from ..numerics.checks import COMMAND_LINE, choice, fail, flag, integer, positive_real
from ..systems import ControlAffineSystem, Plant
from ..systems.base import limit_of_each
from . import config_directory
from .chase import initial_states, make, make_centers, make_system, placement, plain, seed_of

_GROUPS = ("policy", "law", "basis", "extrapolation")  # config groups below `adp` that `changed` can exchange
_RECORDED = 200_000  # states of all trajectories together that are recorded unless asked for


def adp_problem(cfg: DictConfig) -> AdpProblem:
    """Build the closed loop that the settings describe.

    Raises:
        ValueError: if a setting breaks its rule; the message names it.
    """
    device, dtype = placement(cfg.device, cfg.dtype)
    system = plant(cfg)
    assert system.dim is not None
    x0 = initial_states(cfg, system.dim).to(device=device, dtype=dtype)
    cost = make_cost(cfg, system)
    control = controller(cfg, system, cost)
    dt = max(positive_real(COMMAND_LINE, "dt", cfg.dt), control.period or 0.0)
    control = _behind_walls(cfg, system, control, dt)
    duration = positive_real(COMMAND_LINE, "duration", cfg.duration)
    steps = round(duration / dt)
    if steps < 1:
        raise fail(COMMAND_LINE, "duration", f"must be at least one step (dt={dt})", duration)
    for module in (system, cost, control):
        module.to(device=device, dtype=dtype)
    return AdpProblem(
        system=system,
        cost=cost,
        controller=control,
        initial_states=x0,
        dt=dt,
        steps=steps,
        every=_every(cfg.adp.record_every, steps, len(x0)),
        seed=seed_of(cfg),
        integrator=cfg.adp.integrator,
        compile=cfg.adp.compile,
        optimum=optimum_settings(cfg.adp.optimum),
    )


def build(cfg: DictConfig, group: str, kind: type, **known: Callable[[], Any]) -> Any:
    """Build the object of a group below `adp`, a node with ``_target_`` and arguments, which must be of a
    kind.

    Each function of ``known`` makes an argument, and is called only where the constructor has a parameter of
    that name and the node does not give it. Raises ValueError if the node is no option of its group, or the
    object is of another type.
    """
    node = cfg.adp[group]
    if not isinstance(node, DictConfig):
        raise fail(COMMAND_LINE, f"adp.{group}", f"must be an option of the group: adp/{group}=NAME", node)
    asked = inspect.signature(get_object(node["_target_"])).parameters
    given = {name: make_it() for name, make_it in known.items() if name in asked and name not in node}
    # Not through instantiate's own keywords, which would copy the objects.
    maker = instantiate(node, _convert_="all", _partial_=True)
    made = functools.partial(maker, **given) if node.get("_partial_") else maker(**given)
    if not isinstance(made, kind):
        raise fail(COMMAND_LINE, f"adp.{group}", f"must be a {kind.__name__}", made)
    return made


def plant(cfg: DictConfig) -> Plant:
    """Build the plant, which must have inputs."""
    system = make_system(cfg.system)
    if not isinstance(system, Plant) or system.dim is None:
        raise fail(COMMAND_LINE, "system", "must be a `systems.Plant` with `dim`", system)
    if _inputs(system) == 0:
        raise fail(COMMAND_LINE, "system", "must be a plant with inputs", type(system).__name__)
    return system


def _inputs(system: Plant) -> int:
    """Return m, which a class that states none shows in its effectiveness."""
    if not isinstance(system, ControlAffineSystem):
        return system.inputs
    return system.effectiveness(torch.zeros(1, system.dim or 0, dtype=torch.float64, device="cpu")).shape[-1]


def make_cost(cfg: DictConfig, system: Plant) -> Cost:
    """Build the cost rate of the group `adp/cost` in the plant's sizes."""
    cost: Cost = build(cfg, "cost", Cost, dim=lambda: system.dim, inputs=lambda: _inputs(system))
    return cost


def controller(cfg: DictConfig, system: Plant, cost: Cost) -> Controller:
    """Build the controller of the group `adp/policy`; a callable from x to u becomes a `Feedback`."""
    assert system.dim is not None
    basis = functools.cache(functools.partial(value_basis, cfg, system.dim))

    def start(weights: Any) -> Any:
        return plain(weights) if basis().follows_state else basis().weights_near_square()

    policy: Callable[..., Any] = build(
        cfg,
        "policy",
        Callable,  # type: ignore[arg-type]
        system=lambda: system,
        model=lambda: system,
        plant=lambda: system,
        cost=lambda: cost,
        dim=lambda: system.dim,
        inputs=lambda: _inputs(system),
        lqr=lambda: LQR(system, cost),
        basis=basis,
        extrapolation=lambda: build(cfg, "extrapolation", adp.Extrapolation, dim=lambda: system.dim),
        law=lambda: build(cfg, "law", adp.ActorCriticLaw),
        critic=lambda: start(cfg.adp.critic),
        actor=lambda: start(cfg.adp.actor),
    )
    if not isinstance(policy, Controller):
        if isinstance(policy, NearOptimal) and not isinstance(loop := policy.controller(), Feedback):
            return loop
        return Feedback(policy, getattr(policy, "value", None))
    if cfg.adp.trust is None:
        return policy
    return adp.Supervised(policy, LQR(system, cost), cost, cfg.adp.trust)


def _behind_walls(cfg: DictConfig, system: Plant, control: Controller, dt: float) -> Controller:
    """The controller behind a `SafetyFilter` that keeps the box of `adp.walls`; itself without walls."""
    given, size = plain(cfg.adp.walls), system.dim or 0
    low = limit_of_each("adp.walls", "low", given["low"], -math.inf, size, "states")
    high = limit_of_each("adp.walls", "high", given["high"], math.inf, size, "states")
    kept = walls(low.tolist(), high.tolist())
    return adp.SafetyFilter(control, system, kept, dt=dt, decay=given["decay"]) if kept else control


def value_basis(cfg: DictConfig, dim: int) -> ValueBasis:
    """Build the basis of the group `adp/basis`; one that asks for ``basis`` gets kernel and centers."""
    known = {"dim": lambda: dim, "basis": lambda: StaFBasis(make(cfg.kernel), make_centers(cfg.centers, dim))}
    basis: ValueBasis = build(cfg, "basis", ValueBasis, **known)
    return basis


def changed(cfg: DictConfig, changes: Mapping[str, Any]) -> DictConfig:
    """Copy the settings with others under `adp`, where a string for a group names one of its options.

    Raises:
        ValueError: if the package brings no such option.
    """
    new = cfg.copy()
    with open_dict(new):
        for name, value in changes.items():
            if name in _GROUPS:
                folder = Path(config_directory(), "adp", name)
                options = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
                choice(COMMAND_LINE, f"adp.{name}", value, tuple(options))
                new.adp[name] = OmegaConf.load(options[value])
            else:
                OmegaConf.update(new.adp, name, value)
    return new


def optimum_settings(cfg: DictConfig) -> OptimumSettings:
    """Return the settings `adp.optimum`, checked."""
    wanted, count = cfg.horizon, cfg.intervals
    return OptimumSettings(
        shooting=flag(COMMAND_LINE, "adp.optimum.shooting", cfg.shooting),
        states=integer(COMMAND_LINE, "adp.optimum.states", cfg.states, least=0),
        horizon=None if wanted is None else positive_real(COMMAND_LINE, "adp.optimum.horizon", wanted),
        intervals=None if count is None else integer(COMMAND_LINE, "adp.optimum.intervals", count, 4),
    )


def _every(wanted: object, steps: int, batch: int) -> int:
    """Steps between recorded times: the wanted number, else one that keeps the record within bounds."""
    if wanted is not None:
        return integer(COMMAND_LINE, "adp.record_every", wanted, least=1)
    least = -(-steps * batch // _RECORDED)
    return next(k for k in range(max(1, least), steps + 1) if steps % k == 0) if least < steps else steps
