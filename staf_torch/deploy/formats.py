"""The files: ONNX, `torch.export`, AOTInductor."""

from __future__ import annotations

import importlib.util
import json
import logging
import os
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.export import ExportedProgram

from ..numerics.checks import fail, integer, trailing
from ..signs import Sign
from .data_sheet import Source
from .graph import trace
from .names import check_count, check_dtype, function_name, listed_names
from .onnx_writer import OnnxWriter

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


@Sign("export to ONNX")
def export_onnx(
    program: ExportedProgram | nn.Module,
    path: Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    example: Tensor | None = None,
    batch: int | None = None,
    name: str | None = None,
) -> Source | None:
    """Write a module, or a program of `trace`, as an ONNX model.

    A module whose loops a row program keeps (a rollout, a filter) is written in a second, with ONNX's Loop in
    the place of each; any other one as `trace` has it. A program of `trace` has its loops unrolled: minutes
    to write, and quicker to call.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> policy = deploy.policy_of(adp.LQR(plant, cost))
        >>> x = torch.zeros(1, 2).double()
        >>> path = Path("policy.onnx")
        >>> deploy.export_onnx(policy, path, ["state"], ["control"], example=x)  # doctest: +SKIP

        Shown by `staf-export RUN --to onnx`.

    Args:
        program: a module, (B, n) -> a tensor or a tuple of them, or a program.
        path: of the file.
        inputs: the name of its input, a list of one.
        outputs: the names of its outputs.
        example: of a module: an input, (B, n), in its dtype.
        batch: of a module: fixed number of rows of a call; any by default.
        name: of the graph; that of the policy by default.

    Returns:
        The cost of a call where loops are kept, None elsewhere: `trace` has the operations.

    Raises:
        ValueError: if the extra ``onnx`` is not installed, a name is there twice, the number of names is
            wrong, or an argument is missing.
    """
    need_onnx()
    names = [*_named("inputs", inputs), *_named("outputs", outputs)]
    twice = [each for each in names if names.count(each) > 1]
    if twice:
        rule = "must differ from each other and from the input"
        raise fail("export_onnx", "outputs", rule, twice[0])
    if len(inputs) != 1:
        raise fail("export_onnx", "inputs", "must be one name", list(inputs))
    module = program if isinstance(program, nn.Module) else None
    name = function_name("export_onnx", name, module)
    if module is None:
        assert not isinstance(program, nn.Module)
        model = _unrolled(program, names)
    else:
        if example is None:
            raise fail("export_onnx", "example", "must be given with a module: an input (B, n)", example)
        if trailing("export_onnx", "example", example, dims=2).dim() > 2 or not len(example):
            raise fail("export_onnx", "example", "must be states (B, n), one at least", tuple(example.shape))
        if batch is not None:
            integer("export_onnx", "batch", batch, least=1)
        check_dtype("export_onnx", module, example)
        written = in_loops(module, example, names, batch, name)
        if written is not None:
            path.write_bytes(written.model.SerializeToString())
            return written.source
        model = _unrolled(trace(module, example, batch=batch), names)
    model.graph.name = name
    path.write_bytes(model.SerializeToString())
    return None


def _named(argument: str, names: Sequence[str]) -> list[str]:
    """Return names as a list, refused where a file with them could not be loaded."""
    found = listed_names("export_onnx", names, argument)
    for each in found:
        if not each or each.startswith("_"):
            raise fail("export_onnx", argument, "must not be empty or begin with _", each)
    return found


def _unrolled(program: ExportedProgram, names: Sequence[str]) -> Any:
    """Return the ONNX model of a program, in which no name within is one of those given."""
    count = len(program.graph_signature.user_outputs)
    check_count("export_onnx", names[1:], count)
    # The exporter warns that torchvision is not there, for operators that nothing here has.
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    own = ["_input", *(f"_output_{k}" for k in range(count))]
    with warnings.catch_warnings(action="ignore"):
        made = torch.onnx.export(
            program, dynamo=True, input_names=own[:1], output_names=own[1:], verbose=False, optimize=True
        )
    assert made is not None
    return renamed(made.model_proto, dict(zip(own, names, strict=True)))


@Sign("export to a torch program")
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


@Sign("export to a package of AOTInductor")
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


class OnnxFile(NamedTuple):
    """A model, and the cost of a call for a row."""

    model: Any
    source: Source


def in_loops(
    module: nn.Module, example: Tensor, names: Sequence[str], batch: int | None, name: str
) -> OnnxFile | None:
    """Return a module (B, n) -> a tensor, or a tuple of tensors (B,) and (B, m), with loops as an ONNX model;
    None where it has none, or rows that are not alone.

    ``names`` are of the input and the outputs, ``name`` that of the graph; ``batch`` are rows, None for any.
    """
    writer = OnnxWriter(np.dtype(np.float32 if example.dtype == torch.float32 else np.float64), names[0])
    with torch.no_grad():
        found = writer.policy(module, example[:1].detach(), names[0])
    if found is None:
        return None
    check_count("export_onnx", names[1:], len(found))
    return OnnxFile(writer.model(name, names, found, example.shape[-1], batch), writer.source)


def renamed(model: Any, names: Mapping[str, str]) -> Any:
    """Return a model, as torch writes it, with other names of values, old to new; a value within that has one
    of them already gets another."""
    table = {new: f"_own_{new}" for new in names.values()} | dict(names)

    def visit(graph: Any) -> None:
        for value in (*graph.input, *graph.output, *graph.value_info, *graph.initializer):
            value.name = table.get(value.name, value.name)
        for node in graph.node:
            for ends in (node.input, node.output):
                ends[:] = [table.get(each, each) for each in ends]
            for attribute in node.attribute:
                if attribute.HasField("g"):
                    visit(attribute.g)

    visit(model.graph)
    return model
