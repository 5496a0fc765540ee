"""Policies with loops inside as ONNX models, whose graph `onnx_writer` writes; names in graphs of others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from .names import check_count
from .onnx_writer import OnnxWriter
from .scalar_program import Source


class OnnxFile(NamedTuple):
    """A model, and the cost of a call for a row."""

    model: Any
    source: Source


def in_loops(
    module: nn.Module, example: Tensor, names: Sequence[str], batch: int | None, name: str
) -> OnnxFile | None:
    """Return a module with loops as an ONNX model; None where it has none, or rows that are not alone.

    Args:
        module: (B, n) -> a tensor or a tuple of tensors (B,) and (B, m).
        example: an input, (B, n).
        names: of the input and the outputs.
        batch: rows; None for any.
        name: of the graph.
    """
    writer = OnnxWriter(np.dtype(np.float32 if example.dtype == torch.float32 else np.float64), names[0])
    with torch.no_grad():
        found = writer.policy(module, example[:1].detach(), names[0])
    if found is None:
        return None
    check_count("export_onnx", names[1:], len(found))
    return OnnxFile(writer.model(name, names, found, example.shape[-1], batch), writer.source)


def renamed(model: Any, names: Mapping[str, str]) -> Any:
    """Return a model with other names of values; a value within that has one of them already gets another.

    Args:
        model: as torch writes it.
        names: old and new.
    """
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
