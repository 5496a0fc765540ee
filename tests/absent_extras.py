"""Tests of what is not installed are skipped: a plugin of `conftest.py`.

The library names the extra that it lacks (`pip install 'staf_torch[adp]'`), an import names its module. Where
that is really absent, a test, or a file of tests, that ends so says nothing of the library.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator

import pytest

EXTRAS = {
    **{"adp": "scipy", "tables": "pyarrow", "tensorboard": "tensorboard", "onnx": "onnx", "rivals": "casadi"},
    **{"gym": "gymnasium", "mujoco": "mujoco", "docs": "mkdocs"},
}
_TOOLS = ("jsonschema", "pandas", "onnxscript", "onnxruntime")  # of the extra `dev`, imported by tests alone
_HINT = re.compile(r"staf_torch\[(\w+)\]")


def reason(error: BaseException | None) -> str | None:
    """Return which extra an exception, or what it came of, says to be missing; None where it is installed."""
    seen = set[int]()
    while error is not None and id(error) not in seen:  # a chain may be a ring
        seen.add(id(error))
        names = {EXTRAS.get(extra, "") for extra in _HINT.findall(f"{error} {getattr(error, 'stderr', '')}")}
        if isinstance(error, ModuleNotFoundError) and error.name is not None:
            names.add(error.name.partition(".")[0])
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
    why = reason(call.excinfo.value) if report.failed and call is not None and call.excinfo else None
    if why is not None:
        report.outcome = "skipped"
        path, line, _ = getattr(report, "location", (str(getattr(report, "nodeid", "")), 0, ""))
        report.longrepr = (str(path), line or 0, f"Skipped: {why}")
