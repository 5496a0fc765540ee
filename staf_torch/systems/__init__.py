"""Plants, one a file of this folder, and their trajectories."""

from ..numerics.registry import unlisted as _unlisted
from ..numerics.runge_kutta import runge_kutta_step as runge_kutta_step
from .barrier import Barrier as Barrier
from .base import Bounds as Bounds
from .base import ControlAffineSystem as ControlAffineSystem
from .base import Linearisation as Linearisation
from .base import Plant as Plant
from .base import Units as Units
from .cart_pole import CartPole as CartPole
from .clocked import Clocked as Clocked
from .equilibria import Equilibrium as Equilibrium
from .equilibria import find_equilibrium as find_equilibrium
from .integrators import simulate as simulate
from .integrators import trajectory as trajectory
from .linear import Linear as Linear
from .mujoco_plant import MujocoPlant as MujocoPlant
from .oscillator import Oscillator as Oscillator
from .pendulum import Pendulum as Pendulum
from .planar_quadrotor import PlanarQuadrotor as PlanarQuadrotor
from .three_state import ThreeState as ThreeState
from .two_link_robot import TwoLinkRobot as TwoLinkRobot
from .two_state import TwoState as TwoState
from .two_state_chain import TwoStateChain as TwoStateChain
from .two_state_tracking import TwoStateTracking as TwoStateTracking
from .two_state_tracking import desired_trajectory as desired_trajectory
from .user_plants import RatePlant as RatePlant
from .user_plants import StepPlant as StepPlant
from .van_der_pol import VanDerPol as VanDerPol

globals().update(_unlisted(globals(), Plant))  # a file is enough; lines above are for type checkers

__all__ = [name for name, value in globals().items() if callable(value) and not name.startswith("_")]
