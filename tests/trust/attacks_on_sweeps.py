"""Sweeps of somebody else that are taken up again."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable
from pathlib import Path

from arena import ATTACKS, Arena, Attack, attack


@attack
def an_environment_for_jobs(arena: Arena) -> Attack:
    arena.module(arena.many, "sitecustomize")
    arena.line(f"hydra.job.env_set.PYTHONPATH={arena.many}")
    return arena.line("hydra.launcher.executor=process")


@attack
def a_sweeper_that_is_foreign(arena: Arena) -> Attack:
    arena.module(arena.cwd)
    return arena.line("hydra.sweeper._target_=evil_mod.V")


def locked(arena: Arena, make: Callable[[Path], object]) -> Attack:
    """A sweep with a lock that somebody made."""
    make(arena.many / ".lock")
    return arena.resume()


@attack
def flags_among_the_lines(arena: Arena) -> Attack:
    folder = arena.many / "conf" / "kernel"
    folder.mkdir(parents=True)
    arena.module(arena.cwd)
    (folder / "gaussian.yaml").write_text("_target_: evil_mod.V\n")
    for flag in ("--config-dir", str(folder.parent), "-cd", str(folder.parent), "--trust"):
        arena.json("sweep.json", lambda found, flag=flag: found["hydra"].insert(0, flag))
    return arena.line("kernel=gaussian")


@attack
def overrides_of_a_job_alone(arena: Arena) -> Attack:
    arena.module(arena.cwd)
    arena.json(
        "sweep.json",
        lambda found: found["jobs"][2]["overrides"].extend(["target=custom", "target.path=evil_mod.V"]),
    )
    return arena.resume()


@attack
def the_environment_in_an_override(arena: Arena) -> Attack:
    arena.swept("+note=${oc.env:STAF_SECRET}")
    return arena.resume()


@attack
def a_path_as_the_experiment(arena: Arena) -> Attack:
    arena.module(arena.cwd)
    folder = arena.many / "conf"
    folder.mkdir()
    (folder / "x.yaml").write_text("# @package _global_\ntask: evil_mod.V\n")
    arena.swept(f"experiment=../../..{folder}/x")
    return arena.resume()


@attack
def hard_links_of_the_victim(arena: Arena) -> Attack:
    for name in (
        "table.md",
        "table.csv",
        "report.html",
        "sweep.json.partial",
        ".table.md.partial",
        "multirun.yaml",
    ):
        (arena.many / name).unlink(missing_ok=True)
        os.link(arena.victim / "note.txt", arena.many / name)
    return arena.resume()


@attack
def a_picture_that_is_a_link(arena: Arena) -> Attack:
    (arena.many / "figures").mkdir()
    (arena.many / "0" / "figures").mkdir()
    for name in ("error_against_radius", "chase", "error_map"):
        for folder in (arena.many, arena.many / "0"):
            (folder / "figures" / f"{name}.png").symlink_to(arena.victim / "secret.txt")
    code = "import staf_torch, sys; found = staf_torch.read_runs(sys.argv[1])"
    code += "; print(found._repr_html_(), [run._repr_html_() for run in found])"
    arena.resume()
    return [
        "python",
        "-c",
        f"import subprocess, sys; subprocess.run(['staf', '-m', 'sweep.resume={arena.many}'])\n{code}",
        str(arena.many),
    ], None


@attack
def modules_of_the_library_beside_the_runs(arena: Arena) -> Attack:
    for name in ("json", "numpy", "yaml", "staf_torch", "hydra", "csv", "torch"):
        arena.module(arena.many, name)
    return ["bash", "-c", f"cd {arena.many} && staf-table . && staf-export 0 --to c --calls 10"], None


ATTACKS.update(
    {
        "another_directory_of_the_sweep": lambda arena: arena.line(f"hydra.sweep.dir={arena.victim}"),
        "another_subdirectory": lambda arena: arena.line("hydra.sweep.subdir=../../victim/${hydra.job.num}"),
        "a_log_file_elsewhere": lambda arena: arena.line(
            f"hydra.job_logging.handlers.file.filename={arena.victim}/note.txt"
        ),
        "a_lock_that_is_a_pipe": lambda arena: locked(arena, os.mkfifo),
        "a_lock_that_is_a_link": lambda arena: locked(
            arena, lambda path: path.symlink_to(arena.victim / "note.txt")
        ),
        "a_lock_of_everybody": lambda arena: locked(
            arena,
            lambda path: path.write_text(
                json.dumps({"host": socket.gethostname(), "pid": -1, "token": "x"}) * 2
            ),
        ),
        "settings_elsewhere": lambda arena: arena.line(f"hydra.output_subdir={arena.victim}"),
    }
)
