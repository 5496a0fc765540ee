"""A loss as the quadratic that it is in a parameter, and what an optimizer takes, skips and refuses."""

from __future__ import annotations

import pytest
import torch
from helpers import random_positive_definite, uniform
from torch import Tensor, nn

from staf_torch import optim
from staf_torch.optim.torch_optimizer import ChaseOptimizer, LossObjective

GRAM, VALUES = random_positive_definite(1, 4, size=3), uniform(4, 3, seed=2)


def loss_of(a: Tensor) -> Tensor:
    """a'K a - 2 V'a + 7, a number a row."""
    return ((a.unsqueeze(-2) @ GRAM).squeeze(-2) * a).sum(-1) - 2 * (VALUES * a).sum(-1) + 7


def made(at: Tensor, slope: Tensor | None = None) -> tuple[LossObjective, nn.Parameter]:
    parameter = nn.Parameter(at)
    (found,) = torch.autograd.grad(loss_of(parameter).sum(), parameter, create_graph=True)
    return LossObjective(parameter, found if slope is None else slope), parameter


def test_a_loss_has_the_matrix_and_the_vector_of_its_quadratic() -> None:
    found, _ = made(uniform(4, 3, seed=3))
    v = uniform(4, 3, seed=4)
    torch.testing.assert_close(found.gram, GRAM)
    torch.testing.assert_close(found.values, VALUES)
    torch.testing.assert_close(found.curvature(v), (GRAM @ v.unsqueeze(-1)).squeeze(-1))
    torch.testing.assert_close(found.descent(v), 2 * (VALUES - (GRAM @ v.unsqueeze(-1)).squeeze(-1)))
    torch.testing.assert_close(found.minimiser(), torch.linalg.solve(GRAM, VALUES))
    torch.testing.assert_close(found.solve(v), torch.linalg.solve(GRAM, v))
    values = torch.linalg.eigvalsh(GRAM)
    low, high = found.spectrum()
    torch.testing.assert_close(torch.stack((low, high), -1), values[:, [0, -1]])
    assert found.values is found.values
    assert not found.curvature(v).requires_grad
    with pytest.raises(ValueError, match=r"^A loss has no sample at a state\.$"):
        found.sample()


def test_a_loss_that_is_linear_has_no_curvature() -> None:
    found, parameter = made(uniform(4, 3, seed=5), -2 * VALUES)
    assert found.curvature(parameter.detach()).tolist() == [[0.0] * 3] * 4
    torch.testing.assert_close(found.values, VALUES)
    other = nn.Parameter(uniform(4, 3, seed=6))
    apart = LossObjective(parameter, (other.square() - other.detach().square()) - 2 * VALUES)  # of another's
    assert apart.curvature(parameter.detach()).tolist() == [[0.0] * 3] * 4


@pytest.mark.parametrize("steps", [1, 3])
def test_a_step_takes_so_many_iterations_and_returns_the_loss_before_it(steps: int) -> None:
    start = uniform(4, 3, seed=7)
    weights = nn.Parameter(start.clone())
    optimizer = ChaseOptimizer([weights], optim.SteepestDescent(), inner_steps=steps)
    said = optimizer.step(lambda: loss_of(weights))
    torch.testing.assert_close(said, loss_of(start))
    assert not said.requires_grad
    a = start
    for _ in range(steps):
        g = 2 * (VALUES - (GRAM @ a.unsqueeze(-1)).squeeze(-1))
        length = (g * g).sum(-1) / (2 * (g * (GRAM @ g.unsqueeze(-1)).squeeze(-1)).sum(-1))
        a = a + length.unsqueeze(-1) * g
    torch.testing.assert_close(weights.detach(), a)


def test_what_is_fixed_unused_or_has_a_rate_of_zero_stays_where_it_is() -> None:
    used, unused, fixed, still = (nn.Parameter(uniform(4, 3, seed=k)) for k in range(8, 12))
    fixed.requires_grad_(False)
    before = [each.detach().clone() for each in (unused, fixed, still)]
    groups = [{"params": [used, unused, fixed]}, {"params": [still], "lr": 0}]
    optimizer = ChaseOptimizer(groups, optim.FixedStep(0.5))
    assert [group["lr"] for group in optimizer.param_groups] == [0.5, 0]
    optimizer.step(lambda: loss_of(used) + loss_of(fixed) + loss_of(still))
    for each, was in zip((unused, fixed, still), before, strict=True):
        assert torch.equal(each, was)
    assert "lr" not in ChaseOptimizer([used], optim.SteepestDescent()).param_groups[0]
    assert optimizer.param_groups[0]["inner_steps"] == 1


@pytest.mark.parametrize("size", [(), (3,)])
def test_parameters_are_rows_of_floating_point_numbers(size: tuple[int, ...]) -> None:
    whole = torch.ones(size, dtype=torch.int64 if size else torch.float64)
    with pytest.raises(ValueError, match=r"must be floating-point tensors \(..., M\); got the shape"):
        ChaseOptimizer([whole], optim.SteepestDescent())


def test_what_an_optimizer_cannot_use_is_said() -> None:
    weights = nn.Parameter(torch.ones(3).double())
    with pytest.raises(ValueError, match=r"`ChaseOptimizer\(law=...\)` must be an UpdateLaw; got 'sgd'"):
        ChaseOptimizer([weights], "sgd")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"must not need a sample at a state, as a loss has none"):
        ChaseOptimizer([weights], optim.NormalisedLMS())
    with pytest.raises(ValueError, match=r"`ChaseOptimizer\(inner_steps=...\)` must be at least 1; got 0"):
        ChaseOptimizer([weights], optim.SteepestDescent(), inner_steps=0)
    optimizer = ChaseOptimizer([weights], optim.SteepestDescent())
    with pytest.raises(ValueError, match=r"step\(closure=...\)` must be a function that returns the loss"):
        optimizer.step()
    for loss, said in ((3.0, "got 3.0"), (torch.ones(2), r"got a tensor \(2,\) without a graph")):
        with pytest.raises(ValueError, match=rf"must return a differentiable loss; {said}"):
            optimizer.step(lambda given=loss: given)  # type: ignore[misc]

    def backwards() -> Tensor:
        loss = weights.square().sum()
        loss.backward()
        return loss

    with pytest.raises(ValueError, match="must return the loss without calling `backward` on it; auto"):
        optimizer.step(backwards)
