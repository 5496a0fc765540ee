"""Plants, one a file, and their trajectories."""

from .base import ControlAffineSystem as ControlAffineSystem
from .integrators import runge_kutta_step as runge_kutta_step
from .integrators import simulate as simulate
from .integrators import trajectory as trajectory
from .linear import Linear as Linear
from .oscillator import Oscillator as Oscillator
