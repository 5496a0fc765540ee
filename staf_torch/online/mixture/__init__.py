"""A mixture of forecasters on remembered samples."""

from .regressor import MixtureRegressor as MixtureRegressor

__all__ = ["MixtureRegressor"]
