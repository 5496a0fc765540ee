"""Direct shooting: the optimum of a plant whose optimal value no formula knows."""

from .direct import DirectShooting as DirectShooting
from .starts import Optimum as Optimum
from .starts import PlanReplay as PlanReplay
