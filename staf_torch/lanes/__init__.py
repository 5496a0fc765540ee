"""Row programs: torch functions of one row, compiled with a row in every vector lane."""

from . import cuda as cuda
from .combinators import each as each
from .combinators import reduce as reduce
from .combinators import repeat as repeat
from .combinators import scan as scan
from .compiling import compiling as compiling
from .function import ready as ready
from .program import Program as Program
from .tree import Shared as Shared

__all__ = ["Program", "Shared", "compiling", "each", "ready", "reduce", "repeat", "scan"]
