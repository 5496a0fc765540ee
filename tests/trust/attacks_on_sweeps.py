"""Sweeps of somebody else that are taken up again."""

from __future__ import annotations

import json
import os
import pickle
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from arena import ATTACKS, Arena, Attack, Call, attack


def locked(arena: Arena, make: Callable[[Path], object]) -> Attack:
    """A sweep with a lock that somebody made."""
    make(arena.many / ".lock")
    return arena.resume()


def swept(arena: Arena, *texts: str) -> Attack:
    """A sweep with more overrides."""
    arena.swept(*texts)
    return arena.resume()


def killed_table(arena: Arena, *typed: str, rows: list[dict[str, Any]] | None = None) -> Attack:
    """Make the sweep one of a table that was killed, with those rows on disk, and take it up again."""
    arena.resume(lose=3)
    arena.json("sweep.json", lambda found: found.update(jobs=[], overrides=list(typed) or found["overrides"]))
    if rows is not None:
        lines = "".join(json.dumps(row) + ",\n" for row in rows)
        (arena.many / ".rows.json.partial").write_text('{"version": "0.1.0", "rows": [\n' + lines)
    arena.line("sweep.records=table")
    return arena.resume("--trust", lose=0) if rows else arena.resume(lose=0)


def linked(
    folder: Path, target: Path, *names: str, by: Callable[[Path, Path], Any] = Path.symlink_to
) -> None:
    """Links in the place of files that are written."""
    for name in names:
        (folder / name).unlink(missing_ok=True)
        by(folder / name, target)


ATTACKS.update(
    {
        "another_directory_of_the_sweep": lambda arena: arena.line(f"hydra.sweep.dir={arena.victim}"),
        "another_subdirectory": lambda arena: arena.line("hydra.sweep.subdir=../../victim/${hydra.job.num}"),
        "a_log_file_elsewhere": lambda arena: arena.line(
            f"hydra.job_logging.handlers.file.filename={arena.victim}/note.txt"
        ),
        "settings_elsewhere": lambda arena: arena.line(f"hydra.output_subdir={arena.victim}"),
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
        "the_environment_in_an_override": lambda arena: swept(arena, "+note=${oc.env:STAF_SECRET}"),
        "a_grammar_that_takes_for_ever": lambda arena: swept(
            arena, "+note=" + "[" * 4000 + "]" * 4000, "+more=" + "sort(" * 400 + "1" + ")" * 400
        ),
        "a_product_of_forty_choices": lambda arena: swept(
            arena, *(f"+key{k}=choice(0,1,2,3)" for k in range(40))
        ),
        "a_billion_rows": lambda arena: killed_table(arena, "seed=range(1000000000)"),
    }
)


@attack
def an_environment_for_jobs(arena: Arena) -> Attack:
    arena.module(arena.many, "sitecustomize")
    arena.line(f"hydra.job.env_set.PYTHONPATH={arena.many}")
    return arena.line("hydra.launcher.executor=process")


@attack
def a_sweeper_that_is_foreign(arena: Arena) -> Attack:
    arena.module(arena.cwd)
    return arena.line("hydra.sweeper._target_=evil_mod.V")


@attack
def flags_among_the_lines(arena: Arena) -> Attack:
    folder = arena.many / "conf" / "kernel"
    folder.mkdir(parents=True)
    arena.module(arena.cwd)
    (folder / "gaussian.yaml").write_text("_target_: evil_mod.V\n")
    flags = ["--trust", str(folder.parent), "-cd", str(folder.parent), "--config-dir"]
    arena.json("sweep.json", lambda found: found.update(hydra=[*flags, *found["hydra"]]))
    return arena.line("kernel=gaussian")


@attack
def overrides_of_a_job_alone(arena: Arena) -> Attack:
    arena.module(arena.cwd)
    more = ["target=custom", "target.path=evil_mod.V"]
    arena.json("sweep.json", lambda found: found["jobs"][2]["overrides"].extend(more))
    return arena.resume()


@attack
def a_path_as_the_experiment(arena: Arena) -> Attack:
    arena.module(arena.cwd)
    folder = arena.many / "conf"
    folder.mkdir()
    (folder / "x.yaml").write_text("# @package _global_\ntask: evil_mod.V\n")
    return swept(arena, f"experiment=../../..{folder}/x")


@attack
def hard_links_of_the_victim(arena: Arena) -> Attack:
    names = [
        "table.md",
        "table.csv",
        "report.html",
        "sweep.json.partial",
        ".table.md.partial",
        "multirun.yaml",
    ]
    linked(arena.many, arena.victim / "note.txt", *names, by=Path.hardlink_to)
    return arena.resume()


@attack
def a_picture_that_is_a_link(arena: Arena) -> Attack:
    for folder in (arena.many / "figures", arena.many / "0" / "figures"):
        folder.mkdir()
        names = (f"{name}.png" for name in ("error_against_radius", "chase", "error_map"))
        linked(folder, arena.victim / "secret.txt", *names)
    arena.resume()
    code = f"import subprocess, sys; subprocess.run(['staf', '-m', 'sweep.resume={arena.many}'])\n"
    code += "import staf_torch, sys; found = staf_torch.read_runs(sys.argv[1])"
    code += "; print(found._repr_html_(), [run._repr_html_() for run in found])"
    return ["python", "-c", code, str(arena.many)], None


@attack
def modules_of_the_library_beside_the_runs(arena: Arena) -> Attack:
    for name in ("json", "numpy", "yaml", "staf_torch", "hydra", "csv", "torch"):
        arena.module(arena.many, name)
    return ["bash", "-c", f"cd {arena.many} && staf-table . && staf-export 0 --to c --calls 10"], None


@attack
def traces_kept_where_the_runs_are(arena: Arena) -> Attack:
    """A cache of traces, which are pickles, that the environment of the jobs leads to."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    evil = pickle.dumps(Call("os.system", arena.touch))
    for path in (home / "staf_torch").rglob("*"):
        copy = arena.many / "cache" / path.relative_to(home)
        if path.is_file() and path.suffix != ".so":
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(evil)
    arena.line(f"hydra.job.env_set.XDG_CACHE_HOME={arena.many}/cache")
    return arena.line("hydra.launcher.executor=process")


@attack
def rows_that_are_written_through_a_link(arena: Arena) -> Attack:
    linked(arena.many, arena.victim / "note.txt", ".rows.json.partial", ".rows.json.sums", "rows.json")
    return killed_table(arena)


@attack
def checksums_of_rows_that_are_a_pipe(arena: Arena) -> Attack:
    os.mkfifo(arena.many / ".rows.json.sums")
    return killed_table(arena, rows=[])


@attack
def a_folder_of_rows_that_leads_elsewhere(arena: Arena) -> Attack:
    (arena.many / "rows").symlink_to(arena.victim, target_is_directory=True)
    command, _ = killed_table(arena)
    return [*command, "--trust"], None


@attack
def rows_of_a_task_of_ones_own(arena: Arena) -> Attack:
    arena.module(arena.cwd)
    return killed_table(arena, "seed=0,1", f"hydra.sweep.dir={arena.victim}", "task=evil_mod.V")


@attack
def rows_that_speak(arena: Arena) -> Attack:
    """Rows that a killed sweep is said to have left: escapes, formulas, numbers of any size."""
    evil = "\x1b]0;x\x07\u202e=cmd|'/C calc'!A0<script>alert(1)</script>"
    rows = [
        {"num": 0, "overrides": [f"seed={evil}"], "status": "failed", "reason": evil, "metrics": {}},
        {"num": 10**30, "overrides": ["seed=1"], "status": evil, "reason": None, "metrics": {evil: 1e308}},
        {"num": -1, "overrides": [evil] * 3, "status": "completed", "metrics": {"ball_error": [1]}},
    ]
    return killed_table(arena, rows=rows)


@attack
def files_of_a_run_that_lie_elsewhere(arena: Arena) -> Attack:
    """Checksums of /dev/zero, of a secret, of a folder: whoever checks them reads them."""
    names = ["/dev/zero", "../../../victim/secret.txt", "../..", "/proc/self/mem", "\x1b[2J"]
    arena.records(lambda found: found.update(files={n: [10**15, "0" * 64] for n in names}))
    return arena.resume()


@attack
def modules_of_a_run_that_are_imported_to_be_hashed(arena: Arena) -> Attack:
    for folder in (arena.cwd, arena.many, arena.many / "0"):
        arena.module(folder)
    arena.records(lambda found: found["build"]["modules"].update({"evil_mod": "0" * 12, "os": "1"}))
    return arena.resume("--trust")


@attack
def settings_nine_hundred_deep(arena: Arena) -> Attack:
    deep: Any = 1
    for _ in range(900):
        deep = {"x": deep}
    arena.records(lambda found: found["settings"].update(kernel=deep, spread=[deep]))
    arena.records(lambda found: found["build"].update(torch=deep, modules=[deep]))
    return arena.resume()


@attack
def a_group_in_the_place_of_a_callback(arena: Arena) -> Attack:
    """Hydra's packages put a group of settings where its own callbacks stand, without a word of `hydra.`."""
    arena.module(arena.cwd)
    arena.swept("+target@hydra.callbacks.more=custom")
    return arena.line("hydra.callbacks={more: {_target_: evil_mod.V}, staf: {_target_: evil_mod.V}}")


@attack
def dangling_links_where_files_are_made(arena: Arena) -> Attack:
    """A link to a file that does not exist yet: whoever opens it to write makes that file."""
    command, _ = arena.resume("--trust")
    job = arena.many / "2"
    (job / ".hydra").mkdir(parents=True)
    names = ("run.json", "metrics.json", "staf.log", "history.npz", ".metrics.json.partial")
    for name in (*names, ".hydra/config.yaml"):
        linked(job, arena.victim / f"new_{name.rpartition('/')[2]}", name)
    linked(job / ".hydra", arena.victim / "note.txt", "overrides.yaml")
    linked(arena.many, arena.victim / "new_table", ".table.tex.partial")
    return command, None


@attack
def a_lock_of_no_process(arena: Arena) -> Attack:
    """Numbers that no process has, and the host of this machine, so that they are looked up."""
    lock = {"host": socket.gethostname(), "pid": 10**30, "token": {"x": []}, "started": "soon"}
    (arena.many / ".lock").write_text(json.dumps(lock))
    return arena.resume("--trust")


@attack
def a_version_of_the_sweep_that_is_a_program(arena: Arena) -> Attack:
    """What a refusal repeats of the folder goes to the terminal."""
    evil = "\x1b[2J\x9b31m\u202e$(touch PWNED)`id`" + "A" * 200_000
    arena.records(lambda found: found["build"].update(torch=evil, compiler=evil))
    arena.json("sweep.json", lambda found: found.update(version=evil))

    def check(arena: Arena, result: Any) -> str | None:
        return f"{len(result.text)} characters were said" if len(result.text) > 20_000 else None

    return arena.resume()[0], check
