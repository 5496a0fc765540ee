"""From settings to the objects of a gradient chase, and of the experiments on the theorems."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import inspect
import json
import math
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn

from ..approximation.basis import StaFBasis, Target
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
from ..engine import ChaseResult, chase
from ..engine.predictors import Predictor
from ..kernels import Kernel
from ..metrics import Metric
from ..numerics.checks import COMMAND_LINE, choice, fail, flag, integer, positive_real, real, vector
from ..optim import UpdateLaw
from ..results.run import OWN
from ..systems import ControlAffineSystem, Units, simulate
from .plain import PlainSettings
from .plain import plain as plain

_CENTERS = "staf_torch.settings.chase.centers_of"
DTYPES = {"float64": torch.float64, "float32": torch.float32}


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
    metrics: tuple[Metric, ...] = ()  # of the user's own

    def chase(
        self, states: Tensor, weights: Tensor | None = None, basis: StaFBasis | None = None
    ) -> ChaseResult:
        """Chase along states (B, T, n) from weights (B, M), by its own basis unless another is given."""
        return chase(
            states,
            self.basis if basis is None else basis,
            self.target,
            self.law,
            inner_steps=self.inner_steps,
            predictor=self.predictor,
            weights=weights,
        )


def load(path: str, arguments: dict[str, Any] | None = None, *, inner_steps: int | None = None) -> Any:
    """Return the object at a dotted path, for classes and functions outside the package.

    A class is called, a function where there are ``arguments``; anything else is returned as it is.
    ``inner_steps`` is not used here: it stands beside an update law in the settings and belongs to the chase.

    Raises:
        ValueError: if nothing is there, or arguments are given to something that takes none.
    """
    module, _, name = path.rpartition(".") if isinstance(path, str) else ("", "", "")
    if not module:
        raise fail("custom", "path", "must be a dotted path `package.module.name`", path)
    try:
        named = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise fail("custom", "path", f"cannot be imported ({error})", path) from error
    if isinstance(named, type) or (arguments and inspect.isfunction(named)):
        return named(**(arguments or {}))
    if arguments:
        raise fail("custom", "arguments", f"needs a class or a function at {path}, which is none", arguments)
    return named


@contextlib.contextmanager
def warnings_to(messages: list[str]) -> Iterator[None]:
    """Append the warnings that are given meanwhile to a list, and show none."""
    with warnings.catch_warnings(record=True, action="always") as given:
        yield
    messages += [str(warning.message) for warning in given]


class Parts:
    """Cache: equal settings share one constructed object.

    A warning of the construction is repeated for every configuration that uses the object.
    """

    def __init__(self) -> None:
        self._made: dict[tuple[object, ...], tuple[Any, list[str]]] = {}

    def __call__(self, make: Callable[..., Any], *arguments: Any) -> Any:
        """``make(*arguments)``; arguments are settings, or objects that come from here."""
        key = (make, *map(_key, arguments))
        if key not in self._made:
            said: list[str] = []
            with warnings_to(said):
                self._made[key] = make(*arguments), said
        made, said = self._made[key]
        for message in said:
            warnings.warn(message, stacklevel=2)
        return made


def _key(argument: object) -> object:
    """Return a key that is equal for equal settings; an object that is none is only equal to itself."""
    if OmegaConf.is_config(argument):
        return json.dumps(OmegaConf.to_container(argument, resolve=True), default=repr)
    if isinstance(argument, PlainSettings):
        return json.dumps(argument, default=repr)
    return argument if isinstance(argument, int | float | str | None) else id(argument)


def chase_problem(cfg: DictConfig | PlainSettings, parts: Parts | None = None) -> ChaseProblem:
    """Build the gradient chase that the settings describe; ``parts`` is the cache of a batch.

    Raises ValueError if a setting breaks its rule; the message names it.
    """
    parts = Parts() if parts is None else parts
    device, dtype = placement(cfg.device, cfg.dtype)
    where = str(cfg.device), str(cfg.dtype)
    system = parts(_placed, parts(make_system, cfg.system), *where)
    if not callable(getattr(system, "drift", None)):
        raise fail(COMMAND_LINE, "system", "must be a plant with a method `drift`", system)
    dim = _dimension(system, cfg.initial_state)
    basis = parts(StaFBasis, parts(make, cfg.kernel), parts(make_centers, cfg.centers, dim))
    basis, target = parts(_placed, basis, *where), parts(_placed, parts(make, cfg.target), *where)
    if not callable(target):
        raise fail(COMMAND_LINE, "target", "must be callable", target)
    dt = positive_real(COMMAND_LINE, "dt", cfg.dt)
    duration = positive_real(COMMAND_LINE, "duration", cfg.duration)
    if duration < dt:
        raise fail(COMMAND_LINE, "duration", f"must be at least one step (dt={dt})", duration)
    law, inner_steps = parts(_law, cfg.optimizer)
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
        metrics=parts(make_metrics, cfg.get("metric")),
    )


def _placed(part: Any, device: str, dtype: str) -> Any:
    """Move a module to a device and a dtype, which a basis answers by being set up anew; else do nothing."""
    if isinstance(part, nn.Module):
        part.to(*placement(device, dtype))
    return part


def _dimension(system: ControlAffineSystem, initial_state: object) -> int:
    """Return n: the system's, or that of the initial state where the system takes any."""
    stated = getattr(system, "dim", None)
    if stated is not None:
        return integer(type(system).__name__, "dim", stated, least=1)
    return len(vector(COMMAND_LINE, "initial_state", plain(initial_state)))


def make(cfg: DictConfig | PlainSettings) -> Any:
    """Build the object that a group of settings names by ``_target_``.

    A user's function that needs more than the settings give is itself what is asked for, as a target
    V(x) (..., n) -> (...): it is returned with the settings as its keyword arguments.

    Raises:
        ValueError: if its constructor has no such argument, or needs one that is not there.
    """
    try:
        return instantiate(cfg, _convert_="all")
    except Exception as error:
        cause = error if isinstance(error, TypeError) else error.__cause__  # Hydra 1.3 wraps, 1.4 does not
        if isinstance(cause, TypeError) and re.search(
            r"unexpected keyword argument|missing \d+ req", str(cause)
        ):
            if _lacks_arguments(cfg):  # asked when Hydra has let the name pass
                return instantiate(cfg, _convert_="all", _partial_=True)
            raise ValueError(f"`{cfg._target_}` cannot be built from these settings: {cause}.") from error
        raise


def _lacks_arguments(cfg: DictConfig | PlainSettings) -> bool:
    """Return whether a user's function is named and the settings lack an argument that it needs."""
    named: Any = get_object(str(cfg._target_)) if cfg.get("_target_") else None
    if not inspect.isfunction(named) or named.__module__.partition(".")[0] == "staf_torch":
        return False
    rest = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
    needed = inspect.signature(named).parameters.values()
    return any(
        each.default is each.empty and each.name not in cfg and each.kind not in rest for each in needed
    )


def make_system(cfg: DictConfig | PlainSettings) -> Any:
    """Build the plant that the settings name: by its class, or by a function of nothing that makes it."""
    made = make(cfg)
    return made() if inspect.isfunction(made) else made


def units_of(cfg: DictConfig | PlainSettings) -> dict[str, str]:
    """Return the units of state and input that the class of the plant declares; nothing where it has none."""
    chosen = cfg.get("system") or {}
    try:
        units = getattr(get_object(str(chosen.get("path") or chosen.get("_target_"))), "units", Units())
    except Exception:  # the run itself says what is wrong with its plant
        return {}
    return units._asdict() if isinstance(units, Units) and units != Units() else {}


def make_metrics(cfg: DictConfig | PlainSettings | None) -> tuple[Metric, ...]:
    """Return the metrics of the user's own that the group `metric` names: none, one, or a sequence of them.

    Raises:
        ValueError: if something else is named, or a name is taken.
    """
    if cfg is None or cfg.get("_target_") is None:
        return ()
    made = make(cfg)
    metrics = (made,) if isinstance(made, Metric) else made
    if not isinstance(metrics, list | tuple) or not all(isinstance(metric, Metric) for metric in metrics):
        raise fail(COMMAND_LINE, "metric", "must be a `staf_torch.metrics.Metric`, or several", made)
    taken = [info.name for info in OWN]
    for metric in metrics:
        if metric.name in taken:
            raise fail(COMMAND_LINE, "metric", "must have a name that no other metric has", metric.name)
        taken.append(metric.name)
    return tuple(metrics)


def placement(device: object, dtype: object) -> tuple[torch.device, torch.dtype]:
    """Return device and dtype by name.

    Raises:
        ValueError: if the dtype is unknown, or the device cannot be used.
    """
    choice(COMMAND_LINE, "dtype", dtype, tuple(DTYPES))
    try:
        place = torch.device(str(device))
        torch.empty(0, dtype=torch.uint8, device=place)  # every device has these
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise fail(COMMAND_LINE, "device", f"cannot be used here ({reason})", device) from error
    return place, DTYPES[str(dtype)]


def make_centers(cfg: DictConfig | PlainSettings, dim: int) -> StateFollowingCenters:
    """Build the centers of the group `centers` around states of ``dim`` coordinates.

    Raises:
        ValueError: if the layout does not exist in that dimension, or has another number of centers.
    """
    settings = plain(cfg)
    if settings.pop("_target_", _CENTERS) == _CENTERS:
        return centers_of(**settings, dim=dim)
    made = make(cfg)
    if not isinstance(made, StateFollowingCenters):
        raise fail(COMMAND_LINE, "centers", "must be StateFollowingCenters", made)
    return made


def centers_of(
    layout: str,
    count: int | None = None,
    radius: float = 0.1,
    shrink: Mapping[str, Any] | None = None,
    *,
    dim: int | None = None,
    directions: Sequence[Sequence[float]] | None = None,
) -> StateFollowingCenters:
    """Return the centers of a node of settings, such as those of the group `centers`.

    Example:
        >>> from staf_torch.settings.chase import centers_of
        >>> centers_of("ball", 10, 0.2, dim=3).directions.shape
        torch.Size([10, 3])

    Args:
        layout: rings, polygon, simplex, cross_polytope, ball or directions.
        count: M; None where the layout and the dimension say it.
        radius: of the ball.
        shrink: None, or ``offset`` and ``gain`` of `StateRadius`; a null offset means a constant radius.
        dim: n; None where the layout says it, as rings, polygon and directions do.
        directions: of the layout of that name, (M, n) in the closed unit ball.

    Raises:
        ValueError: if the layout does not exist in that dimension, has another number of centers, or does
            not say the dimension.
    """
    planar: dict[str, Callable[[int], Tensor]] = {"rings": rings, "polygon": polygon}
    fixed: dict[str, Callable[[int], Tensor]] = {"simplex": simplex, "cross_polytope": cross_polytope}
    choice(COMMAND_LINE, "centers.layout", layout, (*planar, *fixed, "ball", "directions"))
    if layout in planar:
        if dim not in (None, 2):
            raise ValueError(
                f"`centers={layout}` lies in the plane, but the system has {dim} states: "
                "use simplex, cross_polytope or ball."
            )
        points = planar[layout](count)  # type: ignore[arg-type]  # which refuses None
    elif layout == "directions":
        if isinstance(directions, str) or not directions:  # "???" where nothing was given
            raise fail(COMMAND_LINE, "centers.directions", "must be a list of points", directions)
        rows = [vector(COMMAND_LINE, "centers.directions", row, dim) for row in directions]
        points = torch.tensor(rows, dtype=torch.float64, device="cpu")
    elif dim is None:
        raise fail("centers", "dim", f"must be given for the layout {layout}: instantiate(..., dim=n)", dim)
    elif layout in fixed:
        points = fixed[layout](dim)
        if count is not None and count != len(points):
            integer(COMMAND_LINE, "centers.count", count, least=1)
            rule = f"must be {len(points)} (or null) for {layout} with {dim} states"
            raise fail(COMMAND_LINE, "centers.count", rule, count)
    else:
        points = ball(count, dim)  # type: ignore[arg-type]
    shrinking = shrink or {}
    size = make_radius(radius, shrinking.get("offset"), shrinking.get("gain", 1.0))
    return StateFollowingCenters(points, size)


def make_radius(radius: float, offset: float | None, gain: float) -> float | Radius:
    """Return the radius: constant where the offset is None, else radius (x'x + offset) / (1 + gain x'x)."""
    return radius if offset is None else StateRadius(radius, offset, gain)


def _law(cfg: DictConfig | PlainSettings) -> tuple[UpdateLaw, int]:
    """Build the update law of the group `optimizer`; return it with the number of inner steps."""
    settings = plain(cfg)
    inner_steps = integer(COMMAND_LINE, "optimizer.inner_steps", settings.pop("inner_steps"), least=1)
    return make(OmegaConf.create(settings)), inner_steps


def initial_states(cfg: DictConfig | PlainSettings, dim: int) -> Tensor:
    """Return the stated initial state, then others uniform in a box around it: (B, n) float64.

    The generator runs on the CPU in float64, so that one seed means the same states everywhere, and
    the first k of them do not depend on how many follow.
    """
    stated = vector(COMMAND_LINE, "initial_state", plain(cfg.initial_state), dim)
    first = torch.tensor(stated, dtype=torch.float64, device="cpu")
    batch = integer(COMMAND_LINE, "trajectories", cfg.trajectories, least=1)
    spread = positive_real(COMMAND_LINE, "spread", cfg.spread)
    rows = torch.rand(batch - 1, dim, dtype=torch.float64, generator=generator_of(cfg), device="cpu")
    return torch.cat((first.unsqueeze(0), first + spread * (2 * rows - 1)))


class LocalProblem(NamedTuple):
    """A function to approximate around some states of a trajectory."""

    kernel: Kernel
    target: Target
    radius: float  # of the balls
    states: Tensor  # (T, n)
    time: Tensor  # (T,) s


def local_problem(cfg: DictConfig, states: str) -> LocalProblem:
    """Build the first trajectory of the settings, at as many equally spaced times as the setting of the name
    ``states`` says.

    Raises ValueError if a setting breaks its rule; the message names it.
    """
    problem = chase_problem(cfg)
    if cfg.centers.shrink.offset is not None:
        rule = "must be null here: the experiment is about balls of a constant radius"
        raise fail(COMMAND_LINE, "centers.shrink.offset", rule, cfg.centers.shrink.offset)
    count = integer(COMMAND_LINE, states, OmegaConf.select(cfg, states), least=1)
    path = simulate(problem.system, problem.initial_states[:1], dt=problem.dt, steps=problem.steps)[0]
    # Without the last one: over one period that is the first again.
    index = (torch.arange(min(count, problem.steps), device="cpu") * problem.steps) // min(
        count, problem.steps
    )
    radius = positive_real(COMMAND_LINE, "centers.radius", cfg.centers.radius)
    return LocalProblem(
        problem.basis.kernel, problem.target, radius, path[index], index.to(path) * problem.dt
    )


def numbers(cfg: DictConfig, name: str) -> list[float]:
    """Return a setting that lists positive numbers, sorted and without repetitions.

    Raises:
        ValueError: if the setting ``name`` is no such list.
    """
    listed = plain(OmegaConf.select(cfg, name))
    if not isinstance(listed, list) or not listed:
        raise fail(COMMAND_LINE, name, "must be a list of numbers", listed)
    return sorted({positive_real(COMMAND_LINE, name, number) for number in listed})


def generator_of(cfg: DictConfig | PlainSettings) -> torch.Generator:
    """Return a generator of random numbers that begins with the setting `seed`."""
    return torch.Generator().manual_seed(seed_of(cfg))


def seed_of(cfg: DictConfig | PlainSettings) -> int:
    """Return the setting `seed`, checked."""
    return integer(COMMAND_LINE, "seed", cfg.seed, least=0)


def horizon(cfg: DictConfig) -> tuple[float, int]:
    """Return the step of the setting `dt`, s, and the number of steps in `duration`, at least 1."""
    dt = positive_real(COMMAND_LINE, "dt", cfg.dt)
    return dt, max(1, round(positive_real(COMMAND_LINE, "duration", cfg.duration) / dt))
