"""Direct shooting: the optimum of a plant whose optimal value no formula knows."""

from .direct import DirectShooting as DirectShooting
from .direct import Optimum as Optimum
