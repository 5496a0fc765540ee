"""How the time of a chase grows with B and T, and that its memory does not grow with T."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

import staf_torch as st  # noqa: E402

BATCH, TIMES = 100_000, (200, 1000, 2000)
SIZES = ((1000, 250), (1000, 1000), (1000, 4000), (10_000, 100), (10_000, 400), (100_000, 10), (100_000, 40))
ROUNDS = 5


def report() -> dict[str, Any]:
    """Both, printed and as numbers."""
    print("\nnanoseconds a trajectory-step, M = 3, float64, all weights kept:")
    linear = [nanoseconds(batch, times) for batch, times in SIZES]
    for found in linear:
        print(f"B = {found['B']:6d}, T = {found['T']:4d}: {found['ns']:5.1f}")
    print(f"\nB = {BATCH}, states simulated in pieces, no history:")
    memory = [_apart(times) for times in TIMES]
    for found in memory:
        print(f"T = {found['T']:4.0f}: {found['MiB']:4.0f} MiB more, {found['seconds']:.1f} s")
    return {"linear": linear, "memory": memory}


def nanoseconds(batch: int, times: int) -> dict[str, float]:
    import chase

    x, at = chase.states(batch, times, torch.float64), chase.basis(3)
    law, target, seconds = st.optim.SteepestDescent(), st.targets.Paper(), []
    for _ in range(ROUNDS + 1):
        start = time.perf_counter()
        st.chase_weights(x, at, target, law)
        seconds.append(time.perf_counter() - start)
    return {"B": batch, "T": times, "ns": 1e9 * statistics.median(seconds[1:]) / (batch * times)}


def _apart(times: int) -> dict[str, float]:
    """`memory` in a process of its own."""
    done = subprocess.run([sys.executable, __file__, str(times)], capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def memory(times: int) -> dict[str, float]:
    """Growth of the peak memory (MiB) and the time (s) of a long chase in pieces without history."""
    import resource

    import chase

    def peak() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    law, target, basis = st.optim.SteepestDescent(), st.targets.Paper(), chase.basis(3)
    x0 = chase.states(BATCH, 2, torch.float64)[:, 0]
    st.chase_weights(x0[:8, None].clone(), basis, target, law)  # loads what a chase loads
    before, start = peak(), time.perf_counter()
    pieces = st.systems.trajectory(st.systems.Oscillator(), x0, dt=0.01, steps=times - 1, chunk=8)
    st.chase_weights(pieces, basis, target, law, history=False)
    return {"T": times, "MiB": peak() - before, "seconds": time.perf_counter() - start}


if __name__ == "__main__":
    print(json.dumps(memory(int(sys.argv[1]))))
