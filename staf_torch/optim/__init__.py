"""Update laws, one a file."""

from .base import UpdateLaw as UpdateLaw
from .steepest_descent import SteepestDescent as SteepestDescent
