"""What JAX does in the time, on the device of `tests/gpu.py`: steepest descent of three centers."""

from __future__ import annotations

import concurrent.futures
import statistics
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch

import staf_torch as st
from tests import gpu_cases as cases

NAME, LAW, COUNT, TIMES, ITERATIONS = "M = 3 SteepestDescent, 100", "SteepestDescent", 3, 100, 10


class Peer(NamedTuple):
    """A program of JAX."""

    kind: str
    dtype: torch.dtype
    rows: int


def built(pool: concurrent.futures.Executor) -> dict[Peer, Any]:
    """Programs of JAX that are being compiled; none where it is not installed."""
    sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
    try:
        import jax  # noqa: F401
    except ImportError as told:
        print(f"no JAX: {told}")
        return {}
    peers = (
        Peer(kind, dtype, rows)
        for dtype in (torch.float64, torch.float32)
        for rows in (100_000, 1_000_000)
        for kind in ("components apart", "batch last")
    )
    return {each: pool.submit(_compiled, each) for each in peers}


def _compiled(peer: Peer) -> Any:
    import jax
    import peer_laws

    offsets = (st.rings(COUNT) * cases.RADIUS[COUNT]).double().numpy()
    if peer.kind == "components apart":
        program = peer_laws.jax_apart(offsets, ITERATIONS)
    else:
        program = peer_laws.jax_programs(LAW, offsets, ITERATIONS)[peer.kind][0]
    given = jax.ShapeDtypeStruct((TIMES, 2, peer.rows), str(peer.dtype)[6:])
    return program.lower(given).compile()


def compared(
    waiting: dict[Peer, Any], rates: dict[tuple[str, torch.dtype, int], float], until: float
) -> None:
    """Print the rates of JAX beside ours of the same, the best of its programs last."""
    best: dict[tuple[torch.dtype, int], float] = {}
    for peer, program in waiting.items():
        if time.perf_counter() > until:
            print("JAX: the rest was left out, as the time was over")
            break
        try:
            rate = peer.rows * TIMES / _seconds(program.result(), peer)
        except Exception as told:
            print(f"JAX {NAME}, {peer.kind}: {type(told).__name__}: {str(told)[:200]}")
            continue
        key = peer.dtype, peer.rows
        best[key] = max(best.get(key, 0.0), rate)
        ours = rates.get((NAME, *key), float("nan"))
        told = f"{rate / 1e9:8.3f} G/s; ours {ours / 1e9:8.3f}, {ours / best[key]:7.1f} times the best"
        print(f"JAX {NAME:24} {peer.kind:16} {str(peer.dtype)[6:]:8} {peer.rows:8} {told}", flush=True)


def _seconds(program: Any, peer: Peer) -> float:
    """The median of the seconds of a call of JAX, of which none is the first."""
    import jax

    x = cases.circles(peer.rows, TIMES, peer.dtype).permute(1, 2, 0).contiguous().numpy()
    given, seconds = jax.device_put(x), list[float]()
    for _ in range(4):
        begin = time.perf_counter()
        jax.block_until_ready(program(given))
        seconds.append(time.perf_counter() - begin)
    return statistics.median(seconds[1:])
