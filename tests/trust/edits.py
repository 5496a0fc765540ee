"""Something is edited between start and resume of a sweep: `python tests/trust/edits.py [--edits 30]`.

A sweep of three jobs loses its last one; then a setting, the package's own settings or source, an override,
the version, torch or a module of the user's own changes, drawn at random, and the sweep is taken up again.
That must be refused in words that name what has changed, and no job may run. Without an edit (a file is
written again as it was) it must go on.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import random
import re
import shutil
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
os.environ["OMP_NUM_THREADS"] = "1"  # torch's threads do not survive a fork

MODULES = {
    "bowls": "import importlib\nfrom bowl_helper import SCALE\n"
    "OTHER = importlib.import_module('bowl_' + 'extra')\n\n"
    "def bowl(x):\n    return SCALE * OTHER.SCALE * x.square().sum(-1) + 0.5\n",
    "bowl_helper": "SCALE = 1.5\n",
    "bowl_extra": "SCALE = 2.5\n",
}
MINE = "# @package _global_\ntask: gradient_chase\nspread: 0.5\ndt: 0.01\ntrajectories: 2\nsettle_time: 0.0\n"
LINE = ["experiment=mine", "target=custom", "target.path=bowls.bowl", "seed=0,1,2", "centers.radius=0.2"]
LINE += ["duration=0.05", "figures=false", "history=false"]
Edit = tuple[str, list[str], dict[str, str]]  # what is told, further arguments, patches


def command(place: Path, *line: str, patches: dict[str, str] | None = None) -> tuple[int, str]:
    """`staf -m` in a process forked from this one: exit code, and what it said."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        said, code = io.StringIO(), 0
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            try:
                from staf_torch.cli import staf
                from staf_torch.results import build

                for name, value in (patches or {}).items():
                    setattr(build, name, lambda value=value: value)
                os.chdir(place)
                sys.argv = ["staf", "-m", "--config-dir", "conf", *line]
                staf.main()
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else int(end.code is not None)
                said.write(str(end.code))
            except BaseException:
                code = 99
                traceback.print_exc()
        with os.fdopen(write, "w") as out:
            out.write(said.getvalue())
        os._exit(code)
    os.close(write)
    with os.fdopen(read) as text:
        found = text.read()
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), found


def another_number(path: Path, chance: random.Random, pattern: str = r"\d+\.\d+") -> str:
    """Change one number of a file; return what stood before it."""
    text = path.read_text()
    hit = chance.choice(list(re.finditer(pattern, text)))
    changed = str(round((float(hit[0]) + 0.01) * chance.uniform(1.1, 3), 4))  # also where it is zero
    path.write_text(text[: hit.start()] + changed + text[hit.end() :])
    return text[: hit.start()].splitlines()[-1]


def a_setting(place: Path, package: Path, chance: random.Random) -> Edit:
    return another_number(place / "conf" / "experiment" / "mine.yaml", chance).strip(": "), [], {}


def a_further_setting(place: Path, package: Path, chance: random.Random) -> Edit:
    key, value = chance.choice(
        [("certificate", "true"), ("initial_state", "[0.5, 0.25]"), ("dtype", "float32")]
    )
    path = place / "conf" / "experiment" / "mine.yaml"
    path.write_text(path.read_text() + f"{key}: {value}\n")
    return key, [], {}


def the_packages_settings(place: Path, package: Path, chance: random.Random) -> Edit:
    name, key = chance.choice(
        [
            ("optimizer/steepest_descent", "inner_steps"),
            ("centers/rings", "count"),
            ("system/oscillator", "frequency"),
        ]
    )
    path = package / "conf" / f"{name}.yaml"
    text = path.read_text()
    found = re.search(rf"{key}: (\S+)", text)
    assert found is not None
    path.write_text(text.replace(found[0], f"{key}: {6 if key == 'count' else float(found[1]) + 1:g}"))
    return key, [], {}


def the_source(place: Path, package: Path, chance: random.Random) -> Edit:
    path = chance.choice(
        sorted((package / "staf_torch").rglob("*.[ch]pp")) + sorted((package / "staf_torch").rglob("*.py"))
    )
    path.write_text(
        path.read_text() + chance.choice(["# further\n" if path.suffix == ".py" else "// further\n", "\n"])
    )
    return "the source of staf_torch", [], {}


def an_override(place: Path, package: Path, chance: random.Random) -> Edit:
    line = list(LINE)
    at = chance.choice([3, 4, 5])
    key = line[at].partition("=")[0]
    line[at] = {3: "seed=0,1,2,3", 4: "centers.radius=0.3", 5: "duration=0.06"}[at]
    return key, line, {}


def the_overrides_on_disk(place: Path, package: Path, chance: random.Random) -> Edit:
    path = place / "sweep" / "sweep.json"
    found = json.loads(path.read_text())
    found["overrides"] = [
        f"centers.radius={chance.uniform(0.3, 0.5):.3f}" if "radius" in line else line
        for line in found["overrides"]
    ]
    path.write_text(json.dumps(found))
    return "centers.radius", [], {}


def the_version(place: Path, package: Path, chance: random.Random) -> Edit:
    path = place / "sweep" / "sweep.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version": f"0.0.{chance.randrange(9)}"}))
    return "version", [], {}


def another_torch(place: Path, package: Path, chance: random.Random) -> Edit:
    return "torch was", [], {"_torch": f"2.{chance.randrange(20, 99)}.0"}


def a_module(place: Path, package: Path, chance: random.Random) -> Edit:
    name = chance.choice(list(MODULES))
    another_number(place / f"{name}.py", chance)
    return f"the module {name} has changed", [], {}


def nothing(place: Path, package: Path, chance: random.Random) -> Edit:
    path = chance.choice(
        [place / "bowls.py", place / "conf" / "experiment" / "mine.yaml", package / "staf_torch" / "basis.py"]
    )
    if path.exists():
        path.write_text(path.read_text())
    return "", [], {}


KINDS: list[Callable[[Path, Path, random.Random], Edit]] = [
    *(a_setting, a_further_setting, the_packages_settings, the_source, an_override),
    *(the_overrides_on_disk, the_version, another_torch, a_module, a_module),
]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--edits", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    chance, told, quiet = random.Random(chosen.seed), 0, 0
    with tempfile.TemporaryDirectory(prefix="edits.") as base:
        package, place = Path(base) / "package", Path(base) / "place"
        for name in ("staf_torch", "conf"):
            shutil.copytree(ROOT / name, package / name, ignore=shutil.ignore_patterns("__pycache__"))
        sys.path.insert(0, str(package))
        sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != ROOT]
        import torch._dynamo  # noqa: F401

        import staf_torch.experiments.gradient_chase

        assert staf_torch.__file__ == str(package / "staf_torch" / "__init__.py")
        (place / "conf" / "experiment").mkdir(parents=True)
        (place / "conf" / "experiment" / "mine.yaml").write_text(MINE)
        for name, text in MODULES.items():
            (place / f"{name}.py").write_text(text)
        code, said = command(place, *LINE, "hydra.sweep.dir=sweep")
        assert code == 0, said
        shutil.rmtree(place / "sweep" / "2")
        shutil.copytree(package, Path(base) / "kept_package")
        shutil.copytree(place, Path(base) / "kept_place")
        for number in range(chosen.edits + 3):
            edit = nothing if number >= chosen.edits else KINDS[number % len(KINDS)]
            named, line, patches = edit(place, package, chance)
            code, said = command(place, *line, "sweep.resume=sweep", "--trust", patches=patches)
            ran = (place / "sweep" / "2" / "metrics.json").exists()
            good = code == 0 and ran if edit is nothing else code == 1 and named in said and not ran
            told, quiet = told + (good and edit is not nothing), quiet + (good and edit is nothing)
            print(
                f"{number + 1}: {'as it should' if good else 'WRONG'}: {edit.__name__} ({named})", flush=True
            )
            if not good:
                print(f"   exit {code}, ran {ran}: {said[-600:]}")
            for folder, kept in ((place, "kept_place"), (package, "kept_package")):
                shutil.rmtree(folder)
                shutil.copytree(Path(base) / kept, folder)
    print(f"{told} of {chosen.edits} edits told; {quiet} of 3 resumed where nothing had changed")
    return int(told < chosen.edits or quiet < 3)


if __name__ == "__main__":
    sys.exit(main())
