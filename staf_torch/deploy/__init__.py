"""Out to the device: a fixed approximation or controller as ONNX, a `torch.export` program, an AOTInductor
package or C."""

from .approximators import approximator as approximator
from .c_header import export_c as export_c
from .c_header import export_learning_c as export_learning_c
from .c_header import time_c as time_c
from .controllers import policy_of as policy_of
from .formats import export_onnx as export_onnx
from .formats import export_package as export_package
from .formats import export_program as export_program
from .formats import load_program as load_program
from .formats import trace as trace

__all__ = [name for name, value in globals().items() if callable(value) and not name.startswith("_")]
