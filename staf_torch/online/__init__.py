"""Online regression on streams of samples."""

from .regressor import StaFRegressor as StaFRegressor
from .river_adapter import RiverRegressor as RiverRegressor

__all__ = ["RiverRegressor", "StaFRegressor"]
