"""Bases of a value function, one a file."""

from .base import ValueBasis as ValueBasis
from .leading import LeadingCoordinates as LeadingCoordinates
from .quadratic import QuadraticBasis as QuadraticBasis
from .rbf_grid import RBFGridBasis as RBFGridBasis
from .staf import StaFValueBasis as StaFValueBasis
