"""Long lives of streams: `python tests/benchmarks/streams_life.py [--samples N] [--streams S] [--steps T]`.

S streams (ten thousand) side by side, of which at every tenth step one in a hundred each gets NaN, infinity
and 1e300, one in a hundred begins anew, and one in a hundred is dropped while as many begin: streams that
nothing happened to must have the bits of streams that were never beside them. Then a filter and a bank learn
N samples (a million; a tenth of that) of one stream that drifts: the error of every tenth of it. In both the
memory of the process must not grow.
"""

from __future__ import annotations

import argparse
import math
import resource
import sys
from pathlib import Path

import torch
from torch import Tensor

sys.path[:0] = [str(Path(__file__).parents[2])]

import staf_torch as st  # noqa: E402


def samples(start: int, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """A path in the plane and a function of it that drifts, noise of .05: (T, 2), (T,)."""
    draw = torch.Generator().manual_seed(seed)
    time = torch.arange(start, start + count, dtype=torch.float64)
    x = torch.stack(((0.05 * time).sin(), (0.0713 * time).cos()), -1)
    y = (2 * x[:, 0] + 1e-4 * time).sin() + x[:, 1].square()
    return x, y + 0.05 * torch.randn(count, generator=draw, dtype=torch.float64)


def memory() -> float:
    """Most memory that the process has used, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def long_life(model: st.StaFRegressor, count: int) -> tuple[list[float], float]:
    """Root mean square errors of every tenth, and growth of memory in MB after the first."""
    errors, part, begun = [], count // 10, 0.0
    for tenth in range(10):
        x, y = samples(tenth * part, part, tenth)
        sum_ = 0.0
        for k, (state, value) in enumerate(zip(x, y, strict=True)):
            if tenth or k:
                sum_ += float(model.predict(state) - value) ** 2
            model.partial_fit(state, value)
        errors.append(math.sqrt(sum_ / part))
        begun = begun or memory()
    return errors, memory() - begun


def crowd(streams: int, steps: int) -> tuple[bool, float, int]:
    """Whether untouched streams have the bits of streams alone, growth of memory in MB, streams that died."""
    draw = torch.Generator().manual_seed(0)
    model, alone = st.StaFRegressor(radius=0.4, noise=0.05), st.StaFRegressor(radius=0.4, noise=0.05)
    phase = 6.28 * torch.rand(streams, 2, generator=draw, dtype=torch.float64)
    calm, share, begun = streams // 2, streams // 100, 0.0  # the first half is left in peace
    some = slice(0, calm, max(calm // 50, 1))
    for k in range(steps):
        x = (0.05 * k * torch.tensor([1.0, 1.3], dtype=torch.float64) + phase).sin()
        y = (2 * x).sin().sum(-1)
        alone.partial_fit(x[some].contiguous(), y[some].contiguous())
        if k % 10 == 3:
            hurt = calm + torch.randperm(streams - calm, generator=draw)[: 3 * share]
            x[hurt[:share], 0], y[hurt[share : 2 * share]], y[hurt[2 * share :]] = math.nan, math.inf, 1e300
        model.partial_fit(x, y)
        if k % 10 == 7:
            gone = calm + torch.randperm(streams - calm, generator=draw)[: 2 * share]
            model.reset(streams=gone[:share])
            model.drop(gone[share:]).add(share)
        begun = begun or (memory() if k == 20 else 0.0)
    found = model.predict(x)
    same = torch.equal(found[some], alone.predict(x[some].contiguous()))
    return same, memory() - begun, int((~torch.isfinite(found)).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--streams", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--bank", type=int, default=100_000, help="samples of the bank's stream")
    options = parser.parse_args()
    torch.set_num_threads(1)
    same, grown, broken = crowd(options.streams, options.steps)
    print(
        f"{options.streams} streams: neighbours bit-equal {same}, memory +{grown:.1f} MB, not finite {broken}"
    )
    models = {
        "filter": (st.StaFRegressor(radius=0.4, noise=0.05, forgetting=0.99), options.samples),
        "bank": (st.StaFRegressor(memory=500, neighbours=16), options.bank),
    }
    for name, (model, count) in models.items():
        errors, grown = long_life(model, count)
        told = " ".join(f"{error:.4f}" for error in errors)
        print(f"{name}, {count} samples: memory +{grown:.1f} MB, errors by tenths {told}", flush=True)


if __name__ == "__main__":
    main()
