"""Direct shooting: the optimum of a plant whose optimal value no formula knows."""

from .direct import DirectShooting as DirectShooting
from .optimum import Optimum as Optimum
from .optimum import PlanReplay as PlanReplay
