"""A module as one graph of tensor operations, and the files of it: ONNX, `torch.export`, AOTInductor."""

from __future__ import annotations

import importlib.util
import json
import logging
import math
import operator
import os
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, fx, nn
from torch._decomp import core_aten_decompositions
from torch.export import Dim, ExportedProgram
from torch.fx.experimental.proxy_tensor import make_fx

from ..numerics.checks import fail, integer, trailing
from ..signs import Sign
from .controllers import check_count, check_dtype, function_name, listed_names
from .data_sheet import Source
from .onnx_writer import OnnxWriter

FORMAT = 1
"""Of the note inside a .pt2 file; raised when an older reader would go wrong."""
_NOTE = "staf_torch.json"
Run = Callable[[Tensor], tuple[Tensor, ...]]
"""An exported file, loaded: (B, n) -> its outputs."""


_TRACED = 3  # rows of the batch while tracing: a size that no other dimension is taken for by chance


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
    found_compiler(
        "CXX",
        ("g++", "clang++"),
        "AOTInductor compiles C++, and there is no compiler here: install g++ (apt-get install g++) "
        "or name one in the variable CXX",
        " ONNX and pt2 need none.",
    )


def found_compiler(variable: str, names: Sequence[str], rule: str, beside: str = "") -> str:
    """Return the compiler that a variable of the environment names, else the first of these that is here."""
    found = os.environ.get(variable) or next(filter(shutil.which, names), None)
    if found is None or shutil.which(found) is None:
        raise ValueError(f"{rule}; got {found!r}.{beside}")
    return found


def trace(module: nn.Module, example: Tensor, *, batch: int | None = None) -> ExportedProgram:
    """The module as a `torch.export` program of core operations, with its constants folded.

    Derivatives inside the module become ordinary operations.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> policy = deploy.policy_of(adp.LQR(plant, cost))
        >>> program = deploy.trace(policy, torch.zeros(1, 2).double())
        >>> program.module()(torch.tensor([[0.0, 1.0]]).double()).shape
        torch.Size([1, 1])

        Shown by `staf-export RUN --to pt2`.

    Args:
        module: (B, n) -> a tensor or a tuple of tensors.
        example: an input, (B, n) with any B from 1; its values do not matter, its dtype does.
        batch: B; any by default.

    Raises:
        ValueError: if an argument breaks its rule, or the module cannot be traced for every batch.
    """
    if trailing("trace", "example", example, dims=2).dim() > 2 or not len(example):
        raise fail("trace", "example", "must be states (B, n), one at least", tuple(example.shape))
    rows = _TRACED if batch is None else integer("trace", "batch", batch, least=1)
    x = example[:1].detach().expand(rows, -1).clone()
    shapes = ({0: Dim("batch", min=1)},) if batch is None else None
    module = module.eval().requires_grad_(False)
    with warnings.catch_warnings(action="ignore"), torch.no_grad():  # of the tracer, about its own internals
        try:
            # First to operations, derivatives and all, which `torch.export` alone does not take.
            mode: Literal["symbolic", "real"] = "symbolic" if batch is None else "real"
            table: Any = core_aten_decompositions()
            graph = make_fx(module, table, tracing_mode=mode, _allow_non_fake_inputs=True)(x)
            graph = lift_numbers(fold(graph))
            program: ExportedProgram = torch.export.export(graph, (x,), dynamic_shapes=shapes)
            decomposed: ExportedProgram = program.run_decompositions({})
            return decomposed
        except Exception as error:  # the tracer raises errors of all sorts
            raise ValueError(
                f"`{type(module).__name__}` cannot be exported for "
                f"{'any batch' if batch is None else f'a batch of {batch}'}: {str(error).splitlines()[0]}"
            ) from error


def fold(graph: fx.GraphModule) -> fx.GraphModule:
    """Return the graph with every operation on constants alone done once, here."""
    known: dict[fx.Node, Any] = {}
    for node in graph.graph.nodes:
        if node.op == "get_attr":
            known[node] = operator.attrgetter(str(node.target))(graph)
        elif node.op == "call_function" and all(parent in known for parent in node.all_input_nodes):
            made = node.meta.get("val")
            fixed = isinstance(made, Tensor) and not any(isinstance(n, torch.SymInt) for n in made.shape)
            if not node.all_input_nodes and not fixed:
                continue
            args, kwargs = fx.map_arg((node.args, node.kwargs), known.__getitem__)
            assert callable(node.target)
            known[node] = node.target(*args, **kwargs)
    for number, (node, value) in enumerate(known.items()):
        used_here = all(user in known for user in node.users)
        if node.op == "get_attr" or not isinstance(value, Tensor) or used_here:
            continue
        name = f"folded_{number}"
        graph.register_buffer(name, value.detach().clone())
        with graph.graph.inserting_before(node):
            constant = graph.graph.get_attr(name)
        constant.meta = dict(node.meta)
        node.replace_all_uses_with(constant)
    graph.graph.eliminate_dead_code()
    used = {str(node.target) for node in graph.graph.nodes if node.op == "get_attr"}
    for name, buffer in list(graph.named_buffers()):
        if name in used:
            setattr(graph, name, buffer.detach().clone())  # not a view of more than a file should hold
    for name, _ in [*graph.named_buffers(), *graph.named_parameters()]:
        if name not in used:
            delattr(graph, name)
    graph.recompile()
    return graph


_ATEN = torch.ops.aten
_TENSOR: dict[Any, Any] = {
    **{getattr(_ATEN, name).Tensor: getattr(_ATEN, name).Tensor for name in ("add", "sub", "mul", "div")},
    **{getattr(_ATEN, name).Scalar: getattr(_ATEN, name).Tensor for name in ("add", "sub", "mul", "div")},
    **{getattr(_ATEN, name).Scalar: getattr(_ATEN, name).Tensor for name in ("le", "lt", "ge", "gt")},
    _ATEN.pow.Tensor_Scalar: _ATEN.pow.Tensor_Tensor,
}
"""Operation: the same between tensors."""


def lift_numbers(graph: fx.GraphModule) -> fx.GraphModule:
    """Return the graph with the numbers that float32 does not hold exactly as constants of their own."""
    count = 0
    for node in list(graph.graph.nodes):
        inexact = [at for at, value in enumerate(node.args) if isinstance(value, float) and _inexact(value)]
        if node.target not in _TENSOR or not inexact:
            continue
        dtype = next(n.meta["val"].dtype for n in node.all_input_nodes if isinstance(n.meta["val"], Tensor))
        arguments = list(node.args)
        for at in inexact:
            name = f"number_{count}"
            count += 1
            value = torch.tensor(arguments[at], dtype=dtype, device="cpu")
            graph.register_buffer(name, value)
            with graph.graph.inserting_before(node):
                constant = graph.graph.get_attr(name)
            constant.meta["val"] = value
            arguments[at] = constant
        node.target, node.args = _TENSOR[node.target], tuple(arguments)
    graph.recompile()
    return graph


def _inexact(value: float) -> bool:
    return math.isfinite(value) and torch.tensor(value, dtype=torch.float32, device="cpu").item() != value


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
    name = function_name("export_onnx", name, program if isinstance(program, nn.Module) else None)
    if isinstance(program, nn.Module):
        module = program
        if example is None:
            raise fail("export_onnx", "example", "must be given with a module: an input (B, n)", example)
        if trailing("export_onnx", "example", example, dims=2).dim() > 2 or not len(example):
            raise fail("export_onnx", "example", "must be states (B, n), one at least", tuple(example.shape))
        if batch is not None:
            integer("export_onnx", "batch", batch, least=1)
        check_dtype("export_onnx", module, example)
        written = in_loops(module, example, path, names, batch, name)
        if written is not None:
            return written
        program = trace(module, example, batch=batch)
    model = _unrolled(program, names)
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


def in_loops(
    module: nn.Module, example: Tensor, path: Path, names: Sequence[str], batch: int | None, name: str
) -> Source | None:
    """Write a module (B, n) -> a tensor, or a tuple of tensors (B,) and (B, m), with loops as an ONNX model,
    and return the cost of a call; None where it has none, or rows that are not alone.

    ``names`` are of the input and the outputs, ``name`` that of the graph; ``batch`` are rows, None for any.
    """
    writer = OnnxWriter(np.dtype(np.float32 if example.dtype == torch.float32 else np.float64), names[0])
    with torch.no_grad():
        found = writer.policy(module, example[:1].detach(), names[0])
    if found is None:
        return None
    check_count("export_onnx", names[1:], len(found))
    path.write_bytes(writer.model(name, names, found, example.shape[-1], batch).SerializeToString())
    return writer.source


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
