"""The theorems, computable: what can be said before a run."""

from .exponential_bound import exponential_bound as exponential_bound
from .exponential_bound import one_polynomial_bound as one_polynomial_bound
from .minimal_count import layout_errors as layout_errors
from .minimal_count import minimal_count as minimal_count
from .minimal_count import power_function as power_function
from .minimal_count import standard_layouts as standard_layouts
from .ultimate_bound import DriftConstants as DriftConstants
from .ultimate_bound import drift_constants as drift_constants
from .ultimate_bound import paper_step as paper_step
from .ultimate_bound import step_for_bound as step_for_bound
from .ultimate_bound import steps_for_bound as steps_for_bound
from .ultimate_bound import ultimate_bound as ultimate_bound
from .uniform_approximation import disc as disc

__all__ = [name for name, value in globals().items() if callable(value) and not name.startswith("_")]
