"""Calls of programs within somebody's `torch.compile`: one operator, with their values and gradients."""

from __future__ import annotations

import functools
import gc
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from functorch.compile import aot_module_simplified, make_boxed_func
from helpers import tensor
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

import staf_torch as st
from staf_torch import lanes, optim, systems, targets

X = tensor([[0.5, 0.1], [0.2, -0.3], [-0.4, 0.6]])
STATES = systems.simulate(systems.Oscillator(), X, dt=0.01, steps=3)


@pytest.fixture(autouse=True)
def fresh_compiler() -> Iterator[None]:
    torch.compiler.reset()
    yield
    torch.compiler.reset()


def whole(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function as one graph, of which autograd's own compiler makes the backward pass."""
    return torch.compile(function, backend="aot_eager", fullgraph=True)


class Pendulums(nn.Module):
    """A network whose outputs start pendulums, of which a gain is learned."""

    def __init__(self) -> None:
        super().__init__()
        self.net, self.factor = nn.Linear(2, 2).double(), 1.0
        self.gain = nn.Parameter(tensor(0.3))
        self.program = lanes.Program(self.step)

    def step(self, x: Tensor, now: Any, row: Any) -> tuple[Tensor, dict[str, Tensor]]:
        x = x - 0.1 * self.factor * self.gain * x.sin()
        return x, {"energy": x.square().sum(-1), "late": x[:, 0] > 0}

    def forward(self, x: Tensor) -> Tensor:
        end, out = self.program(self.net(x), steps=20)
        loss: Tensor = end.sum() + out["energy"].square().mean()
        return loss


def gradients(function: Callable[[Tensor], Tensor], *by: Tensor) -> list[Tensor]:
    x = X.clone().requires_grad_()
    value = function(x)
    return [value.detach(), *torch.autograd.grad(value, [x, *by])]


def same(function: Callable[..., Any], compiled: Callable[..., Any], *by: Tensor) -> bool:
    return all(map(torch.equal, gradients(compiled, *by), gradients(function, *by)))


def test_a_model_of_a_network_a_program_and_a_loss_is_one_graph_with_the_gradients_of_its_call() -> None:
    model = Pendulums()
    compiled = whole(model)
    assert same(model, compiled, *model.parameters())
    with torch.no_grad():
        assert torch.equal(compiled(X[:2]), model(X[:2]))
    found = [compiled(X)]  # what a step reads may change between calls
    with torch.no_grad():
        model.gain.mul_(2)
    found.append(compiled(X))
    model.gain = nn.Parameter(tensor(0.9))
    assert same(model, compiled, *model.parameters())
    found.append(compiled(X))
    model.factor = 0.5
    assert same(model, compiled, *model.parameters())
    found.append(compiled(X))
    assert len({value.item() for value in found}) == 4


def test_a_gradient_is_that_of_the_numbers_of_its_forward_pass() -> None:
    model = Pendulums()
    compiled = whole(model)
    x = X.clone().requires_grad_()
    first, second = compiled(x), compiled(2 * x)
    expected = gradients(model)[1], gradients(lambda x: model(2 * x))[1]
    assert torch.equal(torch.autograd.grad(first, x, retain_graph=True)[0], expected[0])
    assert torch.equal(torch.autograd.grad(second, x)[0], expected[1])
    assert torch.equal(torch.autograd.grad(first, x)[0], expected[0])

    value = compiled(x)
    with torch.no_grad():
        model.gain.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        value.backward()


class Reusing(torch.fx.Interpreter):
    """Runs a graph as torch's compiler does, which uses the memory of a tensor again after its last use."""

    def run_node(self, n: torch.fx.Node) -> Any:
        found = super().run_node(n)
        gone = [node for node in self.user_to_last_uses.get(n, ()) if node.op == "call_function"]
        left = tensors([found, *(value for node, value in self.env.items() if node not in gone)])
        used = {x.untyped_storage().data_ptr() for x in left}
        for x in tensors([self.env[node] for node in gone]):
            if x.is_floating_point() and x.untyped_storage().data_ptr() not in used:
                torch.empty(0, dtype=x.dtype).set_(x.untyped_storage()).fill_(torch.nan)
        return found


def tensors(tree: Any) -> list[Tensor]:
    """Return the tensors in nested lists and tuples."""
    if isinstance(tree, list | tuple):
        return [x for part in tree for x in tensors(part)]
    return [tree] if isinstance(tree, Tensor) else []


def test_a_graph_may_use_the_memory_of_a_result_again() -> None:
    """The backward pass of a program reads results that are its carry, too."""

    def reusing(graph: torch.fx.GraphModule, inputs: Any) -> Any:
        def compiler(traced: torch.fx.GraphModule, _: Any) -> Any:
            return make_boxed_func(Reusing(traced).run)

        return aot_module_simplified(graph, inputs, fw_compiler=compiler)

    def loss(x: Tensor) -> Tensor:
        end, out = LEARNED(x, steps=20)
        value: Tensor = (2 * out).sin().square().sum() + end.sum()
        return value

    compiled = torch.compile(loss, backend=reusing, fullgraph=True)
    for _ in range(2):
        assert same(loss, compiled, GAIN)


GAIN = nn.Parameter(tensor(1.1))
LEARNED = lanes.Program(lambda x, now, row: (x - 0.1 * GAIN * x.sin(), x))
DRIVEN = lanes.Program(lambda x, u, row: (x - 0.1 * u[:, None] * x.sin() * row[0], [x.sum(-1)]))
PREPARED = LEARNED.prepare(X, steps=10)
BASIS = st.StaFBasis(st.GaussianKernel(GAIN), st.StateFollowingCenters(st.rings(3), radius=0.3))
TARGET, LAW, PLANT = targets.Paper(), optim.SteepestDescent(), systems.Pendulum()


class Damping(nn.Module):
    @lanes.compiled("a damping in a graph")
    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]
        return -GAIN * x[..., 1:].tanh()


POLICY = Damping()


def two(x: Tensor) -> Tensor:
    end, out = LEARNED(x, steps=3)
    moved = DRIVEN(end, torch.ones(3, 4).double(), (lanes.Shared(x[0]),))
    loss: Tensor = moved[0].square().sum() + moved[1][0].sum() + out.mean()
    return loss


def every(x: Tensor) -> Tensor:
    prepared = PREPARED(x)[1].square().sum()
    moved = GAIN * systems.simulate(PLANT, x, dt=0.01, steps=12).square().mean() + POLICY(x).square().sum()
    chased = st.chase(STATES + x[:, None], BASIS, TARGET, LAW).weights.square().mean()
    return checkpoint(two, x, use_reentrant=False) + prepared + moved + chased  # type: ignore[no-any-return]


def test_a_call_of_any_kind_is_an_operator_of_a_graph() -> None:
    found, wanted = gradients(whole(every), GAIN), gradients(every, GAIN)
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-12)  # sums of slopes are in another order


def test_a_change_within_the_graph_is_seen_and_in_one_graph_refused() -> None:
    """The graph breaks, as changes of objects come at its end."""

    def factor(model: Pendulums, x: Tensor) -> Tensor:
        model.factor = model.factor * 2
        return model.forward(x)

    def gain(model: Pendulums, x: Tensor) -> Tensor:
        with torch.no_grad():
            model.gain.mul_(2)
        return model.forward(x)

    def swapped(model: Pendulums, x: Tensor) -> Tensor:
        value: Tensor = torch.func.functional_call(model, {"gain": x[0, 0]}, (x,))
        return value

    for change in (factor, gain, swapped):
        torch.compiler.reset()
        model, other = Pendulums(), Pendulums()
        other.load_state_dict(model.state_dict())
        broken = torch.compile(change, backend="aot_eager")
        with torch.no_grad():
            assert torch.equal(broken(model, X), change(other, X))
        torch.compiler.reset()
        with pytest.raises(Exception, match="graph_break"):
            whole(change)(model, X)


def test_no_graph_keeps_a_program() -> None:
    model = Pendulums()
    whole(model)(X).backward()
    program = weakref.ref(model.program)
    del model
    torch.compiler.reset()  # what torch's compiler keeps is its own
    gc.collect()
    assert program() is None


def test_a_users_wrapper_of_a_call_is_read_and_not_the_call() -> None:
    @functools.wraps(systems.simulate)
    def doubled(*args: Any, **kwargs: Any) -> Tensor:
        return 2 * systems.simulate(*args, **kwargs)

    found = whole(lambda x: doubled(PLANT, x, dt=0.01, steps=5))(X)
    assert torch.equal(found, 2 * systems.simulate(PLANT, X, dt=0.01, steps=5))
