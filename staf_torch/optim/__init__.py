"""Update laws, one a file of this folder."""

from ..numerics.registry import unlisted as _unlisted
from .barzilai_borwein import BarzilaiBorwein as BarzilaiBorwein
from .base import UpdateLaw as UpdateLaw
from .conjugate_gradient import ConjugateGradient as ConjugateGradient
from .exact import Exact as Exact
from .fixed_step import FixedStep as FixedStep
from .heavy_ball import HeavyBall as HeavyBall
from .nesterov import Nesterov as Nesterov
from .normalised_lms import NormalisedLMS as NormalisedLMS
from .preconditioned_descent import PreconditionedDescent as PreconditionedDescent
from .recursive_least_squares import RecursiveLeastSquares as RecursiveLeastSquares
from .steepest_descent import SteepestDescent as SteepestDescent
from .torch_optimizer import ChaseOptimizer as ChaseOptimizer

globals().update(_unlisted(globals(), UpdateLaw))  # a file is enough; lines above are for type checkers

__all__ = [name for name, value in globals().items() if callable(value) and not name.startswith("_")]
