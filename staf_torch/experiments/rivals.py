"""Our methods and those of others on the same plants, states and costs; losses are printed as they are."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from ..adp import BoxDDP, SampledProblem
from ..figures.closed_loop import draw_rivals
from ..numerics.checks import COMMAND_LINE, choice, integer
from ..results.run_directory import RunDirectory
from ..settings.chase import plain, seed_of
from ..signs import SHOWN, Progress
from ..tables.model import significant
from .registry import Metrics
from .rival_methods import METHODS, Begin, Rival, UnsuitableError, ipopt_program
from .rival_plants import CASES, RivalPlant
from .study import Study, label_key, tell_of_cpu

_log = logging.getLogger(__name__)
_ROUNDED = 1e-6  # of the range of an input, beyond which it violates its bound: solvers round
_COLUMNS = {
    "plant": "plant",
    "method": "method",
    "ratio_median": "cost over best: median",
    "ratio_max": "max",
    "regulated": "regulated",
    "violations": "violations",
    "us_median": "us a control: median",
    "us_p99": "p99",
    "offline": "s before",
    "megabytes": "MB",
    "lines": "lines",
    "note": "note",
}


@dataclasses.dataclass(frozen=True)
class Episode:
    """Closed loops of a method from every initial state."""

    cost: Tensor  # with the LQR's value at the end, (B,); inf where a number is not finite
    control: Tensor  # (B, T, m)
    state: Tensor  # (B, T + 1, n)
    left: Tensor  # LQR's value at the end, (B,)
    outside: float  # share of the controls beyond the bounds
    offline: float  # CPU s before the first control


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run every method on every plant and fill the run directory, the table after every plant; `metrics.json`
    comes last."""
    settings = cfg.rivals
    cases, chosen = _chosen("plants", settings.plants, CASES), _chosen("methods", settings.methods, METHODS)
    states = integer(COMMAND_LINE, "rivals.states", settings.states, least=1)
    slow = min(states, integer(COMMAND_LINE, "rivals.slow", settings.slow, least=1))
    calls = integer(COMMAND_LINE, "rivals.calls", settings.calls, least=1)
    seed = seed_of(cfg)
    tell_of_cpu(cfg, _log, "every method is timed there, others' programs among them")
    study, out = Study("rivals", _COLUMNS, (), _log, digits=5), RunDirectory(directory)
    for case in progress.each(cases, "plants"):
        for method, measured, more in compare(case, chosen, case.states(states, seed), calls, slow):
            study.add(f"{case.name}_{label_key(method)}_", measured, more, plant=case.name, method=method)
        study.write_table(out)
    return study.write(cfg, out, lambda: draw_rivals(study.rows))


def _chosen(what: str, names: object, known: Mapping[str, Any]) -> list[Any]:
    return [known[str(choice(COMMAND_LINE, f"rivals.{what}", name, tuple(known)))] for name in plain(names)]


def compare(
    case: RivalPlant, rivals: Sequence[Rival], x0: Tensor, calls: int, slow: int | None = None
) -> list[tuple[str, Metrics, dict[str, Any]]]:
    """The rows of one plant: a method, its metrics (None: it did not run), and for the table its times, sizes
    and a note. Slow methods run from so many of the states and a fifth of the calls are timed, with a note of
    it; None: as many as the others."""
    problem = case.problem()
    episodes: dict[str, Episode] = {}
    times: dict[str, list[float]] = {}
    notes: dict[str, str] = {}
    for rival in rivals:
        if rival.missing is not None:
            notes[rival.name] = f"{rival.missing} is not installed"
            continue
        began = time.process_time()
        try:
            begin = rival.prepare(case)
            begin(x0[:1])  # a plan of the whole episode is made here
        except UnsuitableError as why:
            notes[rival.name] = str(why)
            continue
        offline = time.process_time() - began
        few = rival.slow and slow is not None and slow < len(x0)
        if few:
            notes[rival.name] = f"from {slow} of the {len(x0)} states"
        episode = play(problem, begin, x0[:slow] if few else x0, case.steps, offline)
        episodes[rival.name] = episode
        times[rival.name] = timed(problem, begin, x0[:1], -(-calls // 5) if few else calls)
        _log.info("%s, %s: mean cost %s", case.name, rival.name, significant(float(episode.cost.mean()), 5))
    best = best_known(case, problem, x0, list(episodes.values()))
    rows = []
    for rival in rivals:
        megabytes = None if rival.missing else rival.megabytes
        more: dict[str, Any] = dict.fromkeys(("us_median", "us_p99", "offline"))
        more |= {"megabytes": megabytes, "lines": rival.lines, "note": notes.get(rival.name)}
        measured: Metrics = dict.fromkeys(("ratio_median", "ratio_max", "regulated", "violations"))
        if played := episodes.get(rival.name):
            median, high = np.quantile(times[rival.name], (0.5, 0.99))
            more |= {"us_median": float(median), "us_p99": float(high), "offline": played.offline}
            measured = _measured(played, best, case.left)
        rows.append((rival.name, measured, more))
    return rows


@torch.no_grad()
def play(problem: SampledProblem, begin: Begin, x0: Tensor, steps: int, offline: float = 0.0) -> Episode:
    """Steer from x0 for a number of periods; what is applied is within the bounds."""
    steer, x = begin(x0), x0
    spent, outside = x0.new_zeros(len(x0)), 0.0
    controls, states = [], [x0]
    slack = _ROUNDED * (problem.bounds.high - problem.bounds.low)
    for _ in range(steps):
        wanted = steer(x)
        u = problem.admissible(wanted)
        outside += float(((wanted - u).abs() > slack).any(-1).double().mean()) / steps
        x, paid = problem.advance(x, u)
        spent = spent + paid
        controls.append(u)
        states.append(x)
    left = problem.terminal(x)
    cost = torch.where(torch.isfinite(spent + left), spent + left, torch.inf)
    return Episode(cost, torch.stack(controls, 1), torch.stack(states, 1), left, outside, offline)


@torch.no_grad()
def timed(problem: SampledProblem, begin: Begin, x: Tensor, calls: int) -> list[float]:
    """CPU microseconds of every control of one state, along its trajectory, the first ones left out."""
    steer, taken = begin(x), []
    for _ in range(calls):
        start = time.process_time()
        u = steer(x)
        taken.append(1e6 * (time.process_time() - start))
        x, _ = problem.advance(x, problem.admissible(u))
    return taken[len(taken) // 10 :]


def best_known(case: RivalPlant, problem: SampledProblem, x0: Tensor, episodes: list[Episode]) -> Tensor:
    """The lowest cost over the episode that anything reached: a method, from all states or the first ones,
    box-DDP from where it went, and where CasADi is installed IPOPT from the best of these: (B,)."""
    search = BoxDDP(problem, steps=case.steps, iterations=100)
    found = search.solve(x0)
    best, control, state = found.cost, found.control, found.state
    for episode in episodes:
        count = len(episode.cost)
        fine = (torch.isfinite(episode.cost) & (episode.cost < 1e3 * best[:count])).nonzero().squeeze(1)
        if not len(fine):
            continue
        refined = search.solve(x0[fine], episode.control[fine])
        lower = refined.cost < best[fine]
        rows = fine[lower]
        best = best.index_copy(0, rows, refined.cost[lower])
        control = control.index_copy(0, rows, refined.control[lower])
        state = state.index_copy(0, rows, refined.state[lower])
        best = torch.cat((torch.minimum(best[:count], episode.cost), best[count:]))
    if METHODS["IPOPT"].missing is None:
        best = torch.minimum(best, _by_ipopt(case, problem, x0, control, state))
    return best


def _by_ipopt(
    case: RivalPlant, problem: SampledProblem, x0: Tensor, control: Tensor, state: Tensor
) -> Tensor:
    import casadi

    solve = ipopt_program(casadi, case, problem, case.steps)
    found = []
    for row in range(len(x0)):
        guess = np.concatenate([state[row, :, : case.dim].numpy().ravel(), control[row].numpy().ravel()])
        solved = solve(x0=guess, p=np.append(x0[row, : case.dim].numpy(), 0.0))
        found.append(float(solved["f"]) if solved["success"] else np.inf)
    return torch.tensor(found, dtype=torch.float64, device="cpu")


def _measured(episode: Episode, best: Tensor, share: float) -> Metrics:
    """Return what the metrics have of the controls of a method."""
    best = best[: len(episode.cost)]
    up = episode.left <= share * best
    ratio = (episode.cost / best)[up]
    return {
        "ratio_median": float(ratio.median()) if len(ratio) else None,
        "ratio_max": float(ratio.max()) if len(ratio) else None,
        "regulated": float(up.double().mean()),
        "violations": episode.outside,
    }
