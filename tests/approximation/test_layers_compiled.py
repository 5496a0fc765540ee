"""Layers under `torch.compile(fullgraph=True)` and `torch.export`."""

from __future__ import annotations

import os

import pytest
import torch
from helpers import basis_of, uniform
from helpers_layers import learnable
from torch import Tensor, nn

import staf_torch as st
from staf_torch.targets import Paper


def test_the_whole_layer_is_one_graph() -> None:
    staf, y = learnable("gaussian", "shrinking", (4,))

    def everything(at: Tensor) -> tuple[Tensor, ...]:
        return staf(at), staf.gradient(at, "total")

    torch.compiler.reset()
    compiled = torch.compile(everything, fullgraph=True, backend="eager")
    for found, expected in zip(compiled(y), everything(y), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    staf.basis.centers.radius.radius.data.fill_(-1.2)  # an assertion of the graph
    with pytest.raises(
        RuntimeError, match=r"`StateRadius\(radius=...\)` must stay positive and finite while"
    ):
        compiled(y)


@pytest.mark.needs_compiler
@pytest.mark.skipif(
    torch.__version__.startswith("2.6"), reason="an assertion in inductor's own backward pass"
)
@pytest.mark.skipif(
    "clang" in os.environ.get("CXX", ""), reason="inductor includes omp.h, a package of its own for clang"
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
    torch.compiler.reset()
    found = torch.autograd.grad(torch.compile(value)(), learned)
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)


class ValueAndGradient(nn.Module):
    """What is shipped: both at once."""

    def __init__(self, staf: st.StaF) -> None:
        super().__init__()
        self.staf = staf

    def forward(self, y: Tensor) -> tuple[Tensor, Tensor]:
        return self.staf.value_and_gradient(y)


@pytest.mark.filterwarnings("ignore::UserWarning")  # torch 2.6, of its own nodes
def test_export_takes_batches_of_any_size() -> None:
    staf = st.StaF(basis_of("exponential", 6, 0.4)).fit_(uniform(2, low=0.3), Paper())
    module = ValueAndGradient(staf)
    make = lambda *batch: staf.state + uniform(*batch, 2, low=-0.2, high=0.2)  # noqa: E731
    sizes = ({0: torch.export.Dim("batch"), 1: torch.export.Dim("points")},)
    with torch.no_grad():
        program = torch.export.export(module, (make(3, 2),), dynamic_shapes=sizes, strict=False)
        for batch in ((3, 2), (7, 5)):
            y = make(*batch)
            for found, expected in zip(program.module()(y), module(y), strict=True):
                torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    # nothing that depends on the directions alone is left to do
    assert "qr" not in program.graph_module.code
