"""Integral concurrent learning beside concurrent learning of a differentiated state, over random gains."""

from __future__ import annotations

import logging
import math
from functools import partial
from pathlib import Path

import torch
from omegaconf import DictConfig
from torch import Tensor

from ..adp import ConcurrentTracker, LoopResult, Measured, ParametricPlant, QuadraticCost
from ..figures.closed_loop import draw_gain_sets
from ..numerics.checks import COMMAND_LINE, fail, integer, non_negative, positive_real, real, vector
from ..results.run_directory import RunDirectory
from ..settings.chase import generator_of, placement, plain, seed_of
from ..signs import SHOWN, Progress
from .registry import Metrics
from .study import Method, Study, histories, recorded_times

_log = logging.getLogger(__name__)
SOURCES = {"integral": "integral", "slope": "derivative"}
_TRUE = (5.0, 10.0, 15.0, 20.0)
_RECORDED = 0.1  # s between recorded times at most, about: of each all stacks are kept
_COLUMNS = {
    "method": "concurrent learning",
    "diverged": "diverged",
    "error_median": "RMS of e, median",
    "error_best": "best",
    "error_worst": "worst",
    "parameter_error_median": "RMS of the theta error, median",
    "parameter_error_best": "best",
    "parameter_error_worst": "worst",
}


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run both sources with the same gains and noise and fill the run directory, `metrics.json` last."""
    settle = non_negative(COMMAND_LINE, "settle_time", cfg.settle_time)
    found, truth = loops(cfg), published().theta
    time = found["integral"].time
    late = time >= settle
    if not bool(late.any()):
        raise fail(COMMAND_LINE, "settle_time", "must be before the end", cfg.settle_time)
    states = {name: each.state.cpu() for name, each in found.items()}
    thetas = {name: each["theta"].cpu() for name, each in found.items()}
    errors = {name: x[..., :2] - reference(x)[0] for name, x in states.items()}
    rms = {
        "error": {name: _rms(error[:, late]) for name, error in errors.items()},
        "parameter_error": {name: _rms(theta[:, late] - truth) for name, theta in thetas.items()},
    }
    study = Study("icl", _COLUMNS, ("error_median", "parameter_error_median"), _log, digits=4)
    for name, each in found.items():
        measured = {"diverged": float(each.diverged.sum())}
        for what, of in rms.items():
            parts = {"median": of[name].median(), "best": of[name].min(), "worst": of[name].max()}
            measured |= {f"{what}_{key}": float(value) for key, value in parts.items()}
        study.add(f"{name}_", measured, method=name)
    for what, of in rms.items():
        ours, theirs = (of[name].nan_to_num(math.inf, math.inf) for name in ("integral", "derivative"))
        study.metrics[f"integral_better_{what}"] = float((ours < theirs).double().mean())
    shown = int(rms["parameter_error"]["integral"].nan_to_num(math.inf, math.inf).argmin())
    drawing = partial(
        draw_gain_sets,
        time=time.numpy(),
        parameters=thetas["integral"][shown].numpy(),
        truth=truth.numpy(),
        error={name: values.numpy() for name, values in rms["error"].items()},
        parameter_error={name: values.numpy() for name, values in rms["parameter_error"].items()},
        followed={name: error[shown].norm(dim=-1).numpy() for name, error in errors.items()},
    )
    return study.write(cfg, RunDirectory(directory), drawing)


def loops(cfg: DictConfig) -> dict[str, LoopResult]:
    """Run all gains with the equations of either source.

    Raises:
        ValueError: if a setting breaks its rule.
    """
    plant, gains = published(), _gains(cfg)
    device, dtype = placement(cfg.device, cfg.dtype)
    dt = positive_real(COMMAND_LINE, "dt", cfg.dt)
    duration = positive_real(COMMAND_LINE, "duration", cfg.duration)
    noise = real(COMMAND_LINE, "icl.noise", cfg.icl.noise)
    size = integer(COMMAND_LINE, "icl.size", cfg.icl.size, 1)
    start = [*vector(COMMAND_LINE, "initial_state", plain(cfg.initial_state), 2), 1.0, 0.0, 1.0]
    if non_negative(COMMAND_LINE, "settle_time", cfg.settle_time) > duration:
        raise fail(COMMAND_LINE, "settle_time", "must be before the end", cfg.settle_time)
    times = recorded_times(duration, dt, min(_RECORDED, duration / 20))
    cost = QuadraticCost(1.0, 1.0, 5, 2, output=lambda z: z[..., :2] - reference(z)[0])
    x0 = torch.tensor([start], dtype=dtype, device="cpu").repeat(len(gains["rate"]), 1).to(device)

    def tracked(source: str) -> Method:
        tracker = ConcurrentTracker(plant, reference, source=source, size=size, **gains)  # type: ignore[arg-type]
        return Method(Measured(tracker, noise=[noise, noise, 0.0, 0.0, 0.0], dim=5), plant, cost)

    methods = {name: tracked(source) for source, name in SOURCES.items()}
    return {name: each.run(x0, dt=dt, seed=seed_of(cfg), **times) for name, each in methods.items()}


run.held = lambda cfg: histories(loops(cfg))  # type: ignore[attr-defined]


def published() -> ParametricPlant:
    """x' = Y(x, t) theta + u of the paper, in the state (x1, x2, e^(-t/10), sin t, cos t)."""

    def regressor(z: Tensor, u: Tensor) -> Tensor:
        x1, x2, _, sine, _ = z.unbind(-1)
        none = torch.zeros_like(x1)
        first = torch.stack((x1.square(), x2.sin(), none, none), dim=-1)
        second = torch.stack((none, x2 * sine, x1, x1 * x2), dim=-1)
        return torch.stack((first, second, *(torch.zeros_like(first),) * 3), dim=-2)

    def known(z: Tensor, u: Tensor) -> Tensor:
        _, _, decay, sine, cosine = z.unbind(-1)
        return torch.cat((u, torch.stack((-0.1 * decay, cosine, -sine), dim=-1)), dim=-1)

    return ParametricPlant(regressor, known, dim=5, inputs=2, theta=_TRUE, rows=[0, 1])


def reference(z: Tensor) -> tuple[Tensor, Tensor]:
    """xd = 10 (1 - e^(-t/10)) (sin 2t, 0.4 cos 3t) and its rate: (..., 5) -> (..., 2), (..., 2).

    The published code has a factor of 30 in the rate where the derivative has 10.
    """
    _, _, decay, s, c = z.unbind(-1)
    sine, cosine = 2 * s * c, c * c - s * s  # of 2t
    sine3, cosine3 = 3 * s - 4 * s**3, 4 * c**3 - 3 * c
    wide = 10 * (1 - decay)
    wanted = torch.stack((wide * sine, 0.4 * wide * cosine3), dim=-1)
    first = decay * sine + 2 * wide * cosine
    second = 0.4 * (decay * cosine3 - 3 * wide * sine3)
    return wanted, torch.stack((first, second), dim=-1)


def _gains(cfg: DictConfig) -> dict[str, Tensor]:
    """Gains of every row, uniform in their ranges."""
    rows = integer(COMMAND_LINE, "trajectories", cfg.trajectories, least=1)
    generator = generator_of(cfg)
    drawn = torch.rand(rows, 4, generator=generator, dtype=torch.float64, device="cpu")
    found = {}
    for k, name in enumerate(("feedback", "gain", "rate", "length")):
        low, high = vector(COMMAND_LINE, f"icl.{name}", plain(cfg.icl[name]), 2)
        if not 0 < low <= high:
            rule = "must be two positive numbers, the smaller first"
            raise fail(COMMAND_LINE, f"icl.{name}", rule, [low, high])
        found[name] = low + (high - low) * drawn[:, k]
    return found


def _rms(values: Tensor) -> Tensor:
    """Root of the mean square of the norms: (B, T, k) -> (B,)."""
    return values.square().sum(-1).mean(1).sqrt()
