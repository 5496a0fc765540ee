"""A new kernel, law, plant or controller touches three files: its own, its YAML, `tests/variants.py`."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

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


OWN = ROOT / "tests" / "examples" / "own"


def own(name: str) -> str:
    """A user's class of `tests/examples/own`, with the imports of its room."""
    text = (OWN / f"{name}.py").read_text(encoding="utf-8")
    return re.sub(r"^from staf_torch(\.\w+)? import", "from .base import", text, flags=re.MULTILINE)


ADDITIONS = {
    "kernel": Addition(
        {
            "staf_torch/kernels/cauchy.py": own("cauchy"),
            "conf/kernel/cauchy.yaml": "_target_: staf_torch.kernels.Cauchy\nwidth: 1.0\n",
        },
        (
            "KERNELS",
            '"cauchy": KernelCase(lambda: st.kernels.Cauchy(0.7), '
            "lambda y, c: 1 / (1 + (distance(y, c) / 0.7) ** 2)),",
        ),
    ),
    "law": Addition(
        {
            "staf_torch/optim/cautious.py": own("cautious"),
            "conf/optimizer/cautious.yaml": "_target_: staf_torch.optim.Cautious.from_settings\n"
            "share: 0.5\ninner_steps: 10\n",
        },
        ("LAWS", '"cautious": optim.Cautious(),'),
    ),
    "plant": Addition(
        {
            "staf_torch/systems/trolley.py": own("trolley"),
            "conf/system/trolley.yaml": "_target_: staf_torch.systems.Trolley\nmass: 1.0\n",
        },
        ("PLANTS", '"trolley": systems.Trolley,'),
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
    "kernel": ("kernel=cauchy", "kernel.width=0.8"),
    "law": ("optimizer=cautious", "optimizer.share=0.7"),
    "plant": ("system=trolley", "system.mass=2"),
    "controller": ("experiment=adp", "adp/policy=damping", "adp.compile=false", "system=trolley", "dt=0.01"),
}
PROPERTIES = ("test_variants.py", "test_modules.py", "test_rules.py", "kernels/test_kernels.py")
PROGRAM = """
import contextlib, io, json, runpy, sys, pytest
import staf_torch as st
from staf_torch.cli.table import main

def said(run, *given):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        run(*given)
    return out.getvalue()

def staf(*words):
    sys.argv = ["staf", *words]
    return said(lambda: runpy.run_module("staf_torch", run_name="__main__"))

tests = said(pytest.main, ["-n", "0", "-p", "no:cacheprovider", "-k", SELECTED, *PROPERTIES])
for line in LINES:
    staf(*line)
table = said(main, ["runs", "--format", "json"])
names = [*st.kernels.__all__, *st.optim.__all__, *st.systems.__all__]
print(json.dumps({"tests": tests, "table": table, "schema": staf("schema"), "names": names}))
"""


def test_each_has_the_properties_an_option_of_the_command_of_the_schema_and_of_tables_and_a_page(
    tmp_path: Path,
) -> None:
    """In a copy of this tree with all additions, each of three files."""
    for room in ("staf_torch", "conf", "tests"):
        shutil.copytree(ROOT / room, tmp_path / room, ignore=shutil.ignore_patterns("benchmarks"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for addition in ADDITIONS.values():
        assert len(addition.write(tmp_path)) == 3
    short = ("duration=0.05", "settle_time=0", "figures=false")
    lines = [[*short, *words, f"hydra.run.dir=runs/{name}"] for name, words in RUNS.items()]
    selected = " or ".join(("auchy", "autious", "rolley", "amping", "listed", "known_here"))
    properties = [str(Path("tests", name)) for name in PROPERTIES]
    given = f"LINES, SELECTED, PROPERTIES = {lines!r}, {selected!r}, {properties!r}"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (tmp_path, tmp_path / "staf_torch/plugins")))}
    line = [sys.executable, "-c", given + PROGRAM]
    ended = subprocess.run(line, cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout[-5000:] + ended.stderr[-5000:]
    found = json.loads(ended.stdout.splitlines()[-1])
    assert " failed" not in found["tests"], found["tests"][-5000:]
    assert int(found["tests"].split(" passed")[0].split()[-1]) > 30
    rows = json.loads(found["table"])
    assert len(rows) == len(RUNS)
    assert {"cauchy", "cautious", "trolley", "damping"} <= {str(v) for row in rows for v in row.values()}
    assert all(key in found["schema"] for key in ("kernels.Cauchy", "Cautious", "systems.Trolley", "Damping"))
    assert {"Cauchy", "Cautious", "Trolley"} <= set(found["names"])
