"""State Following (StaF) kernel approximation as a batched PyTorch engine."""

from . import adp as adp
from . import diagnostics as diagnostics
from . import optim as optim
from . import sensitivity as sensitivity
from . import systems as systems
from . import targets as targets
from . import theory as theory
from .basis import StaFBasis as StaFBasis
from .centers import ConstantRadius as ConstantRadius
from .centers import StateFollowingCenters as StateFollowingCenters
from .centers import StateRadius as StateRadius
from .centers import ball as ball
from .centers import cross_polytope as cross_polytope
from .centers import polygon as polygon
from .centers import rings as rings
from .centers import simplex as simplex
from .chase import ChaseResult as ChaseResult
from .chase import ChaseWeights as ChaseWeights
from .chase import chase as chase
from .chase import chase_weights as chase_weights
from .chase import predictors as predictors
from .kernels import AnchoredKernel as AnchoredKernel
from .kernels import ExponentialKernel as ExponentialKernel
from .kernels import GaussianKernel as GaussianKernel
from .kernels import InverseMultiquadricKernel as InverseMultiquadricKernel
from .kernels import Kernel as Kernel
from .kernels import MaternKernel as MaternKernel
from .kernels import PolynomialKernel as PolynomialKernel
from .kernels import RationalQuadraticKernel as RationalQuadraticKernel
from .memory import ExperienceMemory as ExperienceMemory
from .module import StaF as StaF
from .streams import StaFRegressor as StaFRegressor

__version__ = "0.1.0"
