"""Layers under `torch.compile(fullgraph=True)` and `torch.export`."""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers import basis_of, uniform
from helpers_layers import learnable, target_of
from torch import Tensor, nn
from variants import over

import staf_torch as st
from staf_torch.targets import Paper


def fixed(
    kernel: str, radius: float | st.StateRadius, batch: tuple[int, ...], outputs: int | None, count: int = 6
) -> st.StaF:
    x = uniform(*batch, 2, low=0.3, seed=1)
    return st.StaF(basis_of(kernel, count, radius), batch, outputs).fit_(x, target_of(outputs))


CASES: dict[str, Callable[[], st.StaF]] = {
    "exponential": lambda: fixed("exponential", 0.4, (4,), 2),
    "matern52": lambda: fixed("matern52", 0.4, (4,), None, 3),
    "everything_learned": lambda: learnable("gaussian", "shrinking", (4,))[0],
    "polynomial_learned": lambda: learnable("polynomial", "constant", (4,), count=6)[0],
}
MODES = {"exponential": "total_frozen_weights", "everything_learned": "total"}


@over(CASES)
def test_the_whole_layer_is_one_graph(name: str) -> None:
    staf = CASES[name]()
    y = staf.state.unsqueeze(-2) + uniform(4, 3, 2, low=-0.2, high=0.2)
    mode = MODES.get(name)

    def everything(at: Tensor) -> tuple[Tensor, ...]:
        return staf.value_and_gradient(at) if mode is None else (staf(at), staf.gradient(at, mode))

    torch._dynamo.reset()
    compiled = torch.compile(everything, fullgraph=True, backend="eager")(y)
    for found, expected in zip(compiled, everything(y), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_compiled_gradients_reach_the_parameters() -> None:
    staf, y = learnable("gaussian", "constant")
    staf(y).square().sum().backward()
    expected = {key: p.grad.clone() for key, p in staf.named_parameters()}
    staf.zero_grad()
    torch._dynamo.reset()
    torch.compile(staf, fullgraph=True, backend="aot_eager")(y).square().sum().backward()
    for key, p in staf.named_parameters():
        torch.testing.assert_close(p.grad, expected[key], rtol=1e-9, atol=1e-9, msg=key)


@pytest.mark.needs_compiler
@pytest.mark.skipif(
    torch.__version__.startswith("2.6"), reason="an assertion in inductor's own backward pass"
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")  # inductor warns itself
def test_inductor_differentiates_learned_hyperparameters_of_the_newton_basis(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Three centers, all learned: inductor was wrong where it fused the Gram matrix with its factor.

    It is as wrong without vectors and at -O0, which it compiles in a third of the time.
    """
    monkeypatch.setattr("torch._inductor.cpu_vec_isa.valid_vec_isa_list", list, raising=False)
    monkeypatch.setenv("TORCHINDUCTOR_DEBUG_COMPILE", "1")
    kernel = st.AnchoredKernel(st.GaussianKernel(nn.Parameter(torch.tensor(0.8, dtype=torch.float64))))
    radius = nn.Parameter(torch.tensor(0.3, dtype=torch.float64))
    basis = st.StaFBasis(kernel, st.StateFollowingCenters(nn.Parameter(0.95 * st.rings(3)), radius))
    x, points = torch.tensor([0.5, -0.4], dtype=torch.float64), 0.05 * uniform(1, 2)

    def value() -> Tensor:
        return basis.local(x).evaluate(points, torch.ones(3, dtype=torch.float64)).square().sum()

    learned = list(basis.parameters())
    assert len(learned) == 3
    expected = torch.autograd.grad(value(), learned)
    torch._dynamo.reset()
    found = torch.autograd.grad(torch.compile(value)(), learned)
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)


def test_compiled_layers_see_swapped_directions() -> None:
    staf = fixed("exponential", 0.4, (), None)
    y = staf.state + uniform(3, 2, low=-0.2, high=0.2)

    def call(directions: Tensor) -> Tensor:
        return torch.func.functional_call(staf, {"basis.centers.directions": directions}, (y,))

    torch._dynamo.reset()
    other = st.ball(6, 2)
    found = torch.compile(call, fullgraph=True, backend="eager")(other)
    torch.testing.assert_close(found, call(other), rtol=1e-12, atol=1e-12)
    assert not torch.allclose(found, staf(y))


class ValueAndGradient(nn.Module):
    """What is shipped: both at once."""

    def __init__(self, staf: st.StaF) -> None:
        super().__init__()
        self.staf = staf

    def forward(self, y: Tensor) -> tuple[Tensor, Tensor]:
        return self.staf.value_and_gradient(y)


@pytest.mark.parametrize(
    ("name", "strict"),
    [
        ("exponential", True),  # the front end of torch.compile; the others by the default one
        *((name, False) for name in ("gaussian", "anchored_gaussian")),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")  # torch 2.6, of its own nodes
def test_export_takes_batches_of_any_size(name: str, strict: bool) -> None:
    count = 6 if name in ("exponential", "gaussian") else 3  # every step of a Newton basis is written out
    staf = st.StaF(basis_of(name, count, 0.4)).fit_(uniform(2, low=0.3), Paper())
    module = ValueAndGradient(staf)
    make = lambda *batch: staf.state + uniform(*batch, 2, low=-0.2, high=0.2)  # noqa: E731
    sizes = ({0: torch.export.Dim("batch"), 1: torch.export.Dim("points")},)
    with torch.no_grad():
        program = torch.export.export(module, (make(3, 2),), dynamic_shapes=sizes, strict=strict)
        for batch in ((3, 2), (7, 5)):
            y = make(*batch)
            for found, expected in zip(program.module()(y), module(y), strict=True):
                torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    if name in ("exponential", "gaussian"):  # nothing that depends on the directions alone is left to do
        assert "qr" not in program.graph_module.code


ROOT = Path(st.__file__).parent
LAYERS = ("approximation", "centers", "kernels", "local_basis", "numerics")


@pytest.mark.parametrize("room", LAYERS)
def test_no_method_of_a_named_tuple_reads_a_property_of_it(room: str) -> None:
    """Dynamo of torch 2.9 knows fields and methods of a named tuple, and no property."""
    for path in sorted((ROOT / room).glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ClassDef) or "NamedTuple" not in map(ast.unparse, node.bases):
                continue
            functions = [each for each in node.body if isinstance(each, ast.FunctionDef)]
            properties = {f.name for f in functions if any(map(is_property, f.decorator_list))}
            assert properties <= {"offsets", "rank", "scale"}, (
                path,
                node.name,
            )  # not read where one compiles
            for function in functions:
                read = {ast.unparse(each) for each in ast.walk(function) if isinstance(each, ast.Attribute)}
                assert not read & {f"self.{name}" for name in properties}, (path, node.name, function.name)


def is_property(decorator: ast.expr) -> bool:
    return ast.unparse(decorator) == "property"
