"""The speed of the gradient chase beside JAX, numba and torch.compile: `python tests/benchmarks/chase.py`.

Every program does the same work in the same run: states given, V at the centers, the Gram structure, ten
iterations, the weights of every time returned; exponential kernel, the paper's V, rings. The rounds of the
programs alternate, and a speed is the median of five. Peers that are not installed are skipped by name
(extra `bench` installs them). Prints the tables, and writes all numbers to runs/benchmarks/chase.json.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

import scaling  # noqa: E402

import staf_torch as st  # noqa: E402

ROUNDS = 5
INNER_STEPS = 10
RADIUS = 0.1
STEPS = {3: 1e6, 6: 1e6, 15: 5e5}  # centers: trajectory-steps a measurement
COMPILED_TIMES = 200  # torch.compile of one step pays its overhead a time: more would only take longer
OURS = {"staf_torch": "the library's V", "V in Python": "Python", "V compiled": "torch.compile"}
NAMED = ("JAX jit(vmap(scan))", "JAX components, unrolled")  # the two programs that issue 4 names
Program = tuple[Callable[[], Any], int]  # what to call, times


def states(batch: int, times: int, dtype: torch.dtype) -> torch.Tensor:
    """Circles of radii 0.5 to 1.5, (B, T, 2) contiguous."""
    angle = torch.linspace(0, 6, batch, dtype=torch.float64)
    radius = torch.linspace(0.5, 1.5, batch, dtype=torch.float64)
    x0 = torch.stack((radius * angle.cos(), radius * angle.sin()), dim=-1)
    return st.systems.simulate(st.systems.Oscillator(), x0, dt=0.01, steps=times - 1).to(dtype).contiguous()


def basis(count: int) -> st.StaFBasis:
    return st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(count), RADIUS))


def users_value(x: torch.Tensor) -> torch.Tensor:
    """The paper's V as a user writes it."""
    x1, x2 = x[..., 0], x[..., 1]
    return x1**2 + 5 * x2**2 + torch.tanh(x1 * x2)


def ours(x: torch.Tensor, count: int) -> dict[str, Program]:
    at, law = basis(count), st.optim.SteepestDescent()
    values = (st.targets.Paper(), users_value, torch.compile(users_value, dynamic=True))

    def run(value: Callable[[torch.Tensor], torch.Tensor]) -> np.ndarray:
        return st.chase_weights(x, at, value, law, inner_steps=INNER_STEPS).weights.numpy()

    return {name: (partial(run, value), x.shape[1]) for name, value in zip(OURS, values, strict=True)}


def jax_programs(x: torch.Tensor, count: int) -> dict[str, Program]:
    import jax
    import peer_jax

    offsets = RADIUS * st.rings(count).numpy()
    rows, last = jax.numpy.asarray(x.numpy()), jax.numpy.asarray(x.permute(1, 2, 0).contiguous().numpy())

    def call(program: Callable[[Any], Any], given: Any) -> Callable[[], Any]:
        return lambda: jax.block_until_ready(program(given))

    found = peer_jax.programs(offsets, INNER_STEPS)
    return {
        f"JAX {n}": (call(f, last if batch_last else rows), x.shape[1])
        for n, (f, batch_last) in found.items()
    }


def numba_programs(x: torch.Tensor, count: int) -> dict[str, Program]:
    import peer_numba

    d = (RADIUS * st.rings(count)).to(x.dtype).numpy()
    rows, last, core = x.numpy(), x.permute(1, 2, 0).contiguous().numpy(), np.exp(d @ d.T)
    return {
        "numba loops": (lambda: peer_numba.chase(rows, d, core, INNER_STEPS), x.shape[1]),
        "numba blocks": (lambda: peer_numba.chase_blocks(last, d, core, INNER_STEPS), x.shape[1]),
    }


def compiled_programs(x: torch.Tensor, count: int) -> dict[str, Program]:
    import peer_torch

    given = x[:, :COMPILED_TIMES].permute(1, 2, 0).contiguous()
    run = peer_torch.program((RADIUS * st.rings(count)).to(x), INNER_STEPS, x.shape[0])
    return {"torch.compile of a step": (lambda: run(given), len(given))}


def as_rows(result: Any) -> np.ndarray:
    """What a program returns, of components (T, B) each the first two times as rows."""
    if isinstance(result, list):  # components, (T, B) each
        return np.stack([np.asarray(part[:2]) for part in result]).transpose(2, 1, 0)
    return np.asarray(result)


def case(count: int, dtype: torch.dtype, batch: int) -> dict[str, Any]:
    """Millions of trajectory-steps a second of every program, and how far it is from ours."""
    times = max(2, int(STEPS[count] * (0.1 if batch == 1 else 1)) // batch)
    x = states(batch, times, dtype)
    programs = ours(x, count)
    for peers in (jax_programs, numba_programs, compiled_programs):
        try:
            programs |= peers(x, count)
        except ModuleNotFoundError as error:
            print(f"skipped: {peers.__name__.split('_')[0]} ({error})", file=sys.stderr)
    want = programs["staf_torch"][0]()[:, :2]
    apart, seconds = {}, {name: [] for name in programs}
    for name, (program, _) in programs.items():
        got = as_rows(program())
        got = got[:, :2] if got.shape[0] == batch and got.shape[2] == count else got[:2].transpose(2, 0, 1)
        apart[name] = float(np.abs(got - want).max() / np.abs(want).max())
    for _ in range(ROUNDS):
        for name, (program, _) in programs.items():
            start = time.perf_counter()
            program()
            seconds[name].append(time.perf_counter() - start)
    speed = {n: batch * programs[n][1] / statistics.median(each) / 1e6 for n, each in seconds.items()}
    return {"M": count, "dtype": str(dtype)[6:], "B": batch, "T": times, "speed": speed, "apart": apart}


def row(found: dict[str, Any]) -> str:
    speed, own = found["speed"], found["speed"]["staf_torch"]
    jax = [name for name in speed if name.startswith("JAX")]
    best, named = max(jax, key=speed.__getitem__, default=""), [speed[n] for n in NAMED if n in speed]
    cells = [str(found["M"]), found["dtype"], str(found["B"]), *(f"{speed[name]:.2f}" for name in OURS)]
    cells += [f"{speed[best]:.2f}", best[4:], f"{own / speed[best]:.1f}"] if jax else ["-"] * 3
    cells += [f"{max(named):.2f}", f"{own / max(named):.1f}"] if named else ["-"] * 2
    others = ("numba loops", "numba blocks", "torch.compile of a step")
    return "| " + " | ".join(cells + [f"{speed[n]:.2f}" if n in speed else "-" for n in others]) + " |"


def machine() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    name = names[0] if names else platform.processor()
    return f"{name}, {os.cpu_count()} cores, torch {torch.__version__}, {platform.platform()}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, default=ROOT / "runs" / "benchmarks" / "chase.json")
    parser.add_argument("--centers", type=int, nargs="*", default=[3, 6, 15])
    parser.add_argument("--dtype", nargs="*", default=["float64", "float32"])
    parser.add_argument("--batch", type=int, nargs="*", default=[1, 64, 1000, 100_000])
    parser.add_argument("--no-scaling", action="store_true", help="leave out memory and linearity")
    options = parser.parse_args()
    print(f"{machine()}\nMillions of trajectory-steps a second, {INNER_STEPS} iterations each.")
    print(
        "staf_torch with V of the library | in Python | by torch.compile; the best JAX that we could write;"
    )
    print("the better of jit(vmap(scan)) and components with the inner loop unrolled; the other peers\n")
    print("| M | dtype | B | staf_torch | V in Python | V compiled | best JAX | which | ratio "
          "| named JAX | ratio | numba loops | numba blocks | torch.compile |")  # fmt: skip
    print("|" + "---|" * 14)
    cases = []
    for count in options.centers:
        for dtype in options.dtype:
            torch._dynamo.reset()
            for batch in options.batch:
                cases.append(case(count, getattr(torch, dtype), batch))
                print(row(cases[-1]), flush=True)
    results: dict[str, Any] = {"machine": machine(), "cases": cases}
    if not options.no_scaling:
        results |= scaling.report()
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(results, indent=1))
    print(f"\nwritten to {options.json}")


if __name__ == "__main__":
    main()
