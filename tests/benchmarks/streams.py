"""Public streams, peers tuned: `tests/benchmarks/streams.py [--earlier|--held-out|--latest] [--cache FILE]`.

One protocol: inputs and target standardised by the first fifth for the peers; every setting of a peer's grid
runs over the first fifth, the one with the smallest error on its last two thirds then runs over the whole
stream, predicting each sample before it learns it, and is scored on the other four fifths (root mean square).
`MixtureRegressor(1000)` has one default for all, and raw units. Before the table kafbox's Lorenz is
reproduced (embedding 6, ALD-KRLS, -40.17 dB after 1000 samples). `--cache` keeps the peers' results, which
take a quarter of an hour. `--earlier`, `--held-out` and `--latest` take the streams of streams_held_out.py,
`--sets` some by name; `--filter` tunes the filter alone, as peers are. Peers that are not installed are named
and skipped: `pip install -e '.[bench]'`.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import peer_kernel_filters as kernels
import peer_local_models as local
import torch
from streams_data import SETS, Series, lorenz
from streams_held_out import EARLIER, HELD_OUT, LATEST

import staf_torch as st

try:
    from peer_river import River
except ImportError as missing:
    print(f"river skipped: {missing}", file=sys.stderr)
    River = None  # type: ignore[assignment,misc]

WORST = 1e300
Grid = list[dict[str, Any]]


def grid(**choices: list[Any]) -> Grid:
    """All combinations."""
    return [dict(zip(choices, row, strict=True)) for row in itertools.product(*choices.values())]


def methods(dim: int) -> dict[str, tuple[Callable[..., Any], Grid]]:
    """The peers and their settings for inputs of this dimension, widths in units of its root."""
    unit = dim**0.5
    widths = [w * unit for w in (0.25, 0.5, 1, 2, 4, 8)]
    found: dict[str, tuple[Callable[..., Any], Grid]] = {
        "ALD-KRLS": (kernels.Krls, grid(width=widths, nu=[1e-1, 1e-2, 1e-3, 1e-4, 1e-6])),
        "KRLS-T": (
            kernels.KrlsTracker,
            grid(width=widths[1:], noise=[1e-6, 1e-4, 1e-2, 1e-1], forgetting=[1.0, 0.999, 0.99]),
        ),
        "QKLMS": (
            kernels.Qklms,
            grid(width=widths[:5], rate=[0.1, 0.3, 0.6, 0.9], quantum=[0.05 * unit, 0.2 * unit]),
        ),
        "RFF-RLS": (
            kernels.RandomFeatures,
            grid(width=widths[1:], ridge=[1e-8, 1e-4, 1e-2], forgetting=[1.0, 0.999, 0.99]),
        ),
        "GP window": (local.WindowedGP, grid(window=[32, 100], width=widths[1:], noise=[1e-6, 1e-3, 1e-1])),
        "local linear": (local.LocalLinear, grid(count=[2, 4, 8, 16, 50], ridge=[1e-6, 1e-3, 1e-1])),
        "persistence": (local.Persistence, [{}]),
    }
    if River is not None:
        kinds = ["linear", "passive-aggressive", "bayesian", "neighbours", "hoeffding tree"]
        found["river"] = (River, grid(kind=kinds))
    return found


def errors(model: Any, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Prequential errors of a peer: (T,)."""
    found = np.empty(len(y))
    for k, (point, value) in enumerate(zip(x, y, strict=True)):
        found[k] = model.predict(point) - value
        model.learn(point, float(value))
    return found


def rms(error: np.ndarray) -> float:
    value = float(np.sqrt(np.mean(np.square(error))))
    return value if np.isfinite(value) else WORST


def tuned(make: Callable[..., Any], settings: Grid, x: np.ndarray, y: np.ndarray) -> tuple[float, Any]:
    """Error of a peer on one output (T,), and the setting it took."""
    first = len(y) // 5
    scale = np.where(x[:first].std(0) > 0, x[:first].std(0), 1.0)
    u, unit = (x - x[:first].mean(0)) / scale, float(y[:first].std())
    v = (y - y[:first].mean()) / unit

    def early(setting: dict[str, Any]) -> float:
        try:
            return rms(errors(make(**setting), u[:first], v[:first])[first // 3 :])
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            return WORST  # a matrix without a factor: the setting does not serve

    chosen = min(settings, key=early)
    return rms(errors(make(**chosen), u, v)[first:]) * unit, chosen


def own(series: Series, filters: bool) -> dict[str, list[float]]:
    """Our error, rms of error / standard deviation, coverage of the 90 % band, an output each."""
    model = st.StaFRegressor() if filters else st.MixtureRegressor(1000, 56)
    mean, std = np.zeros_like(series.y), np.ones_like(series.y)
    x, y = torch.as_tensor(series.x), torch.as_tensor(series.y)
    if isinstance(model, st.StaFRegressor):
        model.tune(x[: len(x) // 5], y[: len(x) // 5])
    for k in range(len(x)):
        if k:
            found, deviation = model.predict(x[k], return_std=True)
            mean[k], std[k] = found.numpy(), deviation.numpy()
        model.partial_fit(x[k], y[k])
    late = slice(len(x) // 5, None)
    error = (mean - series.y)[late]
    z = error / std[late]
    return {
        "error": [rms(e) for e in error.T],
        "z": [rms(e) for e in z.T],
        "covered": [float((np.abs(e) < 1.645).mean()) for e in z.T],
    }


def kafbox_lorenz(count: int = 10_000) -> float:
    """Mean square error in dB after 1000 samples, as kafbox's demonstration prints it: -40.17."""
    values = lorenz(count + 1)
    x = np.stack([np.concatenate((np.zeros(i), values[: count - i])) for i in range(6)], 1)
    found = errors(kernels.Krls(width=32.0, nu=1e-4), x, values[1:])
    return float(10 * np.log10(np.mean(np.square(found[1000:]))))


def rows(names: list[str], cache: Path | None, filters: bool) -> list[dict[str, Any]]:
    """A row an output of every set: the peers' errors and our own."""
    kept = json.loads(cache.read_text()) if cache and cache.exists() else {}
    found = []
    for name in names:
        try:
            series = (SETS | EARLIER | HELD_OUT | LATEST)[name]()
        except ImportError as missing:
            print(f"{name} skipped: {missing}", file=sys.stderr)
            continue
        ours = own(series, filters)
        for k in range(series.y.shape[1]):
            label = f"{name} {k + 1}" if series.y.shape[1] > 1 else name
            peers = {}
            for peer, (make, settings) in methods(series.x.shape[1]).items():
                key = f"{label}|{peer}"
                if key not in kept:
                    kept[key] = tuned(make, settings, series.x, series.y[:, k])
                    if cache:
                        cache.write_text(json.dumps(kept))
                peers[peer] = kept[key][0]
            found.append({"set": label, "peers": peers} | {key: value[k] for key, value in ours.items()})
            print(line(found[-1]), flush=True)
    return found


def line(row: dict[str, Any]) -> str:
    """A row of the table: the error, the best peer's, their ratio, those to the kernel filters."""
    best = min(row["peers"], key=row["peers"].get)
    cells = [row["set"], f"{row['error']:.3g}", f"{row['peers'][best]:.3g} ({best})"]
    cells += [f"{row['error'] / row['peers'][name]:.2f}" for name in (best, *COMPARED)]
    return "| " + " | ".join([*cells, f"{row['z']:.2f}", f"{row['covered']:.2f}"]) + " |"


COMPARED = ("ALD-KRLS", "KRLS-T", "RFF-RLS", "GP window", "local linear")


def summary(found: list[dict[str, Any]]) -> str:
    """Wins against each peer, and the ratio to the best of all."""
    ratio = np.array([row["error"] / min(row["peers"].values()) for row in found])
    rest = np.sort(ratio)[1:]
    text = [
        f"ratio to the best peer of each set: geometric mean {np.exp(np.log(ratio).mean()):.3f}, without the "
        f"smallest {np.exp(np.log(rest).mean()):.3f}, largest {ratio.max():.2f}, best on "
        f"{(ratio < 1).sum()}, within 5 % or better on {(ratio <= 1.05).sum()} of {len(ratio)}"
    ]
    for peer in found[0]["peers"]:
        each = np.array([row["error"] / row["peers"][peer] for row in found])
        geometric = np.exp(np.log(np.maximum(each, 1e-300)).mean())
        text.append(f"against {peer}: {(each < 1).sum()} of {len(each)}, geometric ratio {geometric:.2f}")
    return "\n".join(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cache", type=Path, help="where the peers' results are kept, JSON")
    parser.add_argument("--sets", nargs="*")
    for name, which, told in (
        ("--earlier", EARLIER, "the streams that were held out before"),
        ("--held-out", HELD_OUT, "the streams that nothing was chosen on when they were run"),
        ("--latest", LATEST, "more such, that were fixed later"),
    ):
        parser.add_argument(name, action="store_const", dest="which", const=which, default=SETS, help=told)
    parser.add_argument("--filter", action="store_true", help="tuned on the first fifth, not the bank")
    parser.add_argument("--no-kafbox", action="store_true", help="do not reproduce kafbox's Lorenz first")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    np.seterr(all="ignore")
    if not options.no_kafbox:
        print(f"kafbox's Lorenz, ALD-KRLS: {kafbox_lorenz():.2f} dB (printed by kafbox: -40.17 dB)\n")
    print("| set | ours | best peer | ratio | " + " | ".join(COMPARED) + " | z rms | 90 % band |")
    print("|---|---:|---:|---:|" + "---:|" * (len(COMPARED) + 2), flush=True)
    names = options.sets or list(options.which)
    print("\n" + summary(rows(names, options.cache, options.filter)))


if __name__ == "__main__":
    main()
