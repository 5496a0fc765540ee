"""Run the suite in environments of other versions and of other means.

    python tests/matrix.py [--quick] [--only lowest newest] [--tests tests/kernels] [--jobs 2] [--order SEED]

The committed tree counts, not the working one. Environments are built once below `--place` (by default
`~/.cache/staf_torch-matrix`, some gigabytes each) and used again: torch from the index brings CUDA. Each runs
the whole suite, with `--quick` the tests that touch versions and means, in an order by chance where a seed is
given, and writes NAME.log there. What cannot be built here is said, with the last line of pip. Last table:
`tests/README.md`.
"""

from __future__ import annotations

import argparse
import os
import pwd
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
TOOLS = (
    "pytest>=8",
    "pytest-xdist>=3.6",
    "pytest-cov>=7",
    "hypothesis>=6.100",
    "mpmath>=1.3",
    "hatchling>=1.25",
)
EXTRAS = ("scipy>=1.11", "gymnasium>=1.1", "gmpy2>=2.1")
COMPILERS = re.compile(r"(^|-)(cc|c\+\+|gcc|g\+\+|clang|clang\+\+|cpp|c89|c99|tcc|nvcc|icx|icpx)(-[\d.]+)?$")
LOWEST = (
    "torch==2.6.0",
    "numpy==1.26.0",
    "hydra-core==1.3.8",
    "matplotlib==3.8.0",
    "jinja2==3.1.0",
    "tqdm==4.66.0",
)
CORE = ("torch", "numpy", "matplotlib", "jinja2", "tqdm")
QUICK = (
    "tests/kernels",
    "tests/figures",
    "tests/settings",
    "tests/test_modules.py",
    "tests/test_variants.py",
    "tests/cli/test_cli_errors.py",
    "tests/lanes/test_program.py",
    "tests/engine/test_chase.py",
    "tests/approximation/test_layers_compiled.py",
    "tests/deploy/test_deploy.py",
)


class Environment(NamedTuple):
    """What the suite runs in."""

    about: str
    python: str | None = None  # its version; None for the interpreter that runs this, with what it has
    packages: Sequence[str] = ()
    compiler: bool = True
    privileged: bool = True
    processor: bool = True  # all that it can; else what one of ten years ago could, which rounds otherwise


ENVIRONMENTS = {
    "lowest": Environment("lowest declared versions", "3.11", (*LOWEST, *TOOLS, *EXTRAS)),
    "python312": Environment(
        "Python 3.12", "3.12", ("torch==2.9.1", "hydra-core<1.4", *CORE[1:], *TOOLS, *EXTRAS)
    ),
    "newest": Environment(
        "newest of everything, Hydra 1.4 candidate",
        "3.13",
        (*CORE, "hydra-core==1.4.0rc3", *TOOLS, *EXTRAS, "onnx", "onnxscript", "onnxruntime"),
    ),
    "no_extras": Environment("no extras", "3.11", ("torch==2.13.0", *CORE[1:], "hydra-core<1.4", *TOOLS)),
    "no_compiler": Environment("no C or C++ compiler on the path", compiler=False),
    "unprivileged": Environment("another user, home read-only", privileged=False),
    "older_processor": Environment("no AVX-512; compiled without fused operations", processor=False),
}


class Outcome(NamedTuple):
    """What a run of the suite said."""

    versions: str
    said: str
    failed: Sequence[str]
    seconds: float


def main() -> int:
    """Run the command line; the exit code is 1 where an environment is not green."""
    options = _options()
    place = Path(options.place)
    place.mkdir(parents=True, exist_ok=True)
    outcomes: dict[str, Outcome | str] = {}
    tree = Path(tempfile.mkdtemp(prefix="staf-matrix-tree-"))  # a copy: nobody edits it while tests run
    tree.chmod(0o755)
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, capture_output=True, check=True)
    subprocess.run(["tar", "-x", "-C", str(tree)], input=archive.stdout, check=True)
    for name in options.only or ENVIRONMENTS:
        environment = ENVIRONMENTS[name]
        try:
            python = _interpreter(name, environment, place)
        except OSError as error:
            outcomes[name] = f"not to be had here: {error}"
        else:
            tests = QUICK if options.quick else options.tests
            more = ["-n", str(options.jobs), "--dist", "worksteal"] if options.jobs > 1 else []
            more += [] if options.order is None else ["--order", str(options.order)]
            outcomes[name] = _run(environment, python, tree, [*more, *tests], place / f"{name}.log")
        print(_row(name, outcomes[name]), flush=True)
    shutil.rmtree(tree, ignore_errors=True)
    print(f"\n| environment | versions | {time.strftime('%Y-%m-%d')}{', quick' if options.quick else ''} |")
    print("|---|---|---|")
    for name, outcome in outcomes.items():
        print(_row(name, outcome))
    return int(any(isinstance(outcome, str) or outcome.failed for outcome in outcomes.values()))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a subset of the suite")
    parser.add_argument("--tests", nargs="*", default=["tests"], help="that are run; all by default")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--order", type=int, default=None, help="seed of an order by chance")
    parser.add_argument("--only", nargs="*", choices=[*ENVIRONMENTS], help="environments; all by default")
    parser.add_argument("--place", default=str(Path.home() / ".cache" / "staf_torch-matrix"))
    return parser.parse_args()


def _interpreter(name: str, environment: Environment, place: Path) -> Path:
    """The environment's interpreter; its packages are installed where that has not been done.

    Raises:
        OSError: if there is no such Python, or pip does not find the packages.
    """
    if environment.python is None:
        return Path(sys.executable)
    folder, done = place / name, place / name / "installed.txt"
    wanted = "\n".join(environment.packages)
    if not done.exists() or done.read_text() != wanted:
        subprocess.run([str(_python(environment.python)), "-m", "venv", "--clear", str(folder)], check=True)
        line = [str(folder / "bin" / "pip"), "install", "-q", *environment.packages]
        ended = subprocess.run(line, capture_output=True, text=True, check=False)
        if ended.returncode != 0:
            raise OSError((ended.stderr.strip() or "pip failed").splitlines()[-1])
        done.write_text(wanted)
    return folder / "bin" / "python"


def _python(version: str) -> Path:
    found = shutil.which(f"python{version}")
    kept = sorted((Path.home() / ".pyenv" / "versions").glob(f"{version}.*/bin/python"))
    if found is None and not kept:
        raise OSError(f"no Python {version}")
    return kept[-1] if kept else Path(str(found))


def _run(environment: Environment, python: Path, tree: Path, arguments: Sequence[str], log: Path) -> Outcome:

    with (
        tempfile.TemporaryDirectory(prefix="staf-matrix-") as scratch,
        _home(environment, Path(scratch)) as home,
    ):
        settings = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", **home}
        line = [str(python), "-m", "pytest", "-p", "no:cacheprovider", "--tb=short", *arguments]
        user = None if environment.privileged else "nobody"
        begun = time.monotonic()
        with log.open("w") as output:  # to be read while it runs
            code = subprocess.run(
                line, cwd=tree, env=settings, stdout=output, stderr=output, check=False, user=user
            ).returncode
    told = log.read_text()
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", told, re.MULTILINE)
    ends = re.findall(r"^=* ?(\d+ \w+.* in [\d.]+s.*?)=*$", told, re.MULTILINE)
    said = (ends or told.strip().splitlines() or ["nothing"])[-1]
    if code != 0:
        sys.stderr.write(told[-20000:])
        failed = failed or ["pytest itself"]
    return Outcome(_versions(python), said.strip("= "), failed, time.monotonic() - begun)


@contextmanager
def _home(environment: Environment, scratch: Path) -> Iterator[dict[str, str]]:
    """Variables of the environment: where programs are found, where a user may write."""
    changed: dict[str, str] = {}
    if not environment.compiler:
        programs = scratch / "bin"
        programs.mkdir()
        for folder in os.environ["PATH"].split(os.pathsep):
            for found in Path(folder).glob("*"):
                place = programs / found.name
                if found.is_file() and not COMPILERS.search(found.name) and not place.is_symlink():
                    place.symlink_to(found)
        changed |= {"PATH": str(programs), "CXX": "", "CC": "", "XDG_CACHE_HOME": str(scratch / "cache")}
    if not environment.processor:
        # torch's own loops, those of its linear algebra, and what is compiled here.
        wrapper, program = scratch / "g++", shutil.which("g++") or ""
        wrapper.write_text(f'#!/bin/bash\nexec {program} "${{@/-march=native/-march=x86-64-v2}}"\n')
        wrapper.chmod(0o755)
        changed |= {"ATEN_CPU_CAPABILITY": "avx2", "MKL_ENABLE_INSTRUCTIONS": "AVX2"}
        changed |= {"CXX": str(wrapper), "XDG_CACHE_HOME": str(scratch / "cache")}
    if not environment.privileged:
        home, temporary = scratch / "home", scratch / "tmp"
        home.mkdir(mode=0o555)
        temporary.mkdir()
        scratch.chmod(0o755)
        os.chown(temporary, pwd.getpwnam("nobody").pw_uid, -1)
        unset = ("XDG_CACHE_HOME", "MPLCONFIGDIR")
        changed |= {"HOME": str(home), "TMPDIR": str(temporary), **dict.fromkeys(unset, "")}
    yield changed


def _versions(python: Path) -> str:
    program = (
        "import platform; from importlib.metadata import version as v\n"
        "print('Python', platform.python_version(), *(f'{n} {v(n)}' for n in "
        "('torch', 'numpy', 'hydra-core', 'matplotlib')), sep=', ')"
    )
    return subprocess.run(
        [str(python), "-c", program], capture_output=True, text=True, check=True
    ).stdout.strip()


def _row(name: str, outcome: Outcome | str) -> str:
    about = ENVIRONMENTS[name].about
    if isinstance(outcome, str):
        return f"| {about} | - | {outcome} |"
    failing = f"; failing: {', '.join(outcome.failed[:5])}" if outcome.failed else ""
    return f"| {about} | {outcome.versions} | {outcome.said}{failing} |"


if __name__ == "__main__":
    sys.exit(main())
