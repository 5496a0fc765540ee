"""A law of a user's own may carry numbers, vectors and matrices; what breaks its rules is refused."""

from __future__ import annotations

import pytest
import torch
from helpers_chase import circles
from torch import Tensor

from staf_torch import ExponentialKernel, Kernel, StaFBasis, StateFollowingCenters, chase, optim, rings
from staf_torch.engine import predictors
from staf_torch.optim.base import LawState, UpdateLaw
from staf_torch.optim.objective import Objective
from staf_torch.targets import Paper

BASIS = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(3), 0.6))
STATES = circles(5, 20)


class Adaptive(UpdateLaw):
    """A step of a row that grows while it helps; its number, a flag, a velocity and a matrix are carried."""

    def init(self, weights: Tensor) -> LawState:
        count = weights.shape[-1]
        number = torch.full(weights.shape[:-1], 0.05, dtype=weights.dtype)
        matrix = torch.eye(count, dtype=weights.dtype).expand(*weights.shape, count).clone()
        return number, number > 1, torch.zeros_like(weights), matrix

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        size, _, velocity, matrix = state
        g = objective.descent(weights)
        move = size.unsqueeze(-1) * (matrix * g.unsqueeze(-2)).sum(-1) + 0.3 * velocity
        helps = objective.descent(weights + move).square().sum(-1) < g.square().sum(-1)
        matrix = 0.99 * matrix + 0.01 * torch.eye(matrix.shape[-1])
        state = torch.where(helps, 1.1 * size, 0.5 * size), helps, move * helps.unsqueeze(-1), matrix
        return torch.where(helps.unsqueeze(-1), weights + move, weights), state


@pytest.mark.needs_compiler
@pytest.mark.compiled
def test_a_law_that_carries_tensors_of_every_kind(caplog: pytest.LogCaptureFixture) -> None:
    found = chase(STATES, BASIS, Paper(), Adaptive(), inner_steps=3)
    assert not caplog.text  # compiled
    wanted = chase(STATES.clone().requires_grad_(), BASIS, Paper(), Adaptive(), inner_steps=3)
    torch.testing.assert_close(found.weights, wanted.weights.detach(), rtol=1e-9, atol=1e-9)
    assert bool((found.excess[:, -1] < found.excess[:, 0]).all())
    for row in range(len(STATES)):
        alone = chase(STATES[row : row + 1], BASIS, Paper(), Adaptive(), inner_steps=3).weights[0]
        assert torch.equal(alone, found.weights[row])


class Broken(UpdateLaw):
    def __init__(self, initial: object, weights: object = None, state: object = None) -> None:
        self.initial, self.weights, self.state = initial, weights, state

    def init(self, weights: Tensor) -> LawState:
        return self.initial  # type: ignore[return-value]

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        moved = weights if self.weights is None else self.weights
        return moved, state if self.state is None else self.state  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (Broken([]), r"`Broken.init` must return a tuple of tensors; got \[\]"),
        (Broken((0.5,)), r"`Broken.init` must return a tuple of tensors; got \(0.5,\)"),
        (Broken((torch.zeros(3),)), r"B = 5; number 0 is \(3,\)"),
        (Broken((torch.tensor(0.5),)), r"B = 5; number 0 is \(\)"),
        (Broken((), torch.zeros(5, 4)), r"must return weights of the shape \(B, 3\); got \(5, 4\)"),
        (Broken((), None, (torch.zeros(5),)), r"must return a state of the shapes .* \[\]; got \[\(5,\)\]"),
    ],
)  # fmt: skip
def test_a_law_that_breaks_its_rules_is_named(law: UpdateLaw, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        chase(STATES, BASIS, Paper(), law, inner_steps=1)


class Distance(Kernel):
    """A kernel by torch.cdist, which has no derivative in forward mode."""

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        return (-torch.cdist(x1, x2).square()).exp()


@pytest.mark.needs_compiler
@pytest.mark.compiled
def test_a_kernel_by_distances_is_compiled_and_its_tangent_refused(caplog: pytest.LogCaptureFixture) -> None:
    basis = StaFBasis(Distance(), StateFollowingCenters(rings(3), 0.6))
    law = optim.SteepestDescent()
    found = chase(STATES, basis, Paper(), law)
    assert not caplog.text
    wanted = chase(STATES.clone().requires_grad_(), basis, Paper(), law)
    torch.testing.assert_close(found.weights, wanted.weights.detach(), rtol=1e-9, atol=1e-9)
    with pytest.raises(NotImplementedError, match=r"`Tangent` predictor needs derivatives .* forward mode"):
        chase(STATES, basis, Paper(), law, predictor=predictors.Tangent())
