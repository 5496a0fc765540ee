"""Settings and histories of a run that `staf-export` is to build: foreign code, time and memory."""

from __future__ import annotations

import pickle
import re
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

from arena import ATTACKS, Arena, Attack, Call, attack

GAUSSIAN, BALL = {"_target_": "staf_torch.GaussianKernel"}, {"layout": "ball", "count": 10**8, "radius": 0.1}
LOADER = {"_target_": "staf_torch.settings.chase.load", "path": "gymnasium.make"}
MUJOCO = {"_target_": "staf_torch.systems.MujocoPlant"}
BOX = {"_target_": "staf_torch.systems.Barrier", "low": [-1, -1], "high": [1, 1]}
STEPS = {"_target_": "staf_torch.systems.StepPlant", "dim": 2, "inputs": 1, "dt": 0.1}
CENTERS = {"_target_": "staf_torch.settings.chase.centers_of", "shrink": {"offset": None, "gain": 1.0}}


def system(arena: Arena) -> dict[str, Any]:
    return {"_target_": "os.system", "command": arena.touch}


def loaded(arena: Arena, target: str) -> dict[str, Any]:
    """A pickle beside the run that a function reads."""
    (arena.one / "evil.pt").write_bytes(pickle.dumps(Call("os.system", arena.touch)))
    return {"_target_": target, "f": str(arena.one / "evil.pt"), "weights_only": False}


def with_module(arena: Arena, key: str, value: object) -> Attack:
    """A key of the settings that names a module which lies beside the run and where the command starts."""
    arena.module(arena.one)
    arena.module(arena.cwd)
    return arena.set(key, value)


def text(arena: Arena, content: str) -> Attack:
    """The settings as a text of YAML."""
    (arena.one / ".hydra" / "config.yaml").write_text(content)
    return arena.export()


ATTACKS.update(
    {
        "target_through_a_module_of_ours": lambda arena: arena.set(
            "kernel", loaded(arena, "staf_torch.kernels.gaussian.torch.load")
        ),
        "a_partial_of_os_system": lambda arena: arena.set("target", system(arena) | {"_partial_": True}),
        "a_target_within_a_list_argument": lambda arena: arena.set(
            "kernel",
            GAUSSIAN | {"width": [{"_target_": "subprocess.check_output", "args": arena.touch.split()}]},
        ),
        "a_target_among_positional_arguments": lambda arena: arena.set(
            "kernel", GAUSSIAN | {"_args_": [system(arena)]}
        ),
        "a_target_of_ones_own_beside_the_run": lambda arena: with_module(
            arena, "target", {"_target_": "staf_torch.settings.chase.custom", "path": "evil_mod.V"}
        ),
        "a_task_that_is_a_path": lambda arena: with_module(arena, "task", "evil_mod.V"),
        "text_where_a_number_belongs": lambda arena: arena.set(
            "dt", f"__import__('os').system('{arena.touch}')"
        ),
        "a_hundred_million_centers": lambda arena: arena.set("centers", CENTERS | BALL),
        "a_polynomial_of_degree_a_billion": lambda arena: arena.set(
            "kernel", {"_target_": "staf_torch.PolynomialKernel", "degree": 10**9, "bias": 1.0}
        ),
        "base_sixty_numbers": lambda arena: text(arena, "dt: 1" + ":59" * 400_000 + "\n"),
        "thirty_megabytes_of_brackets": lambda arena: text(arena, "dt: " + "[" * (30 * 2**20)),
        "an_environment_whose_id_names_a_module": lambda arena: with_module(
            arena, "system", {"_target_": "staf_torch.envs.EnvironmentPlant", "env": "evil_mod:Evil-v0"}
        ),
        "an_environment_made_by_the_loader": lambda arena: with_module(
            arena, "target", LOADER | {"arguments": {"id": "evil_mod:Evil-v0"}}
        ),
        "a_secret_as_a_model_of_mujoco": lambda arena: arena.set(
            "system", MUJOCO | {"model": f"{arena.victim}/secret.txt"}
        ),
        "a_device_as_a_model_of_mujoco": lambda arena: arena.set("system", MUJOCO | {"model": "/dev/zero"}),
        "slopes_that_are_a_call": lambda arena: arena.set(
            "system", STEPS | {"step": system(arena), "slopes": system(arena)}
        ),
        "a_plant_within_a_barrier": lambda arena: arena.set(
            "system", BOX | {"plant": loaded(arena, "torch.load")}
        ),
    }
)


@attack
def a_python_tag_in_yaml(arena: Arena) -> Attack:
    for run in (arena.one, arena.many / "0"):
        for name in ("config", "overrides", "hydra"):
            path = run / ".hydra" / f"{name}.yaml"
            path.write_text(f"kernel: !!python/object/apply:os.system ['{arena.touch}']\n")
    return arena.export()


@attack
def metric_tracker_and_predictor(arena: Arena) -> Attack:
    arena.module(arena.cwd)
    for key in ("metric", "tracker", "predictor"):
        arena.set(key, {"_target_": "evil_mod.V"})
    return arena.export()


@attack
def the_environment_in_a_setting(arena: Arena) -> Attack:
    arena.set("device", "${oc.env:STAF_SECRET}")
    return arena.set("task", "${oc.env:STAF_SECRET}")


@attack
def four_hundred_anchors(arena: Arena) -> Attack:
    kernel: dict[str, object] = GAUSSIAN
    for _ in range(400):
        kernel = {"_target_": "staf_torch.AnchoredKernel", "kernel": kernel}
    return arena.set("kernel", kernel)


@attack
def a_plant_of_five_thousand_states(arena: Arena) -> Attack:
    arena.set("initial_state", [0.0] * 5000)
    return arena.set("system", {"_target_": "staf_torch.systems.Linear", "matrix": [[0.0] * 3] * 5000})


@attack
def keys_merged_into_a_target(arena: Arena) -> Attack:
    """`_target_` by YAML's merge keys, by an escape, and twice over, so that the last one counts."""
    before = (arena.one / ".hydra" / "config.yaml").read_text()
    before = re.sub(r"(?ms)^kernel:\n(?:  .*\n)+", "", before)
    content = f'more: &more {{_target_: os.system, command: "{arena.touch}"}}\n' + before
    content += "kernel:\n  <<: *more\n  _target_: staf_torch.ExponentialKernel\n"
    content += f'  "\\x5ftarget\\x5f": os.system\n  command: "{arena.touch}"\n'
    return text(arena, content)


@attack
def interpolations_that_double(arena: Arena) -> Attack:
    """Forty texts, each twice the next one: 10^12 characters where they are resolved."""
    doubled = {f"s{k}": 2 * f"${{s{k + 1}}}" for k in range(40)}
    arena.config(lambda found: found.update(doubled, s40="x", dtype="${s0}", device="${device}"))
    return arena.export()


@attack
def merge_keys_that_double(arena: Arena) -> Attack:
    lines = ["a0: &a0 {x: 1, y: 2, z: 3}"]
    lines += [f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 9)}], k{k}: 1}}" for k in range(1, 12)]
    return text(arena, "\n".join(lines) + "\n" + (arena.one / ".hydra" / "config.yaml").read_text())


# Histories


def histories(arena: Arena) -> list[Path]:
    return [run / "history.npz" for run in (arena.one, arena.many / "0", arena.many / "1")]


def numpy_file(header: bytes) -> bytes:
    """The beginning of an array in a file of NumPy's, version 2."""
    return b"\x93NUMPY\x02\x00" + len(header).to_bytes(4, "little") + header


@attack
def pickles_in_the_history(arena: Arena) -> Attack:
    body = pickle.dumps(Call("os.system", arena.touch))
    for path in histories(arena):
        with zipfile.ZipFile(path, "w") as archive:
            for name in ("time", "state", "weights", "value", "estimate", "ideal_weights", "excess"):
                header = b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }"
                archive.writestr(f"{name}.npy", numpy_file(header) + body)
    return arena.export("--row", "0")


@attack
def a_history_that_unpacks_to_gigabytes(arena: Arena) -> Attack:
    for path in histories(arena):
        with (
            zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
            archive.open("state.npy", "w", force_zip64=True) as out,
        ):
            out.write(numpy_file(b"{'descr': '<f8', 'fortran_order': False, 'shape': (1, 400000000), }"))
            for _ in range(1600):
                out.write(bytes(2**20))
    return arena.export()


@attack
def a_history_whose_header_is_a_program(arena: Arena) -> Attack:
    for path in histories(arena):
        with zipfile.ZipFile(path, "w") as archive:
            for name in ("state.npy", "weights.npy"):
                archive.writestr(name, numpy_file(b"{'descr': " + b"(" * 60_000 + b")" * 4_000))
    return arena.export()


@attack
def an_archive_whose_files_overlap(arena: Arena) -> Attack:
    """Sixty thousand names in a ZIP that share one kernel of zeros: small on disk, 60 GB unpacked."""
    data = zlib.compressobj(9, zlib.DEFLATED, -15)
    kernel = data.compress(bytes(2**20)) + data.flush()
    crc = zlib.crc32(bytes(2**20))
    head = struct.pack("<4sHHHHHIIIHH", b"PK\3\4", 20, 0, 8, 0, 33, crc, len(kernel), 2**20, 9, 0)
    body, central = head + b"state.npy" + kernel, b""
    for k in range(60_000):
        name = b"state.npy" if k == 0 else b"s%d.npy" % k
        entry = struct.pack(
            *("<4sHHHHHHIIIHHHHHII", b"PK\1\2", 20, 20, 0, 8, 0, 33, crc, len(kernel), 2**20),
            *(len(name), 0, 0, 0, 0, 0, 0),
        )
        central += entry + name
    end = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 60_000, 60_000, len(central), len(body), 0)
    for path in histories(arena):
        path.write_bytes(body + central + end)
    assert zipfile.is_zipfile(histories(arena)[0])
    return arena.export("--row", "0")


# Names that are written into programs in C

EVIL_C = "extern int system(const char *); __attribute__((constructor)) static void evil(void)"


def moved(arena: Arena, to: str) -> Attack:
    """The export of the run from a folder of another name."""
    place = arena.hostile / to
    place.parent.mkdir(exist_ok=True)
    arena.one.rename(place)
    return ["staf-export", str(place), "--to", "c", "--calls", "10"], None


@attack
def a_record_that_closes_a_comment_in_c(arena: Arena) -> Attack:
    """Whatever an exported program repeats of the run is compiled, and its self-test is run."""
    code = f'*/ {EVIL_C} {{ system("{arena.touch}"); }} /*'
    arena.override("../one", f"note={code}")
    arena.json("../one/run.json", lambda found: found["settings"].update({"kernel": code, code: code}))
    arena.json("../one/run.json", lambda found: found.update(version=code, task=code))
    return moved(arena, f"x*/ {EVIL_C} {{}} $(touch PWNED)`touch PWNED`")


@attack
def a_name_that_ends_an_include_in_c(arena: Arena) -> Attack:
    """The folder's name closes the quotes around it, so that a file beside the folder is included."""
    (arena.hostile / "x").write_text(f'{EVIL_C} {{ system("{arena.touch}"); }}\nvoid staf() {{}}\n')
    return moved(arena, 'x"\n#pragma /one')


@attack
def a_name_that_speaks(arena: Arena) -> Attack:
    return moved(arena, "\x1b[2J\x9b31m\u202e`<img src=x onerror=alert(1)>\n# x")
