"""The files: ONNX, `torch.export`, AOTInductor."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor
from torch.export import ExportedProgram

from ..numerics.checks import fail

FORMAT = 1
"""Of the note inside a .pt2 file; raised when an older reader would go wrong."""
_NOTE = "staf_torch.json"
Run = Callable[[Tensor], tuple[Tensor, ...]]
"""An exported file, loaded: (B, n) -> its outputs."""


def need_onnx() -> None:
    """Refuse where the extra is missing.

    Raises:
        ValueError: that names the extra.
    """
    missing = [name for name in ("onnx", "onnxscript", "onnxruntime") if not importlib.util.find_spec(name)]
    if missing:
        raise ValueError(
            f"ONNX needs {', '.join(missing)}, which {'is' if len(missing) == 1 else 'are'} not installed: "
            "pip install 'staf_torch[onnx]'."
        )


def need_compiler() -> None:
    """Refuse where AOTInductor could not compile.

    Raises:
        ValueError: that says what to install.
    """
    compiler = os.environ.get("CXX") or next((c for c in ("g++", "clang++") if shutil.which(c)), None)
    if compiler is None or shutil.which(compiler) is None:
        raise ValueError(
            "AOTInductor compiles C++, and there is no compiler here: install g++ (apt-get install g++) "
            f"or name one in the variable CXX; got {compiler!r}. ONNX and pt2 need none."
        )


def export_onnx(program: ExportedProgram, path: Path, inputs: list[str], outputs: list[str]) -> None:
    """Write a program of `trace` as an ONNX model.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> policy = deploy.policy_of(adp.LQR(plant, cost))
        >>> program = deploy.trace(policy, torch.zeros(1, 2).double())
        >>> deploy.export_onnx(program, Path("policy.onnx"), ["state"], ["control"])  # doctest: +SKIP

        Shown by `staf-export RUN --to onnx`.

    Args:
        program: the program.
        path: of the file.
        inputs: the name of its input, a list of one.
        outputs: the names of its outputs.

    Raises:
        ValueError: if the extra ``onnx`` is not installed.
    """
    need_onnx()
    with warnings.catch_warnings(action="ignore"):
        model = torch.onnx.export(
            program, dynamo=True, input_names=inputs, output_names=outputs, verbose=False, optimize=True
        )
        assert model is not None
        model.save(str(path))


def export_program(program: ExportedProgram, path: Path, note: Mapping[str, object]) -> None:
    """Write a program of `trace` with a note of what it is; `load_program` reads both.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> policy = deploy.policy_of(adp.LQR(plant, cost))
        >>> program = deploy.trace(policy, torch.zeros(1, 2).double())
        >>> deploy.export_program(program, Path("policy.pt2"), {"plant": "two states"})
        >>> deploy.load_program("policy.pt2")[1]
        {'format': 1, 'plant': 'two states'}

        Shown by `staf-export RUN --to pt2`.
    """
    text = json.dumps({"format": FORMAT, **note}, indent=2)
    torch.export.save(program, path, extra_files={_NOTE: text})


def load_program(path: str | Path) -> tuple[ExportedProgram, dict[str, object]]:
    """A program that `export_program` wrote, and its note.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> policy = deploy.policy_of(adp.LQR(plant, cost))
        >>> program = deploy.trace(policy, torch.zeros(1, 2).double())
        >>> deploy.export_program(program, Path("policy.pt2"), {"plant": "two states"})
        >>> deploy.load_program("policy.pt2")[1]
        {'format': 1, 'plant': 'two states'}

        Shown by `staf-export RUN --to pt2`.

    Raises:
        ValueError: if the file is not one of ours, or of a later format.
    """
    note = {_NOTE: ""}
    try:
        with warnings.catch_warnings(action="ignore"):  # torch 2.9 warns of a file that it then refuses
            program = torch.export.load(path, extra_files=note)
    except Exception as error:  # torch raises errors of all sorts for what is no archive
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        rule = f"must be a .pt2 file of staf-export ({reason})"
        raise fail("load_program", "path", rule, str(path)) from error
    if not note[_NOTE]:
        raise fail("load_program", "path", "must have been written by staf-export", str(path))
    said = json.loads(note[_NOTE])
    if said.get("format") != FORMAT:
        raise ValueError(
            f"{path} has format {said.get('format')} (staf_torch {said.get('version')}), and this version "
            f"reads format {FORMAT}: export the run anew."
        )
    return program, said


def export_package(program: ExportedProgram, path: Path) -> None:
    """Compile a program of `trace` into an AOTInductor package, for one thread.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> policy = deploy.policy_of(adp.LQR(plant, cost))
        >>> program = deploy.trace(policy, torch.zeros(1, 2).double())
        >>> deploy.export_package(program, Path("policy_compiled.pt2"))  # doctest: +SKIP

        Shown by `staf-export RUN --to pt2`.

    Raises:
        ValueError: if there is no C++ compiler.
    """
    need_compiler()
    with warnings.catch_warnings(action="ignore"):
        torch._inductor.aoti_compile_and_package(
            program, package_path=str(path), inductor_configs={"cpp.threads": 1}
        )


def runner_onnx(path: Path) -> Run:
    """An ONNX file in onnxruntime, on one thread."""
    need_onnx()
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name

    def run(x: Tensor) -> tuple[Tensor, ...]:
        return tuple(torch.from_numpy(out) for out in session.run(None, {name: x.numpy()}))

    return run


def runner_program(path: Path) -> Run:
    """A .pt2 program in eager torch."""
    module = load_program(path)[0].module()
    return lambda x: as_tuple(module(x))


def runner_package(path: Path) -> Run:
    """An AOTInductor package."""
    package = torch._inductor.aoti_load_package(str(path))
    return lambda x: as_tuple(package(x))


def as_tuple(out: Tensor | tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Return an output, or several, as a tuple."""
    return (out,) if isinstance(out, Tensor) else tuple(out)
