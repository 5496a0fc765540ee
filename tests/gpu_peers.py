"""What others do in the time: JAX, and torch as it is, on the device of `tests/gpu.py`."""

from __future__ import annotations

import concurrent.futures
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch

import staf_torch as st
from staf_torch import lanes
from tests import gpu_cases as cases

DTYPES = torch.float64, torch.float32
EIGENVALUES = "Nesterov", "HeavyBall"  # laws whose programs of JAX solve an eigenvalue problem a row and time
FEWER = 20_000  # rows of these in JAX, which takes seconds for them
ITERATIONS = 10


class Peer(NamedTuple):
    """A program of JAX, of a law."""

    law: str
    count: int
    times: int
    kind: str
    dtype: torch.dtype
    rows: int

    @property
    def name(self) -> str:
        return f"M = {self.count} {self.law}" + (", 100" if self.times == 100 else "")


def peers(largest: int) -> list[Peer]:
    found = []
    measured = [("SteepestDescent", 3, 100), ("ConjugateGradient", 6, 16), ("SteepestDescent", 15, 16)]
    for law, count, times in [*measured, *((law, 15, 16) for law in ("Exact", *EIGENVALUES))]:
        for dtype in DTYPES:
            for rows in (100_000, 1_000_000) if (law, count, times) in measured else (100_000,):
                rows = min(rows, largest, FEWER if law in EIGENVALUES else rows)
                apart = count == 3 or (count == 6 and rows <= 100_000)  # XLA takes half a minute for M = 6
                kinds = ("components apart", "batch last") if apart else ("batch last",)
                found += [Peer(law, count, times, kind, dtype, rows) for kind in kinds]
    return list(dict.fromkeys(found))


def built(pool: concurrent.futures.Executor, largest: int) -> dict[Peer, Any]:
    """Programs of JAX that are being compiled; none where it is not installed."""
    sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
    try:
        import jax  # noqa: F401
    except ImportError as told:
        print(f"no JAX: {told}")
        return {}
    return {each: pool.submit(_compiled, each) for each in peers(largest)}


def _compiled(peer: Peer) -> Any:
    import jax
    import peer_laws

    offsets = (st.rings(peer.count) * cases.RADIUS[peer.count]).double().numpy()
    if peer.kind == "components apart":
        program = peer_laws.jax_apart(peer.law, offsets, ITERATIONS)
    else:
        program = peer_laws.jax_programs(peer.law, offsets, ITERATIONS)[peer.kind][0]
    given = jax.ShapeDtypeStruct((peer.times, 2, peer.rows), str(peer.dtype)[6:])
    return program.lower(given).compile()


def compared(
    waiting: dict[Peer, Any], rates: dict[tuple[str, torch.dtype, int], float], until: float
) -> None:
    """Print the rates of JAX beside ours of the same, the best of its programs last."""
    best: dict[tuple[str, torch.dtype, int], float] = {}
    for peer, program in waiting.items():
        if time.perf_counter() > until:
            print("JAX: the rest was left out, as the time was over")
            break
        try:
            rate = peer.rows * peer.times / _seconds(program.result(), peer)
        except Exception as told:
            print(f"JAX {peer.name}, {peer.kind}: {type(told).__name__}: {str(told)[:200]}")
            continue
        key = peer.name, peer.dtype, peer.rows
        best[key] = max(best.get(key, 0.0), rate)
        same = [each for (name, dtype, _), each in rates.items() if (name, dtype) == key[:2]]
        ours = rates.get(key, same[0] if same else float("nan"))  # where JAX has fewer rows
        told = f"{rate / 1e9:8.3f} G/s; ours {ours / 1e9:8.3f}, {ours / best[key]:7.1f} times the best"
        print(f"JAX {peer.name:24} {peer.kind:16} {str(peer.dtype)[6:]:8} {peer.rows:8} {told}", flush=True)


def _seconds(program: Any, peer: Peer) -> float:
    """The median of the seconds of a call of JAX, of which none is the first."""
    import jax

    x = cases.circles(peer.rows, peer.times, peer.dtype).permute(1, 2, 0).contiguous().numpy()
    given, seconds = jax.device_put(x), list[float]()
    for _ in range(2 if peer.law in EIGENVALUES else 4):
        begin = time.perf_counter()
        jax.block_until_ready(program(given))
        seconds.append(time.perf_counter() - begin)
    return statistics.median(seconds[1:])


def eager(
    names: list[str],
    case_of: Callable[[str, torch.dtype, int], cases.Case],
    rates: dict[tuple[str, torch.dtype, int], float],
    device: str,
    until: float,
) -> None:
    """Print how many times what torch as it is takes a call takes, for the same tensors on the device."""
    for name in names:
        if time.perf_counter() > until:
            print("eager torch: the rest was left out, as the time was over")
            break
        keys = [key for key in rates if key[:2] == (name, torch.float64)]
        if not keys:
            continue
        rows = min(100_000, max(key[2] for key in keys))
        case = case_of(name, torch.float64, rows)
        case.to(device)
        given = lanes.tree.moved(case.inputs, device)
        try:
            case.plain(*lanes.tree.moved(case_of(name, torch.float64, 16).inputs, device))
            torch.cuda.synchronize()
            begin = time.perf_counter()
            case.plain(*given)
            torch.cuda.synchronize()
        except Exception as told:
            print(f"eager {name}: {type(told).__name__}: {str(told)[:200]}")
            continue
        rate = rows * case.times / (time.perf_counter() - begin)
        ours = rates.get((name, torch.float64, rows), float("nan"))
        print(
            f"eager torch {name:28} {rows:8} {rate / 1e6:9.2f} M/s; ours {ours / rate:8.1f} times", flush=True
        )
        torch.cuda.empty_cache()
