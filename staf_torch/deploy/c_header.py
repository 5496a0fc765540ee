"""A C header: the arithmetic of one call and its constants, nothing else."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.export import ExportedProgram

from .formats import Run
from .scalars import Scalars


def export_c(
    program: ExportedProgram, path: Path, outputs: Sequence[str], *, dtype: torch.dtype, note: str = ""
) -> None:
    """Write a program of `trace` for a batch of one row as ``static inline void staf(const T state[n], T
    value[...], ...)``. It needs math.h, and no memory but the stack.

    Args:
        program: the program, of batch 1.
        path: of the header.
        outputs: the names of its outputs.
        dtype: float64 (double) or float32 (float).
        note: lines for the comment at its head.

    Raises:
        ValueError: if an operation of the program has no C here.
    """
    kind, suffix = ("float", "f") if dtype == torch.float32 else ("double", "")
    scalars = Scalars(program, suffix)
    try:
        found = scalars.run(*[None] * len(program.graph_signature.input_specs))
    except ValueError as error:
        raise ValueError(str(error).splitlines()[0]) from error  # without the tracer's epilogue
    size = int(next(iter(_inputs(program))).shape[-1])
    ends = [np.asarray(out, dtype=object).reshape(-1) for out in found]
    arguments = [f"const {kind} state[{size}]"]
    arguments += [f"{kind} {name}[{len(end)}]" for name, end in zip(outputs, ends, strict=True)]
    stores = [
        f"{name}[{k}] = {scalars.text(entry)};"
        for name, end in zip(outputs, ends, strict=True)
        for k, entry in enumerate(end)
    ]
    comment = "".join(f" * {line}\n" for line in note.replace("*/", "* /").splitlines())
    body = "\n".join(f"    {line}" for line in (*scalars.lines, *stores))
    path.write_text(
        f"/*\n{comment} */\n#ifndef STAF_H\n#define STAF_H\n\n#include <math.h>\n\n"
        f"static inline void staf({', '.join(arguments)})\n{{\n{body}\n}}\n\n#endif\n",
        encoding="utf-8",
    )


def runner_c(path: Path, sizes: Sequence[int | None], dtype: torch.dtype) -> Run:
    """The header, compiled with -O2 and called a row at a time.

    Args:
        path: of the header.
        sizes: entries of every output, None for a scalar.
        dtype: as in `export_c`.

    Raises:
        ValueError: if there is no C compiler.
    """
    kind = "float" if dtype == torch.float32 else "double"
    names = ", ".join(f"o{k}" for k in range(len(sizes)))
    declared = ", ".join(f"{kind} *o{k}" for k in range(len(sizes)))
    source = f'#include "{path.resolve()}"\n'
    source += f"void call(const {kind} *state, {declared}) {{ staf(state, {names}); }}\n"
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "call.c").write_text(source, encoding="utf-8")
        line = [need_c_compiler(), "-O2", "-shared", "-fPIC", "-x", "c", "call.c", "-o", "call.so", "-lm"]
        subprocess.run(line, cwd=folder, check=True, capture_output=True)
        call = ctypes.CDLL(str(Path(folder) / "call.so")).call

    def run(x: Tensor) -> tuple[Tensor, ...]:
        outs = tuple(torch.empty(len(x), *([] if size is None else [size]), dtype=dtype) for size in sizes)
        for k in range(len(x)):
            call(*(ctypes.c_void_p(t[k].data_ptr()) for t in (x, *outs)))
        return outs

    return run


def need_c_compiler() -> str:
    """The C compiler here.

    Raises:
        ValueError: if there is none.
    """
    wanted = os.environ.get("CC")
    found = wanted or next((c for c in ("cc", "gcc", "g++", "clang") if shutil.which(c)), None)
    if found is None or shutil.which(found) is None:
        raise ValueError(
            "The C header is compiled once to compare it with the library, and there is no C compiler here: "
            f"install gcc, or name one in the variable CC; got {found!r}."
        )
    return found


def _inputs(program: ExportedProgram) -> list[Tensor]:
    fed = set(program.graph_signature.user_inputs)
    return [n.meta["val"] for n in program.graph.nodes if n.op == "placeholder" and n.name in fed]
