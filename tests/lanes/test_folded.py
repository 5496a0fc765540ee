"""Graphs of tensor operations before they are exported: constants are folded, numbers become tensors."""

from __future__ import annotations

import math
import operator
import warnings
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, fx, nn
from torch.fx.experimental.proxy_tensor import make_fx

from staf_torch.lanes import tracing
from staf_torch.lanes.float64_constants import _inexact, lift_numbers
from staf_torch.lanes.tracing import _attribute, _returns_tensor, fold

ATEN = torch.ops.aten
X = torch.tensor([[1.0, -2.0], [0.5, 4.0]], dtype=torch.float64)


def graph_of(function: Callable[[Tensor], Any], x: Tensor = X) -> fx.GraphModule:
    made: fx.GraphModule = make_fx(function)(x)
    return made


def operations(graph: fx.GraphModule) -> list[str]:
    return [str(node.target) for node in graph.graph.nodes if node.op == "call_function"]


def constants(graph: fx.GraphModule) -> dict[str, Tensor]:
    return dict(graph.named_buffers())


def test_what_depends_on_constants_alone_is_computed_once() -> None:
    table = torch.arange(4, dtype=torch.float64).view(2, 2)
    graph = graph_of(lambda x: x @ (table.exp() + torch.ones(2, dtype=torch.float64)).mT + x.sin())
    assert len(operations(graph)) > 4
    before = graph(X)
    folded = fold(graph)
    assert folded is graph
    assert torch.equal(folded(X), before)
    assert operations(folded) == ["aten.mm.default", "aten.sin.default", "aten.add.Tensor"]
    (name,) = constants(folded)
    assert name.startswith("folded_")
    assert torch.equal(constants(folded)[name], (table.exp() + 1).mT)
    assert name in folded.code
    (node,) = (node for node in folded.graph.nodes if node.op == "get_attr")
    assert node.meta["val"].shape == (2, 2)  # what a later pass knows about it
    folded.graph.lint()


def test_what_nobody_reads_is_left_out() -> None:
    table = torch.arange(3, dtype=torch.float64)

    def unread(x: Tensor) -> Tensor:
        x.cos()
        table.exp()
        return x + 1.5

    graph = fold(graph_of(unread))
    assert operations(graph) == ["aten.add.Tensor"]
    assert constants(graph) == {}
    assert not [node for node in graph.graph.nodes if node.op == "get_attr"]
    assert torch.equal(graph(X), X + 1.5)


def test_a_constant_that_is_read_as_it_is_stays_and_holds_no_more_than_its_own_numbers() -> None:
    table = torch.arange(4000, dtype=torch.float64)

    class Held(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("few", table[10:12])

        def forward(self, x: Tensor) -> Tensor:
            return x * self.few

    module = Held()
    graph = graph_of(lambda x: x * module.few)
    graph = fold(graph)
    (held,) = constants(graph).values()
    assert held.tolist() == [10.0, 11.0]
    assert held.untyped_storage().nbytes() == 16
    assert held.data_ptr() != table[10:].data_ptr()  # nor is it the module's own memory
    assert torch.equal(graph(X), X * table[10:12])


def test_constants_that_feed_both_kinds_of_operations_are_folded_where_a_row_reads_them() -> None:
    table = torch.tensor([2.0, 3.0], dtype=torch.float64)

    def both(x: Tensor) -> tuple[Tensor, Tensor]:
        root = table.sqrt()  # read by a row, and by what is folded
        return x * root, x + root.sum()

    graph = fold(graph_of(both))
    assert sorted(operations(graph)) == ["aten.add.Tensor", "aten.mul.Tensor"]
    assert sorted(each.numel() for each in constants(graph).values()) == [1, 2]
    for found, wanted in zip(graph(X), both(X), strict=True):
        assert torch.equal(found, wanted)


def test_what_is_made_of_nothing_is_a_constant_where_its_size_is_known() -> None:
    graph = fold(graph_of(lambda x: x + torch.eye(2, dtype=torch.float64) * 3))
    assert operations(graph) == ["aten.add.Tensor"]
    assert constants(graph).popitem()[1].tolist() == [[3.0, 0.0], [0.0, 3.0]]

    def sized(x: Tensor) -> Tensor:
        return x + torch.ones(x.shape[0], 1, dtype=torch.float64)

    symbolic: Any = make_fx(sized, tracing_mode="symbolic")
    graph = fold(symbolic(torch.ones(3, 2, dtype=torch.float64)))
    assert any("ones" in name or "full" in name for name in operations(graph))
    for rows in (1, 2, 5):
        assert graph(torch.ones(rows, 2, dtype=torch.float64)).tolist() == [[2.0, 2.0]] * rows


def test_operations_with_several_results_and_none_are_left_to_the_graph() -> None:
    graph = fx.Graph()
    x = graph.placeholder("x")
    table = graph.get_attr("table")
    pair = graph.call_function(ATEN.aminmax.default, (table,))
    least = graph.call_function(operator.getitem, (pair, 0))
    graph.output(graph.call_function(ATEN.add.Tensor, (x, least)))
    root = nn.Module()
    root.register_buffer("table", torch.tensor([3.0, 1.0, 2.0], dtype=torch.float64))
    made = fold(fx.GraphModule(root, graph))
    assert operations(made) == ["aten.add.Tensor"]
    assert constants(made).popitem()[1].item() == 1.0
    assert torch.equal(made(X), X + 1)


def test_an_attribute_is_found_by_its_path() -> None:
    module = nn.Sequential(nn.Linear(2, 2))
    found = fx.symbolic_trace(module)
    assert _attribute(found, "0.weight") is getattr(found, "0").weight


def test_a_tensor_of_a_size_that_is_known_is_told_from_others() -> None:
    def node(value: Any) -> fx.Node:
        made = fx.Graph().create_node("call_function", torch.ones, (1,))
        if value is not None:
            made.meta["val"] = value
        return made

    assert _returns_tensor(node(torch.ones(2)))
    assert not _returns_tensor(node(3))
    assert not _returns_tensor(node(None))
    symbolic: Any = make_fx(lambda x: x.sin(), tracing_mode="symbolic")
    (sine,) = (n for n in symbolic(torch.ones(3, 2)).graph.nodes if n.op == "call_function")
    assert not _returns_tensor(sine)


# Numbers.


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
}


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_that_single_precision_does_not_hold_becomes_a_tensor(name: str) -> None:
    graph = graph_of(NUMBERS[name])
    lifted = lift_numbers(graph)
    assert lifted is graph
    (constant,) = constants(lifted).items()
    assert constant[0] == "number_0"
    assert constant[1].dtype == torch.float64
    assert constant[1].item() == (0.3 if name == "quotient" else 0.1)
    assert operations(lifted)[-1].endswith((".Tensor", ".Tensor_Tensor"))
    assert not any(isinstance(a, float) for n in lifted.graph.nodes for a in n.args)
    assert "number_0" in lifted.code  # what runs is the new graph
    (node,) = (n for n in lifted.graph.nodes if n.op == "get_attr")
    assert torch.equal(node.meta["val"], constant[1])
    assert torch.equal(lifted(X), NUMBERS[name](X))


def test_numbers_that_single_precision_holds_stay_as_they_are() -> None:
    graph = lift_numbers(graph_of(lambda x: (x * 0.5 + 3.0) / 1024.0 - 2))
    assert constants(graph) == {}
    assert sum(isinstance(a, float) for n in graph.graph.nodes for a in n.args) == 3


def test_every_number_gets_a_name_of_its_own_and_other_operations_keep_theirs() -> None:
    graph = lift_numbers(graph_of(lambda x: (x * 0.1 + 0.7).clamp(0.2, 0.9) * 0.3))
    assert {k: v.item() for k, v in constants(graph).items()} == {
        "number_0": 0.1,
        "number_1": 0.7,
        "number_2": 0.3,
    }
    assert torch.equal(graph(X), (X * 0.1 + 0.7).clamp(0.2, 0.9) * 0.3)
    single = lift_numbers(graph_of(lambda x: x * 0.1, X.float()))
    assert constants(single)["number_0"].dtype == torch.float32


def test_which_numbers_single_precision_holds() -> None:
    for value in (0.0, -0.0, 1.0, 0.5, -3.0, 2.0**100, 2.0**-140, math.inf, -math.inf, math.nan, 16777216.0):
        assert not _inexact(value), value
    for value in (0.1, 1 + 2**-24, 16777217.0, 1e39, -1e39, 1e-50, 2.0**-150, math.pi):
        assert _inexact(value), value


# What is asked of a caller.


@pytest.mark.parametrize("shape", [(), (2,), (2, 2, 2), (0, 2)])
def test_an_example_is_a_batch_of_states(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"trace\(example=...\)"):
        tracing.trace(nn.Identity(), torch.zeros(shape))


@pytest.mark.parametrize("batch", [0, -1, 1.5])
def test_a_batch_has_a_row_at_least(batch: Any) -> None:
    with pytest.raises(ValueError, match=r"trace\(batch=...\)"):
        tracing.trace(nn.Identity(), torch.zeros(1, 2), batch=batch)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What torch is asked for, which answers at once."""
    found: dict[str, Any] = {}

    def make(module: nn.Module, table: Any, **options: Any) -> Callable[[Tensor], str]:
        warnings.warn("of the tracer about its own", stacklevel=1)  # nobody hears of it
        found.update(module=module, options=options)
        return lambda x: found.update(traced=x) or "graph"  # type: ignore[func-returns-value]

    def export(graph: str, given: tuple[Tensor], **options: Any) -> SimpleNamespace:
        found.update(exported=(graph, given[0]), **options)
        return SimpleNamespace(run_decompositions=lambda table: ("decomposed", table))

    monkeypatch.setattr(tracing, "make_fx", make)
    monkeypatch.setattr(tracing, "fold", lambda graph: f"folded {graph}")
    monkeypatch.setattr(tracing, "lift_numbers", lambda graph: f"lifted {graph}")
    monkeypatch.setattr(torch.export, "export", export)
    return found


@pytest.mark.parametrize("batch", [None, 1, 5])
def test_a_module_is_traced_for_a_batch_or_for_any(batch: int | None, asked: dict[str, Any]) -> None:
    module = nn.Sequential(nn.Linear(2, 2), nn.Dropout()).train()
    example = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    program: Any = tracing.trace(module, example, batch=batch)
    assert program == ("decomposed", {})
    assert asked["exported"][0] == "lifted folded graph"
    x = asked["traced"]
    assert asked["exported"][1] is x
    assert x.shape[1:] == (2,)
    assert len(x) == batch if batch is not None else len(x) > 2
    assert torch.equal(x, example[:1].expand_as(x))
    assert not module.training
    assert not any(each.requires_grad for each in module.parameters())
    mode = "symbolic" if batch is None else "real"
    assert asked["options"] == {"tracing_mode": mode, "_allow_non_fake_inputs": True}
    if batch is not None:
        assert asked["dynamic_shapes"] is None
    else:
        ((axis, dim),) = asked["dynamic_shapes"][0].items()
        assert (axis, dim.__name__, dim.min) == (0, "batch", 1)


@pytest.mark.parametrize(("batch", "said"), [(None, "any batch"), (4, "a batch of 4")])
def test_what_cannot_be_traced_is_said_in_a_line(
    batch: int | None, said: str, asked: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fold(graph: str) -> None:
        raise KeyError("why\nand where")

    monkeypatch.setattr(tracing, "fold", fold)
    with pytest.raises(ValueError, match=rf"^`Identity` cannot be exported for {said}: 'why\\nand where'$"):
        tracing.trace(nn.Identity(), torch.zeros(1, 2), batch=batch)
