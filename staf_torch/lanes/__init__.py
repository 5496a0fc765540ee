"""Row programs: torch functions of one row, compiled with a row in every vector lane.

Every room imports those before it. `tree` and `row_numbers` are what all inputs are made of, `dependencies`
is what a step reads and whether it has changed, `threads` has locks, `gradients` derivatives of plain torch,
`compilation` the compiler and its cache. `calls` checks inputs, chooses between compiled code and plain
torch, and prepares calls. `trace` writes a step down as a scalar program, `emit` makes C++, C or CUDA of it,
`device` runs kernels, `adjoint` has gradients, `texts` keeps traces and what is built of them. `program`
brings these together; `shared_programs` and `compiled_methods` are programs for many objects, functions,
loops and methods. Beside them stand `per_row`, objects whose numbers differ from row to row, and
`torch_compile`, calls within somebody's `torch.compile`.
"""

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
