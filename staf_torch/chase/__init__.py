"""The open-loop engine: gradient chase along given trajectories."""

from . import predictors as predictors
from .certificate import Certificate as Certificate
from .engine import chase as chase
from .engine import chase_pieces as chase_pieces
from .engine import chunk_length as chunk_length
from .predictors import Predictor as Predictor
from .predictors import Secant as Secant
from .predictors import Tangent as Tangent
from .rates import along as along
from .rates import gram_rates as gram_rates
from .result import ChaseResult as ChaseResult
from .result import ChaseWeights as ChaseWeights
from .weights import chase_weights as chase_weights
