"""What `import staf_torch` brings, and what it must not."""

from __future__ import annotations

import ast
import subprocess
import sys

import pytest
from command_line import environment

import staf_torch
from staf_torch.numerics import checks as _checks

PUBLIC = (
    "StaF",
    "StaFBasis",
    "StaFRegressor",
    "ExperienceMemory",
    "ExponentialKernel",
    "GaussianKernel",
    "MaternKernel",
    "InverseMultiquadricKernel",
    "RationalQuadraticKernel",
    "PolynomialKernel",
    "AnchoredKernel",
    "StateFollowingCenters",
    "ConstantRadius",
    "StateRadius",
    "rings",
    "polygon",
    "simplex",
    "cross_polytope",
    "ball",
    "chase",
    "ChaseResult",
    "optim",
    "systems",
    "targets",
)


@pytest.mark.parametrize("name", PUBLIC)
def test_public_name_is_there(name: str) -> None:
    assert hasattr(staf_torch, name)


def test_calling_the_package_name_chase_runs_a_chase() -> None:
    """The function and the subpackage share the name; users get the function."""
    assert callable(staf_torch.chase)


def test_every_name_that_type_checkers_see_is_listed_and_can_be_had() -> None:
    with open(staf_torch.__file__, encoding="utf-8") as file:
        tree = ast.parse(file.read())
    (block,) = [
        node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    ]
    named = {a.asname for node in block.body if isinstance(node, ast.ImportFrom) for a in node.names}
    commands = {"read_runs", "run", "sweep"}  # with which `import *` would import Hydra
    assert set(PUBLIC) <= named - commands == set(staf_torch.__all__) <= named <= set(dir(staf_torch))
    assert all(getattr(staf_torch, str(name)) is not None for name in named)


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'Staf'"):
        _ = staf_torch.Staf


def loaded_by(program: str) -> set[str]:
    """The top-level modules that are loaded at the end of a program."""
    program += "\nimport sys; print(*{name.partition('.')[0] for name in sys.modules})"
    line = [sys.executable, "-W", "error", "-c", program]
    ended = subprocess.run(line, env=environment(), capture_output=True, text=True, check=True)
    return set(ended.stdout.split())


RENAMED = """
import warnings, staf_torch
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    from staf_torch.chase import chase_weights
assert said and callable(chase) and callable(staf_torch.chase) and callable(chase_weights)
"""
"""`chase` was a package once: it stays a function after an import from there."""


def test_importing_the_library_imports_no_hydra_and_no_matplotlib() -> None:
    loaded = loaded_by("from staf_torch import *\nStaF, adp, chase" + RENAMED)
    assert "torch" in loaded
    assert loaded.isdisjoint({"hydra", "omegaconf", "matplotlib", "antlr4"})


def test_the_command_for_tables_imports_nothing_that_is_slow() -> None:
    loaded = loaded_by(
        "from staf_torch.cli.table import main\ntry: main(['--version-of-nothing'])\nexcept SystemExit: pass"
    )
    assert "staf_torch" in loaded
    assert loaded.isdisjoint({"torch", "numpy", "hydra", "omegaconf", "matplotlib", "pandas", "jinja2"})


def test_a_sentence_names_call_rule_and_value() -> None:
    error = _checks.fail("Call", "name", "must be so", 3)
    assert isinstance(error, ValueError)
    assert str(error) == "`Call(name=...)` must be so; got 3."
