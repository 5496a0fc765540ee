"""Gymnasium's MuJoCo pendulums at their own periods: how many of 1000 steps they stand, from 20 resets.

    python tests/benchmarks/mujoco_resets.py [--resets 20] [--policies LQR,near_optimal]

Needs mujoco and gymnasium. The environment is Gymnasium's, the policy knows its model alone; all environments
of a policy run side by side, so that a control is one call for all of them. Ends with an error where one
falls. Not collected by pytest.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

import gymnasium
import numpy as np
import torch
from gymnasium.envs import mujoco as folder
from torch import Tensor

from staf_torch import adp, systems

MODELS = {
    "InvertedPendulum-v5": ("inverted_pendulum.xml", 0.04),
    "InvertedDoublePendulum-v5": ("inverted_double_pendulum.xml", 0.05),
}
_STEPS = 1000


@torch.no_grad()
def stood(name: str, policy: Callable[[Tensor], Tensor], resets: int) -> tuple[list[int], float]:
    """Steps that every environment took before it ended, and CPU milliseconds of the policy a control."""
    environments = [gymnasium.make(name) for _ in range(resets)]
    for seed, environment in enumerate(environments):
        environment.reset(seed=seed)
    taken, over, spent = [0] * resets, [False] * resets, 0.0
    for _ in range(_STEPS):
        datas = [environment.unwrapped.data for environment in environments]
        x = torch.from_numpy(np.stack([np.concatenate((data.qpos, data.qvel)) for data in datas]))
        began = time.process_time()
        u = policy(x)
        spent += time.process_time() - began
        for k, environment in enumerate(environments):
            if not over[k]:
                _, _, over[k], _, _ = environment.step(u[k].numpy())
                taken[k] += not over[k]
    return taken, 1000 * spent / _STEPS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--resets", type=int, default=20)
    parser.add_argument("--policies", default="LQR,near_optimal")
    settings = parser.parse_args()
    torch.set_num_threads(1)
    fell = False
    for name, (file, dt) in MODELS.items():
        plant = systems.MujocoPlant(f"{folder.__path__[0]}/assets/{file}", dt=dt)
        cost = adp.QuadraticCost(1.0, 1.0, dim=plant.dim, inputs=1)
        made = {"LQR": lambda p=plant, c=cost: adp.LQR(p, c), "near_optimal": None}
        for kind in settings.policies.split(","):
            policy = made[kind]() if made[kind] else adp.near_optimal(plant, cost)
            steps, spent = stood(name, policy, settings.resets)
            whole = sum(count == _STEPS for count in steps)
            fell |= whole < settings.resets
            print(
                f"{name} {kind}: {whole} of {settings.resets} stand for {_STEPS} steps, "
                f"the least {min(steps)}; {spent:.1f} CPU-ms a control of all",
                flush=True,
            )
    sys.exit(fell)


if __name__ == "__main__":
    main()
