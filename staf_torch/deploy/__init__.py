"""Out to the device: a fixed approximation or controller as ONNX, a `torch.export` program, an AOTInductor
package or C."""

from .approximators import LocalApproximator as LocalApproximator
from .approximators import approximator as approximator
from .ridges import RidgeApproximator as RidgeApproximator
