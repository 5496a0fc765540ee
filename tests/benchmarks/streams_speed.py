"""Processor time of streams, one thread: `python tests/benchmarks/streams_speed.py`.

The filter on ten thousand streams, of which about a seventh (M = 6) and a quarter (M = 28) move their centers
at a step; one stream, a sample a call from Python, filter and bank; the filter of M = 6 as the row program
that `forecast` and devices run, all steps in one call, against which the hand-written C++ must defend itself.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import torch
from torch import Tensor

sys.path[:0] = [str(Path(__file__).parents[2])]

import staf_torch as st  # noqa: E402
from staf_torch import lanes  # noqa: E402

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
    spent: list[list[float]] = [[], []]
    for k, (x, y) in enumerate(samples):
        start = time.process_time()
        if k >= 20:
            model.predict(x)
            spent[0].append(time.process_time() - start)
            start = time.process_time()
        model.partial_fit(x, y)
        if k >= 20:
            spent[1].append(time.process_time() - start)
    predict, learn = (1e6 * sorted(part)[len(part) // 2] / streams for part in spent)
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
    spent = []
    for _ in range(5):
        begin = time.process_time()
        model.forecast(x, y)
        spent.append(time.process_time() - begin)
    each = 1e6 * sorted(spent)[2] / streams / steps
    return f"{each:.3f} us to predict and learn, {float(max(errors)):.1e} from the regressor"


def processes_as_row_program(streams: int, neighbours: int = 32) -> str:
    """The largest part of the bank, its 24 Gaussian processes of the nearest samples, a stream a lane."""
    rates = torch.tensor([0.5, 1.0, 2.0]).double().repeat(8)
    fades = torch.tensor([0.0, 0.01, 0.05, 0.1]).double().repeat_interleave(6)
    eye = 1e-3 * torch.eye(neighbours, dtype=torch.float64)

    def step(carry: tuple[()], _: tuple[()], row: tuple[Tensor, ...]) -> tuple[tuple[()], Tensor]:
        points, y, when = row
        square = (points.unsqueeze(2) - points.unsqueeze(1)).square().sum(-1)
        age = (when.unsqueeze(2) - when.unsqueeze(1)).abs()

        def process(_: tuple[()], rule: tuple[Tensor, Tensor]) -> tuple[tuple[()], Tensor]:
            kernel = (-rule[0] * square - rule[1] * age).exp()
            factor = torch.linalg.cholesky_ex(kernel[:, :-1, :-1] + eye).L
            sides = torch.stack((y, kernel[:, :-1, -1]), -1)
            beta, seen = torch.linalg.solve_triangular(factor, sides, upper=False).unbind(-1)
            return (), torch.stack(((beta * seen).sum(-1), seen.square().sum(-1), beta.square().sum(-1)), -1)

        return carry, lanes.scan(process, (), (rates, fades), dim=0)[1].transpose(0, 1)

    generator = torch.Generator().manual_seed(0)
    shapes = (neighbours + 1, 4), (neighbours,), (neighbours + 1,)
    row = tuple(torch.rand(streams, *shape, generator=generator).double() for shape in shapes)
    program, spent = lanes.Program(step), []
    if not program.compiles((), (), row, steps=1):
        return "is not compiled"
    for _ in range(30):
        begin = time.process_time()
        program((), (), row, steps=1)
        spent.append(time.process_time() - begin)
    return f"{1e6 * sorted(spent)[15] / streams:.0f} us a stream"


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
    for streams in (1, 8):
        print(
            f"its 24 processes alone as a row program, streams {streams}: {processes_as_row_program(streams)}"
        )
    print(f"M = 6 as a row program, float64: {as_row_program(2, 6)}")


if __name__ == "__main__":
    main()
