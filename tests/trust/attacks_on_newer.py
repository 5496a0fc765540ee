"""What came last: plants of other libraries, slopes, kept traces, tables that go on."""

from __future__ import annotations

import os
import pickle
import shutil
from pathlib import Path

from arena import ATTACKS, Arena, Attack, Call, attack


@attack
def an_environment_whose_id_names_a_module(arena: Arena) -> Attack:
    arena.module(arena.cwd)
    arena.module(arena.one)
    return arena.set("system", {"_target_": "staf_torch.envs.EnvironmentPlant", "env": "evil_mod:Evil-v0"})


@attack
def an_environment_made_by_the_loader(arena: Arena) -> Attack:
    arena.module(arena.cwd)
    loader = {"_target_": "staf_torch.settings.chase.load", "path": "gymnasium.make"}
    return arena.set("target", loader | {"arguments": {"id": "evil_mod:Evil-v0"}})


MUJOCO = {"_target_": "staf_torch.systems.MujocoPlant"}
ATTACKS["a_secret_as_a_model_of_mujoco"] = lambda arena: arena.set(
    "system", MUJOCO | {"model": f"{arena.victim}/secret.txt"}
)
ATTACKS["a_device_as_a_model_of_mujoco"] = lambda arena: arena.set("system", MUJOCO | {"model": "/dev/zero"})


@attack
def slopes_that_are_a_call(arena: Arena) -> Attack:
    call = {"_target_": "os.system", "command": arena.touch}
    plant = {"_target_": "staf_torch.systems.StepPlant", "dim": 2, "inputs": 1, "dt": 0.1}
    return arena.set("system", plant | {"step": call, "slopes": call})


@attack
def a_plant_within_a_barrier(arena: Arena) -> Attack:
    (arena.one / "evil.pt").write_bytes(pickle.dumps(Call("os.system", arena.touch)))
    inner = {"_target_": "torch.load", "f": str(arena.one / "evil.pt"), "weights_only": False}
    box = {"_target_": "staf_torch.systems.Barrier", "low": [-1, -1], "high": [1, 1]}
    return arena.set("system", box | {"plant": inner})


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


def killed_table(arena: Arena, *typed: str) -> Attack:
    """Make the sweep one of a table that was killed, and take it up again."""
    for job in range(3):
        shutil.rmtree(arena.many / str(job))
    arena.json("sweep.json", lambda found: found.update(jobs=[], overrides=list(typed) or found["overrides"]))
    arena.line("sweep.records=table")
    return ["staf", "-m", f"sweep.resume={arena.many}"], None


@attack
def rows_that_are_written_through_a_link(arena: Arena) -> Attack:
    for name in (".rows.json.partial", ".rows.json.sums", "rows.json"):
        (arena.many / name).symlink_to(arena.victim / "note.txt")
    return killed_table(arena)


@attack
def checksums_of_rows_that_are_a_pipe(arena: Arena) -> Attack:
    os.mkfifo(arena.many / ".rows.json.sums")
    (arena.many / ".rows.json.partial").write_text('{"version": "0.1.0", "rows": [\n')
    return killed_table(arena)


@attack
def a_folder_of_rows_that_leads_elsewhere(arena: Arena) -> Attack:
    (arena.many / "rows").symlink_to(arena.victim, target_is_directory=True)
    command, _ = killed_table(arena)
    return [*command, "--trust"], None


@attack
def a_billion_rows(arena: Arena) -> Attack:
    return killed_table(arena, "seed=range(1000000000)")


@attack
def rows_of_a_task_of_ones_own(arena: Arena) -> Attack:
    arena.module(arena.cwd)
    return killed_table(arena, "seed=0,1", f"hydra.sweep.dir={arena.victim}", "task=evil_mod.V")
