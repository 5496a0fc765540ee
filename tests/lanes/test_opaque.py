"""What compiles itself under `torch.compile`, `torch.export` and `torch.jit.trace`."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor, nn

import staf_torch as st
from staf_torch import adp, lanes, systems


class Damping(nn.Module):
    def __init__(self, gain: Tensor) -> None:
        super().__init__()
        self.gain = gain

    @lanes.compiled("a damping of this test")
    def forward(self, x: Tensor) -> Tensor:
        return -self.gain * x[..., 1:].tanh()


PLANT, COST = systems.Pendulum(), adp.QuadraticCost(1.0, 0.1, dim=2, inputs=1)
X0 = tensor([[0.5, 0.1], [0.2, -0.3]])
BASIS = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(3), radius=0.1))
STATES = systems.simulate(systems.Oscillator(), X0, dt=0.01, steps=3)
POLICY, REGRESSOR = Damping(tensor(2.0)), st.StaFRegressor().fit(uniform(20, 2), uniform(20))


def everything(x: Tensor) -> tuple[Tensor, ...]:
    run = adp.simulate(POLICY, PLANT, COST, x, dt=0.02, steps=5, compile=False)
    return 2 * run.cost, 2 * POLICY(x), REGRESSOR.predict(x[0]) + x


def test_torch_compile_leaves_what_compiles_itself_alone() -> None:
    """Every operation between the calls is a graph; a loop that was entered would be hundreds."""
    graphs = list[Any]()

    def counted(graph: Any, inputs: Any) -> Any:
        graphs.append(graph)
        return graph.forward

    torch.compiler.reset()
    found = torch.compile(everything, backend=counted)(X0)
    assert len(graphs) <= 4
    assert all(torch.equal(*pair) for pair in zip(found, everything(X0), strict=True))


def test_a_compiled_policy_has_the_gradient_of_what_it_holds() -> None:
    """Also one that was compiled while nobody wanted a gradient; and it serves again afterwards."""
    policy = Damping(tensor(2.0).requires_grad_())
    with torch.no_grad():
        assert lanes.ready(policy, X0)
    policy(X0).sum().backward()
    torch.testing.assert_close(policy.gain.grad, -X0[:, 1:].tanh().sum())
    with torch.no_grad():
        assert lanes.ready(policy, X0)

    program = lanes.Program(lambda carry, now, row: (carry, policy.gain * row))
    with torch.no_grad():
        program((), (), X0, steps=1)
    assert program((), (), X0, steps=1)[1].requires_grad


def test_torch_export_takes_a_compiled_method_or_says_what_does() -> None:
    exported = torch.export.export(POLICY, (X0,))
    torch.testing.assert_close(exported.module()(X0), POLICY(X0))
    lqr = adp.LQR(PLANT, COST)
    filtered = adp.SafetyFilter(lqr, PLANT, lambda x, t: 1 - x[:, 0], dt=0.02, low=-5.0, high=5.0)
    with pytest.raises(
        ValueError, match=r"`torch.export` does not take a safety filter.*deploy.trace\(policy, x\)"
    ):
        torch.export.export(filtered, (X0,))


class Traced(nn.Module):
    """A program, a chase and a trajectory of the states."""

    def __init__(self) -> None:
        super().__init__()
        self.program = lanes.Program(lambda x, now, row: (x.sin(), x))

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        chased = st.chase(STATES + x[:, None], BASIS, st.targets.Paper(), st.optim.Exact(), inner_steps=1)
        moved = systems.simulate(PLANT, x, dt=0.02, steps=3)
        return self.program(x, steps=3)[0], chased.value, moved, POLICY(x)


@pytest.mark.filterwarnings("ignore")  # torch.jit is deprecated, and a trace tells of every branch
def test_a_trace_of_torch_jit_computes_with_its_own_inputs() -> None:
    """Machine code is unseen by it: its results would be constants of the trace, or the process would end."""
    traced = torch.jit.trace(model := Traced(), (X0,), check_trace=False)
    torch.testing.assert_close(traced(X0 + 0.1), model(X0 + 0.1))
