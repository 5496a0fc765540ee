"""The speed of the gradient chase beside JAX and numba: `python tests/benchmarks/chase.py [--json FILE]`.

Every program does the same work in the same run: states given, V at the centers, the Gram structure, ten
iterations, the weights of every time returned; exponential kernel, the paper's V, rings. The rounds of
the programs alternate, and a speed is the median of five. Peers that are not installed are skipped by name.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

import staf_torch as st  # noqa: E402

ROUNDS = 5
INNER_STEPS = 10
RADIUS = 0.1
STEPS = {3: 2e6, 6: 1e6, 15: 2e5}  # centers: trajectory-steps a measurement
MEMORY_BATCH, MEMORY_TIMES = 100_000, (200, 2000)


def states(batch: int, times: int, dtype: torch.dtype) -> torch.Tensor:
    """Circles of radii 0.5 to 1.5, (B, T, 2) contiguous."""
    angle = torch.linspace(0, 6, batch, dtype=torch.float64)
    radius = torch.linspace(0.5, 1.5, batch, dtype=torch.float64)
    x0 = torch.stack((radius * angle.cos(), radius * angle.sin()), dim=-1)
    return st.systems.simulate(st.systems.Oscillator(), x0, dt=0.01, steps=times - 1).to(dtype).contiguous()


def basis(count: int) -> st.StaFBasis:
    return st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(count), RADIUS))


def ours(x: torch.Tensor, count: int) -> Callable[[], np.ndarray]:
    at, target, law = basis(count), st.targets.Paper(), st.optim.SteepestDescent()
    return lambda: st.chase_weights(x, at, target, law, inner_steps=INNER_STEPS).weights.numpy()


def jax_programs(x: torch.Tensor, count: int) -> dict[str, Callable[[], Any]]:
    import jax
    import peer_jax

    offsets = RADIUS * st.rings(count).numpy()
    rows, last = jax.numpy.asarray(x.numpy()), jax.numpy.asarray(x.permute(1, 2, 0).contiguous().numpy())

    def call(program: Callable[[Any], Any], given: Any) -> Callable[[], Any]:
        return lambda: jax.block_until_ready(program(given))

    found = peer_jax.programs(offsets, INNER_STEPS)
    return {f"JAX {name}": call(f, last if batch_last else rows) for name, (f, batch_last) in found.items()}


def numba_programs(x: torch.Tensor, count: int) -> dict[str, Callable[[], Any]]:
    import peer_numba

    d = (RADIUS * st.rings(count)).to(x.dtype).numpy()
    given, core = x.numpy(), np.exp(d @ d.T)
    return {"numba scalar loops": lambda: peer_numba.chase(given, d, core, INNER_STEPS)}


def as_rows(result: Any) -> np.ndarray:
    """Whatever layout a program returns, as (B, T, M)."""
    if isinstance(result, list):  # components, (T, B) each
        return np.stack([np.asarray(part) for part in result]).transpose(2, 1, 0)
    return np.asarray(result)


def case(count: int, dtype: torch.dtype, batch: int) -> dict[str, Any]:
    """Millions of trajectory-steps a second of every program, and how far it is from ours."""
    times = max(2, int(STEPS[count] * (0.1 if batch == 1 else 1)) // batch)
    x = states(batch, times, dtype)
    programs = {"staf_torch": ours(x, count)}
    for peers in (jax_programs, numba_programs):
        try:
            programs |= peers(x, count)
        except ModuleNotFoundError as error:
            print(f"skipped: {peers.__name__.split('_')[0]} ({error})", file=sys.stderr)
    want = programs["staf_torch"]()
    apart, seconds = {}, {name: [] for name in programs}
    for name, program in programs.items():
        got = as_rows(program())
        got = got if got.shape == want.shape else got.transpose(2, 0, 1)
        apart[name] = float(np.abs(got[:, :2] - want[:, :2]).max() / np.abs(want).max())
    for _ in range(ROUNDS):
        for name, program in programs.items():
            start = time.perf_counter()
            program()
            seconds[name].append(time.perf_counter() - start)
    speed = {name: batch * times / statistics.median(each) / 1e6 for name, each in seconds.items()}
    return {"M": count, "dtype": str(dtype)[6:], "B": batch, "T": times, "speed": speed, "apart": apart}


def row(found: dict[str, Any]) -> str:
    speed = found["speed"]
    best = max((name for name in speed if name.startswith("JAX")), key=speed.__getitem__, default=None)
    loops = speed.get("numba scalar loops")
    cells = [str(found["M"]), found["dtype"], str(found["B"]), f"{speed['staf_torch']:.2f}"]
    cells += (
        [f"{speed[best]:.2f}", best[4:], f"{speed['staf_torch'] / speed[best]:.1f}"] if best else ["-"] * 3
    )
    cells += [f"{loops:.2f}", f"{speed['staf_torch'] / loops:.1f}"] if loops else ["-"] * 2
    return "| " + " | ".join(cells) + " |"


def memory(times: int) -> dict[str, float]:
    """Growth of the peak memory (MiB) and the time (s) of a long chase in pieces without history."""
    done = subprocess.run(
        [sys.executable, __file__, "--memory-of", str(times)], capture_output=True, text=True, check=True
    )
    found: dict[str, float] = json.loads(done.stdout)
    return found


def memory_of(times: int) -> dict[str, float]:
    import resource

    def peak() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    law, target = st.optim.SteepestDescent(), st.targets.Paper()
    x0 = states(MEMORY_BATCH, 2, torch.float64)[:, 0]
    st.chase_weights(x0[:8, None].clone(), basis(3), target, law)  # loads what a chase loads
    before, start = peak(), time.perf_counter()
    pieces = st.systems.trajectory(st.systems.Oscillator(), x0, dt=0.01, steps=times - 1, chunk=4)
    st.chase_weights(pieces, basis(3), target, law, history=False)
    return {"T": times, "MiB": peak() - before, "seconds": time.perf_counter() - start}


def machine() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    name = names[0] if names else platform.processor()
    return f"{name}, {os.cpu_count()} cores, torch {torch.__version__}, {platform.platform()}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the results here as well")
    parser.add_argument("--centers", type=int, nargs="*", default=[3, 6, 15])
    parser.add_argument("--batch", type=int, nargs="*", default=[1, 64, 1000, 100_000])
    parser.add_argument("--no-memory", action="store_true")
    parser.add_argument("--memory-of", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory_of:
        print(json.dumps(memory_of(options.memory_of)))
        return
    print(f"{machine()}\nMillions of trajectory-steps a second, {INNER_STEPS} iterations each\n")
    print("| M | dtype | B | staf_torch | best JAX | which | ratio | numba | ratio |")
    print("|---|---|---|---|---|---|---|---|---|")
    cases = []
    for count in options.centers:
        for dtype in (torch.float64, torch.float32):
            for batch in options.batch:
                cases.append(case(count, dtype, batch))
                print(row(cases[-1]), flush=True)
    results: dict[str, Any] = {"machine": machine(), "cases": cases}
    if not options.no_memory:
        results["memory"] = [memory(times) for times in MEMORY_TIMES]
        for found in results["memory"]:
            print(
                f"\nB = {MEMORY_BATCH}, T = {found['T']:.0f}, no history: "
                f"{found['MiB']:.0f} MiB, {found['seconds']:.1f} s"
            )
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
