"""Kernels, one a file. A kernel of your own is a subclass of `Kernel` with `forward` alone."""

from .anchored import AnchoredKernel as AnchoredKernel
from .base import Kernel as Kernel
from .exponential import ExponentialKernel as ExponentialKernel
from .gaussian import GaussianKernel as GaussianKernel
from .inverse_multiquadric import InverseMultiquadricKernel as InverseMultiquadricKernel
from .matern import MaternKernel as MaternKernel
from .polynomial import PolynomialKernel as PolynomialKernel
from .radial import RadialKernel as RadialKernel
from .rational_quadratic import RationalQuadraticKernel as RationalQuadraticKernel

__all__ = [name for name, value in globals().items() if callable(value) and not name.startswith("_")]
