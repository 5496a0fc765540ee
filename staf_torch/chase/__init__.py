"""The open-loop engine: gradient chase along given trajectories."""

from .engine import chase as chase
from .engine import chase_pieces as chase_pieces
from .engine import chunk_length as chunk_length
from .result import ChaseResult as ChaseResult
from .result import ChaseWeights as ChaseWeights
from .weights import chase_weights as chase_weights
