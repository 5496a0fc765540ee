"""The theorems, computable: what can be said before a run."""

from .paper_step import PaperStep as PaperStep
from .paper_step import paper_step as paper_step
from .power_function import power_function as power_function
from .ultimate_bound import DriftConstants as DriftConstants
from .ultimate_bound import UltimateBound as UltimateBound
from .ultimate_bound import drift_constants as drift_constants
from .ultimate_bound import step_for_bound as step_for_bound
from .ultimate_bound import steps_for_bound as steps_for_bound
from .ultimate_bound import ultimate_bound as ultimate_bound
