"""A module as one graph of tensor operations, which every format starts from; a step of it as scalars."""

from __future__ import annotations

import math
import operator
import warnings
from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor, fx, nn
from torch._decomp import core_aten_decompositions
from torch.export import Dim, ExportedProgram
from torch.fx.experimental.proxy_tensor import make_fx

from ..lanes.calls.inputs import Given
from ..lanes.trace.row_independence import doubt
from ..lanes.trace.step import Step, Traced
from ..lanes.trace.step import trace as trace_step
from ..lanes.trace.tracer import NotLoweredError
from ..numerics.checks import fail, integer, trailing

_TRACED = 3  # rows of the batch while tracing: a size that no other dimension is taken for by chance


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


def traced_row(step: Step, row: Mapping[str, Tensor]) -> Traced | None:
    """Return the trace of a step of a row without a carry, (1, ...); None where it has no scalar form."""
    two = {key: part.expand(2, *part.shape[1:]).contiguous() for key, part in row.items()}
    given = Given.of((), (), two, 1)
    try:
        traced = trace_step(step, given, folded=True)
    except NotLoweredError:
        return None
    real = next(iter(row.values())).dtype
    plain = all(len(shape) < 2 and dtype == real for shape, dtype in traced.outputs)
    return traced if plain and doubt(step, given) is None else None
