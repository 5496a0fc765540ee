"""Where results go beside the run directory, one way a file."""

from .base import Tracker as Tracker
from .tensorboard import TensorBoardTracker as TensorBoardTracker
