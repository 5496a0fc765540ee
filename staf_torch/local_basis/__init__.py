"""The span of the kernels around a state, in a basis in which it can be computed with.

Near the state x, with offsets z and d, a kernel is k(x+z, x+d) = e^{g} e^{s(z)} k0(z, d) e^{s(d)}
(`Kernel`). Kernels whose core is an exponential of z'd get the graded basis, polynomial kernels its finite
analogue, all others the Newton basis.
"""

from .base import LocalSpace as LocalSpace
from .base import evaluate_scaled as evaluate_scaled
from .base import scale as scale
from .choice import LocalBasis as LocalBasis
from .choice import choose as choose
from .elimination import Degrees as Degrees
from .elimination import degrees_of as degrees_of
from .graded import SERIES_BELOW as SERIES_BELOW
from .graded import GradedBasis as GradedBasis
from .graded import GradedSpace as GradedSpace
from .graded import Interpolation as Interpolation
from .graded import graded_basis as graded_basis
from .graded import phi as phi
from .newton import NewtonSpace as NewtonSpace
from .newton import newton_space as newton_space
from .polynomial import PolynomialSpace as PolynomialSpace
from .polynomial import polynomial_space as polynomial_space
