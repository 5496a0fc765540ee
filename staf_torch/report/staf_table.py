"""What the console script `staf-table` imports: the tables alone, in a tenth of the time that torch takes.

A module of the package would not do, since importing it imports the package first, and that torch. The wheel
has this file beside the package (pyproject.toml), where it stands in for the package's own `__init__`: of
the modules below, `staf_torch.report` and what it uses know nothing of torch.
"""

from __future__ import annotations

import importlib.util
import sys
import types


def main() -> int:
    """`staf-table`."""
    spec = importlib.util.find_spec("staf_torch")  # finds it, does not import it
    if spec is None or spec.submodule_search_locations is None:
        raise ModuleNotFoundError("staf_torch is not installed")
    package = types.ModuleType("staf_torch")
    package.__path__ = list(spec.submodule_search_locations)
    sys.modules["staf_torch"] = package
    command = importlib.import_module("staf_torch.report.command")
    code: int = command.main()
    return code
