"""The examples in the docstrings of public names do what they say; `test_structure.py` asks each for one.

They begin where a reader does: after `import torch`, `from pathlib import Path`, `from staf_torch import *`,
and the names of the package that the name itself is in.
"""

from __future__ import annotations

import doctest
import functools
import inspect
from pathlib import Path

import pytest
from public_names import public
from recorded import Record

from staf_torch.lanes import build
from staf_torch.sweeps.python_api import sweep
from staf_torch.sweeps.runs import Runs

PUBLIC = public()


RUNS = ("results", "sweeps", "tables")  # examples of these rooms run simulations of hundreds of steps
COMPILE = ("staf_torch.deploy.c_header.time_c", "staf_torch.lanes.function.ready")  # their examples do


def asked(name: str) -> object:
    """A name, whose chases are compiled where its example has long ones."""
    return pytest.param(name, marks=[pytest.mark.compiled] if name.split(".")[1] in RUNS else [])


@functools.cache
def kept(*lines: str) -> Runs:
    """What examples of tables and runs begin with: they only read it."""
    return sweep(*lines)


def swept(*lines: str, **places: str) -> Runs:
    return sweep(*lines, **places) if places else kept(*lines)


@pytest.mark.parametrize("name", [asked(name) for name in PUBLIC])
def test_the_example_of_a_name_does_what_it_says(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record: Record
) -> None:
    monkeypatch.chdir(tmp_path)
    if name in COMPILE and not build.compiler():
        pytest.skip("needs a C++ compiler")
    thing, names = PUBLIC[name]
    if thing is not sweep and names.get("sweep") is sweep:
        names = {**names, "sweep": swept}
    text = inspect.cleandoc(thing.__doc__ or "")
    test = doctest.DocTestParser().get_doctest(text, dict(names), name, None, None)
    said: list[str] = []
    runner = doctest.DocTestRunner(verbose=False, optionflags=doctest.ELLIPSIS)
    runner.run(test, out=said.append, clear_globs=False)
    assert said == [], "".join(said)
    left = {key: value for key, value in test.globs.items() if key not in names and not key.startswith("__")}
    record(left, rtol=1e-5, texts=False)  # they name versions and folders
