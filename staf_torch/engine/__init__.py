"""The open-loop engine: gradient chase along given trajectories."""

from . import predictors as predictors
from .api import chase as chase
from .api import chase_pieces as chase_pieces
from .api import chase_weights as chase_weights
from .api import chunk_length as chunk_length
from .predictors import Predictor as Predictor
from .predictors import Secant as Secant
from .predictors import Tangent as Tangent
from .predictors import along as along
from .predictors import gram_rates as gram_rates
from .result import Certificate as Certificate
from .result import ChaseResult as ChaseResult
from .result import ChaseWeights as ChaseWeights

__all__ = [
    "Certificate",
    "ChaseResult",
    "ChaseWeights",
    "Predictor",
    "Secant",
    "Tangent",
    "along",
    "chase",
    "chase_pieces",
    "chase_weights",
    "chunk_length",
    "gram_rates",
]
