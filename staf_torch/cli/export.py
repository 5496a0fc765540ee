"""The command `staf-export`: a run's controller or approximation as a file for a device."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import __version__
from ..deploy import c_header, data_sheet, export_learning_c, formats, trace
from ..deploy.controllers import made_name
from ..deploy.data_sheet import Port
from ..deploy.formats import in_loops
from ..lanes.emit.c import checked_names
from ..numerics.checks import choice, fail
from ..results.build import processor
from ..results.files import visible, write_text
from ..settings.chase import DTYPES
from ..signs import Sign, printed
from .deployable import CarriesPlanError, Deployable, Learner, deployable, learning

_PORTS = ("state", "control", "value", "gradient", "x", "u", "uniform")  # names of inputs and outputs
ENDINGS = {"onnx": ".onnx", "pt2": ".pt2", "aoti": ".aoti.pt2", "c": ".h"}
_RUNTIMES = {"onnx": "onnxruntime", "pt2": "eager torch", "aoti": "AOTInductor", "c": "C by ctypes"}
_NEEDS: dict[str, Callable[[], object]] = {
    "onnx": formats.need_onnx,
    "aoti": formats.need_compiler,
    "c": c_header.need_c_compiler,
}
_ROUNDED = 0.05  # what float32 may lose, by its error against float64, in a file that is kept
_SAME = {"float64": 1e-9, "float32": 1e-3}  # farther from the library a file is broken, and not left behind


@Sign("staf-export")
def export(
    run: Path,
    to: str,
    *,
    dtype: str = "float64",
    output: Path | None = None,
    row: int = 0,
    batch: int | None = None,
    calls: int = data_sheet.CALLS,
    trust: bool = False,
    name: str | None = None,
    function: bool = False,
) -> dict[str, Any]:
    """Write the file and its sheet (the same name with .json and .md), and return the sheet.

    Args:
        run: the run directory.
        to: onnx, pt2 (a `torch.export` program), aoti (an AOTInductor package) or c (a header).
        dtype: float64 or float32.
        output: of the file; RUN/export/<kind> and an ending by default.
        row, trust, function: as in `deployable`.
        batch: fixed number of rows of a call; any by default.
        calls: that the latency is the worst of.
        name: of the C function or the graph; that of the run's folder by default.

    Raises:
        ValueError: if an argument breaks its rule, an extra or a compiler is missing, the run cannot be
            exported, or the file does not compute what the library does.
    """
    choice("staf-export", "to", to, tuple(ENDINGS))
    choice("staf-export", "dtype", dtype, tuple(DTYPES))
    _NEEDS.get(to, lambda: None)()
    given, name = name, _called(name, run, row)
    if to == "c":
        batch = 1
    try:
        found = deployable(run, row, trust=trust, function=function)
    except CarriesPlanError:
        if to != "c":
            raise
        return export_learning(run, dtype=dtype, output=output, row=row, calls=calls, trust=trust, name=given)
    path = _file(run, output, f"{found.kind}{ENDINGS[to]}")
    module = found.module(DTYPES[dtype])
    origin: dict[str, object] = {"run": str(run), "row": row, "name": name}
    if to == "c":
        call, work = _write_c(module, path, found, origin, DTYPES[dtype])
    else:
        call, work = _write(module, path, to, found, origin, DTYPES[dtype], batch)
    facts = _measure(call, module, found, dtype, batch, calls)
    ends = {"to": to, "dtype": dtype, "batch": "any" if batch is None else batch}
    ports = {"inputs": (found.input,), "outputs": found.outputs}
    return _page(path, found, origin, ends, ports, work, facts)


def export_learning(
    run: Path,
    *,
    dtype: str = "float64",
    output: Path | None = None,
    row: int = 0,
    calls: int = data_sheet.CALLS,
    trust: bool = False,
    name: str | None = None,
) -> dict[str, Any]:
    """Write a C header of a controller that goes on learning, or carries a plan, and its sheet.

    The header has the weights, or the plan, of time 0 and must follow the first steps of the run: the same
    states and random numbers give the same controls. Arguments and errors as of `export`; the default name
    ends with ``_learner``.
    """
    choice("staf-export", "dtype", dtype, tuple(DTYPES))
    c_header.need_c_compiler()
    _called(name, run, row)
    found, real = learning(run, row, trust=trust), DTYPES[dtype]
    name = _called(name, run, row, "_learner" if found.learns else "")
    path = _file(run, output, "learner.h" if found.learns else "controller.h")
    origin: dict[str, object] = {"run": str(run), "row": row, "name": name}
    note = f"{found.what}\nFrom {run}, trajectory {row}, staf_torch {__version__}."
    states, uniform = found.states.to(real), found.uniform.to(real)
    made = export_learning_c(found.copied(real), states[:1], path, dt=found.dt, name=name, note=note)
    device = c_header.runner_learning_c(path, found.controller.draws, int(found.outputs[0].size or 1), real)
    exact, rough = _followed(found, torch.float64), _followed(found, torch.float32)
    wanted = exact if real == torch.float64 else rough
    facts = {
        "equality": {"u": data_sheet.worst_difference((device(states, uniform),), (wanted,))[0]},
        "float32_error": {"u": data_sheet.worst_difference((rough,), (exact,))[0]},
        "latency": dataclasses.asdict(
            data_sheet.latency(lambda x: device(x, uniform[:1]), states[:1], calls)
        ),
    }
    ports = {"inputs": found.inputs, "outputs": found.outputs}
    entries = sum(port.size or 1 for port in (*found.inputs, *found.outputs))
    work = made.work(entries, real)
    return _page(path, found, origin, {"to": "c", "dtype": dtype, "batch": 1}, ports, work, facts)


def _followed(found: Learner, dtype: torch.dtype) -> Tensor:
    """The controls of the library at the states of the run with its random numbers, (K, m)."""
    controller, states, uniform = found.copied(dtype), found.states.to(dtype), found.uniform.to(dtype)
    carried, controls = controller.init(states[:1]), []
    with torch.no_grad():
        for x, numbers in zip(states.split(1), uniform.split(1), strict=True):
            u, carried = controller.step(x, carried, numbers, found.dt)
            controls.append(u)
    return torch.cat(controls)


def _called(name: str | None, run: Path, row: int, end: str = "") -> str:
    """Return the name in the file: as given, else of the run's folder and the trajectory."""
    if name is None:
        made = made_name(run.resolve().name, "run") + (f"_{row}" if row else "") + end
        return f"{made}_run" if made in _PORTS else made
    checked_names("staf-export", "name", [name], _PORTS)
    return name


def _file(run: Path, output: Path | None, name: str) -> Path:
    path = run / "export" / name if output is None else output
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_symlink() or (output is None and path.parent.is_symlink()):
        raise ValueError(f"{path} is a link, or in a folder that is one: it is not written through.")
    return path


def _page(
    path: Path,
    found: Deployable | Learner,
    origin: dict[str, object],
    ends: dict[str, Any],
    ports: dict[str, tuple[Port, ...]],
    work: data_sheet.Work,
    facts: dict[str, Any],
) -> dict[str, Any]:
    """Write the sheet beside a file that computes what the library does, and return it."""
    worst, same = max(facts["equality"].values()), _SAME[ends["dtype"]]
    if ends["dtype"] == "float32":  # a plan ends where its next step is small: nobody has more digits than it
        same = max(same, min(_ROUNDED, 3 * max(facts["float32_error"].values())))
    if not worst <= same:
        path.unlink()
        raise ValueError(f"{path} differs from the library by {worst:.3g} and was removed.")
    page = {
        "file": path.name,
        "what": found.what,
        **origin,
        "version": __version__,
        "run_version": found.written_by,
        "torch": torch.__version__,
        **ends,
        **{way: [dataclasses.asdict(port) for port in given] for way, given in ports.items()},
        "work": dataclasses.asdict(work),
        "runtime": _RUNTIMES[ends["to"]],
        "machine": processor(),
        **facts,
    }
    write_text(path.with_name(path.name + ".json"), json.dumps(page, indent=2, allow_nan=False) + "\n")
    write_text(path.with_name(path.name + ".md"), data_sheet.markdown(page))
    return page


def _write(
    module: torch.nn.Module,
    path: Path,
    to: str,
    found: Deployable,
    origin: dict[str, object],
    dtype: torch.dtype,
    batch: int | None,
) -> tuple[formats.Run, data_sheet.Work]:
    names, name, example = [port.name for port in found.outputs], str(origin["name"]), found.points.to(dtype)
    if to == "onnx":
        written = in_loops(module, example, path, [found.input.name, *names], batch, name)
        if written is not None:
            entries = example.shape[1] + sum(port.size or 1 for port in found.outputs)
            return formats.runner_onnx(path), written.work(entries, dtype)
    program = trace(module, example, batch=batch)
    if to == "onnx":
        formats.export_onnx(program, path, [found.input.name], names, name=name)
        return formats.runner_onnx(path), data_sheet.work(program)
    if to == "pt2":
        said = {"input": dataclasses.asdict(found.input), "outputs": names, "what": found.what}
        formats.export_program(program, path, {"version": __version__, **origin, **said})
        return formats.runner_program(path), data_sheet.work(program)
    formats.export_package(program, path)
    return formats.runner_package(path), data_sheet.work(program)


def _write_c(
    module: torch.nn.Module, path: Path, found: Deployable, origin: dict[str, object], dtype: torch.dtype
) -> tuple[formats.Run, data_sheet.Work]:
    names, sizes = [port.name for port in found.outputs], [port.size for port in found.outputs]
    note = f"{found.what}\nFrom {origin['run']}, trajectory {origin['row']}, staf_torch {__version__}."
    example = found.points.to(dtype)
    made = c_header.export_c(module, example, path, names, name=str(origin["name"]), note=note)
    entries = example.shape[1] + sum(size or 1 for size in sizes)
    return c_header.runner_c(path, sizes, dtype), made.work(entries, dtype)


def _measure(
    call: formats.Run, module: torch.nn.Module, found: Deployable, dtype: str, batch: int | None, calls: int
) -> dict[str, Any]:
    names = [port.name for port in found.outputs]
    points = found.points.to(DTYPES[dtype])
    pieces = [piece for piece in points.split(batch or len(points)) if batch is None or len(piece) == batch]
    single = found.points.float()
    with torch.no_grad():
        made = formats.as_tuple(module(torch.cat(pieces)))
        got = [call(piece) for piece in pieces]
        rough = formats.as_tuple(found.module(torch.float32)(single))
        exact = formats.as_tuple(found.module(torch.float64)(single.double()))
    equality = data_sheet.worst_difference(tuple(map(torch.cat, zip(*got, strict=True))), made)
    error = data_sheet.worst_difference(rough, exact)
    late = data_sheet.latency(call, points[: batch or 1].clone(), calls)
    return {
        "latency": dataclasses.asdict(late),
        "equality": dict(zip(names, equality, strict=True)),
        "float32_error": dict(zip(names, error, strict=True)),
    }


def parser() -> argparse.ArgumentParser:
    """The arguments of `staf-export`."""
    found = argparse.ArgumentParser(
        prog="staf-export",
        description="Write a run's controller (adp) or approximation (gradient_chase) for a device, with a "
        "sheet of parameters, flops, latency and errors beside it.",
    )
    found.add_argument("run", type=Path, help="directory of the run")
    found.add_argument("--to", required=True, choices=tuple(ENDINGS), help="format of the file")
    found.add_argument("--dtype", default="float64", choices=tuple(DTYPES), help="precision (float64)")
    found.add_argument("--output", type=Path, help="file to write (RUN/export/...)")
    found.add_argument("--row", type=int, default=0, help="trajectory of the run, from 0 on (0)")
    found.add_argument("--batch", type=int, help="fixed number of rows of a call (any)")
    found.add_argument(
        "--calls", type=int, default=data_sheet.CALLS, help=f"calls timed for the sheet ({data_sheet.CALLS})"
    )
    found.add_argument(
        "--learning",
        action="store_true",
        help="with --to c: export a controller that goes on learning, from time 0",
    )
    found.add_argument("--name", help="name of the C function or the graph (that of the run's folder)")
    found.add_argument(
        "--function",
        action="store_true",
        help="of near_optimal with bounds: export u(x), without the plans of its controller()",
    )
    found.add_argument(
        "--trust",
        action="store_true",
        help="import the modules that the run's settings name: code of whoever wrote them runs",
    )
    return found


def main(arguments: list[str] | None = None) -> None:
    """Run the command. What a user got wrong ends as one sentence and the exit code 1."""
    given = vars(parser().parse_args(arguments))
    try:
        if not given.pop("learning"):
            page = export(**given)
        elif given.pop("function"):
            raise fail("staf-export", "function", "must not go with --learning", True)
        elif (to := given.pop("to")) != "c":
            raise fail("staf-export", "learning", "must go with --to c: the other formats have no state", to)
        elif (batch := given.pop("batch")) not in (None, 1):
            raise fail("staf-export", "batch", "must be 1 for a controller that learns", batch)
        else:
            page = export_learning(**given)
    except (ValueError, OSError) as error:
        sys.exit(f"staf-export: {visible(str(error))}")
    printed(data_sheet.markdown(page))
