"""Numbers of a graph as tensors of its dtype: `torch.onnx` would round those of float64 to float32."""

from __future__ import annotations

import struct
from typing import Any

import torch
from torch import Tensor, fx

_ATEN = torch.ops.aten
_TENSOR: dict[Any, Any] = {
    **{getattr(_ATEN, name).Tensor: getattr(_ATEN, name).Tensor for name in ("add", "sub", "mul", "div")},
    **{getattr(_ATEN, name).Scalar: getattr(_ATEN, name).Tensor for name in ("add", "sub", "mul", "div")},
    **{getattr(_ATEN, name).Scalar: getattr(_ATEN, name).Tensor for name in ("le", "lt", "ge", "gt")},
    _ATEN.pow.Tensor_Scalar: _ATEN.pow.Tensor_Tensor,
}
"""Operation: the same between tensors."""


def lift_numbers(graph: fx.GraphModule) -> fx.GraphModule:
    """The same graph with the numbers that float32 does not hold exactly as constants of their own."""
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
            value = torch.tensor(arguments[at], dtype=dtype)
            graph.register_buffer(name, value)
            with graph.graph.inserting_before(node):
                constant = graph.graph.get_attr(name)
            constant.meta["val"] = value
            arguments[at] = constant
        node.target, node.args = _TENSOR[node.target], tuple(arguments)
    graph.recompile()
    return graph


def _inexact(value: float) -> bool:
    if value != value or value in (float("inf"), float("-inf")):
        return False
    try:
        rounded: float = struct.unpack("f", struct.pack("f", value))[0]
    except OverflowError:
        return True
    return rounded != value
