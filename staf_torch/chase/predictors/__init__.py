"""Predictors, one a file: how the weights move between times."""

from .base import Predictor as Predictor
from .secant import Secant as Secant
from .tangent import Tangent as Tangent
