"""Settings of a run that `staf-export` is to build: foreign code, time and memory."""

from __future__ import annotations

import pickle
import zipfile

from arena import ATTACKS, Arena, Attack, Call, attack


@attack
def target_through_a_module_of_ours(arena: Arena) -> Attack:
    (arena.one / "evil.pt").write_bytes(pickle.dumps(Call("os.system", arena.touch)))
    target = "staf_torch.kernels.gaussian.torch.load"
    return arena.set("kernel", {"_target_": target, "f": str(arena.one / "evil.pt"), "weights_only": False})


def with_module(arena: Arena, key: str, value: object) -> Attack:
    """A key of the settings that names a module which lies beside the run and where the command starts."""
    arena.module(arena.one)
    arena.module(arena.cwd)
    return arena.set(key, value)


GAUSSIAN, BALL = {"_target_": "staf_torch.GaussianKernel"}, {"layout": "ball", "count": 10**8, "radius": 0.1}
CALL = "subprocess.check_output"
ATTACKS.update(
    {
        "a_partial_of_os_system": lambda arena: arena.set(
            "target", {"_target_": "os.system", "_partial_": True, "command": arena.touch}
        ),
        "a_target_within_a_list_argument": lambda arena: arena.set(
            "kernel", GAUSSIAN | {"width": [{"_target_": CALL, "args": ["touch", f"{arena.victim}/PWNED"]}]}
        ),
        "a_target_among_positional_arguments": lambda arena: arena.set(
            "kernel", GAUSSIAN | {"_args_": [{"_target_": "os.system", "command": arena.touch}]}
        ),
        "a_target_of_ones_own_beside_the_run": lambda arena: with_module(
            arena, "target", {"_target_": "staf_torch.settings.chase.custom", "path": "evil_mod.V"}
        ),
        "a_task_that_is_a_path": lambda arena: with_module(arena, "task", "evil_mod.V"),
        "text_where_a_number_belongs": lambda arena: arena.set(
            "dt", f"__import__('os').system('{arena.touch}')"
        ),
        "a_hundred_million_centers": lambda arena: arena.set(
            "centers",
            {"_target_": "staf_torch.settings.chase.centers_of", "shrink": {"offset": None, "gain": 1.0}}
            | BALL,
        ),
        "a_polynomial_of_degree_a_billion": lambda arena: arena.set(
            "kernel", {"_target_": "staf_torch.PolynomialKernel", "degree": 10**9, "bias": 1.0}
        ),
    }
)


@attack
def a_python_tag_in_yaml(arena: Arena) -> Attack:
    for run in (arena.one, arena.many / "0"):
        for name in ("config", "overrides", "hydra"):
            path = run / ".hydra" / f"{name}.yaml"
            path.write_text(f"kernel: !!python/object/apply:os.system ['{arena.touch}']\n")
    return ["staf-export", str(arena.one), "--to", "c"], None


@attack
def metric_tracker_and_predictor(arena: Arena) -> Attack:
    arena.module(arena.cwd)
    for key in ("metric", "tracker", "predictor"):
        arena.config(lambda found, key=key: found.__setitem__(key, {"_target_": "evil_mod.V"}))
    return arena.export()


@attack
def the_environment_in_a_setting(arena: Arena) -> Attack:
    arena.config(lambda found: found.__setitem__("device", "${oc.env:STAF_SECRET}"))
    return arena.set("task", "${oc.env:STAF_SECRET}")


@attack
def pickles_in_the_history(arena: Arena) -> Attack:
    body = pickle.dumps(Call("os.system", arena.touch))
    header = b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }"
    npy = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + body
    for run in (arena.one, arena.many / "0"):
        with zipfile.ZipFile(run / "history.npz", "w") as archive:
            for name in ("time", "state", "weights", "value", "estimate", "ideal_weights", "excess"):
                archive.writestr(f"{name}.npy", npy)
    return arena.export("--row", "0")


@attack
def four_hundred_anchors(arena: Arena) -> Attack:
    kernel: dict[str, object] = GAUSSIAN
    for _ in range(400):
        kernel = {"_target_": "staf_torch.AnchoredKernel", "kernel": kernel}
    return arena.set("kernel", kernel)


@attack
def a_plant_of_five_thousand_states(arena: Arena) -> Attack:
    size = 5000
    arena.config(lambda found: found.__setitem__("initial_state", [0.0] * size))
    return arena.set("system", {"_target_": "staf_torch.systems.Linear", "matrix": [[0.0] * 3] * size})


@attack
def base_sixty_numbers(arena: Arena) -> Attack:
    (arena.one / ".hydra" / "config.yaml").write_text("dt: 1" + ":59" * 400_000 + "\n")
    return arena.export()


@attack
def thirty_megabytes_of_brackets(arena: Arena) -> Attack:
    (arena.one / ".hydra" / "config.yaml").write_text("dt: " + "[" * (30 * 2**20))
    return arena.export()


@attack
def a_history_that_unpacks_to_gigabytes(arena: Arena) -> Attack:
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1, 400000000), }"
    npy = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    for run in (arena.one, arena.many / "0", arena.many / "1"):
        with (
            zipfile.ZipFile(run / "history.npz", "w", zipfile.ZIP_DEFLATED) as archive,
            archive.open("state.npy", "w", force_zip64=True) as out,
        ):
            out.write(npy)
            for _ in range(1600):
                out.write(bytes(2**20))
    return arena.export()


@attack
def a_history_whose_header_is_a_program(arena: Arena) -> Attack:
    header = b"{'descr': " + b"(" * 60_000 + b")" * 4_000
    npy = b"\x93NUMPY\x02\x00" + len(header).to_bytes(4, "little") + header
    for run in (arena.one, arena.many / "0"):
        with zipfile.ZipFile(run / "history.npz", "w") as archive:
            archive.writestr("state.npy", npy)
            archive.writestr("weights.npy", npy)
    return arena.export()
