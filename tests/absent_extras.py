"""Tests of what is not installed are skipped, and nothing else is.

The library names the extra that it lacks (`pip install 'staf_torch[adp]'`), an import names its module. Where
that extra is really absent, a test or a file of tests that ends so says nothing of the library.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from types import TracebackType

import pytest

EXTRAS = {
    "adp": "scipy",
    "tables": "pyarrow",
    "tensorboard": "tensorboard",
    "onnx": "onnx",
    "rivals": "casadi",
    "gym": "gymnasium",
    "mujoco": "mujoco",
    "docs": "pdoc",
}
_TOOLS = ("jsonschema", "pandas", "onnxscript", "onnxruntime")  # of the extra `dev`, imported by tests alone
_HINT = re.compile(r"staf_torch\[(\w+)\]")
Raised = tuple[type[BaseException], BaseException, TracebackType | None]


def reason(error: BaseException | None) -> str | None:
    """Return why an exception says nothing of the library: an extra that is not here; None where it does.

    Args:
        error: and what it was raised from.
    """
    while error is not None:
        names = set()
        if isinstance(error, ModuleNotFoundError) and error.name is not None:
            names.add(error.name.partition(".")[0])
        names.update(EXTRAS.get(extra, "") for extra in _HINT.findall(str(error)))
        for name in sorted(names & {*EXTRAS.values(), *_TOOLS}):
            if importlib.util.find_spec(name) is None:
                return f"{name} is not installed"
        error = error.__cause__ or error.__context__
    return None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    report = yield
    _forgive(report, call)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[None]:
    report = yield
    _forgive(report, getattr(report, "call", None))
    return report


def _forgive(report: pytest.TestReport | pytest.CollectReport, call: pytest.CallInfo[object] | None) -> None:
    if not report.failed or call is None or call.excinfo is None:
        return
    why = reason(call.excinfo.value)
    if why is not None:
        report.outcome = "skipped"
        path, line, _ = getattr(report, "location", (str(getattr(report, "nodeid", "")), 0, ""))
        report.longrepr = (str(path), line or 0, f"Skipped: {why}")
