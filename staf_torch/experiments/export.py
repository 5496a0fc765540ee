"""The command `staf-export`: a run's controller or approximation as a file for a device."""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from .. import __version__
from .._checks import choice
from ..deploy import c_header, describe, formats, sheet, trace
from ..report import write_text
from .export_run import Deployable, deployable

ENDINGS = {"onnx": ".onnx", "pt2": ".pt2", "aoti": ".aoti.pt2", "c": ".h"}
_RUNTIMES = {
    "onnx": "onnxruntime",
    "pt2": "eager torch",
    "aoti": "AOTInductor",
    "c": "C by ctypes",
}
_NEEDS: dict[str, Callable[[], object]] = {
    "onnx": formats.need_onnx,
    "aoti": formats.need_compiler,
    "c": c_header.need_c_compiler,
}
_DTYPES = {"float64": torch.float64, "float32": torch.float32}
_SAME = {"float64": 1e-9, "float32": 1e-3}  # farther from the library a file is broken, and not left behind


def export(
    run: Path,
    to: str,
    *,
    dtype: str = "float64",
    output: Path | None = None,
    row: int = 0,
    batch: int | None = None,
    calls: int = sheet.CALLS,
    trust: bool = False,
) -> dict[str, Any]:
    """Write the file and its sheet (the same name with .json and .md), and return the sheet.

    Args:
        run: the run directory.
        to: onnx, pt2 (a `torch.export` program), aoti (an AOTInductor package) or c (a header).
        dtype: float64 or float32.
        output: of the file; RUN/export/<kind> and an ending by default.
        row: the trajectory.
        batch: rows of every call; any by default.
        calls: that the latency is the worst of.
        trust: as in `deployable`.

    Raises:
        ValueError: if an argument breaks its rule, an extra or a compiler is missing, the run cannot be
            exported, or the file does not compute what the library does.
    """
    choice("staf-export", "to", to, tuple(ENDINGS))
    choice("staf-export", "dtype", dtype, tuple(_DTYPES))
    _NEEDS.get(to, lambda: None)()
    if to == "c":
        batch = 1
    found = deployable(run, row, trust=trust)
    path = run / "export" / f"{found.kind}{ENDINGS[to]}" if output is None else output
    path.parent.mkdir(parents=True, exist_ok=True)
    module = found.module(_DTYPES[dtype])
    program = trace(module, found.points.to(_DTYPES[dtype]), batch=batch)
    call = _write(program, path, to, found, {"run": str(run), "row": row}, _DTYPES[dtype])
    facts = _measure(call, module, found, dtype, batch, calls)
    worst = max(facts["equality"].values())
    if not worst <= _SAME[dtype]:
        path.unlink()
        raise ValueError(f"{path} differs from the library by {worst:.3g} and was removed.")
    page = {
        "file": path.name,
        "what": found.what,
        "run": str(run),
        "row": row,
        "version": __version__,
        "run_version": found.written_by,
        "torch": torch.__version__,
        "to": to,
        "dtype": dtype,
        "batch": "any" if batch is None else batch,
        "inputs": [dataclasses.asdict(found.input)],
        "outputs": [dataclasses.asdict(port) for port in found.outputs],
        "work": dataclasses.asdict(sheet.work(program)),
        "runtime": _RUNTIMES[to],
        "machine": sheet.machine(),
        **facts,
    }
    write_text(path.with_name(path.name + ".json"), json.dumps(page, indent=2, allow_nan=False) + "\n")
    write_text(path.with_name(path.name + ".md"), describe.markdown(page))
    return page


def _write(
    program: torch.export.ExportedProgram,
    path: Path,
    to: str,
    found: Deployable,
    origin: dict[str, object],
    dtype: torch.dtype,
) -> formats.Run:
    names = [port.name for port in found.outputs]
    if to == "onnx":
        formats.export_onnx(program, path, [found.input.name], names)
        return formats.runner_onnx(path)
    if to == "pt2":
        ports = {"input": dataclasses.asdict(found.input), "outputs": names, "what": found.what}
        formats.export_program(program, path, {"version": __version__, **origin, **ports})
        return formats.runner_program(path)
    if to == "c":
        note = f"{found.what}\nFrom {origin['run']}, trajectory {origin['row']}, staf_torch {__version__}."
        c_header.export_c(program, path, names, dtype=dtype, note=note)
        return c_header.runner_c(path, [port.size for port in found.outputs], dtype)
    formats.export_package(program, path)
    return formats.runner_package(path)


def _measure(
    call: formats.Run,
    module: torch.nn.Module,
    found: Deployable,
    dtype: str,
    batch: int | None,
    calls: int,
) -> dict[str, Any]:
    names = [port.name for port in found.outputs]
    points = found.points.to(_DTYPES[dtype])
    pieces = points.split(len(points) if batch is None else batch)
    pieces = tuple(piece for piece in pieces if batch is None or len(piece) == batch)
    single = found.points.float()
    with torch.no_grad():
        made = [formats.as_tuple(module(piece)) for piece in pieces]
        got = [call(piece) for piece in pieces]
        rough = formats.as_tuple(found.module(torch.float32)(single))
        exact = formats.as_tuple(found.module(torch.float64)(single.double()))
    equality = sheet.worst_difference(_joined(got), _joined(made))
    error = sheet.worst_difference(rough, exact)
    late = sheet.latency(call, points[: 1 if batch is None else batch].clone(), calls)
    return {
        "latency": dataclasses.asdict(late),
        "equality": dict(zip(names, equality, strict=True)),
        "float32_error": dict(zip(names, error, strict=True)),
    }


def _joined(pieces: list[tuple[torch.Tensor, ...]]) -> tuple[torch.Tensor, ...]:
    return tuple(torch.cat(column) for column in zip(*pieces, strict=True))


def parser() -> argparse.ArgumentParser:
    """The arguments of `staf-export`."""
    found = argparse.ArgumentParser(
        prog="staf-export",
        description="Write a run's controller (adp) or approximation (gradient_chase) for a device, with a "
        "sheet of parameters, flops, latency and errors beside it.",
    )
    found.add_argument("run", type=Path, help="run directory")
    found.add_argument("--to", required=True, choices=tuple(ENDINGS), help="the format")
    found.add_argument("--dtype", default="float64", choices=tuple(_DTYPES))
    found.add_argument("--output", type=Path, help="file; RUN/export/... by default")
    found.add_argument("--row", type=int, default=0, help="trajectory (0)")
    found.add_argument("--batch", type=int, help="rows of every call; any by default")
    found.add_argument("--calls", type=int, default=sheet.CALLS, help=f"timed ({sheet.CALLS})")
    found.add_argument("--trust", action="store_true", help="import code of your own that the settings name")
    return found


def main(arguments: list[str] | None = None) -> None:
    """Run the command. What a user got wrong ends as one sentence and the exit code 1."""
    given = parser().parse_args(arguments)
    # The exporter warns that torchvision is not there, for operators that nothing here has.
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    try:
        page = export(
            given.run,
            given.to,
            dtype=given.dtype,
            output=given.output,
            row=given.row,
            batch=given.batch,
            calls=given.calls,
            trust=given.trust,
        )
    except (ValueError, OSError) as error:
        sys.exit(f"staf-export: {error}")
    sys.stdout.write(describe.markdown(page))
