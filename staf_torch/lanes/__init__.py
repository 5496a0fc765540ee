"""Row programs: torch functions of one row, compiled with a row in every vector lane."""

from . import device as device
from .adjoint.gradient_call import gradient_memory as gradient_memory
from .calls.choice import compiling as compiling
from .compiled_methods import compiled as compiled
from .compiled_methods import ready as ready
from .per_row.objects import rows as rows
from .program import Program as Program
from .shared_programs import shared_program as shared_program
from .trace.loops import each as each
from .trace.loops import reduce as reduce
from .trace.loops import repeat as repeat
from .trace.loops import scan as scan
from .trace.loops import traced_as as traced_as
from .trace.loops import where_rows as where_rows
from .tree import Shared as Shared

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
