"""`ChaseOptimizer` as a torch optimizer, and as the law that it runs."""

from __future__ import annotations

import copy
import io
import re

import pytest
import torch
from helpers import uniform
from helpers_laws import TARGET, basis, quadratic
from torch import Tensor, nn
from variants import LAWS, by_turns

from staf_torch import optim
from staf_torch.optim.objective import NativeError

USABLE = {name: law for name, law in LAWS.items() if name != "normalised lms"}


def losses(objective: NativeError, weights: Tensor) -> Tensor:
    """F(a) - ||V||^2, one a row."""
    return torch.linalg.vecdot(weights, objective.curvature(weights) - 2 * objective.values)


@pytest.mark.parametrize(("name", "summed"), by_turns(USABLE, [True, False]))
def test_a_step_is_the_step_of_the_law_on_the_staf_quadratic(name: str, summed: bool) -> None:
    law = USABLE[name]
    x = torch.tensor([[1.0, 0.0], [0.3, -0.8]], dtype=torch.float64)
    objective = NativeError(basis(radius=0.4).gram(x), TARGET(basis(radius=0.4).centers(x)))
    parameter = nn.Parameter(torch.zeros(2, 3, dtype=torch.float64))
    optimizer = optim.ChaseOptimizer([parameter], law, inner_steps=2)

    def closure() -> Tensor:
        found = losses(objective, parameter)
        return found.sum() if summed else found

    weights = torch.zeros(2, 3, dtype=torch.float64)
    state = law.init(weights)
    for _ in range(3):
        before = losses(objective, weights)
        loss = optimizer.step(closure)
        torch.testing.assert_close(loss, before.sum() if summed else before)
        state = law.begin(objective, weights, state)
        for _ in range(2):
            weights, state = law.step(objective, weights, state)
        torch.testing.assert_close(parameter.detach(), weights, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("name", ["recursive least squares", "barzilai-borwein"])
def test_a_run_goes_on_from_its_state_dict(name: str) -> None:
    objective = quadratic()

    def fresh() -> tuple[nn.Parameter, optim.ChaseOptimizer]:
        parameter = nn.Parameter(torch.zeros(5, 4, dtype=torch.float64))
        return parameter, optim.ChaseOptimizer([parameter], USABLE[name])

    def advance(parameter: nn.Parameter, optimizer: optim.ChaseOptimizer) -> None:
        for _ in range(3):
            optimizer.step(lambda: losses(objective, parameter))

    parameter, optimizer = fresh()
    advance(parameter, optimizer)
    file = io.BytesIO()
    torch.save(optimizer.state_dict(), file)
    file.seek(0)
    other, resumed = fresh()
    other.data.copy_(parameter.data)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    advance(parameter, optimizer)
    advance(other, resumed)
    assert torch.equal(parameter, other)


def test_a_scheduler_drives_the_step_size() -> None:
    objective = quadratic()
    parameter = nn.Parameter(torch.zeros(5, 4, dtype=torch.float64))
    optimizer = optim.ChaseOptimizer([parameter], optim.FixedStep(1.0))
    scheduler = torch.optim.lr_scheduler.StepLR(optimizer, step_size=1, gamma=0.5)
    weights = torch.zeros(5, 4, dtype=torch.float64)
    for size in (1.0, 0.5, 0.25):
        assert optimizer.param_groups[0]["lr"] == size
        optimizer.step(lambda: losses(objective, parameter))
        scheduler.step()
        weights, _ = optim.FixedStep(size).step(objective, weights, ())
        torch.testing.assert_close(parameter.detach(), weights)


def test_groups_have_their_own_number_of_iterations() -> None:
    objective = quadratic()
    one, many = (nn.Parameter(torch.zeros(5, 4, dtype=torch.float64)) for _ in range(2))
    optimizer = optim.ChaseOptimizer([one], optim.ConjugateGradient())
    optimizer.add_param_group({"params": [many], "inner_steps": 4})
    optimizer.step(lambda: losses(objective, one) + losses(objective, many))
    torch.testing.assert_close(many.detach(), objective.minimiser())
    assert not torch.allclose(one.detach(), objective.minimiser())
    assert copy.deepcopy(optimizer).param_groups[1]["inner_steps"] == 4


def test_a_vector_is_one_problem_and_single_precision_stays() -> None:
    parameter = nn.Parameter(torch.zeros(3))
    target = torch.tensor([1.0, -2.0, 0.5])
    optimizer = optim.ChaseOptimizer([parameter], optim.SteepestDescent())
    optimizer.step(lambda: (parameter - target).square().sum())
    torch.testing.assert_close(parameter.detach(), target)


def test_what_it_cannot_use_is_refused_in_a_sentence() -> None:
    parameter = nn.Parameter(torch.zeros(2, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"ChaseOptimizer\(law=\.\.\.\)` must not need a sample"):
        optim.ChaseOptimizer([parameter], optim.NormalisedLMS())
    optimizer = optim.ChaseOptimizer([parameter], optim.SteepestDescent())
    with pytest.raises(ValueError, match="must be a function"):
        optimizer.step()
    with pytest.raises(ValueError, match="must return a differentiable loss"):
        optimizer.step(lambda: torch.zeros(()))

    def backward() -> Tensor:
        loss = parameter.square().sum()
        loss.backward()
        return loss

    with pytest.raises(ValueError, match="without calling `backward`"):
        optimizer.step(backward)


@pytest.mark.parametrize(("shape", "dtype"), [((5, 3), torch.float64), ((2, 3, 4), torch.float32)])
def test_rows_that_are_coupled_are_refused_with_the_curvature_between_them(
    shape: tuple[int, ...], dtype: torch.dtype
) -> None:
    weights, coupling = nn.Parameter(uniform(*shape).to(dtype)), 0.0

    def loss() -> Tensor:
        rows = weights.flatten(0, -2)
        return weights.square().sum() + coupling * (rows[0] - rows[-1]).square().sum()

    optimizer = optim.ChaseOptimizer([("coefficients", weights)], optim.FixedStep(0.5))
    optimizer.step(loss)
    coupling, before = 0.25, weights.detach().clone()  # later than the first step
    last = tuple(n - 1 for n in shape[:-1])
    said = (
        f"`coefficients` of the shape {shape} the curvature of the loss between the rows {(0,) * len(last)}"
    )
    with pytest.raises(ValueError, match=re.escape(f"{said} and {last} is 0.2 times that of row")):
        optimizer.step(loss)
    assert torch.equal(weights, before)
    chased = optim.ChaseOptimizer([weights], optim.Exact())
    with pytest.raises(ValueError, match="rows that are independent problems: in parameter 0 of group 0"):
        chased.step(lambda: weights.sum(0).square().sum())


def test_parameters_that_are_coupled_are_refused_by_name() -> None:
    a, b = (nn.Parameter(torch.ones(4, dtype=torch.float64)) for _ in range(2))
    with pytest.raises(ValueError, match=r"of the loss between `a` and `b` is 2 times that of `a` itself"):
        optim.ChaseOptimizer([("a", a), ("b", b)], optim.Exact()).step(
            lambda: a.square().sum() + b.square().sum() + 4 * (a @ b)
        )
    apart = optim.ChaseOptimizer([{"params": [a]}, {"params": [b]}], optim.Exact())
    with pytest.raises(ValueError, match="parameter 0 of group 0 and parameter 0 of group 1 is inf times"):
        apart.step(lambda: (a * b).sum())
    copied = copy.deepcopy(optim.ChaseOptimizer([a], optim.SteepestDescent()))
    (mine,) = copied.param_groups[0]["params"]
    copied.step(lambda: mine.square().sum())
    assert not bool(mine.any())


def test_a_loss_of_several_parameters_moves_each_and_skips_what_it_does_not_use() -> None:
    first, second = quadratic(seed=1), quadratic(seed=2)
    a, b, unused, frozen = (nn.Parameter(torch.zeros(5, 4, dtype=torch.float64)) for _ in range(4))
    frozen.requires_grad_(False)
    optimizer = optim.ChaseOptimizer([a, b, unused, frozen], optim.Exact())
    optimizer.step(lambda: losses(first, a).sum() + losses(second, b).sum())
    torch.testing.assert_close(a.detach(), first.minimiser())
    torch.testing.assert_close(b.detach(), second.minimiser())
    assert not bool(unused.any())
    assert not bool(frozen.any())
