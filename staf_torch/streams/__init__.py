"""Online regression on streams of samples."""

from .regressor import StaFRegressor as StaFRegressor
