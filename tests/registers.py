"""Registers of a kernel and what of it is spilled, by NVIDIA's compilers, without a card."""

from __future__ import annotations

import re
import subprocess
import tempfile
from pathlib import Path

from staf_torch.lanes.device.cuda import fewer_is_better
from staf_torch.lanes.emit.cuda import FEWER_REGISTERS

ARCHITECTURES = (80, 90, 100)
RECORDED = Path(__file__).with_name("benchmarks") / "registers.txt"


def recorded(name: str, dtype: str, architecture: int) -> list[tuple[int, ...]]:
    """What is recorded of the kernels of a case of `tests/gpu.py`: as `ptxas` returns it."""
    lines = [line for line in RECORDED.read_text().splitlines() if line.startswith(f"{name:28} {dtype} ")]
    found = (
        re.search(rf"sm_{architecture} (\d+) registers (\d+) spilled (\d+) stack", line) for line in lines
    )
    return [tuple(map(int, each.groups())) for each in found if each is not None]


def ptxas(text: str, architectures: tuple[int, ...] = ARCHITECTURES) -> dict[int, tuple[int, int, int]]:
    """Registers, bytes spilled and bytes of stack of a kernel, by nvcc and ptxas: the better of two ways."""
    found = _ptxas(text, architectures, ())
    spilling = tuple(each for each, (_, spilled, _) in found.items() if spilled)
    other = _ptxas(text, spilling, (FEWER_REGISTERS,)) if spilling else {}
    better = {each: of for each, of in other.items() if fewer_is_better(found[each][:0:-1], of[:0:-1])}
    return found | better


def _ptxas(
    text: str, architectures: tuple[int, ...], options: tuple[str, ...]
) -> dict[int, tuple[int, int, int]]:
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        source, middle = Path(folder) / "kernel.cu", Path(folder) / "kernel.ptx"
        source.write_text(text)
        command = ["nvcc", "-ptx", f"-arch=compute_{min(architectures)}", "--fmad=false", *options]
        subprocess.run([*command, "-w", "-o", middle, source], check=True)
        for each in architectures:
            out = Path(folder) / "kernel.cubin"
            given = ["ptxas", "-v", f"-arch=sm_{each}", "-o", out, middle]
            told = subprocess.run(given, check=True, capture_output=True, text=True).stderr
            numbers = [line.split() for line in told.splitlines()]
            used = next(int(line[line.index("Used") + 1]) for line in numbers if "Used" in line)
            frames = [line for line in numbers if "spill" in line]
            found[each] = (
                used,
                sum(int(line[line.index("spill") - 2]) for line in frames),
                sum(int(line[0]) for line in frames),
            )
    return found
