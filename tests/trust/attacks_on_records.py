"""What a folder says of itself, where a reader may believe it: a third set, held out like the others.

Four of them reached something, which was mended: a name that ends an include, one that speaks, the grammar,
the version.
"""

from __future__ import annotations

import json
import re
import shutil
import socket
import struct
import zipfile
import zlib
from typing import Any

from arena import Arena, Attack, attack


def rows_cut_off(arena: Arena, rows: list[dict[str, Any]]) -> Attack:
    """A sweep of a table that was killed with those rows on disk, taken up again."""
    for job in range(3):
        shutil.rmtree(arena.many / str(job))
    arena.json("sweep.json", lambda found: found.update(jobs=[]))
    text = '{"version": "0.1.0", "rows": [\n' + ",\n".join(json.dumps(row) for row in rows) + ",\n"
    (arena.many / ".rows.json.partial").write_text(text)
    arena.line("sweep.records=table")
    return ["staf", "-m", f"sweep.resume={arena.many}"], None


@attack
def files_of_a_run_that_lie_elsewhere(arena: Arena) -> Attack:
    """Checksums of /dev/zero, of a secret, of a folder: whoever checks them reads them."""
    names = ["/dev/zero", "../../../victim/secret.txt", "../..", "/proc/self/mem", "\x1b[2J"]
    for job in range(3):
        arena.json(
            f"{job}/run.json",
            lambda found: found.__setitem__("files", {n: [10**15, "0" * 64] for n in names}),
        )
    return arena.resume()


@attack
def modules_of_a_run_that_are_imported_to_be_hashed(arena: Arena) -> Attack:
    for folder in (arena.cwd, arena.many, arena.many / "0"):
        arena.module(folder)
    for job in range(3):
        arena.json(
            f"{job}/run.json",
            lambda found: found["build"]["modules"].update({"evil_mod": "0" * 12, "os": "1"}),
        )
    return arena.resume("--trust")


@attack
def settings_nine_hundred_deep(arena: Arena) -> Attack:
    deep: Any = 1
    for _ in range(900):
        deep = {"x": deep}
    for job in range(3):
        arena.json(f"{job}/run.json", lambda found: found["settings"].update(kernel=deep, spread=[deep]))
        arena.json(f"{job}/run.json", lambda found: found["build"].update(torch=deep, modules=[deep]))
    return arena.resume()


@attack
def a_group_in_the_place_of_a_callback(arena: Arena) -> Attack:
    """Hydra's packages put a group of settings where its own callbacks stand, without a word of `hydra.`."""
    arena.module(arena.cwd)
    arena.swept("+target@hydra.callbacks.more=custom")
    return arena.line("hydra.callbacks={more: {_target_: evil_mod.V}, staf: {_target_: evil_mod.V}}")


@attack
def a_grammar_that_takes_for_ever(arena: Arena) -> Attack:
    deep = "[" * 4000 + "]" * 4000
    arena.swept(f"+note={deep}")
    arena.swept("+more=" + "sort(" * 400 + "1" + ")" * 400)
    return arena.resume()


@attack
def a_product_of_forty_choices(arena: Arena) -> Attack:
    arena.swept(*(f"+key{k}=choice(0,1,2,3)" for k in range(40)))
    return arena.resume()


EVIL_C = "extern int system(const char *); __attribute__((constructor)) static void evil(void)"


@attack
def a_record_that_closes_a_comment_in_c(arena: Arena) -> Attack:
    """Whatever an exported program repeats of the run is compiled, and its self-test is run."""
    code = f'*/ {EVIL_C} {{ system("{arena.touch}"); }} /*'
    arena.json("../one/run.json", lambda found: found["overrides"].append(f"note={code}"))
    arena.json("../one/run.json", lambda found: found["settings"].update({"kernel": code, code: code}))
    arena.json("../one/run.json", lambda found: found.update(version=code, task=code))
    moved = arena.hostile / "x*" / f" {EVIL_C} {{}} $(touch PWNED)`touch PWNED`"
    moved.parent.mkdir()
    arena.one.rename(moved)
    return ["staf-export", str(moved), "--to", "c", "--calls", "10"], None


@attack
def a_name_that_ends_an_include_in_c(arena: Arena) -> Attack:
    """The folder's name closes the quotes around it, so that a file beside the folder is included."""
    (arena.hostile / "x").write_text(f'{EVIL_C} {{ system("{arena.touch}"); }}\nvoid staf() {{}}\n')
    moved = arena.hostile / 'x"\n#pragma '
    moved.mkdir()
    arena.one.rename(moved / "one")
    return ["staf-export", f"{moved}/one", "--to", "c", "--calls", "10"], None


@attack
def a_name_that_speaks(arena: Arena) -> Attack:
    moved = arena.hostile / "\x1b[2J\x9b31m\u202e`<img src=x onerror=alert(1)>\n# x"
    arena.one.rename(moved)
    return ["staf-export", str(moved), "--to", "c", "--calls", "10"], None


@attack
def keys_merged_into_a_target(arena: Arena) -> Attack:
    """`_target_` by YAML's merge keys, by an escape, and twice over, so that the last one counts."""
    path = arena.one / ".hydra" / "config.yaml"
    text = path.read_text()
    evil = f'{{_target_: os.system, command: "{arena.touch}"}}'
    text = re.sub(r"(?ms)^kernel:\n(?:  .*\n)+", "", text)
    text = f"more: &more {evil}\n" + text
    text += "kernel:\n  <<: *more\n  _target_: staf_torch.ExponentialKernel\n"
    text += f'  "\\x5ftarget\\x5f": os.system\n  command: "{arena.touch}"\n'
    path.write_text(text)
    return arena.export()


@attack
def interpolations_that_double(arena: Arena) -> Attack:
    """Forty texts, each twice the next one: 10^12 characters where they are resolved."""

    def change(found: dict[str, Any]) -> None:
        for k in range(40):
            found[f"s{k}"] = 2 * f"${{s{k + 1}}}"
        found["s40"], found["dtype"] = "x", "${s0}"
        found["device"] = "${device}"

    arena.config(change)
    return arena.export()


@attack
def merge_keys_that_double(arena: Arena) -> Attack:
    lines = ["a0: &a0 {x: 1, y: 2, z: 3}"]
    lines += [f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 9)}], k{k}: 1}}" for k in range(1, 12)]
    path = arena.one / ".hydra" / "config.yaml"
    path.write_text("\n".join(lines) + "\n" + path.read_text())
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
    for run in (arena.one, arena.many / "0", arena.many / "1"):
        (run / "history.npz").write_bytes(body + central + end)
    assert zipfile.is_zipfile(arena.one / "history.npz")
    return arena.export("--row", "0")


@attack
def dangling_links_where_files_are_made(arena: Arena) -> Attack:
    """A link to a file that does not exist yet: whoever opens it to write makes that file."""
    command, _ = arena.resume("--trust")
    job = arena.many / "2"
    (job / ".hydra").mkdir(parents=True)
    for name in (
        "run.json",
        "metrics.json",
        "staf.log",
        "history.npz",
        ".hydra/config.yaml",
        ".metrics.json.partial",
    ):
        (job / name).symlink_to(arena.victim / f"new_{name.rpartition('/')[2]}")
    (job / ".hydra" / "overrides.yaml").symlink_to(arena.victim / "note.txt")
    (arena.many / ".table.tex.partial").symlink_to(arena.victim / "new_table")
    return command, None


@attack
def a_lock_of_no_process(arena: Arena) -> Attack:
    """Numbers that no process has, and the host of this machine, so that they are looked up."""
    lock = {"host": socket.gethostname(), "pid": 10**30, "token": {"x": []}, "started": "soon"}
    (arena.many / ".lock").write_text(json.dumps(lock))
    return arena.resume("--trust")


@attack
def rows_that_speak(arena: Arena) -> Attack:
    """Rows that a killed sweep is said to have left: escapes, formulas, numbers of any size."""
    evil = "\x1b]0;x\x07\u202e=cmd|'/C calc'!A0<script>alert(1)</script>"
    rows = [
        {"num": 0, "overrides": [f"seed={evil}"], "status": "failed", "reason": evil, "metrics": {}},
        {"num": 10**30, "overrides": ["seed=1"], "status": evil, "reason": None, "metrics": {evil: 1e308}},
        {"num": -1, "overrides": [evil] * 3, "status": "completed", "metrics": {"ball_error": [1]}},
    ]
    command, _ = rows_cut_off(arena, rows)
    return [*command, "--trust"], None


@attack
def an_override_of_a_million_commas(arena: Arena) -> Attack:
    """A table has a column a setting, and looks for what was swept among all of them."""
    many = [f"key{k}={','.join(['1'] * 50)}" for k in range(30_000)]
    for job in range(3):
        arena.json(f"{job}/run.json", lambda found: found["overrides"].extend(many))
        swept = dict.fromkeys((line[:9] for line in many), job)
        arena.json(f"{job}/run.json", lambda found, swept=swept: found["settings"].update(swept))
    return arena.table("--format", "csv")


@attack
def a_version_of_the_sweep_that_is_a_program(arena: Arena) -> Attack:
    """What a refusal repeats of the folder goes to the terminal."""
    evil = "\x1b[2J\x9b31m\u202e$(touch PWNED)`id`" + "A" * 200_000
    for job in range(3):
        arena.json(f"{job}/run.json", lambda found: found["build"].update(torch=evil, compiler=evil))
    arena.json("sweep.json", lambda found: found.update(version=evil))

    def check(arena: Arena, result: Any) -> str | None:
        return f"{len(result.text)} characters were said" if len(result.text) > 20_000 else None

    return arena.resume()[0], check


@attack
def a_table_written_over_its_source(arena: Arena) -> Attack:
    """A link in the place of the file that is asked for, and a folder that leads elsewhere."""
    (arena.cwd / "table.csv").symlink_to(arena.many / "table.csv")
    for name in ("table.csv", "table.md", "report.html"):
        (arena.many / name).unlink(missing_ok=True)
        (arena.many / name).symlink_to(arena.victim / "note.txt")
    return ["staf-table", str(arena.many), "--format", "csv", "--output", str(arena.many / "table.csv")], None
