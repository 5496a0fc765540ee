"""Kernels, one a file of this folder. A kernel of your own is a subclass of `Kernel` with `forward` alone."""

from ..numerics.registry import unlisted as _unlisted
from ..numerics.registry import variants as _variants
from ..numerics.registry import without_arguments as _without_arguments
from .anchored import AnchoredKernel as AnchoredKernel
from .base import Kernel as Kernel
from .exponential import ExponentialKernel as ExponentialKernel
from .gaussian import GaussianKernel as GaussianKernel
from .inverse_multiquadric import InverseMultiquadricKernel as InverseMultiquadricKernel
from .matern import MaternKernel as MaternKernel
from .polynomial import PolynomialKernel as PolynomialKernel
from .radial import RadialKernel as RadialKernel
from .rational_quadratic import RationalQuadraticKernel as RationalQuadraticKernel

globals().update(_unlisted(globals(), Kernel))  # a file is enough; lines above are for type checkers

NAMED: dict[str, type[Kernel]] = _without_arguments(_variants(__name__, Kernel))
"""Kernels that need no argument, by the names of their files, which options of `staf kernel=` have too."""

__all__ = [name for name, value in globals().items() if callable(value) and not name.startswith("_")]
