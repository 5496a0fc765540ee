"""What may not reach the native recursion does not: it runs, or the reference computes the result."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from helpers_fused import BASES, LAW, circles, needs_compiler
from torch import Tensor, nn

from staf_torch import chase, chase_weights, engine, optim, targets
from staf_torch.engine import compiled
from staf_torch.engine.compiled import CompiledInputs
from staf_torch.engine.problem import Problem
from staf_torch.engine.recursion import start


def paper(x: Tensor) -> Tensor:
    value: Tensor = targets.Paper()(x)
    return value


@pytest.fixture
def chunk() -> tuple[Problem, Tensor, CompiledInputs, engine.recursion.Carry]:
    """A chunk of time that the compiled recursion takes."""
    problem, states = Problem("chase", BASES["exponential"], paper, LAW, 3), circles(5, 4)
    inputs = CompiledInputs(problem.basis.gram_structure(states), problem.basis.values(states, paper))
    return problem, states, inputs, start(problem, states, None)


CHANGED: dict[str, Callable[[Tensor], Tensor]] = {
    "another dtype": Tensor.float,
    "half precision": Tensor.half,
    "integers": Tensor.long,
    "complex": lambda v: v.to(torch.complex128),
    "meta": lambda v: v.to("meta"),
    "sparse": Tensor.to_sparse,
    "negative view": torch._neg_view,
    "a gradient": lambda v: v.clone().requires_grad_(),
    "a parameter": nn.Parameter,
    "a time too few": lambda v: v[:, 1:],
    "a row too few": lambda v: v[1:],
    "a center too few": lambda v: v[..., 1:],
    "a dimension too few": lambda v: v[0],
    "a dimension too many": lambda v: v.unsqueeze(0),
}


@needs_compiler
@pytest.mark.parametrize("changed", CHANGED)
@pytest.mark.parametrize("which", ["states", "values", "weights", "log_gain"])
def test_native_code_gets_plain_tensors_of_the_right_shape_alone(which: str, changed: str, chunk) -> None:
    problem, states, inputs, carry = chunk
    assert compiled.runs(problem, states, inputs, carry)
    change = CHANGED[changed]
    if which == "states" and states.shape != change(states).shape:
        return  # the sizes of everything else are those of the states
    if which == "states":
        states = change(states)
    elif which == "values":
        inputs = inputs._replace(values=change(inputs.values))
    elif getattr(carry, which).dim() > 1 or changed not in ("a time too few", "a center too few"):
        carry = carry._replace(**{which: change(getattr(carry, which))})
    else:
        carry = carry._replace(**{which: getattr(carry, which)[1:]})
    assert not compiled.runs(problem, states, inputs, carry)


@needs_compiler
def test_other_laws_no_iterations_and_values_without_states_stay_out(chunk) -> None:
    problem, states, inputs, carry = chunk
    for law, steps in ((optim.Nesterov(), 3), (LAW, 0)):
        other = Problem("chase", problem.basis, paper, law, steps)
        assert not compiled.runs(other, states, inputs, carry)
    formula = targets.Paper().formula(2)
    assert not compiled.runs(problem, states, inputs._replace(values=formula), carry)


@pytest.mark.parametrize("run", [chase, chase_weights])
@pytest.mark.parametrize("name", ["exponential", "gaussian", "exponential, moving radius"])
def test_a_target_of_another_precision_is_the_references(run, name: str) -> None:
    states = circles(6, 5)
    got = run(states, BASES[name], lambda x: paper(x).float(), LAW, inner_steps=2).weights
    want = run(states, BASES[name], lambda x: paper(x).float().double(), LAW, inner_steps=2).weights
    torch.testing.assert_close(got, want, rtol=0, atol=1e-9 * float(want.abs().max()))


class Scaled(targets.Paper):
    """A target with a formula, and a number that it never registered."""

    def __init__(self, factor: Tensor) -> None:
        super().__init__()
        self.factor = factor if isinstance(factor, nn.Parameter) else (factor,)[0]

    def forward(self, x: Tensor) -> Tensor:
        value: Tensor = self.factor * super().forward(x)
        return value

    def formula(self, dim: int) -> targets.Formula | None:
        base = super().formula(dim)
        assert base is not None
        return targets.Formula(f"p[0] * ({base.expression})", (float(self.factor),))


@pytest.mark.parametrize("run", [chase, chase_weights])
@pytest.mark.parametrize("kind", [nn.Parameter, Tensor.requires_grad_])
def test_a_learned_target_keeps_its_gradient(run, kind) -> None:
    states, basis = circles(3, 4), BASES["gaussian"]
    factor = kind(torch.tensor(2.0, dtype=torch.float64))
    result = run(states, basis, Scaled(factor), LAW, inner_steps=2)
    (gradient,) = torch.autograd.grad(result.weights[:, -1].sum(), factor)
    # The chase is linear in V where the line searches are: they are invariant under its scale.
    want = result.weights[:, -1].sum() / 2
    torch.testing.assert_close(gradient, want.detach(), rtol=1e-6, atol=0)
    with torch.no_grad():
        fixed = run(states, basis, Scaled(factor), LAW, inner_steps=2).weights
    torch.testing.assert_close(fixed, result.weights.detach(), rtol=0, atol=1e-8 * float(fixed.abs().max()))


def test_a_reach_beyond_one_is_warned_of_where_the_reference_runs() -> None:
    with pytest.warns(UserWarning, match="Shrink the radius"):
        chase_weights(5 * circles(3, 4), BASES["exponential"], lambda x: paper(x).float(), LAW)
