"""From settings to the objects of a closed loop."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from .._checks import choice, fail, flag, integer, positive_real
from ..adp import (
    LQR,
    ActorCritic,
    ActorCriticLaw,
    BoundedInputCost,
    Controller,
    Cost,
    Extrapolation,
    Feedback,
    Frozen,
    Gains,
    Information,
    Published,
    QuadraticBasis,
    QuadraticCost,
    QuadraturePoints,
    RandomPoints,
    RBFGridBasis,
    RolloutPolicy,
    StaFValueBasis,
    Supervised,
    ValueBasis,
)
from ..basis import StaFBasis
from ..centers import ConstantRadius, Radius, StateFollowingCenters, StateRadius, ball, cross_polytope, rings
from ..kernels import ExponentialKernel
from ..systems import ControlAffineSystem
from .build import initial_states, make, make_centers, placement

_POLICIES = ("actor_critic", "rollout", "lqr", "none")
_LAWS: dict[str, type[ActorCriticLaw]] = {"information": Information, "published": Published}
_RECORDED = 200_000  # states of all trajectories together that are recorded unless asked for


@dataclasses.dataclass(frozen=True)
class OptimumSettings:
    """How the optimum is found where no formula knows it."""

    shooting: bool
    states: int  # recorded states, of all trajectories together, whose V* and u* are wanted
    horizon: float | None  # s
    intervals: int | None


@dataclasses.dataclass(frozen=True)
class AdpProblem:
    """A closed loop, checked."""

    system: ControlAffineSystem
    cost: Cost
    controller: Controller
    initial_states: Tensor  # (B, n)
    dt: float  # s
    steps: int
    every: int  # steps between recorded times
    seed: int
    integrator: str
    compile: bool | str
    optimum: OptimumSettings

    def with_states(self, states: Tensor) -> AdpProblem:
        """The same from other initial states (B, n)."""
        return dataclasses.replace(self, initial_states=states)


def adp_problem(cfg: DictConfig) -> AdpProblem:
    """The closed loop that the settings describe.

    Raises:
        ValueError: if a setting breaks its rule; the message names it.
    """
    device, dtype = placement(cfg.device, cfg.dtype)
    system = plant(cfg)
    assert system.dim is not None
    x0 = initial_states(cfg, system.dim).to(device=device, dtype=dtype)
    choice("adp", "policy", cfg.adp.policy, _POLICIES)
    cost = make_cost(cfg.adp.cost, system)
    control = controller(cfg, system, cost)
    dt = positive_real("staf", "dt", cfg.dt)
    if cfg.adp.policy == "rollout":
        dt = max(dt, positive_real("rollout", "period", cfg.adp.rollout.period))
    duration = positive_real("staf", "duration", cfg.duration)
    steps = round(duration / dt)
    if steps < 1:
        raise fail("staf", "duration", f"must be at least one step (dt={dt})", duration)
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
        seed=integer("staf", "seed", cfg.seed, least=0),
        integrator=cfg.adp.integrator,
        compile=cfg.adp.compile,
        optimum=_optimum_settings(cfg.adp.optimum),
    )


def plant(cfg: DictConfig) -> ControlAffineSystem:
    """The plant of the settings, with inputs."""
    system = make(cfg.system)
    if not isinstance(system, ControlAffineSystem) or system.dim is None:
        raise fail("adp", "system", "must be a ControlAffineSystem with `dim`", system)
    if system.effectiveness(torch.zeros(1, system.dim, dtype=torch.float64)).shape[-1] == 0:
        raise fail("adp", "system", "must be a plant with inputs", type(system).__name__)
    return system


def make_cost(cfg: DictConfig, system: ControlAffineSystem) -> Cost:
    """The cost rate of the settings, of the plant's sizes."""
    assert system.dim is not None
    at = torch.zeros(1, system.dim, dtype=torch.float64)
    inputs = system.effectiveness(at).shape[-1]
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    state, control, bound = settings["state"], settings["control"], settings["bound"]
    if bound is None:
        return QuadraticCost(state, control, system.dim, inputs)
    return BoundedInputCost(state, control, system.dim, inputs, bound=bound)


def controller(cfg: DictConfig, system: ControlAffineSystem, cost: Cost) -> Controller:
    """The controller that `adp.policy` names."""
    policy = cfg.adp.policy
    if policy in ("rollout", "lqr"):
        lqr = LQR(system, cost)
        if policy == "lqr":
            return Feedback(lqr, lqr.value)
        improved = rollout_policy(cfg.adp.rollout, system, cost, lqr)
        return Feedback(improved, improved.value)
    if not isinstance(cost, QuadraticCost):
        raise fail("adp", "cost.bound", "needs adp.policy=rollout or lqr", cfg.adp.cost.bound)
    basis = value_basis(cfg, system)
    critic, actor = _numbers(cfg.adp.critic), _numbers(cfg.adp.actor)
    if not isinstance(basis, StaFValueBasis):
        critic = actor = _weights_of_square(basis)
    learner = ActorCritic(
        basis,
        system,
        cost,
        extrapolation(cfg.adp, system),
        actor_critic_law(cfg),
        critic=critic,
        actor=actor,
        gain=cfg.adp.gain,
    )
    if cfg.adp.trust is None:
        return learner
    return Supervised(learner, LQR(system, cost), cost, cfg.adp.trust)


def rollout_policy(cfg: DictConfig, system: ControlAffineSystem, cost: Cost, lqr: LQR) -> RolloutPolicy:
    """Rollouts of the LQR at centers in a ball around the state."""
    assert system.dim is not None
    directions = _rollout_directions(cfg.centers, system.dim)
    shrink = cfg.shrink
    radius = cfg.radius if shrink.offset is None else StateRadius(cfg.radius, shrink.offset, gain=shrink.gain)
    basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(directions, radius))
    return RolloutPolicy(
        basis, system, cost, lqr, lqr.value, horizon=cfg.horizon, steps=cfg.steps, depth=cfg.depth
    )


def _rollout_directions(count: int | None, dim: int) -> Tensor:
    """Points whose fit has a gradient without bias at 0: all that quadratics need, or a symmetric cross."""
    if count is None and dim > 3:
        corners = cross_polytope(dim)
        return torch.cat((corners, torch.zeros_like(corners[:1])))
    number = math.comb(dim + 2, 2) if count is None else count
    return rings(6) if (dim, number) == (2, 6) else ball(number, dim)


def value_basis(cfg: DictConfig, system: ControlAffineSystem) -> ValueBasis:
    """The basis that `adp.basis` names."""
    choice("adp", "basis", cfg.adp.basis, ("staf", "quadratic", "rbf_grid"))
    assert system.dim is not None
    if cfg.adp.basis == "quadratic":
        return QuadraticBasis(system.dim)
    if cfg.adp.basis == "rbf_grid":
        grid = cfg.adp.rbf_grid
        return RBFGridBasis(system.dim, grid.points, grid.half_width, grid.width, flat=grid.flat)
    return staf_value_basis(cfg, system.dim)


def staf_value_basis(cfg: DictConfig, dim: int) -> StaFValueBasis:
    """The StaF basis of the settings in ``dim`` states."""
    basis = StaFBasis(make(cfg.kernel), make_centers(cfg.centers, dim))
    return StaFValueBasis(basis, cfg.adp.gradient)


def extrapolation(cfg: DictConfig, system: ControlAffineSystem) -> Extrapolation:
    """The extrapolated points that `adp.extrapolation` names."""
    choice("adp", "extrapolation", cfg.extrapolation, ("random", "quadrature"))
    width = cfg.half_width
    box: Radius = (
        ConstantRadius(width.radius)
        if width.offset is None
        else StateRadius(width.radius, width.offset, width.gain)
    )
    if cfg.extrapolation == "random":
        return RandomPoints(cfg.points, box, cfg.extrapolated_centers, around=cfg.extrapolated_around)
    assert system.dim is not None
    return QuadraturePoints(
        cfg.order, system.dim, box, cfg.extrapolated_centers, around=cfg.extrapolated_around
    )


def actor_critic_law(cfg: DictConfig) -> ActorCriticLaw:
    """The law that `adp.law` names, without learning for `adp.policy=none`."""
    choice("adp", "law", cfg.adp.law, tuple(_LAWS))
    settings: Any = OmegaConf.to_container(cfg.adp.gains, resolve=True)
    law = Frozen if cfg.adp.policy == "none" else _LAWS[cfg.adp.law]
    return law(Gains(**settings), cfg.adp.bound)


def _weights_of_square(basis: ValueBasis) -> list[float]:
    """The weights with which a global basis is nearest to x'x over [-1, 1]^n: a start that stabilises."""
    generator = torch.Generator().manual_seed(0)
    y = 2 * torch.rand(1000, basis.dim, dtype=torch.float64, generator=generator) - 1
    square = y.square().sum(-1, keepdim=True)
    fitted: list[float] = torch.linalg.lstsq(basis(y, y), square, driver="gelsd").solution[:, 0].tolist()
    return fitted


def _optimum_settings(cfg: DictConfig) -> OptimumSettings:
    return OptimumSettings(
        shooting=flag("adp", "optimum.shooting", cfg.shooting),
        states=integer("adp", "optimum.states", cfg.states, least=0),
        horizon=None if cfg.horizon is None else positive_real("adp", "optimum.horizon", cfg.horizon),
        intervals=None if cfg.intervals is None else integer("adp", "optimum.intervals", cfg.intervals, 4),
    )


def _numbers(value: Any) -> Any:
    return OmegaConf.to_container(value) if OmegaConf.is_list(value) else value


def _every(wanted: object, steps: int, batch: int) -> int:
    if wanted is not None:
        return integer("adp", "record_every", wanted, least=1)
    least = -(-steps * batch // _RECORDED)
    return next(k for k in range(max(1, least), steps + 1) if steps % k == 0) if least < steps else steps
