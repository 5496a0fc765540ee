"""Directions, radii and the centers that follow the state."""

from .ball import ball as ball
from .ball import probe_points as probe_points
from .layouts import cross_polytope as cross_polytope
from .layouts import polygon as polygon
from .layouts import rings as rings
from .layouts import simplex as simplex
from .radius import ConstantRadius as ConstantRadius
from .radius import Radius as Radius
from .radius import StateRadius as StateRadius
from .state_following import StateFollowingCenters as StateFollowingCenters
