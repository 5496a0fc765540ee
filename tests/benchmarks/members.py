"""Gradient chases of 500 steps as one tensor batch and one by one: seconds a member.

    python tests/benchmarks/members.py [kernel] [members]

Run it alone on the machine. The members differ in radius and seed; nothing is written.
"""

from __future__ import annotations

import sys
import time

from staf_torch.results.progress import SHOWN
from staf_torch.sweeps.batching import batches, flat_or_none, solve
from staf_torch.sweeps.hydra_compat import Composer, config_loader

ALONE = 3


def main(kernel: str = "gaussian", count: str = "25") -> None:
    radii = [0.05, 0.1, 0.2, 0.3, 0.5]
    jobs = [[f"centers.radius={radii[i % 5]}", f"seed={i // 5}", "trajectories=2"] for i in range(int(count))]
    base = [f"kernel={kernel}", "centers.count=6", "duration=5", "settle_time=2.5", "figures=false"]
    start = time.perf_counter()
    composer = Composer(config_loader(), hydra_node=False)
    cfgs = [composer([*base, *job]) for job in jobs]
    composed = time.perf_counter()
    solve(cfgs[:1], SHOWN)
    warm = time.perf_counter()
    for batch_ in batches([flat_or_none(cfg) for cfg in cfgs]):
        solve([cfgs[i] for i in batch_], SHOWN)
    batch = time.perf_counter()
    for cfg in cfgs[:ALONE]:
        solve([cfg], SHOWN)
    alone = time.perf_counter()
    print(f"{count} members, {kernel}: composed in {composed - start:.3f} s")
    print(f"  batch {batch - warm:.3f} s, {(batch - warm) / len(cfgs) * 1e3:.1f} ms a member")
    print(f"  alone {(alone - batch) / ALONE * 1e3:.1f} ms a member")


if __name__ == "__main__":
    main(*sys.argv[1:])
