"""`staf doctor`: what a report of a problem should say, and a self-test whose number is known."""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from .. import __version__
from ..approximation.basis import StaFBasis
from ..centers import StateFollowingCenters, rings
from ..engine import chase
from ..kernels import ExponentialKernel
from ..lanes import Program
from ..lanes.compilation.cache import cache
from ..lanes.compilation.compiler import find_compiler
from ..lanes.device.cuda import kernel_compiler
from ..optim import SteepestDescent
from ..results.build import installed
from ..signs import printed
from ..systems import Oscillator, simulate
from ..targets import Paper

_PACKAGES = ("torch", "numpy", "hydra-core", "omegaconf", "matplotlib", "scipy", "pandas", "pyarrow")
_EXPECTED = 6.23712254984
"""Excess of the self-test at its last time."""
_TOLERANCE = 1e-6  # relative


def main(words: Sequence[str] = ()) -> int:
    """Print one line a finding; return 0 if the self-test has its number and all places can be written.

    Raises:
        ValueError: if there are words: it takes none.
    """
    if words:
        raise ValueError(f"`staf doctor` takes no arguments; got {words[0]!r}.")
    sound = True
    for name, found, good in _findings():
        printed(f"{name + ':':<12}{found}{'' if good else '   <- problem'}\n")
        sound = sound and good
    return 0 if sound else 1


def _findings() -> Iterator[tuple[str, str, bool]]:
    yield "staf_torch", f"{__version__} in {Path(__file__).resolve().parent.parent}", True
    yield "python", f"{platform.python_version()}, {platform.platform()}", True
    yield "packages", ", ".join(f"{name} {installed(name) or '-'}" for name in _PACKAGES), True
    yield "compiler", find_compiler() or "none: everything runs in plain torch, slower", True
    cores = os.cpu_count()
    set_by = os.environ.get("OMP_NUM_THREADS", "not set")
    yield "threads", f"{torch.get_num_threads()} of torch, {cores} cores, OMP_NUM_THREADS {set_by}", True
    yield "gpu", *_gpu()
    for name in ("sbatch", "squeue", "sacct"):  # of SLURM, by which sweeps run on a cluster
        yield name, shutil.which(name) or "not found: no SLURM here", True
    for name in ("submitit", "ray"):
        extra = "slurm" if name == "submitit" else name
        missing = (
            f"not installed: pip install -e '.[{extra}]' in the clone for hydra.launcher.executor={name}"
        )
        yield name, installed(name) or missing, True
    for name, place in (("cache", cache()), ("runs", Path("runs")), ("scratch", Path(tempfile.gettempdir()))):
        yield name, *_place(place)
    yield "self-test", *_self_test()


def _gpu() -> tuple[str, bool]:
    """Return the card, what compiles kernels for it, and whether one has run: a row of a program."""
    if not torch.cuda.is_available():
        return "none", True
    name, carry = torch.cuda.get_device_name(), torch.ones(2, dtype=torch.float64, device="cuda")
    program = Program(lambda x, now, row: (x + 0.5 * x.sin(), ()), name="the self-test of a card")
    found, wanted = program(carry, steps=3)[0].cpu(), program.definition(carry.cpu(), steps=3)[0]
    if not program.compiles(carry, steps=3):
        return f"{name}, no kernel has run: the log above says what is missing", False
    good = torch.allclose(found, wanted, rtol=1e-12, atol=0)
    return f"{name}, kernels by {kernel_compiler()}, one has run{'' if good else ' and is wrong'}", good


def _place(folder: Path) -> tuple[str, bool]:
    """Return the folder, and whether it, or the folder in which it would be made, can be written."""
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    wrong = ", not a folder" if not there.is_dir() else "" if os.access(there, os.W_OK) else ", read-only"
    files = sum(1 for path in folder.glob("*.so")) if folder.is_dir() else 0
    return f"{folder.absolute()}{f', {files} libraries' if files else ''}{wrong}", not wrong


def _self_test() -> tuple[str, bool]:
    """Run the paper's chase for a second of its time and compare the excess at the end."""
    start = time.perf_counter()
    basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), radius=0.1))
    x = torch.tensor([[1.0, 0.0]], dtype=torch.float64, device="cpu")
    states = simulate(Oscillator(), x, dt=0.01, steps=100)
    found = float(chase(states, basis, Paper(), SteepestDescent(), inner_steps=10).excess[0, -1])
    good = abs(found - _EXPECTED) <= _TOLERANCE * _EXPECTED
    return f"{found:.12g}, expected {_EXPECTED:.12g}, in {time.perf_counter() - start:.1f} s", good
