"""Who leaves the box of the published two states: the LQR of s, and the LQR behind `adp.BoxFilter`.

    python tests/benchmarks/walls.py [starts] [seed]

As many starts from the whole box, and as many 1e-6 beside one of its walls, followed for 0.1 s with controls
held for 1 ms, in double and single precision. Whether a start that is lost could have been kept is found
without the filter: a harder u pulls x1 back further, so that the hardest u that leaves x2 inside (by
bisection, 200 Runge-Kutta steps a hold) keeps x1 inside, or none does.
"""

from __future__ import annotations

import sys
import time

import torch
from torch import Tensor

from staf_torch import adp, systems

LOW, HIGH, NEAR, DT = (-7.0, -5.0), (5.0, 7.0), 1e-6, 1e-3
PLANT = systems.TwoStateChain()


def starts(count: int, beside: bool, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(LOW).double(), torch.tensor(HIGH).double()
    x = low + (high - low) * torch.rand(count, 2, dtype=torch.float64, generator=generator)
    wall = torch.randint(4, (count,), generator=generator)
    for k, side in ((0, 0), (0, 1), (1, 0), (1, 1)):
        at = (HIGH[k] - NEAR) if side else (LOW[k] + NEAR)
        x[:, k] = torch.where((wall == 2 * k + side) & beside, at, x[:, k])
    return x


def held(x: Tensor, u: Tensor, pieces: int = 200) -> tuple[Tensor, Tensor]:
    """Whether x1 and x2 stay inside while u is held, (B,) bool each."""
    inside = torch.ones(2, len(x), dtype=torch.bool)
    for _ in range(pieces):
        x = systems.runge_kutta_step(lambda y: PLANT.rate(y, u.unsqueeze(-1)), x, DT / pieces)
        inside &= torch.stack([(x[:, k] > LOW[k]) & (x[:, k] < HIGH[k]) for k in (0, 1)])
    return inside[0], inside[1]


def can_be_kept(x: Tensor) -> Tensor:
    """Whether the hardest pull that leaves x2 inside keeps x1 inside: (B, 2) -> (B,) bool."""
    outward = torch.sign(x[:, 0] - 0.5 * (LOW[0] + HIGH[0]))  # the nearer wall of x1
    soft, hard = torch.zeros(len(x)).double(), torch.full((len(x),), 5e4).double()
    for _ in range(30):
        middle = 0.5 * (soft + hard)
        _, fits = held(x, -outward * middle)
        soft, hard = torch.where(fits, middle, soft), torch.where(fits, hard, middle)
    return held(x, -outward * soft)[0]


def main(count: int, seed: int) -> None:
    torch.set_num_threads(1)
    box = systems.Barrier(PLANT, LOW, HIGH)
    cost = adp.QuadraticCost(10.0, 0.1, dim=2, inputs=1)
    lqr = adp.LQR(box, cost)
    filtered, renewed = (adp.BoxFilter(lqr, box, dt=DT, renewed=each) for each in (False, True))
    print("| starts | dtype | method | left | of these could have been kept | CPU s |")
    print("|---|---|---|---|---|---|")
    for beside in (False, True):
        x = starts(count, beside, seed)
        keeps = can_be_kept(x)
        for dtype in (torch.float64, torch.float32):
            s0 = box.transform(x).to(dtype)
            for name, policy, renew, substeps in (
                ("LQR of s", lqr, False, 16),
                ("LQR of s, renewed 16 times a ms", lqr, True, 16),
                ("filtered", filtered, False, (1, 16)),
                ("filtered, renewed", renewed, True, (1, 16)),
            ):
                clock = time.process_time()
                settings = {"dt": DT, "steps": 100, "every": 100, "substeps": substeps, "renew": renew}
                run = adp.simulate(adp.Feedback(policy), box, cost, s0, compile=True, **settings)  # type: ignore[arg-type]
                spent, left = time.process_time() - clock, run.diverged
                where = "beside a wall" if beside else "in the box"
                row = (where, dtype, name, int(left.sum()), int((left & keeps).sum()), f"{spent:.1f}")
                print("| " + " | ".join(map(str, row)) + " |", flush=True)
        print(f"of {count} starts {int((~keeps).sum())} cannot be kept by any control held for 1 ms")


if __name__ == "__main__":
    count, seed = [*map(int, sys.argv[1:]), *(10_000, 0)[len(sys.argv) - 1 :]]
    main(count, seed)
