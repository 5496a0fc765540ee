"""Online regression on streams of samples."""

from .experience_memory import ExperienceMemory as ExperienceMemory
from .mixture import MixtureRegressor as MixtureRegressor
from .regressor import StaFRegressor as StaFRegressor
from .river_adapter import RiverRegressor as RiverRegressor

__all__ = ["ExperienceMemory", "MixtureRegressor", "RiverRegressor", "StaFRegressor"]
