"""Directions, radii and the centers that follow the state."""

from .layouts import ball as ball
from .layouts import cross_polytope as cross_polytope
from .layouts import polygon as polygon
from .layouts import probe_points as probe_points
from .layouts import rings as rings
from .layouts import simplex as simplex
from .state_following import ConstantRadius as ConstantRadius
from .state_following import Radius as Radius
from .state_following import StateFollowingCenters as StateFollowingCenters
from .state_following import StateRadius as StateRadius

__all__ = [name for name, value in globals().items() if callable(value) and not name.startswith("_")]
