"""Processor time of streams, one thread: `python tests/benchmarks/streams_speed.py`.

The filter on ten thousand streams, of which about a seventh (M = 6) and a quarter (M = 28) move their centers
at a step; one stream, a sample a call from Python, filter and bank; the filter of M = 6 as the row program
that `forecast` and devices run, all steps in one call, against which the hand-written C++ must defend itself.
"""

from __future__ import annotations

import statistics
import time

import torch
from timing import spent
from torch import Tensor

import staf_torch as st

NOISE, FORGETTING = 0.05, 0.999


def path(streams: int, dim: int, steps: int, dtype: torch.dtype) -> list[tuple[Tensor, Tensor]]:
    phase = 6.28 * torch.rand(streams, dim, generator=torch.Generator().manual_seed(0))
    rates = torch.linspace(1, 1.7, dim)
    found = [(0.05 * k * rates + phase).sin().to(dtype) for k in range(steps)]
    return [(x, x.sum(-1)) for x in found]


def regressor(dim: int, count: int) -> st.StaFRegressor:
    return st.StaFRegressor(st.GaussianKernel(0.9 * dim**0.5), 0.4, count, noise=NOISE, forgetting=FORGETTING)


def many(dim: int, count: int, dtype: torch.dtype, streams: int = 10_000, steps: int = 20) -> str:
    model, samples = regressor(dim, count), path(streams, dim, steps + 20, dtype)
    times: list[tuple[float, float]] = []
    for x, y in samples:
        predicted = spent(lambda x=x: model.predict(x))[0] if len(times) >= 20 else 0.0
        times.append((predicted, spent(lambda x=x, y=y: model.partial_fit(x, y))[0]))
    predict, learn = (1e6 * statistics.median_high(part) / streams for part in zip(*times[20:], strict=True))
    name = str(dtype).removeprefix("torch.")
    return (
        f"{streams} streams, n = {dim}, M = {count}, {name}: predict {predict:.3f} us, learn {learn:.3f} us"
    )


def single(model: st.StaFRegressor | st.MixtureRegressor, dim: int, calls: int = 2000) -> str:
    samples = [(x[0].contiguous(), y[0]) for x, y in path(1, dim, calls + 1100, torch.float64)]
    for x, y in samples[:1100]:
        model.partial_fit(x, y)
    start = time.process_time()
    for x, y in samples[1100:]:
        model.predict(x)
        model.partial_fit(x, y)
    return f"{1e6 * (time.process_time() - start) / calls:.1f} us to predict and learn"


def as_row_program(dim: int, count: int, streams: int = 10_000, steps: int = 20) -> str:
    """`forecast`: the filter's definition as a row program, every sample expected and learned."""
    samples, model, errors = path(streams, dim, steps, torch.float64), regressor(dim, count), []
    x, y = (torch.stack([pair[k] for pair in samples]) for k in range(2))
    found = model.forecast(x, y).mean
    for k, (point, value) in enumerate(samples):
        if k:
            errors.append((model.predict(point) - found[k]).abs().max())
        model.partial_fit(point, value)
    each = 1e6 * statistics.median(spent(lambda: model.forecast(x, y))[0] for _ in range(5)) / streams / steps
    return f"{each:.3f} us to predict and learn, {float(max(errors)):.1e} from the regressor"


def main() -> None:
    torch.set_num_threads(1)
    for dtype in (torch.float32, torch.float64):
        print(many(2, 6, dtype))
    print(many(6, 28, torch.float32))
    print(f"one stream, n = 2, M = 6: {single(regressor(2, 6), 2)}")
    print(f"one stream, n = 6, M = 28: {single(regressor(6, 28), 6)}")
    for neighbours in (32, 56):
        model = st.MixtureRegressor(1000, neighbours)
        print(f"one stream, bank of {neighbours} neighbours, n = 4: {single(model, 4)}")
    print(f"M = 6 as a row program, float64: {as_row_program(2, 6)}")


if __name__ == "__main__":
    main()
