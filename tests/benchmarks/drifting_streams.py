"""Drifting streams: `python tests/benchmarks/drifting_streams.py [--kinds drifting paper noisy] [--batch B]`.

`StaFRegressor` beside ALD-KRLS (Engel et al.) on the same streams: a drifting function, the paper's V along
a trajectory, noisy samples. The error is prequential, root mean square: every sample is
predicted before it is learned. Each method takes the settings of its list that predict the first samples
best, and is scored on the rest. A time is the processor's, one thread, the median over the last steps of
predicting and learning, over streams: each method on as many side by side as its entry says.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from peer_krls import KRLS
from torch import Tensor

import staf_torch as st

STREAMS, STEPS, PREFIX, BURN = (
    32,
    360,
    140,
    40,
)  # streams of the errors; a stream's samples, those to tune on, and of them not scored
WARM, TIMED = 235, 30  # steps before the timed ones, which lie in the middle of the scored stretch


class Method(NamedTuple):
    """A method and the settings that it may choose from."""

    name: str
    make: Callable[..., Any]
    settings: list[dict[str, Any]]
    batch: int  # streams side by side when timed


class Stream(NamedTuple):
    """What every method sees: (S, T, n + 1), the last coordinate of x the time in samples, and (S, T)."""

    x: Tensor
    y: Tensor
    noise: float


def grid(**choices: list[Any]) -> list[dict[str, Any]]:
    """All combinations."""
    return [dict(zip(choices, row, strict=True)) for row in itertools.product(*choices.values())]


def path(streams: int, steps: int, draw: torch.Generator) -> Tensor:
    """Lissajous curves in the square [-1, 1]^2 with frequencies and phases of their own: (S, T, 2)."""
    time_ = torch.arange(steps, dtype=torch.float64)
    frequency = 0.006 + 0.004 * torch.rand(streams, 1, 2, generator=draw, dtype=torch.float64)
    phase = torch.rand(streams, 1, 2, generator=draw, dtype=torch.float64)
    return (2 * torch.pi * (frequency * time_[:, None] + phase)).sin()


def waves(x: Tensor, drift: float, draw: torch.Generator) -> Tensor:
    """Two plane waves of wavelength pi, their phases a random walk with that step: (S, T)."""
    streams, steps, _ = x.shape
    angle = 2 * torch.pi * torch.rand(streams, 2, generator=draw, dtype=torch.float64)
    direction = 2 * torch.stack((angle.cos(), angle.sin()), dim=1)  # (S, n, 2)
    start = 2 * torch.pi * torch.rand(streams, 1, 2, generator=draw, dtype=torch.float64)
    walk = torch.randn(streams, steps, 2, generator=draw, dtype=torch.float64).cumsum(1)
    return (x @ direction + start + drift * walk).sin().sum(-1)


def stream(kind: str, streams: int, steps: int = STEPS, seed: int = 0) -> Stream:
    """One of the three kinds: "drifting", "paper" or "noisy"."""
    draw = torch.Generator().manual_seed(seed)
    x = path(streams, steps, draw)
    if kind == "paper":
        y, noise = st.targets.Paper()(x), 1e-4
    else:
        drift, noise = (0.02, 0.05) if kind == "drifting" else (0.0, 0.3)
        y = waves(x, drift, draw) + noise * torch.randn(streams, steps, generator=draw, dtype=torch.float64)
    clock = torch.arange(steps, dtype=torch.float64).expand(streams, steps)
    return Stream(torch.cat((x, clock.unsqueeze(-1)), dim=-1), y, noise)


class StaF:
    """The regressor on x alone; it needs no clock."""

    def __init__(self, count: int, width: float, radius: float, noise: float, forgetting: float) -> None:
        kernel = st.GaussianKernel(width)
        self.model = st.StaFRegressor(kernel, radius * width, count, noise=noise, forgetting=forgetting)

    def predict(self, x: Tensor) -> Tensor:
        found: Tensor = self.model.predict(x[:, :2])
        return found

    def partial_fit(self, x: Tensor, y: Tensor) -> None:
        self.model.partial_fit(x[:, :2], y)


def methods(noise: float, batch: int) -> Iterator[Method]:
    """Every method with its settings."""
    for count in (3, 6, 15):
        choices = grid(
            count=[count],
            width=[0.6, 0.9, 1.4],
            radius=[0.3, 0.5],
            noise=[noise, 2 * noise],
            forgetting=[1.0, 0.999, 0.99],
        )
        yield Method(f"StaFRegressor, M = {count}", StaF, choices, batch)
    choices = grid(width=[0.4, 0.6, 0.9, 1.4], nu=[1e-1, 1e-2, 1e-3, 1e-4])
    yield Method("ALD-KRLS", KRLS, choices, 1000)


def errors(model: Any, data: Stream, steps: int) -> Tensor:
    """Prequential errors of the first ``steps`` samples: (S, steps - 1)."""
    found = []
    for k in range(steps):
        if k:
            found.append(model.predict(data.x[:, k]) - data.y[:, k])
        model.partial_fit(data.x[:, k], data.y[:, k])
    return torch.stack(found, dim=1)


def rms(found: Tensor) -> float:
    """Root mean square; inf where something is not finite."""
    value = float(found.square().mean().sqrt())
    return value if value == value else float("inf")


def timed(method: Method, settings: dict[str, Any], kind: str) -> tuple[float, float]:
    """Seconds a sample: predicting and learning, and learning alone."""
    data = stream(kind, method.batch, WARM + TIMED, seed=1)
    xs, ys = ([part.contiguous() for part in whole.unbind(1)] for whole in (data.x, data.y))
    model, both, learning = method.make(**settings), [], []
    for k, (x, y) in enumerate(zip(xs, ys, strict=True)):
        start = time.process_time()
        if k:
            model.predict(x)
        middle = time.process_time()
        model.partial_fit(x, y)
        end = time.process_time()
        if k >= WARM:
            both.append((end - start) / method.batch)
            learning.append((end - middle) / method.batch)
    return statistics.median(both), statistics.median(learning)


def case(method: Method, data: Stream, kind: str) -> dict[str, Any]:
    """The method tuned, scored and timed on one kind of stream."""
    tuned = [
        (rms(errors(method.make(**s), data, PREFIX)[:, BURN:]), i) for i, s in enumerate(method.settings)
    ]
    settings = method.settings[min(tuned)[1]]
    score = rms(errors(method.make(**settings), data, STEPS)[:, PREFIX:])
    both, learning = timed(method, settings, kind)
    about = {"stream": kind, "method": method.name, "settings": settings, "batch": method.batch}
    return about | {"error": score, "us": 1e6 * both, "us_learning": 1e6 * learning}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=10_000, help="streams side by side when timed")
    parser.add_argument("--kinds", nargs="*", default=["drifting", "paper", "noisy"])
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| stream | method | streams timed | error | us a sample | learning alone | settings |")
    print("|---|---|---:|---:|---:|---:|---|")
    for kind in options.kinds:
        data, rows = stream(kind, STREAMS), list[dict[str, Any]]()
        for method in methods(data.noise, options.batch):
            rows.append(found := case(method, data, kind))
            chosen = ", ".join(f"{key} {value:g}" for key, value in found["settings"].items())
            size = f"{found['batch']} | {found['error']:.3g}"
            times = f"{found['us']:.3g} | {found['us_learning']:.3g}"
            print(f"| {kind} | {found['method']} | {size} | {times} | {chosen} |", flush=True)
        *own, peer = rows
        for row in own:
            ratio, excess = peer["us"] / row["us"], row["error"] / peer["error"] - 1
            beside = f"{ratio:.0f} times the speed of {peer['method']}"
            print(f"{row['method']}, {kind}: {beside}, error {excess:+.1%}")


if __name__ == "__main__":
    main()
