"""Gradient chases of 500 steps as one tensor batch and one by one: seconds a member.

    python tests/benchmarks/members.py [kernel] [members]

Run it alone on the machine. The members differ in radius and seed; nothing is written.
"""

from __future__ import annotations

import sys
import time

from staf_torch.experiments import members
from staf_torch.experiments.composition import compose

ALONE = 3


def main(kernel: str = "gaussian", count: str = "25") -> None:
    radii = [0.05, 0.1, 0.2, 0.3, 0.5]
    jobs = [[f"centers.radius={radii[i % 5]}", f"seed={i // 5}", "trajectories=2"] for i in range(int(count))]
    base = [f"kernel={kernel}", "centers.count=6", "duration=5", "settle_time=2.5", "figures=false"]
    start = time.perf_counter()
    cfgs = compose(base, jobs, hydra_node=False)
    composed = time.perf_counter()
    members.solve(cfgs[:1])
    warm = time.perf_counter()
    for group in members.groups(cfgs):
        for chunk in members.chunks(cfgs, group):
            members.solve([cfgs[i] for i in chunk])
    batch = time.perf_counter()
    for cfg in cfgs[:ALONE]:
        members.solve([cfg])
    alone = time.perf_counter()
    print(f"{count} members, {kernel}: composed in {composed - start:.3f} s")
    print(f"  batch {batch - warm:.3f} s, {(batch - warm) / len(cfgs) * 1e3:.1f} ms a member")
    print(f"  alone {(alone - batch) / ALONE * 1e3:.1f} ms a member")


if __name__ == "__main__":
    main(*sys.argv[1:])
