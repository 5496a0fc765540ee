"""Directories of runs and sweeps as the launchers leave them, without running anything."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from staf_torch import __version__

BAD_COUNT = "`rings(count=...)` must be one of 3, 6, 10, 15, 21, 28; got 7."
SETTINGS = {
    "task": "gradient_chase",
    "kernel": "exponential",
    "centers": "rings",
    "centers.radius": 0.1,
    "centers.count": 3,
    "optimizer": "steepest_descent",
    "optimizer.inner_steps": 10,
    "predictor": "none",
    "dt": 0.01,
    "seed": 0,
    "initial_state": [1.0, 0.0],
}


def write_run(
    directory: Path,
    overrides: Mapping[str, Any],
    metrics: Mapping[str, float | None] | None,
    *,
    status: str = "completed",
    reason: str | None = None,
    version: str = __version__,
) -> Path:
    """A run directory; without metrics there is no file of them."""
    directory.mkdir(parents=True)
    record = {
        "version": version,
        "task": "gradient_chase",
        "status": status,
        "reason": reason,
        "overrides": typed(overrides),
        "settings": SETTINGS | dict(overrides),
        "seconds": 0.5,
    }
    (directory / "run.json").write_text(json.dumps(record))
    if metrics is not None:
        (directory / "metrics.json").write_text(json.dumps(metrics))
    return directory


def typed(overrides: Mapping[str, Any]) -> list[str]:
    """As on a command line."""
    return [
        f"{key}={value if isinstance(value, str) else json.dumps(value)}" for key, value in overrides.items()
    ]


def error(radius: float, count: int, seed: int) -> float:
    """A made-up error of the right order, another one for each seed."""
    order = {3: 2, 6: 3, 10: 4, 15: 5}[count]
    return (5.0 + 0.12 * seed) * radius**order


def write_sweep(
    sweep: Path,
    kernels: Sequence[str] = ("exponential", "gaussian"),
    radii: Sequence[float] = (0.05, 0.1),
    counts: Sequence[int] = (3, 6, 7),
    seeds: Sequence[int] = (0, 1, 2),
) -> Path:
    """A sweep in which a layout of seven rings fails."""
    grid = [(k, r, c, s) for k in kernels for r in radii for c in counts for s in seeds]
    for num, (kernel, radius, count, seed) in enumerate(grid):
        overrides = {"kernel": kernel, "centers.radius": radius, "centers.count": count, "seed": seed}
        if count == 7:
            write_run(sweep / str(num), overrides, None, status="failed", reason=BAD_COUNT)
            continue
        found = error(radius, count, seed)
        metrics = {
            "ball_error": found,
            "ball_floor_error": found / 2,
            "gradient_error": found / radius,
            "settling_time": None,
            "rounding_floor": 1.1e-15,
        }
        write_run(sweep / str(num), overrides, metrics)
    return sweep
