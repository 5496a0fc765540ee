"""Row programs: torch functions of one row, compiled with a row in every vector lane."""

from . import device as device
from .adjoint import gradient_memory as gradient_memory
from .compiled_methods import compiled as compiled
from .compiled_methods import ready as ready
from .loops import each as each
from .loops import reduce as reduce
from .loops import repeat as repeat
from .loops import scan as scan
from .loops import traced_as as traced_as
from .loops import where_rows as where_rows
from .program import Program as Program
from .row_objects import rows as rows
from .shared_programs import shared_program as shared_program
from .tree import Shared as Shared
from .when_compiled import compiling as compiling

__all__ = [
    "Program",
    "Shared",
    "compiled",
    "compiling",
    "device",
    "each",
    "gradient_memory",
    "ready",
    "reduce",
    "repeat",
    "scan",
]
__all__ += ["rows", "shared_program", "traced_as", "where_rows"]
