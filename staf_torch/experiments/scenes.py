"""Scenes of animations: of a gradient chase and of closed loops."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from ..approximation.basis import StaFBasis
from ..figures.animation import FRAMES, KINDS, Curves, Scene, animate
from ..numerics.checks import COMMAND_LINE, choice, fail
from ..results.run_directory import RunDirectory
from ..settings.chase import ChaseProblem
from ..settings.plain import PlainSettings
from ..systems import Units

if TYPE_CHECKING:  # `adp` is .1 s, which chases do not need
    from ..adp import Controller, LoopResult
    from ..adp.loop.controller import Value
    from ..adp.loop.simulation import AdpProblem

_GRID, _ACROSS = 81, 41


def animation_kind(cfg: DictConfig | PlainSettings, dim: int | None = None) -> str | None:
    """Return what the setting `animation` asks for, gif or html; None for no animation.

    Raises ValueError for anything else, or where the state is known to have fewer than two coordinates.
    """
    wanted = cfg.get("animation", False)
    if wanted is False:
        return None
    kind = "gif" if wanted is True else str(choice(COMMAND_LINE, "animation", wanted, (True, False, *KINDS)))
    if dim is not None and dim < 2:
        raise fail(COMMAND_LINE, "animation", "needs a state of two coordinates or more", dim)
    return kind


def write_animation(cfg: DictConfig, out: RunDirectory, name: str, scene: Callable[[], Scene]) -> None:
    """Write a scene as the setting `animation` asks for; nothing for no animation."""
    kind = animation_kind(cfg)
    if kind is not None:
        out.figure(name, animate(scene(), kind))


def chase_scene(problem: ChaseProblem, drawn: Mapping[str, np.ndarray]) -> Scene:
    """Return the first trajectory of a chase, thinned, as `Outcome.drawn` has it."""
    at = frames(len(drawn["time"]) - 1)
    like = problem.initial_states
    x, weights = (torch.as_tensor(drawn[name][at], device="cpu").to(like) for name in ("state", "weights"))
    radius = problem.basis.centers.radius(x).expand(len(at))
    along, points = _across(torch.as_tensor(drawn["state"], device="cpu").to(like), at, radius)
    with torch.no_grad():
        estimate = (problem.basis(points, x) * weights[:, None]).sum(-1)
        centers = problem.basis.centers(x)[..., :2]
        value = problem.target(points)
        plane = x.shape[-1] == 2
        grid = _levels(problem.target, float(x.abs().max() + 1.4 * radius.max()), like) if plane else None
    return Scene(
        title=f"{'level lines of $V$; ' if plane else ''}the centers move with the state",
        time=drawn["time"][at],
        state=_array(x[:, :2]),
        centers=_array(centers),
        radius=_array(radius),
        curves=Curves("weights, and the ideal ones (dotted)", _array(weights), drawn["ideal_weights"][at]),
        along=_array(along),
        value=_array(value),
        estimate=_array(estimate),
        grid=grid,
        units=getattr(problem.system, "units", Units()).of_states(x.shape[-1]),
    )


def frames(last: int, power: int = 1) -> np.ndarray:
    """Return the indices of the times that are shown, up to the last; with a power, more early ones."""
    return np.unique((np.linspace(0, 1, FRAMES) ** power * last).round().astype(int))


def loop_scene(problem: AdpProblem, result: LoopResult) -> Scene:
    """Return the first trajectory of a closed loop: V is the optimal value, where a formula knows it."""
    from ..adp.planning.shooting.reference_optimum import known_value

    def known(x: Tensor) -> Tensor:
        value = known_value(problem, x)
        assert value is not None
        return value

    optimum = None if known_value(problem, problem.initial_states) is None else known
    # The state is fast at first and then rests: half of the frames are of the first quarter of the time.
    far = result.state[0].norm(dim=-1)
    at = frames(max(1, int((far > 0.01 * far.max()).nonzero().max())), 2)
    scene = _scene(problem.controller, result, at, optimum)
    return scene._replace(units=problem.system.units.of_states(result.state.shape[-1]))


def tracking_scene(controller: Controller, result: LoopResult) -> Scene:
    """Return the first trajectory of a tracking loop with the states (e, xd), in the plane of x = e + xd."""
    at = frames(len(result.time) - 1)
    scene = _scene(controller, result, at, None)
    followed = _array(result.state[0, at, 2:4])
    return scene._replace(
        title="the state, the desired one (dotted), and the centers",
        state=scene.state + followed,
        centers=scene.centers + followed[:, None],
        followed=followed,
    )


def _scene(controller: Controller, result: LoopResult, at: np.ndarray, optimum: Value | None) -> Scene:
    path = result.state[0]
    x, critic = path[at], result.critic_weights[0, at]
    controller = _inner(controller)
    basis = _moving(controller)
    with torch.no_grad():
        radius, centers = 0.1 * path.norm(dim=-1).max(), x.new_zeros(len(at), 0, 2)
        if basis is not None:
            followed = x[:, : basis.dim]
            radius, centers = basis.centers.radius(followed), basis.centers(followed)[..., :2]
        radius = radius.expand(len(at))
        along, points = _across(path, at, radius)
        estimate = _estimate(controller, points, x, critic)
        plane = optimum is not None and x.shape[-1] == 2
        reach = float(x.abs().max() + 1.4 * radius.max())
        return Scene(
            title=("level lines of $V^*$" if plane else "the state") + (" and the centers" if basis else ""),
            time=result.time.numpy()[at],
            state=_array(x[:, :2]),
            centers=_array(centers),
            radius=_array(radius),
            # No ideal weights: the critic learns from the Bellman error, and where the ball shrinks with the
            # state K^-1 V(c) grows beyond all bounds.
            curves=Curves("weights of the critic", _array(critic), None)
            if critic.shape[-1]
            else Curves("control", _array(result.control[0, at]), None),
            along=_array(along),
            value=None if optimum is None else _array(optimum(points)),
            estimate=None if estimate is None else _array(estimate),
            grid=_levels(optimum, reach, x) if plane and optimum is not None else None,
            relative=True,
        )


def _inner(controller: Controller) -> Controller:
    """Return what a supervisor or an identifying tracker holds."""
    from .. import adp

    if isinstance(controller, adp.Supervised):
        return controller.controller
    return controller.learner if isinstance(controller, adp.IdentifyingTracker) else controller


def _moving(controller: Controller) -> StaFBasis | None:
    """Return kernel and centers of what follows the state in a controller."""
    from .. import adp

    basis: object = None
    if isinstance(controller, adp.Feedback):
        basis = getattr(controller.policy, "basis", None)
    elif isinstance(controller, adp.ActorCritic):
        value = controller.basis
        value = value.basis if isinstance(value, adp.LeadingCoordinates) else value
        basis = value.basis if isinstance(value, adp.StaFValueBasis) else None
    return basis if isinstance(basis, StaFBasis) else None


def _estimate(controller: Controller, points: Tensor, x: Tensor, critic: Tensor) -> Tensor | None:
    """Return V^(y; x) at points y (F, S, n) around the states x (F, n)."""
    from .. import adp

    if not isinstance(controller, adp.ActorCritic):
        return controller.value(points, {})
    around = x.unsqueeze(-2).expand(points.shape)
    estimate: Tensor = (controller.basis(points, around) * critic.unsqueeze(-2)).sum(-1)
    return estimate


def _across(path: Tensor, at: np.ndarray, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Return places from -1 to 1 (S,), and the points there (F, S, n): along the way through each ball."""
    way = torch.gradient(path, dim=0)[0][at]
    way = way / way.norm(dim=-1, keepdim=True).clamp_min(torch.finfo(path.dtype).tiny)
    along = torch.linspace(-1, 1, _ACROSS, device="cpu").to(path)
    return along, path[at][:, None] + (radius[:, None] * along)[..., None] * way[:, None]


def _levels(value: Value, reach: float, like: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    line = torch.linspace(-reach, reach, _GRID, device="cpu").to(like)
    plane = torch.stack(torch.meshgrid(line, line, indexing="xy"), dim=-1)
    level = value(plane.reshape(-1, 2)).reshape(_GRID, _GRID)
    return _array(line), _array(line), _array(level)


def _array(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy()
