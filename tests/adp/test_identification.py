"""What the history stack of concurrent learning takes, one pair at a time."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform

from staf_torch import adp


def stack_after(learning: adp.ConcurrentLearning, *pairs: list[float]) -> torch.Tensor:
    state = learning.init(torch.zeros(2, learning.outputs, dtype=torch.float64))
    for s in pairs:
        state = learning.remember(state, tensor(s), torch.ones(learning.outputs, dtype=torch.float64))
    return state.regressors


def test_an_empty_place_takes_what_differs_enough_from_the_pair_before() -> None:
    learning = adp.ConcurrentLearning(2, 1, size=4, novelty=0.1)
    near, far = [1.05, 0.0], [1.0, 1.0]
    assert (stack_after(learning, [1.0, 0.0], near).norm(dim=-1) > 0).tolist() == [True, False, False, False]
    again = stack_after(
        learning, [1.0, 0.0], far, [1.0, 0.0]
    )  # new beside the last, though not beside the first
    assert torch.equal(again[:3], tensor([[1.0, 0.0], far, [1.0, 0.0]]))
    edge = [1.0 / 0.89, 0.0]  # a change of 0.11 of its own norm
    assert torch.equal(stack_after(learning, [1.0, 0.0], edge)[1], tensor(edge))


def test_a_full_stack_takes_what_raises_its_least_singular_value_and_nothing_else() -> None:
    learning = adp.ConcurrentLearning(2, 1, size=2)
    full = ([1.0, 0.0], [1.0, 0.2])
    kept = stack_after(learning, *full)
    better = stack_after(learning, *full, [0.0, 1.0])
    assert torch.linalg.svdvals(better)[-1] > 4 * torch.linalg.svdvals(kept)[-1]
    assert torch.equal(stack_after(learning, *full, [0.5, 0.05]), kept)


@pytest.mark.parametrize("outputs", [1, 3])
def test_the_step_solves_its_implicit_equation(outputs: int) -> None:
    """theta+ - theta = gain dt sum_j s_j (y_j - theta+'s_j)' over the stack and the present pair."""
    learning = adp.ConcurrentLearning(3, outputs, size=3, gain=2.0)
    state = learning.init(uniform(3, outputs, seed=1))
    for k in range(5):
        s, y = uniform(3, seed=2 + k), uniform(outputs, seed=20 + k)
        before, state = state, learning.step(state, s, y, 0.1)
        pairs = [*zip(state.regressors, state.rates, strict=True), (s, y)]
        pull = sum(torch.outer(a, b - state.theta.mT @ a) for a, b in pairs)
        torch.testing.assert_close(state.theta - before.theta, 2.0 * 0.1 * pull, rtol=1e-10, atol=1e-12)
