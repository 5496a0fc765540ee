"""Where the attacks of `attacks.py` take place, how they are listed, and the honest commands beside them."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

SECRET = "pine-apple-4471-not-for-others-0815"
ATTACKS: dict[str, Callable] = {}
CONTROLS: dict[str, Callable] = {}  # honest: what the attacks' time and memory are compared with
Attack = tuple[list[str], Callable | None]


class Arena:
    """Folders of one attack: `hostile` has the runs, `victim` must stay as it is, commands start in `cwd`."""

    def __init__(self, root: Path) -> None:
        self.root, self.hostile, self.victim, self.cwd = root, root / "hostile", root / "victim", root / "cwd"
        self.one, self.many = self.hostile / "one", self.hostile / "many"

    def lay_out(self, honest: Path) -> None:
        shutil.copytree(honest, self.hostile)
        self.victim.mkdir()
        self.cwd.mkdir()
        (self.victim / "note.txt").write_text("mine\n")
        (self.victim / "secret.txt").write_text(SECRET + "\n")
        for folder in self.hostile.rglob("run.json"):  # a forger drops what would tell
            found = json.loads(folder.read_text())
            folder.write_text(json.dumps({k: v for k, v in found.items() if k not in ("checksum", "files")}))
        found = (self.many / "sweep.json").read_text()
        (self.many / "sweep.json").write_text(
            re.sub(r"hydra.sweep.dir=[^\"]*", f"hydra.sweep.dir={self.many}", found)
        )

    @property
    def touch(self) -> str:
        """A shell command that leaves a trace."""
        return f"touch {self.victim}/PWNED"

    def module(self, folder: Path, name: str = "evil_mod") -> None:
        """Plant a module that leaves a trace when it is imported."""
        text = (
            f"import os\nos.system('{self.touch}')\nclass V:\n    def __call__(self, x): return x.sum(-1)\n"
        )
        (folder / f"{name}.py").write_text(text)

    def config(self, change: Callable[[dict], Any], run: Path | None = None) -> None:
        path = (run or self.one) / ".hydra" / "config.yaml"
        found = yaml.safe_load(path.read_text())
        change(found)
        path.write_text(json.dumps(found))  # which is YAML

    def set(self, key: str, value: object) -> Attack:
        """One key of the run's settings, and the export of that run."""
        self.config(lambda found: found.__setitem__(key, value))
        return self.export()

    def export(self, *more: str) -> Attack:
        return ["staf-export", str(self.one), "--to", "c", "--calls", "10", *more], None

    def table(self, *more: str) -> Attack:
        return ["staf-table", str(self.many), *more], None

    def resume(self, *more: str, lose: int = 1) -> Attack:
        """Take the sweep up again after its last `lose` jobs were lost."""
        for job in range(3 - lose, 3):
            shutil.rmtree(self.many / str(job), ignore_errors=True)
        return ["staf", "-m", f"sweep.resume={self.many}", *more], None

    def json(self, path: str, change: Callable[[dict], Any]) -> None:
        found = json.loads((self.many / path).read_text())
        change(found)
        (self.many / path).write_text(json.dumps(found))

    def records(self, change: Callable[[dict], Any]) -> None:
        """Change the record of every job."""
        for job in range(3):
            self.json(f"{job}/run.json", change)

    def override(self, job: object, text: str) -> None:
        """One more override of a job."""
        self.json(f"{job}/run.json", lambda found: found["overrides"].append(text))

    def kernels(self, *values: str) -> None:
        """The jobs are said to have had these kernels."""
        for job, value in enumerate(values):
            self.override(job, f"kernel={value}")

    def metric(self, job: int, name: str) -> None:
        """One more metric of a job."""
        self.json(f"{job}/metrics.json", lambda found: found.update({name: 1.0}))

    def failed(self, job: int, reason: str) -> None:
        self.json(f"{job}/run.json", lambda found: found.update(status="failed", reason=reason))

    def swept(self, *texts: str) -> None:
        """More overrides of the sweep."""
        self.json("sweep.json", lambda found: found["overrides"].extend(texts))

    def line(self, text: str) -> Attack:
        """One more of Hydra's own lines in the sweep, and the sweep taken up again."""
        self.json("sweep.json", lambda found: found["hydra"].append(text))
        return self.resume()


def attack(make: Callable[[Arena], Attack]) -> Callable[[Arena], Attack]:
    ATTACKS[make.__name__] = make
    return make


def control(make: Callable[[Arena], Attack]) -> Callable[[Arena], Attack]:
    CONTROLS[make.__name__] = make
    return make


def says(*words: str) -> Callable:
    """The command must end well and say these words."""

    def check(arena: Arena, result: Any) -> str | None:
        missing = [word for word in words if word not in result.text]
        if missing or result.code:
            return f"exit {result.code}, not said: {missing}"
        return None

    return check


@control
def honest_export(arena: Arena) -> Attack:
    return arena.export()[0], says("one")


@control
def honest_table(arena: Arena) -> Attack:
    return arena.table("--format", "csv")[0], says("0.3")


@control
def honest_resume(arena: Arena) -> Attack:
    return arena.resume()[0], says("0.3", "report")


class Call:
    """Pickles to the call of a function."""

    def __init__(self, name: str, argument: str) -> None:
        self.name, self.argument = name, argument

    def __reduce__(self) -> tuple:
        import posix

        return posix.system, (self.argument,)
