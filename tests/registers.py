"""Registers of a kernel and what of it is spilled, by NVIDIA's compilers, without a card."""

from __future__ import annotations

import functools
import subprocess
import tempfile
from pathlib import Path

from staf_torch.lanes.device.cuda import MachineCode, best, measured

ARCHITECTURES = (80, 90, 100)


def ptxas(text: str, architectures: tuple[int, ...] = ARCHITECTURES) -> dict[int, MachineCode]:
    """Compile a kernel by nvcc and ptxas as a device would, for some architectures."""
    with tempfile.TemporaryDirectory() as folder:
        made = functools.cache(functools.partial(_ptx, Path(folder)))

        def compiled(architecture: int, text: str, *options: str) -> MachineCode:
            out = Path(folder) / "kernel.cubin"
            given = [
                "ptxas",
                "-v",
                f"-arch=sm_{architecture}",
                "-o",
                out,
                made(min(architectures), text, *options),
            ]
            told = subprocess.run(given, check=True, capture_output=True, text=True).stderr
            return measured(out.read_bytes(), told)

        return {each: best(text, functools.partial(compiled, each))[0] for each in architectures}


def _ptx(folder: Path, architecture: int, text: str, *options: str) -> Path:
    number = len([*folder.iterdir()])
    source, out = folder / f"{number}.cu", folder / f"{number}.ptx"
    source.write_text(text)
    command = ["nvcc", "-ptx", f"-arch=compute_{architecture}", "--fmad=false", *options]
    subprocess.run([*command, "-w", "-o", out, source], check=True)
    return out
