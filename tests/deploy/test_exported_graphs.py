"""Graphs of tensor operations that are exported: constants are folded, numbers keep their digits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, fx, nn
from torch.fx.experimental.proxy_tensor import make_fx

from staf_torch.deploy.graph import fold, lift_numbers, trace

X = torch.tensor([[1.0, -2.0], [0.5, 4.0]], dtype=torch.float64)
TABLE = torch.arange(4, dtype=torch.float64).view(2, 2)
LONG = torch.arange(4000, dtype=torch.float64)


def graph_of(function: Callable[[Tensor], Any], x: Tensor = X) -> fx.GraphModule:
    made: fx.GraphModule = make_fx(function)(x)
    return made


def operations(graph: fx.GraphModule) -> list[str]:
    return [str(node.target) for node in graph.graph.nodes if node.op == "call_function"]


def unread(x: Tensor) -> Tensor:
    x.cos()
    TABLE.exp()
    return x + 1.5


def both(x: Tensor) -> Tensor:
    root = TABLE[1].sqrt()  # read by a row, and by what is folded
    return x * root + root.sum()


FOLDED: dict[
    str, tuple[Callable[[Tensor], Tensor], list[str], list[int]]
] = {  # operations, and sizes of constants
    "of a table": (
        lambda x: x @ (TABLE.exp() + torch.ones(2, dtype=torch.float64)).mT + x.sin(),
        ["aten.mm.default", "aten.sin.default", "aten.add.Tensor"],
        [4],
    ),
    "that nobody reads": (unread, ["aten.add.Tensor"], []),
    "of part of a long one": (lambda x: x * LONG[10:12], ["aten.mul.Tensor"], [2]),
    "for both": (both, ["aten.mul.Tensor", "aten.add.Tensor"], [1, 2]),
    "made of nothing": (lambda x: x + torch.eye(2, dtype=torch.float64) * 3, ["aten.add.Tensor"], [4]),
    "one of several results": (lambda x: x + TABLE.aminmax()[1], ["aten.add.Tensor"], [1]),
}


@pytest.mark.parametrize("name", FOLDED)
def test_what_depends_on_constants_alone_is_computed_once(name: str) -> None:
    function, left, sizes = FOLDED[name]
    graph = fold(graph_of(function))
    assert torch.equal(graph(X), function(X))
    assert operations(graph) == left
    constants = dict(graph.named_buffers())
    assert sorted(each.numel() for each in constants.values()) == sizes
    for (
        each
    ) in constants.values():  # a file holds no more than these numbers, and none of the module's own memory
        assert each.untyped_storage().nbytes() == 8 * each.numel()
    graph.graph.lint()


def test_what_depends_on_the_size_of_the_batch_is_left_to_the_graph() -> None:
    def sized(x: Tensor) -> Tensor:
        return x + torch.ones(x.shape[0], 1, dtype=torch.float64)

    symbolic: Any = make_fx(sized, tracing_mode="symbolic")
    graph = fold(symbolic(torch.ones(3, 2, dtype=torch.float64)))
    for rows in (1, 2, 5):
        assert graph(torch.ones(rows, 2, dtype=torch.float64)).tolist() == [[2.0, 2.0]] * rows


NUMBERS: dict[str, Callable[[Tensor], Any]] = {
    "sum": lambda x: x + 0.1,
    "difference": lambda x: x - 0.1,
    "product": lambda x: x * 0.1,
    "quotient": lambda x: x / 0.3,
    "at most": lambda x: x <= 0.1,
    "less": lambda x: x < 0.1,
    "at least": lambda x: x >= 0.1,
    "more": lambda x: x > 0.1,
    "power": lambda x: x.abs() ** 0.1,
    "beyond single precision": lambda x: x * 1e50,
    "below single precision": lambda x: x + 2.0**-150,
    "several": lambda x: (x * 0.1 + 0.7).clamp(0.2, 0.9) * 0.3,
}


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_that_single_precision_does_not_hold_becomes_a_tensor(name: str) -> None:
    graph = lift_numbers(graph_of(NUMBERS[name]))
    constants = dict(graph.named_buffers())
    assert len(constants) == (3 if name == "several" else 1)
    assert {each.dtype for each in constants.values()} == {torch.float64}
    assert not any(
        isinstance(a, float) for n in graph.graph.nodes for a in n.args if "clamp" not in str(n.target)
    )
    assert torch.equal(graph(X), NUMBERS[name](X))


def test_numbers_that_single_precision_holds_stay_as_they_are() -> None:
    graph = lift_numbers(graph_of(lambda x: (x * 0.5 + 3.0) / 1024.0 - 2 + float("inf")))
    assert not dict(graph.named_buffers())
    single = lift_numbers(graph_of(lambda x: x * 0.1, X.float()))
    assert [each.dtype for each in single.buffers()] == [torch.float32]


class Slope(nn.Module):
    """A derivative inside, a layer that drops in training, a number and a table."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(2, 2), nn.Dropout(), nn.Tanh()).double()

    def forward(self, x: Tensor) -> Tensor:
        return torch.func.grad(lambda at: (self.layers(at) @ TABLE.exp() * 0.1).sin().sum())(x)


@pytest.mark.parametrize("batch", [None, 5])
def test_a_module_is_traced_for_a_batch_or_for_any(batch: int | None) -> None:
    module = Slope().train()
    program = trace(module, X, batch=batch)
    assert not module.training
    for rows in (batch,) if batch else (1, 2, 7):
        x = torch.randn(rows, 2, dtype=torch.float64)
        torch.testing.assert_close(program.module()(x), module(x), rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(
    ("example", "options", "message"),
    [
        *((torch.zeros(shape), {}, r"trace\(example=...\)") for shape in ((), (2,), (2, 2, 2), (0, 2))),
        *((torch.zeros(1, 2), {"batch": batch}, r"trace\(batch=...\)") for batch in (0, -1, 1.5)),
    ],
)
def test_a_bad_argument_is_named(example: Tensor, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        trace(nn.Identity(), example, **options)


@pytest.mark.parametrize(("batch", "said"), [(None, "any batch"), (4, "a batch of 4")])
def test_what_cannot_be_traced_is_said_in_a_line(batch: int | None, said: str) -> None:
    class Deciding(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            raise KeyError("why\nand where")

    with pytest.raises(ValueError, match=rf"^`Deciding` cannot be exported for {said}: 'why\\nand where'$"):
        trace(Deciding(), torch.zeros(1, 2), batch=batch)
