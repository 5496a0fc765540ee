"""The command `staf-export`: a run's controller or approximation as a file for a device."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import logging
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import Tensor, nn

from .. import __version__
from ..approximation.staf import StaF
from ..deploy import approximator, c_header, formats, policy_of, sheet, trace
from ..deploy.sheet import Port
from ..experiments.adp import learner
from ..numerics.checks import choice, fail, integer
from ..results import run_record as records
from ..results.archive import Archive
from ..results.files import HISTORY, write_text
from ..results.settings_file import read_settings
from ..results.untrusted import UnreadableError, visible
from ..settings.adp import adp_problem
from ..settings.chase import DTYPES, chase_problem
from ..settings.trust import checked, limited
from ..systems import Units

_POINTS = 1000
_READ = ("state", "weights", "estimate", "actor_weights", "control")  # of the history
_MOST_NUMBERS = 2**25  # of one trajectory
_UNBUILDABLE = (
    *(OmegaConfBaseException, InstantiationException, KeyError, IndexError, AttributeError, TypeError),
    *(AssertionError, RuntimeError),
)
"""What settings of another version, or of nobody's, raise while they are built."""


@dataclasses.dataclass(frozen=True)
class Deployable:
    """What is exported of a run."""

    kind: str  # approximator, controller
    what: str  # one sentence
    module: Callable[[torch.dtype], nn.Module]
    points: Tensor  # (P, n) of the region, float64
    input: Port
    outputs: tuple[Port, ...]
    written_by: str | None  # the version that made the run, where it says


def deployable(run: Path, row: int = 0, *, trust: bool = False) -> Deployable:
    """What a device needs of one trajectory of a run: its controller, or its approximation at the last time.

    The objects are built anew from the run's settings, and must reproduce what the run recorded.

    Args:
        run: the directory.
        row: the trajectory.
        trust: whether code of your own that the settings name may be imported.

    Raises:
        ValueError: if the directory is no run, lacks its history, holds another experiment, names foreign
            code, or was written by a version whose numbers this one does not reproduce.
    """
    cfg = _settings(run, trust)
    tasks = {"gradient_chase": _approximation, "adp": _controller}
    if cfg.get("task") not in tasks:
        listed = " or ".join(tasks)
        raise fail("staf-export", "RUN", f"must be a run of {listed}", cfg.get("task"))
    integer("staf-export", "row", row, least=0)
    history = _history(run, row)
    record = records.read(run / records.RUN) or {}
    written_by = str(record["version"]) if record.get("version") is not None else None
    try:
        precise = cfg.dtype == "float64"
        cfg.dtype, cfg.device = "float64", "cpu"
        with contextlib.nullcontext() if trust else limited(f"What {run} describes"):
            return dataclasses.replace(tasks[cfg.task](cfg, history, precise), written_by=written_by)
    except _UNBUILDABLE as error:
        raise ValueError(
            f"{run} was written by staf_torch {written_by or '(another version)'}, whose settings "
            f"staf_torch {__version__} does not understand ({_first_line(error)}): run it anew, "
            "or export it with that version."
        ) from error


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def _settings(run: Path, trust: bool) -> DictConfig:
    path = run / ".hydra" / "config.yaml"
    if not path.is_file():
        raise fail("staf-export", "RUN", "must be a run directory, with .hydra/config.yaml", str(run))
    try:
        cfg = (
            OmegaConf.load(path) if trust else OmegaConf.create(checked(read_settings(path, run), str(path)))
        )
    except UnreadableError as error:
        raise ValueError(f"{run} has settings that are not read without --trust: {error}.") from error
    if not isinstance(cfg, DictConfig):
        raise fail("staf-export", "RUN", "must hold settings in .hydra/config.yaml", str(run))
    OmegaConf.set_struct(cfg, True)  # a setting that is missing is an error, not None
    return cfg


def _history(run: Path, row: int) -> dict[str, np.ndarray]:
    """Return the arrays of a history, (T, ...) of one trajectory where they have trajectories."""
    path = run / HISTORY
    if not path.exists():
        raise ValueError(
            f"{run} has no history.npz, which holds the weights: run with history=false, or not ended."
        )
    try:
        archive = Archive(path, run)
        names = [name for name in _READ if name in archive.names]
        if "state" not in names:
            raise UnreadableError(f"{path} has no states")
        batch = archive.shape("state")[:1]
        if batch and row >= batch[0]:
            raise fail("staf-export", "row", f"must be below the run's {batch[0]} trajectories", row)
        for name in names:
            if math.prod(archive.shape(name)[1:]) > _MOST_NUMBERS or len(archive.shape(name)) < 2:
                raise UnreadableError(f"{path} has {archive.shape(name)} numbers of {name}")
        return {name: archive.read(name, row) for name in names}
    except (UnreadableError, IndexError) as error:
        raise ValueError(str(error)) from error


def _reproduced(name: str, found: Tensor, recorded: np.ndarray, precise: bool) -> None:
    """Whatever wrote the run: what is built from it must give the recorded numbers."""
    wanted = torch.from_numpy(np.asarray(recorded, dtype=np.float64))
    if not bool(torch.isfinite(wanted).all()):
        raise fail(
            "staf-export", "row", "must be a trajectory that did not diverge", f"a recorded {name} of NaN"
        )
    worst = float((found - wanted).abs().max() / wanted.abs().max().clamp(min=1e-3))
    if not worst <= (1e-8 if precise else 1e-3):
        raise ValueError(
            f"The recorded {name} of this run cannot be reproduced: built from its settings it differs by "
            f"{worst:.3g}. Another version of staf_torch wrote it, or a file was changed: run it anew."
        )


def _approximation(cfg: DictConfig, history: dict[str, np.ndarray], precise: bool) -> Deployable:
    problem = chase_problem(cfg)
    x = torch.from_numpy(history["state"][-1].astype(np.float64))
    weights = torch.from_numpy(history["weights"][-1].astype(np.float64))
    if not bool(torch.isfinite(weights).all()):
        raise fail("staf-export", "row", "must be a trajectory whose weights can be represented", "NaN")
    staf = StaF(problem.basis)
    with torch.no_grad():
        staf.state.copy_(x)
        staf.coefficients.copy_(problem.basis.local(x).coefficients(weights))
    _reproduced("estimate", staf(x.unsqueeze(0)).detach(), history["estimate"][-1:], precise)
    radius = float(problem.basis.centers.radius(x))
    generator = torch.Generator().manual_seed(0)
    inside = torch.randn(_POINTS, len(x), dtype=torch.float64, generator=generator)
    shrink = torch.rand(_POINTS, 1, dtype=torch.float64, generator=generator) ** (1 / len(x))
    points = x + radius * shrink * inside / inside.norm(dim=-1, keepdim=True)
    unit = getattr(problem.system, "units", Units())
    where = ", ".join(f"{v:.6g}" for v in x.tolist())
    return Deployable(
        "approximator",
        f"V^ and its gradient around the state of the last time, {problem.basis.count} centers of "
        f"{type(problem.basis.kernel).__name__}; the gradient is the partial one, centers frozen.",
        lambda dtype: approximator(staf, dtype),
        points,
        Port("state", len(x), unit.state, f"the ball of radius {radius:.6g} around ({where})"),
        (
            Port("value", None, "that of V", "V^; NaN far outside the region, where it has no digits left"),
            Port("gradient", len(x), "that of V per state", "grad V^"),
        ),
        None,
    )


def _controller(cfg: DictConfig, history: dict[str, np.ndarray], precise: bool) -> Deployable:
    problem = adp_problem(cfg)
    states = torch.from_numpy(history["state"].astype(np.float64))
    weights = torch.from_numpy(history["actor_weights"].astype(np.float64))
    learns = learner(problem.controller) is not None
    last = policy_of(problem.controller, weights[-2] if learns else None)
    _reproduced("control", last(states[-2:-1])[0], history["control"][-2], precise)
    low, high = states.amin(0), states.amax(0)
    generator = torch.Generator().manual_seed(0)
    points = low + (high - low) * torch.rand(_POINTS, len(low), dtype=torch.float64, generator=generator)
    unit = problem.system.units
    box = " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(low.tolist(), high.tolist(), strict=True))
    learned = f", {weights.shape[-1]} actor weights as they were at the end" if learns else ""
    return Deployable(
        "controller",
        f"The control u(x) of {type(problem.system).__name__} by {problem.controller.label}{learned}.",
        lambda dtype: policy_of(problem.controller, weights[-1] if learns else None, dtype),
        points,
        Port("state", len(low), unit.state, f"visited: {box}"),
        (Port("control", history["control"].shape[-1], unit.input, f"to be held for {problem.dt:g} s"),),
        None,
    )


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
    choice("staf-export", "dtype", dtype, tuple(DTYPES))
    _NEEDS.get(to, lambda: None)()
    if to == "c":
        batch = 1
    found = deployable(run, row, trust=trust)
    path = run / "export" / f"{found.kind}{ENDINGS[to]}" if output is None else output
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_symlink() or (output is None and path.parent.is_symlink()):
        raise ValueError(f"{path} is a link, or in a folder that is one: it is not written through.")
    module = found.module(DTYPES[dtype])
    origin: dict[str, object] = {"run": str(run), "row": row}
    if to == "c":
        call, work = _write_c(module, path, found, origin, DTYPES[dtype])
    else:
        program = trace(module, found.points.to(DTYPES[dtype]), batch=batch)
        call, work = _write(program, path, to, found, origin), sheet.work(program)
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
        "work": dataclasses.asdict(work),
        "runtime": _RUNTIMES[to],
        "machine": sheet.machine(),
        **facts,
    }
    write_text(path.with_name(path.name + ".json"), json.dumps(page, indent=2, allow_nan=False) + "\n")
    write_text(path.with_name(path.name + ".md"), sheet.markdown(page))
    return page


def _write(
    program: torch.export.ExportedProgram,
    path: Path,
    to: str,
    found: Deployable,
    origin: dict[str, object],
) -> formats.Run:
    names = [port.name for port in found.outputs]
    if to == "onnx":
        formats.export_onnx(program, path, [found.input.name], names)
        return formats.runner_onnx(path)
    if to == "pt2":
        ports = {"input": dataclasses.asdict(found.input), "outputs": names, "what": found.what}
        formats.export_program(program, path, {"version": __version__, **origin, **ports})
        return formats.runner_program(path)
    formats.export_package(program, path)
    return formats.runner_package(path)


def _write_c(
    module: torch.nn.Module, path: Path, found: Deployable, origin: dict[str, object], dtype: torch.dtype
) -> tuple[formats.Run, sheet.Work]:
    names, sizes = [port.name for port in found.outputs], [port.size for port in found.outputs]
    note = f"{found.what}\nFrom {origin['run']}, trajectory {origin['row']}, staf_torch {__version__}."
    example = found.points.to(dtype)
    made = c_header.export_c(module, example, path, names, note=note)
    entries = example.shape[1] + sum(1 if size is None else size for size in sizes)
    work = sheet.Work(
        parameters=made.constants,
        flops=made.flops,
        functions=made.functions,
        bytes_constants=made.constants * dtype.itemsize,
        bytes_in_out=entries * dtype.itemsize,
    )
    return c_header.runner_c(path, sizes, dtype), work


def _measure(
    call: formats.Run,
    module: torch.nn.Module,
    found: Deployable,
    dtype: str,
    batch: int | None,
    calls: int,
) -> dict[str, Any]:
    names = [port.name for port in found.outputs]
    points = found.points.to(DTYPES[dtype])
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
    found.add_argument("--dtype", default="float64", choices=tuple(DTYPES))
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
        page = export(**vars(given))
    except (ValueError, OSError) as error:
        sys.exit(f"staf-export: {visible(str(error))}")
    sys.stdout.write(sheet.markdown(page))
