"""Where the tensor batches of a sweep are computed: one executor a module."""

from .base import Executor as Executor
from .choose import EXECUTORS as EXECUTORS
from .choose import executor as executor
