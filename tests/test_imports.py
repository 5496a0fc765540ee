"""What `import staf_torch` brings, and what it must not."""

from __future__ import annotations

import subprocess
import sys

import pytest
from command_line import ROOT, environment

import staf_torch
from staf_torch import _checks

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


def test_importing_the_library_imports_no_hydra_and_no_matplotlib() -> None:
    program = "import sys, staf_torch; print(*{name.partition('.')[0] for name in sys.modules})"
    line = [sys.executable, "-W", "error", "-c", program]
    ended = subprocess.run(line, env=environment(), capture_output=True, text=True, check=True)
    loaded = set(ended.stdout.split())
    assert "torch" in loaded
    assert loaded.isdisjoint({"hydra", "omegaconf", "matplotlib", "antlr4"})


def test_the_command_for_tables_imports_no_torch() -> None:
    code = (
        "import sys, runpy; sys.argv = ['staf-table', '--version-of-nothing'];"
        "main = runpy.run_path(sys.orig_argv[-1])['main']\n"
        "try: main()\n"
        "except SystemExit: print(*{name.partition('.')[0] for name in sys.modules})"
    )
    line = [sys.executable, "-W", "error", "-c", code, str(ROOT / "staf_torch" / "report" / "staf_table.py")]
    ended = subprocess.run(line, env=environment(), capture_output=True, text=True, check=True)
    loaded = set(ended.stdout.split())
    assert "staf_torch" in loaded
    assert loaded.isdisjoint({"torch", "hydra", "omegaconf", "matplotlib", "pandas"})


def test_a_sentence_names_call_rule_and_value() -> None:
    error = _checks.fail("Call", "name", "must be so", 3)
    assert isinstance(error, ValueError)
    assert str(error) == "`Call(name=...)` must be so; got 3."
