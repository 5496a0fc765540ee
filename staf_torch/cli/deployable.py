"""The deployable part of a run: read, built anew, and compared with what was recorded."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
import yaml
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn

from .. import __version__
from ..adp import Controller, Feedback, LoopResult, SafetyFilter, Supervised, simulate
from ..adp.loop.simulation import AdpProblem
from ..adp.loop.step import by_generator, generated, points_of_steps
from ..adp.planning.receding_horizon import StrainedPlans
from ..approximation.staf import StaF
from ..deploy import approximator, policy_of
from ..deploy.controllers import in_dtype
from ..deploy.data_sheet import Port
from ..experiments.adp import innermost, learner
from ..numerics.checks import fail, integer
from ..results import run_record as records
from ..results.files import HISTORY, HYDRA, UnreadableError, read_bytes
from ..results.run_directory import History
from ..settings.adp import adp_problem
from ..settings.chase import chase_problem
from ..settings.trust import foreign_settings, refusal
from ..sweeps.hydra_compat import everything_trusted, working_directory_imports
from ..sweeps.job import chain
from ..systems import Units

_POINTS = 1000
_FOLLOWED = 500  # steps of a run that a learning controller is compared over
_READ = ("state", "weights", "estimate", "actor_weights", "control")  # of the history


@dataclasses.dataclass(frozen=True)
class Deployable:
    """The part of a run that is exported."""

    kind: str  # approximator, controller
    what: str  # one sentence
    module: Callable[[torch.dtype], nn.Module]
    points: Tensor  # (P, n) of the region, float64
    input: Port
    outputs: tuple[Port, ...]
    written_by: str | None = None  # the version that made the run, where it says


class CarriesPlanError(ValueError):
    """The run's controller carries a plan, and is no function of x."""


def deployable(run: Path, row: int = 0, *, trust: bool = False, function: bool = False) -> Deployable:
    """Return the deployable part of one trajectory (``row``): its controller, or its approximation at the
    last time.

    The objects are built anew from the run's settings, and must reproduce what the run recorded. ``trust``
    says whether code of your own that the settings name may be imported; ``function``, of a controller that
    carries a plan where a bound is met, takes its policy, which does not.

    Raises:
        CarriesPlanError: if the controller carries a plan, and ``function`` is not set.
        ValueError: if the directory is no run, lacks its history, holds another experiment, names foreign
            code, or was written by a version whose numbers this one does not reproduce.
    """
    tasks = {"gradient_chase": _approximation, "adp": _controller}
    with _opened(run, row, tasks, trust) as (cfg, history, precise, written_by):
        if cfg.task == "adp":
            found = _controller(cfg, history, precise, row, function)
        elif function:
            raise fail("staf-export", "function", "must go with a run of adp", cfg.task)
        else:
            found = _approximation(cfg, history, precise)
        return dataclasses.replace(found, written_by=written_by)


@dataclasses.dataclass(frozen=True)
class Learner:
    """A controller that goes on learning, and the first steps of its run."""

    what: str  # one sentence
    controller: Controller
    learns: bool  # False: it carries a plan
    dt: float  # s
    states: Tensor  # (K, n), float64
    uniform: Tensor  # (K, draws, n) random numbers of [-1, 1]
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    written_by: str | None = None

    def copied(self, dtype: torch.dtype) -> Controller:
        """Return the controller in a dtype."""
        return in_dtype(self.controller, dtype)


def learning(run: Path, row: int = 0, *, trust: bool = False) -> Learner:
    """The controller of one trajectory as it was at time 0, that learns or plans as it did in the run.

    Arguments and errors as of `deployable`; ValueError also if the run's controller is a function of x.
    """
    with _opened(run, row, {"adp": _learner}, trust) as (cfg, history, precise, written_by):
        return dataclasses.replace(_learner(cfg, history, precise, row), written_by=written_by)


@contextlib.contextmanager
def _opened(
    run: Path, row: int, tasks: Mapping[str, object], trust: bool
) -> Iterator[tuple[DictConfig, dict[str, Tensor], bool, str | None]]:
    """Context: settings in float64, history of one trajectory, whether it is as precise, and who wrote it."""
    integer("staf-export", "row", row, least=0)
    record = records.read(run / records.RUN) or {}
    written_by = str(record["version"]) if record.get("version") is not None else None
    try:
        cfg = _settings(run, trust)
        if cfg.get("task") not in tasks:
            raise fail("staf-export", "RUN", f"must be a run of {' or '.join(tasks)}", cfg.get("task"))
        history = _history(run, row)
        precise = cfg.dtype == "float64"
        cfg.dtype, cfg.device = "float64", "cpu"
        with contextlib.ExitStack() as stack:
            for each in (everything_trusted, working_directory_imports) if trust else ():
                stack.enter_context(each())
            yield cfg, history, precise, written_by
    except Exception as error:
        absent = _absent(error)
        if absent is not None:
            raise ValueError(
                f"{run} needs the module {absent}, which is neither in {Path.cwd()} nor on Python's path: "
                f"run staf-export where `staf` was run, in the folder with {absent.replace('.', '/')}.py."
            ) from error
        if isinstance(error, ValueError | OSError):
            raise
        # settings of another version, or of nobody's
        raise ValueError(
            f"{run} was written by staf_torch {written_by or '(another version)'}, whose settings "
            f"staf_torch {__version__} does not understand ({_first_line(error)}): run it anew, "
            "or export it with that version."
        ) from error


def _absent(error: BaseException) -> str | None:
    """Return the module of the user's own that was not found, None where the error is another one."""
    return next((each.name for each in chain(error) if isinstance(each, ModuleNotFoundError)), None)


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


class _PlainLoader(yaml.SafeLoader):  # type: ignore[misc]
    """Loader of plain values. Aliases are refused: by them a short file can stand for an endless tree."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Return the next node."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it has an alias, which Hydra never writes")
        return super().compose_node(parent, index)


def _settings(run: Path, trust: bool) -> DictConfig:
    if not (run / HYDRA / "config.yaml").exists():
        raise fail("staf-export", "RUN", f"must be a run directory, with {HYDRA}/config.yaml", str(run))
    try:
        found = yaml.load(read_bytes(run / HYDRA / "config.yaml"), _PlainLoader)
    except (yaml.YAMLError, RecursionError) as error:
        raise UnreadableError(f"{run} has no settings that can be read: {_first_line(error)}") from error
    lines = [] if trust else foreign_settings(found)
    if lines:
        raise ValueError(refusal(run, lines))
    cfg = OmegaConf.create(found)
    if not isinstance(cfg, DictConfig):
        raise fail("staf-export", "RUN", f"must hold settings in {HYDRA}/config.yaml", str(run))
    OmegaConf.set_struct(cfg, True)  # a setting that is missing is an error, not None
    return cfg


def _history(run: Path, row: int) -> dict[str, Tensor]:
    """Return the arrays of a history, (T, ...) of one trajectory where they have trajectories."""
    path = run / HISTORY
    if not path.exists():
        raise ValueError(
            f"{run} has no history.npz, which holds the weights: run with history=false, or not ended."
        )
    history = History(path)
    if "state" not in history or history["state"].ndim != 3:
        raise UnreadableError(f"{path} has no states of trajectories")
    if row >= len(history["state"]):
        raise fail("staf-export", "row", f"must be below the run's {len(history['state'])} trajectories", row)
    found = {name: history[name][row].astype(np.float64) for name in _READ if name in history}
    return {name: torch.from_numpy(array) for name, array in found.items()}


def _reproduced(name: str, found: Tensor, wanted: Tensor, precise: bool) -> None:
    """Whatever wrote the run: what is built from it must give the recorded numbers."""
    if not bool(torch.isfinite(wanted).all()):
        rule = "must be a trajectory that did not diverge"
        raise fail("staf-export", "row", rule, f"a recorded {name} of NaN")
    worst = float((found - wanted).abs().max() / wanted.abs().max().clamp(min=1e-3))
    if not worst <= (1e-8 if precise else 1e-3):
        raise ValueError(
            f"The recorded {name} of this run cannot be reproduced: built from its settings it differs by "
            f"{worst:.3g}. Another version of staf_torch wrote it, or a file was changed: run it anew."
        )


def _approximation(cfg: DictConfig, history: dict[str, Tensor], precise: bool) -> Deployable:
    problem = chase_problem(cfg)
    x, weights = history["state"][-1], history["weights"][-1]
    if not bool(torch.isfinite(weights).all()):
        raise fail("staf-export", "row", "must be a trajectory whose weights can be represented", "NaN")
    staf = StaF(problem.basis)
    with torch.no_grad():
        staf.state.copy_(x)
        staf.coefficients.copy_(problem.basis.local(x).coefficients(weights))
    _reproduced("estimate", staf(x.unsqueeze(0)).detach(), history["estimate"][-1:], precise)
    radius = float(problem.basis.centers.radius(x))
    generator = torch.Generator().manual_seed(0)
    inside = torch.randn(_POINTS, len(x), dtype=torch.float64, generator=generator, device="cpu")
    shrink = torch.rand(_POINTS, 1, dtype=torch.float64, generator=generator, device="cpu") ** (1 / len(x))
    points = x + radius * shrink * inside / inside.norm(dim=-1, keepdim=True)
    unit = getattr(problem.system, "units", Units())
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
    )


def _controller(
    cfg: DictConfig, history: dict[str, Tensor], precise: bool, row: int, function: bool
) -> Deployable:
    problem = adp_problem(cfg)
    states, weights = history["state"], history["actor_weights"]
    learns, controller = learner(problem.controller) is not None, problem.controller
    if not learns and not isinstance(innermost(controller), Feedback):
        if not function:
            raise CarriesPlanError(
                f"The controller of this run, {controller.label}, carries a plan from control to control "
                "where a bound is met: `--to c` writes it with its plan in a structure, `--function` in any "
                "format its policy as a function of x, which does not plan."
            )
        _replayed(problem, history, precise, row)
        controller = without_plans(controller)
    elif function:
        rule = "must be omitted: what this run's controller does is a function of x, or it learns"
        raise fail("staf-export", "function", rule, controller.label)
    else:
        last = policy_of(controller, weights[-2] if learns else None)
        _reproduced("control", last(states[-2:-1])[0], history["control"][-2], precise)
    low, high = states.amin(0), states.amax(0)
    generator = torch.Generator().manual_seed(0)
    points = low + (high - low) * torch.rand(
        _POINTS, len(low), dtype=torch.float64, generator=generator, device="cpu"
    )
    unit = problem.system.units
    box = " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(low.tolist(), high.tolist(), strict=True))
    learned = f", {weights.shape[-1]} actor weights as they were at the end" if learns else ""
    return Deployable(
        "controller",
        f"The control u(x) of {type(problem.system).__name__} by {controller.label}{learned}"
        f"{', without the plans that the run made where a bound is met' if function else ''}.",
        lambda dtype: policy_of(controller, weights[-1] if learns else None, dtype),
        points,
        Port("state", len(low), unit.state, f"visited: {box}"),
        (Port("control", history["control"].shape[-1], unit.input, f"to be held for {problem.dt:g} s"),),
    )


def without_plans(controller: Controller) -> Controller:
    """Return a controller with the policy of the one that plans in its place.

    Raises:
        ValueError: if that is no policy with plans where a bound is met.
    """
    if isinstance(controller, SafetyFilter | Supervised):
        other = copy.copy(controller)
        other.__dict__ = {**vars(controller), "_modules": dict(controller._modules)}
        other.controller = without_plans(controller.controller)
        return other
    if not isinstance(controller, StrainedPlans):
        rule = (
            "must go with `near_optimal`: what this run's controller does is no function of x without plans"
        )
        raise fail("staf-export", "function", rule, controller.label)
    return Feedback(controller.policy)


def _replayed(
    problem: AdpProblem, history: dict[str, Tensor], precise: bool, row: int
) -> tuple[LoopResult, int]:
    """Return the first steps of a run again, compared with what it recorded, and their number."""
    x0, seed = problem.initial_states[row : row + 1], problem.seed + row
    steps = max(problem.every, min(problem.steps, _FOLLOWED) // problem.every * problem.every)
    found = simulate(
        problem.controller,
        problem.system,
        problem.cost,
        x0,
        dt=problem.dt,
        steps=steps,
        seed=seed,
        integrator=problem.integrator,
        compile=problem.compile if learner(problem.controller) is None else False,
    )
    recorded = history["control"][: steps // problem.every]
    _reproduced("control", found.control[0, 0 : steps : problem.every], recorded, precise)
    return found, steps


def _learner(cfg: DictConfig, history: dict[str, Tensor], precise: bool, row: int) -> Learner:
    problem = adp_problem(cfg)
    learns = learner(problem.controller) is not None
    if not learns and isinstance(innermost(problem.controller), Feedback):
        what = type(problem.controller).__name__
        raise fail("staf-export", "learning", "must be omitted where nothing learns", what)
    found, steps = _replayed(problem, history, precise, row)
    x0, seed = problem.initial_states[row : row + 1], problem.seed + row
    draws = problem.controller.draws
    if by_generator(problem.controller):
        uniform = generated(x0, steps, draws, [torch.Generator().manual_seed(seed)])[0]
    else:
        uniform = points_of_steps(x0, [seed], 0, steps, draws)[0]
    unit, size = problem.system.units, x0.shape[-1]
    inputs = [Port("x", size, unit.state, "as the weights have learned it" if learns else "of the plant")]
    if problem.controller.draws:
        numbers = problem.controller.draws * size
        inputs.append(Port("uniform", numbers, "1", "random numbers of [-1, 1], new in every step"))
    return Learner(
        f"One step of {problem.controller.label} on {type(problem.system).__name__}, from the "
        f"{'weights' if learns else 'plan'} of time 0: the control to hold for {problem.dt:g} s, "
        + (
            "before any bounds of the actuator, and new weights." if learns else "and the plan from there on."
        ),
        problem.controller,
        learns,
        problem.dt,
        found.state[0, :steps],
        uniform,
        tuple(inputs),
        (Port("u", found.control.shape[-1], unit.input, f"to be held for {problem.dt:g} s"),),
    )
