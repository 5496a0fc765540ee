"""Row programs: torch functions of one row, compiled with a row in every vector lane."""

from .compiling import compiling as compiling
from .emit import cuda as cuda
from .function import ready as ready
from .loops import each as each
from .loops import reduce as reduce
from .loops import repeat as repeat
from .loops import scan as scan
from .program import Program as Program
from .tree import Shared as Shared

__all__ = ["Program", "Shared", "compiling", "each", "ready", "reduce", "repeat", "scan"]
