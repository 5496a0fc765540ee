"""The suite with other versions, processors and means.

    nox -f tests/noxfile.py [-s lowest "processor(avx2)" ...] [-- TESTS]

`pip install nox`; environments are made below `tests/.nox`, and used again with `-R`: torch from the index
brings CUDA, some gigabytes each. What cannot be had here is skipped, with the reason. Last results:
`tests/README.md`.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from pathlib import Path

import nox

ROOT = Path(__file__).resolve().parent.parent
TOOLS = "pytest>=8 pytest-xdist>=3.6 pytest-cov>=7 hypothesis>=6.100 mpmath>=1.3 hatchling>=1.25"
EXTRAS = "scipy>=1.11 gymnasium>=1.1 gmpy2>=2.1"
FURTHER = "onnx onnxscript onnxruntime casadi"
CORE = "numpy matplotlib jinja2"
LOWEST = "torch==2.6.0 numpy==1.26.0 hydra-core==1.3.8 matplotlib==3.8.0 jinja2==3.1.0"
VERSIONS = {
    "lowest": ("3.11", f"{LOWEST} {TOOLS} {EXTRAS}"),
    "python312": ("3.12", f"torch==2.9.1 hydra-core<1.4 {CORE} {TOOLS} {EXTRAS}"),
    "newest": ("3.13", f"torch hydra-core==1.4.0rc3 {CORE} {TOOLS} {EXTRAS} {FURTHER}"),
    "no_extras": ("3.11", f"torch==2.13.0 hydra-core<1.4 {CORE} {TOOLS}"),
}
PROCESSORS = {  # what programs are compiled for; what torch's own loops use; what its linear algebra does
    "no_avx": "CXXFLAGS=-march=x86-64-v2 ATEN_CPU_CAPABILITY=default MKL_ENABLE_INSTRUCTIONS=SSE4_2",
    "avx2": "CXXFLAGS=-march=x86-64-v3 ATEN_CPU_CAPABILITY=avx2 MKL_ENABLE_INSTRUCTIONS=AVX2",
    "avx512": "CXXFLAGS=-march=x86-64-v4 ATEN_CPU_CAPABILITY=avx512",
    "clang": "CXX=clang++",
}
COMPILERS = re.compile(r"(^|-)(cc|c\+\+|gcc|g\+\+|clang|clang\+\+|cpp|c89|c99|tcc|nvcc|icx|icpx)(-[\d.]+)?$")


def suite(session: nox.Session, *before: str, **variables: str) -> None:
    """Run the tests named behind `--`, all by default, with a cache of programs of their own."""
    session.chdir(ROOT)
    line = [*before, "python", "-m", "pytest", "-p", "no:cacheprovider", "--tb=short"]
    with tempfile.TemporaryDirectory(prefix="staf-nox-") as scratch:
        Path(scratch).chmod(0o777)
        path = f"{ROOT}{os.pathsep}{ROOT}/staf_torch/plugins"
        own = {"PYTHONPATH": path, "XDG_CACHE_HOME": scratch, "TMPDIR": scratch, "OMP_NUM_THREADS": "1"}
        session.run(*line, *(session.posargs or ["tests"]), env=own | variables, external=True)


@nox.session(python=False)
@nox.parametrize("name", list(PROCESSORS), ids=list(PROCESSORS))
def processor(session: nox.Session, name: str) -> None:
    """Another processor or compiler, with the packages that are here."""
    if name == "avx512" and "avx512f" not in Path("/proc/cpuinfo").read_text(encoding="utf-8"):
        session.skip("this processor has no AVX-512")
    if name == "clang" and shutil.which("clang++") is None:
        session.skip("no clang++ here")
    suite(session, **dict(pair.split("=", 1) for pair in PROCESSORS[name].split()))


@nox.session(python=False)
def no_compiler(session: nox.Session) -> None:
    """No C or C++ compiler on the path."""
    programs = Path(session.create_tmp()).resolve() / "bin"
    shutil.rmtree(programs, ignore_errors=True)
    programs.mkdir()
    for found in (each for folder in os.environ["PATH"].split(os.pathsep) for each in Path(folder).glob("*")):
        place = programs / found.name
        if found.is_file() and not COMPILERS.search(found.name) and not place.is_symlink():
            place.symlink_to(found)
    suite(session, PATH=str(programs), CXX="", CC="")


@nox.session(python=False)
def unprivileged(session: nox.Session) -> None:
    """Another user, whose home cannot be written."""
    if os.getuid() != 0:
        session.skip("only root becomes another user")
    suite(session, "runuser", "-u", "nobody", "--", HOME="/", XDG_CACHE_HOME="", MPLCONFIGDIR="")


def _of_versions(name: str) -> None:
    python, packages = VERSIONS[name]

    @nox.session(name=name, python=python)
    def session_of(session: nox.Session) -> None:
        session.install(*packages.split())
        suite(session)


for _name in VERSIONS:
    _of_versions(_name)
