"""Devices that run the kernel of a row program: CUDA, and the host in the place of one."""

from .host import captured as captured
from .host import host as host
from .host import recorded as recorded

__all__ = ["captured", "host", "recorded"]
