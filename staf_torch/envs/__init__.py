"""The plants as Gymnasium environments. Importing this registers them: `staf_torch/TwoState-v0` and so on."""

from importlib.util import find_spec as _find_spec

if _find_spec("gymnasium") is None:
    raise ImportError("staf_torch.envs needs Gymnasium: pip install 'staf_torch[gym]'.")

from .environment_plant import Agent as Agent
from .environment_plant import EnvironmentPlant as EnvironmentPlant
from .environment_plant import classic_control as classic_control
from .plant_env import OWN_PLANT as OWN_PLANT
from .plant_env import PLANTS as PLANTS
from .plant_env import Episodes as Episodes
from .plant_env import PlantEnv as PlantEnv
from .plant_env import PlantVectorEnv as PlantVectorEnv
from .plant_env import register_plants as register_plants

__all__ = [
    "OWN_PLANT",
    "PLANTS",
    "Agent",
    "EnvironmentPlant",
    "Episodes",
    "PlantEnv",
    "PlantVectorEnv",
    "classic_control",
    "register_plants",
]

register_plants()
