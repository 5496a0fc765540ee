"""Actor-critic laws, one a file."""

from .base import ActorCriticLaw as ActorCriticLaw
from .base import BellmanSums as BellmanSums
from .base import Gains as Gains
from .base import Weights as Weights
from .frozen import Frozen as Frozen
from .information import Information as Information
from .published import Published as Published
