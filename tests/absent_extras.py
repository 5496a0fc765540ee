"""Tests of what is not installed are skipped, and nothing else is.

The library names the extra that it lacks (`pip install 'staf_torch[adp]'`), an import names its module. Where
that extra is really absent, a test or a file of tests that ends so says nothing of the library: an error of
an import, one that was raised within the package, or a failure that quotes what a process said of the extra
before it ended with an error. That a test itself writes of the extra is no reason.
"""

from __future__ import annotations

import importlib.util
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

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
_SAID = re.compile(r"[^\n]{1,40}staf_torch\[\w+\]")  # the hint, and what names whose it is
_PACKAGE = str(Path(__file__).resolve().parent.parent / "staf_torch")
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
        text = str(error)
        told = [text] if _raised_in_the_package(error) else [said for said in _heard if said in text]
        names.update(EXTRAS.get(extra, "") for each in told for extra in _HINT.findall(each))
        for name in sorted(names & {*EXTRAS.values(), *_TOOLS}):
            if importlib.util.find_spec(name) is None:
                return f"{name} is not installed"
        error = error.__cause__ or error.__context__
    return None


def _raised_in_the_package(error: BaseException) -> bool:
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is not None and trace.tb_frame.f_code.co_filename.startswith(_PACKAGE)


_heard: set[str] = set()


def heard(code: int | None, *texts: object) -> None:
    """Remember what a process said of an extra that it lacks, where it ended with an error.

    Args:
        code: of its end.
        texts: what it wrote, as text or bytes; None is skipped.
    """
    for text in texts if code else ():
        said = text.decode(errors="replace") if isinstance(text, bytes) else str(text)
        _heard.update(_SAID.findall(said))


_communicate = subprocess.Popen.communicate


def _communicate_and_hear(process: subprocess.Popen[Any], *args: Any, **options: Any) -> tuple[Any, Any]:
    found = _communicate(process, *args, **options)
    heard(process.returncode, *found)
    return found


subprocess.Popen.communicate = _communicate_and_hear  # type: ignore[assignment]


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
