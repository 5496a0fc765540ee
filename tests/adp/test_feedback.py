"""A feedback law is a function of the state; what has a memory carries it as a controller."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from staf_torch import adp, systems

X0 = torch.tensor([[0.3, 0.1], [-0.2, 0.4]], dtype=torch.float64)
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)


class Integral(nn.Module):
    def __init__(self, in_place: bool, buffer: bool) -> None:
        super().__init__()
        zero = torch.zeros(2, 1, dtype=torch.float64)
        if buffer:
            self.register_buffer("total", zero)
        else:
            self.total = zero
        self.in_place, self.calls = in_place, 0

    def forward(self, x: Tensor) -> Tensor:
        self.calls += 1
        if self.in_place:
            self.total += 0.01 * x[:, :1]
        else:
            self.total = self.total + 0.01 * x[:, :1]
        return -3 * x[:, 1:] - self.total


@pytest.mark.parametrize("buffer", [False, True])
@pytest.mark.parametrize("in_place", [False, True])
@pytest.mark.parametrize("compile", [False, True])
def test_a_policy_with_a_memory_is_refused(in_place: bool, buffer: bool, compile: bool) -> None:
    policy = adp.Feedback(Integral(in_place, buffer))
    with pytest.raises(ValueError, match=r"changed its `total`.*is a `Controller`"):
        adp.simulate(policy, systems.TwoState(), COST, X0, dt=0.01, steps=10, compile=compile)


class Counting(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.calls, self.gain = 0, torch.tensor([[-1.0, -3.0]], dtype=torch.float64)

    def forward(self, x: Tensor) -> Tensor:
        self.calls += 1
        return x @ self.gain.mT


def test_a_policy_that_counts_its_calls_is_none() -> None:
    policy = adp.Feedback(Counting())
    run = adp.simulate(policy, systems.TwoState(), COST, X0, dt=0.01, steps=10, compile=False)
    assert not run.diverged.any()
    assert policy.policy.calls >= 10  # type: ignore[attr-defined]


@pytest.mark.parametrize("discount", [0.0, 0.7])
def test_the_value_of_an_lqr_solves_the_hjb_equation_with_its_discount(discount: float) -> None:
    plant = systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]])
    cost = adp.QuadraticCost(1.5, 0.5, dim=2, inputs=1, discount=discount)
    lqr = adp.LQR(plant, cost)
    x = torch.tensor([[1.0, -0.3], [-0.4, 2.0]], dtype=torch.float64)
    u = lqr(x)
    slope = torch.func.grad(lambda x: lqr.value(x).sum())(x)
    residual = cost.rate(x, u) + (slope * plant.motion(x, u)).sum(-1) - discount * lqr.value(x)
    assert float(residual.abs().max()) < 1e-10
