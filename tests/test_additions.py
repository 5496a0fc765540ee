"""A new kernel, law, plant or controller touches three files: its own, its YAML, `tests/variants.py`."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from command_line import ROOT


class Addition(NamedTuple):
    """Three files: name in the tree -> text, and what `tests/variants.py` gets."""

    files: dict[str, str]
    line: tuple[str, str]  # a table and an entry
    imported: str = ""

    def write(self, tree: Path) -> set[str]:
        """Add it to a tree; the files that this touches."""
        for name, text in self.files.items():
            assert not (tree / name).exists()
            (tree / name).write_text(text)
        variants, (table, line) = tree / "tests" / "variants.py", self.line
        lines = variants.read_text().splitlines()
        (at,) = [number for number, each in enumerate(lines) if each.startswith(f"{table}:")]
        lines.insert(at + 1, f"    {line}")
        lines.insert(lines.index("import staf_torch as st") + 1, self.imported)
        variants.write_text("\n".join(lines) + "\n")
        return {*self.files, "tests/variants.py"}


ADDITIONS = {
    "kernel": Addition(
        {
            "staf_torch/kernels/cauchy.py": '''"""The Cauchy kernel."""

from torch import Tensor

from .radial import RadialKernel


class CauchyKernel(RadialKernel):
    """k(y, c) = 1 / (1 + |y - c|^2 / length_scale^2)."""

    def profile(self, s: Tensor) -> Tensor:
        return 1 / (1 + s)
''',
            "conf/kernel/cauchy.yaml": "_target_: staf_torch.kernels.CauchyKernel\nlength_scale: 1.0\n",
        },
        (
            "KERNELS",
            '"cauchy": KernelCase(lambda: st.kernels.CauchyKernel(0.7), '
            "lambda y, c: 1 / (1 + (distance(y, c) / 0.7) ** 2)),",
        ),
    ),
    "law": Addition(
        {
            "staf_torch/optim/cautious.py": '''"""Half of the steps that `FixedStep` takes."""

from torch import Tensor

from ..numerics.checks import positive_real
from .base import LawState, UpdateLaw
from .fixed_step import over_lipschitz
from .objective import Objective


class Cautious(UpdateLaw):
    """a <- a + s g / L."""

    needs = frozenset({"extremes"})

    def __init__(self, share: float = 0.5) -> None:
        self.share = positive_real("Cautious", "share", share)

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        return weights + self.share * over_lipschitz(objective, objective.descent(weights)), state
''',
            "conf/optimizer/cautious.yaml": "_target_: staf_torch.optim.Cautious.from_settings\n"
            "share: 0.5\ninner_steps: 10\n",
        },
        ("LAWS", '"cautious": optim.Cautious(),'),
    ),
    "plant": Addition(
        {
            "staf_torch/systems/duffing.py": '''"""The forced Duffing oscillator."""

import torch
from torch import Tensor

from ..numerics.checks import real
from .base import ControlAffineSystem, Units


class Duffing(ControlAffineSystem):
    """x1' = x2,  x2' = -stiffness x1 - x1^3 - x2 + u."""

    dim = 2
    inputs = 1
    units = Units("m, m/s", "N")

    def __init__(self, stiffness: float = 1.0) -> None:
        super().__init__()
        self.stiffness = real("Duffing", "stiffness", stiffness)

    def drift(self, x: Tensor) -> Tensor:
        x1, x2 = x.unbind(-1)
        return torch.stack((x2, -self.stiffness * x1 - x1**3 - x2), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        zero = torch.zeros_like(x[..., 0])
        return torch.stack((zero, zero + 1), dim=-1).unsqueeze(-1)
''',
            "conf/system/duffing.yaml": "_target_: staf_torch.systems.Duffing\nstiffness: 1.0\n",
        },
        ("PLANTS", '"duffing": systems.Duffing,'),
    ),
    "controller": Addition(
        {
            "staf_torch/adp/policies/damping.py": '''"""Damping of the last coordinate."""

from torch import Tensor, nn

from ...numerics.checks import positive_real
from ..loop.controller import Feedback


class _Damper(nn.Module):
    def __init__(self, gain: float) -> None:
        super().__init__()
        self.gain = gain

    def forward(self, x: Tensor) -> Tensor:
        return -self.gain * x[..., -1:]


class Damping(Feedback):
    """u = -gain x_n."""

    def __init__(self, gain: float = 1.0) -> None:
        super().__init__(_Damper(positive_real("Damping", "gain", gain)))
''',
            "conf/adp/policy/damping.yaml": "_target_: staf_torch.adp.policies.damping.Damping\ngain: 2.0\n",
        },
        ("CONTROLLERS", '"damping": Damping,'),
        "from staf_torch.adp.policies.damping import Damping",
    ),
}
RUNS = {
    "kernel": ("kernel=cauchy", "kernel.length_scale=0.8"),
    "law": ("optimizer=cautious", "optimizer.share=0.7"),
    "plant": ("system=duffing", "system.stiffness=2"),
    "controller": ("experiment=adp", "adp/policy=damping", "adp.compile=false", "system=duffing", "dt=0.01"),
}
PROPERTIES = ("test_variants.py", "test_modules.py", "test_rules.py", "kernels/test_kernels.py")


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of this tree with all additions, each of three files."""
    base = tmp_path_factory.mktemp("copy")
    for room in ("staf_torch", "conf", "tests"):
        shutil.copytree(ROOT / room, base / room, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", base)
    for addition in ADDITIONS.values():
        assert len(addition.write(base)) == 3
    return base


def python(tree: Path, *words: str, into: Path | None = None) -> str:
    """The output of a program of the copy."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tree), str(tree / "staf_torch" / "plugins")])}
    ended = subprocess.run(
        [sys.executable, *words], cwd=into or tree, env=env, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stdout[-5000:] + ended.stderr[-5000:]
    return ended.stdout


def test_each_is_an_option_of_the_command_of_the_schema_and_of_tables(tree: Path, tmp_path: Path) -> None:
    short = ("duration=0.05", "settle_time=0", "figures=false")
    lines = {name: [*short, *words, f"hydra.run.dir=runs/{name}"] for name, words in RUNS.items()}
    program = f"""
import runpy, sys
for words in {list(lines.values())!r}:
    sys.argv = ["staf", *words]
    runpy.run_module("staf_torch", run_name="__main__")
"""
    python(tree, "-c", program, into=tmp_path)
    asked = "from staf_torch.cli.table import main; main(['runs', '--format', 'json'])"
    table = json.loads(python(tree, "-c", asked, into=tmp_path))
    assert len(table["rows"]) == len(RUNS)
    assert {"cauchy", "cautious", "duffing", "damping"} <= {
        str(v) for row in table["rows"] for v in row.values()
    }
    schema = python(tree, "-m", "staf_torch", "schema")
    assert all(key in schema for key in ("CauchyKernel", "Cautious", "systems.Duffing", "Damping"))


def test_each_is_held_to_the_properties_and_has_a_page(tree: Path) -> None:
    words = " or ".join(("auchy", "autious", "uffing", "amping", "listed", "known_here"))
    names = [str(Path("tests", name)) for name in PROPERTIES]
    said = python(tree, "-m", "pytest", "-n", "0", "-p", "no:cacheprovider", *names, "-k", words)
    assert int(said.split(" passed")[0].split()[-1]) > 40
    pages = "import staf_torch as st; print(*st.kernels.__all__, *st.optim.__all__, *st.systems.__all__)"
    assert {"CauchyKernel", "Cautious", "Duffing"} <= set(python(tree, "-c", pages).split())
