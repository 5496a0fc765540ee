"""Runs the pages of staf_torch/guides from top to bottom, and makes their pictures.

`python tests/guides.py` runs every guide and every command of the gallery in a folder of its own, and writes
what they draw to staf_torch/guides/pictures. Names of guides, or of pictures of the gallery, choose some.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from command_line import ROOT, environment, in_a_child, one

from staf_torch.cli import export, table

GUIDES = ROOT / "staf_torch" / "guides"
PICTURES = GUIDES / "pictures"
GALLERY = GUIDES / "GALLERY.md"
KINDS = ("python", "bash")
WIDTH, LARGEST = 1200, 60_000  # pixels of a picture, and bytes
_BLOCK = re.compile(r"^```(python|bash)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_PICTURE = re.compile(r"^!\[[^]]*\]\(pictures/(\w+)\.webp\)$(?:\n\n`([^`]+)`$)?", re.MULTILINE)


def blocks(text: str, kinds: Sequence[str] = KINDS) -> Iterator[tuple[int, str, str]]:
    """Line, kind and text of the blocks of a page that are run."""
    for found in _BLOCK.finditer(text):
        if found[1] in kinds:
            yield text[: found.start(2)].count("\n"), found[1], found[2]


def run_page(text: str, name: str, kinds: Sequence[str] = KINDS) -> None:
    """Run the blocks of a page in the working directory, with names that the Python of the page shares."""
    names: dict[str, object] = {"__name__": "__main__"}
    for line, kind, block in blocks(text, kinds):
        if kind == "python":
            exec(compile("\n" * line + block, name, "exec"), names)
        else:
            run_commands(block)


def run_commands(text: str) -> None:
    """Run a block for the terminal, the library's programs in a fork of this process."""
    for line in re.sub(r"\\\n\s*", "", text).splitlines():
        program, *arguments = shlex.split(line, comments=True) or [""]
        if program in ("staf", "staf-table", "staf-export"):
            with tempfile.TemporaryDirectory() as base:
                code, out, err = in_a_child(lambda p=program, a=arguments: _program(p, a), Path(base))
            print(out, end="")
        else:
            done = subprocess.run(["bash", "-c", line], env=environment(), capture_output=True, text=True)
            code, out, err = done.returncode, done.stdout, done.stderr
            print(out, end="")
        assert code == 0, f"{line}\n{out}{err}"


def _program(program: str, arguments: list[str]) -> tuple[int, str, str]:
    if program == "staf":
        return one(os.getcwd(), arguments)
    return {"staf-table": table, "staf-export": export}[program].main(arguments) or 0, "", ""


def entries() -> dict[str, tuple[str, str]]:
    """Text and file of every picture of the gallery."""
    found = {}
    for text in re.split(r"^#+ ", GALLERY.read_text(encoding="utf-8"), flags=re.MULTILINE):
        for picture in _PICTURE.finditer(text):
            found[picture[1]] = text, picture[2] or f"{picture[1]}.png"
    return found


def guides() -> list[Path]:
    return sorted(path for path in GUIDES.glob("*.md") if path.name not in ("README.md", GALLERY.name))


def keep(drawn: Path, name: str) -> None:
    """Write a picture of the width of a page, as small as it gets."""
    from PIL import Image

    with Image.open(drawn) as image:
        if getattr(image, "n_frames", 1) > 1:
            image.seek(image.n_frames - 1)
        width = min(image.width, WIDTH)
        height = round(image.height * width / image.width)
        small = image.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)
    for quality in (90, 80, 70, 60, 50):
        small.save(PICTURES / f"{name}.webp", quality=quality, method=6)
        if (PICTURES / f"{name}.webp").stat().st_size <= LARGEST:
            return
    raise SystemExit(f"{name}.webp is larger than {LARGEST} bytes")


def main(chosen: list[str]) -> None:
    torch.set_num_threads(1)  # a fork has no threads of a pool, and would wait for them
    PICTURES.mkdir(exist_ok=True)
    pages = {
        path.stem: (path.read_text(encoding="utf-8"), f"{path.stem}.png") for path in guides()
    } | entries()
    for name in chosen or pages:
        before, children = time.process_time(), os.times()
        text, drawn = pages[name]
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            run_page(text, name)
            keep(Path(folder) / drawn, name)
            os.chdir(ROOT)
        after = os.times()
        spent = time.process_time() - before + sum(after[2:4]) - sum(children[2:4])
        print(f"== {name}: {spent:.1f} CPU-s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
