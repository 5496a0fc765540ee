"""The names of the environments."""

from __future__ import annotations

from typing import Any

import gymnasium

from .settings import NAMES

PLANTS = {f"staf_torch/{name}-v0": name for name in NAMES}
"""Id of the environment: name of its plant."""

_ARGUMENTS: dict[str, dict[str, Any]] = {
    "Pendulum": {"spread": 0.5},
    "PlanarQuadrotor": {"spread": 0.2},
    "ThreeState": {"spread": 0.5},
}


def register_plants() -> None:
    """Register every plant with Gymnasium, once."""
    for name, plant in PLANTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="staf_torch.envs:PlantEnv",
                vector_entry_point="staf_torch.envs:PlantVectorEnv",
                kwargs={"plant": plant, **_ARGUMENTS.get(plant, {})},
            )
