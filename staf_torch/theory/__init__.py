"""The paper's theorems as computations."""

from .construction import Construction as Construction
from .exponential_bound import ExponentialBound as ExponentialBound
from .exponential_bound import exponential_bound as exponential_bound
from .exponential_bound import one_polynomial_bound as one_polynomial_bound
from .minimal_count import MinimalCount as MinimalCount
from .minimal_count import layout_errors as layout_errors
from .minimal_count import minimal_count as minimal_count
from .minimal_count import standard_layouts as standard_layouts
from .sampling import disc as disc
