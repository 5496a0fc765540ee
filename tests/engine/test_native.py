"""What the fused recursion finds by itself from the states is what torch computes, in any batch."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from helpers import uniform
from helpers_fused import (
    BASES,
    LAW,
    circles,
    needs_compiler,
)
from torch import Tensor, nn
from variants import TARGETS, over

import staf_torch as st
from staf_torch import chase, chase_weights, targets
from staf_torch.engine import compiled
from staf_torch.lanes import build


def evaluated(target: nn.Module, x: Tensor) -> Tensor:
    """V at x (B, n) by its formula: its values at one center without offset."""
    basis = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(torch.zeros(1, x.shape[-1]), 1.0))
    # One center of a Gaussian: K = 1, so that one exact line search finds w = V.
    result: Tensor = chase_weights(x.unsqueeze(1), basis, target, LAW, inner_steps=1).weights
    return result.flatten()


@needs_compiler
@over(TARGETS)
def test_a_targets_formula_is_its_forward(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    target = TARGETS[name][0]()
    x = torch.cat([scale * uniform(67, 2, seed=int(1e3 * scale)) for scale in (1e-9, 0.1, 1.0, 5.0, 60.0)])
    want = target(x)
    monkeypatch.setattr(targets.Quadratic, "forward", None)  # only the formula is left
    monkeypatch.setattr(targets.Cosine, "forward", None)
    monkeypatch.setattr(targets.Paper, "forward", None)
    got = evaluated(target, x)
    scale = 1 + x.square().sum(-1)
    assert float(((got - want).abs() / (want.abs() + scale * 1e-3)).max()) <= 2e-13


@needs_compiler
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_tanh_of_a_formula_is_exact_to_four_units(dtype: torch.dtype) -> None:
    class Tanh(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return x.squeeze(-1).tanh()

        def formula(self, dim: int) -> targets.Formula:
            return targets.Formula("tanh(x[0])")

    # Smaller, and the square of the gradient would underflow.
    exponents = torch.linspace(-15 if dtype is torch.float32 else -140, 2.5, 4001, dtype=torch.float64)
    x = torch.cat((10**exponents, -(10**exponents), torch.zeros(1, dtype=torch.float64))).to(dtype)
    want = x.double().tanh()
    error = (evaluated(Tanh(), x.unsqueeze(-1)).double() - want).abs()
    assert bool((error <= 4 * torch.finfo(dtype).eps * want.abs()).all())


@needs_compiler
@pytest.mark.parametrize("name", BASES)
@over(TARGETS, "target")
def test_chase_weights_from_formulas_are_those_of_the_reference(
    name: str, target: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    states, basis, value = circles(9, 12), BASES[name], TARGETS[target][0]()
    got = chase_weights(states, basis, value, LAW, inner_steps=3).weights
    monkeypatch.setattr(compiled, "runs", lambda *_: False)
    want = chase_weights(states, basis, value, LAW, inner_steps=3).weights
    torch.testing.assert_close(got, want, rtol=0, atol=1e-8 * float(want.abs().max()))


@needs_compiler
@pytest.mark.parametrize("name", BASES)
def test_chase_is_the_same_with_either_recursion(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    states, basis = circles(9, 12), BASES[name]
    got = chase(states, basis, targets.Paper(), LAW, inner_steps=3)
    alone = chase_weights(states, basis, targets.Paper(), LAW, inner_steps=3).weights
    torch.testing.assert_close(got.weights, alone, rtol=1e-14, atol=0)  # e^{-g} of torch and of the recursion
    monkeypatch.setattr(compiled, "runs", lambda *_: False)
    want = chase(states, basis, targets.Paper(), LAW, inner_steps=3)
    for field in ("estimate", "estimate_before", "excess", "excess_before", "coefficients", "weights"):
        a, b = getattr(got, field), getattr(want, field)
        torch.testing.assert_close(a, b, rtol=0, atol=1e-8 * float(b.abs().max()))


def user_target(x: Tensor) -> Tensor:
    return x[..., 0].square() + (x[..., 0] * x[..., 1]).tanh()


@needs_compiler
@pytest.mark.parametrize("run", [chase, chase_weights])
@pytest.mark.parametrize("value", [targets.Paper(), targets.Quadratic([[1.0, 0.2], [0.2, 3.0]]), user_target])
@pytest.mark.parametrize("name", ["exponential", "exponential, moving radius", "gaussian"])
def test_a_row_has_the_bits_that_it_has_in_any_batch(
    name: str, value: Callable[[Tensor], Tensor], run: Callable[..., st.ChaseResult]
) -> None:
    """Fifty times of ten iterations at a condition number of 10^4: a rounding would become a digit."""
    states = circles(1000, 50)
    whole = run(states, BASES[name], value, LAW).weights
    for first, batch in ((0, 1), (993, 7), (500, 64)):
        part = run(states[first : first + batch], BASES[name], value, LAW).weights
        assert torch.equal(part, whole[first : first + batch])


def test_a_formula_that_may_not_be_that_of_the_forward_is_left_alone() -> None:
    class Twice(targets.Paper):
        def forward(self, x: Tensor) -> Tensor:
            return 2 * super().forward(x)

    hooked, replaced, learned = targets.Paper(), targets.Paper(), targets.Quadratic(2.0)
    hooked.register_forward_hook(lambda module, given, value: -value)
    replaced.forward = lambda x: x[..., 0]  # type: ignore[method-assign]
    learned.matrix.requires_grad_()
    formula_of = compiled.formula_of
    assert formula_of(targets.Paper(), 2) is not None
    for target in (Twice(), hooked, replaced, learned, targets.Paper().forward, lambda x: x[..., 0]):
        assert formula_of(target, 2) is None
    for target in (targets.Paper(), targets.Quadratic([[1.0, 0.0], [0.0, 1.0]]), targets.Cosine([1.0, 2.0])):
        assert formula_of(target, 3) is None  # torch refuses the dimension, in its own words


@needs_compiler
def test_a_formula_that_does_not_compile_is_said_once_and_torch_evaluates_the_target(
    caplog: pytest.LogCaptureFixture,
) -> None:
    class Broken(targets.Paper):
        def forward(self, x: Tensor) -> Tensor:
            return super().forward(x)

        def formula(self, dim: int) -> targets.Formula:
            return targets.Formula("no_such_function(x[0])")

    build._said.clear()
    states, basis = circles(5, 4), BASES["gaussian"]
    want = chase_weights(states, basis, targets.Paper(), LAW, inner_steps=1).weights
    for _ in range(2):
        got = chase_weights(states, basis, Broken(), LAW, inner_steps=1).weights
        torch.testing.assert_close(got, want, rtol=0, atol=1e-10 * float(want.abs().max()))
    assert [r.levelname for r in caplog.records if r.name.startswith("staf_torch")] == ["WARNING"]
    assert "no_such_function" in caplog.text


def test_points_with_a_row_out_of_reach_warn_of_the_reach_alone() -> None:
    states = 3.0 * circles(3, 4)
    states[1, 2:] = torch.inf
    with pytest.warns(UserWarning, match=r"\|x\| r = 0.9|Shrink") as seen:
        chase_weights(2 * states, BASES["exponential"], targets.Paper(), LAW)
    assert len(seen) == 1
