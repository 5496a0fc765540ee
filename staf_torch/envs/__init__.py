"""The plants as Gymnasium environments. Importing this registers them: `staf_torch/TwoState-v0` and so on."""

from importlib.util import find_spec as _find_spec

if _find_spec("gymnasium") is None:
    raise ImportError("staf_torch.envs needs Gymnasium: pip install 'staf_torch[gym]'.")

from .agent import Agent as Agent
from .episodes import Episodes as Episodes
from .plant_env import PlantEnv as PlantEnv
from .registration import PLANTS as PLANTS
from .registration import register_plants
from .vector_env import PlantVectorEnv as PlantVectorEnv

register_plants()
