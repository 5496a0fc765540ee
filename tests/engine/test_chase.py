"""The gradient chase: its inequality, its rows, its pieces; its weights alone are the same weights."""

from __future__ import annotations

import dataclasses
import re
import threading

import pytest
import torch
from helpers import basis_of, tensor, uniform
from helpers_chase import BASES, LAW, circles
from torch import Tensor
from variants import KERNELS, LAWS, PAPER_LAW, by_turns, over

import staf_torch as st
from staf_torch import chase, chase_weights, systems, targets
from staf_torch.engine import ChaseResult
from staf_torch.numerics.linalg import condition_number
from staf_torch.optim import SteepestDescent
from staf_torch.targets import Cosine, Paper


def orbit(*starts: tuple[float, float], dt: float = 0.05, steps: int = 40) -> torch.Tensor:
    return systems.simulate(systems.Oscillator(), tensor(starts), dt=dt, steps=steps)


def fields(result: ChaseResult) -> dict[str, torch.Tensor]:
    """The tensors of a chase without a certificate."""
    assert result.certificate is None
    names = [field.name for field in dataclasses.fields(result) if field.name != "certificate"]
    return {name: getattr(result, name) for name in names}


def run(states: torch.Tensor, kernel: str = "exponential", **settings: object) -> ChaseResult:
    basis = basis_of(kernel, count=3, radius=0.3)
    return st.chase(states, basis, Paper(), SteepestDescent(), **settings)  # type: ignore[arg-type]


STARTS = ((1.0, 0.0), (0.3, 0.9), (-1.2, 0.4), (0.5, -0.5))


@pytest.mark.parametrize(("name", "inner_steps"), by_turns(KERNELS, [1, 10]))
def test_result_is_what_its_fields_say_and_its_excess_contracts(name: str, inner_steps: int) -> None:
    """By any kernel; of every law and predictor: `test_by_hand.py`."""
    basis, states, law = basis_of(name, count=3, radius=0.3), orbit(*STARTS, dt=0.1, steps=8), LAWS[PAPER_LAW]
    result = st.chase(states, basis, Paper(), law, inner_steps=inner_steps)
    at = states.unsqueeze(-2)

    def estimate(weights: torch.Tensor) -> torch.Tensor:
        return (basis.kernel(at, basis.centers(states)).squeeze(-2) * weights).sum(-1)

    assert torch.equal(result.state, states)
    torch.testing.assert_close(result.value, Paper()(states))
    torch.testing.assert_close(
        result.ideal_weights, basis.ideal_weights(states, Paper()), rtol=1e-9, atol=1e-9
    )
    torch.testing.assert_close(result.estimate, estimate(result.weights), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(result.ideal_estimate, estimate(result.ideal_weights), rtol=1e-9, atol=1e-9)
    excess = basis.excess(result.weights, states, Paper())
    torch.testing.assert_close(result.excess, excess, rtol=1e-6, atol=1e-9)
    assert result.diverged_at.tolist() == [-1] * 4
    assert not result.diverged.any()
    brought = torch.cat((torch.zeros(4, 1, 3).double(), result.weights[:, :-1]), dim=1)
    torch.testing.assert_close(result.estimate_before, estimate(brought), rtol=1e-9, atol=1e-9)
    before = basis.excess(brought, states, Paper())
    torch.testing.assert_close(result.excess_before, before, rtol=1e-6, atol=1e-9)
    rate = law.contraction(condition_number(basis.gram(states)))
    assert rate is not None
    native = (result.ideal_weights * basis.values(states, Paper())).sum(-1)
    bound = rate**inner_steps * result.excess_before * (1 + 1e-9) + 1e-12 * native
    assert (result.excess <= bound).all()
    assert (result.excess >= 0).all()


@pytest.mark.parametrize(("name", "poison"), by_turns(KERNELS, [torch.nan, torch.inf]))
def test_a_row_is_as_it_would_be_alone_and_one_that_is_not_finite_freezes_alone(
    name: str, poison: float
) -> None:
    radius = 0.3 if poison == torch.inf else st.StateRadius(0.5, 0.1)
    basis, states = basis_of(name, count=3, radius=radius), orbit(*STARTS, steps=7)
    clean = fields(st.chase(states, basis, Paper(), SteepestDescent(), inner_steps=2))
    alone = fields(st.chase(states[2:3], basis, Paper(), SteepestDescent(), inner_steps=2))
    for key in ("weights", "coefficients", "estimate", "estimate_before", "value", "excess", "excess_before"):
        torch.testing.assert_close(clean[key][2], alone[key][0], rtol=1e-9, atol=1e-11)
    states = states.clone()
    states[1, 5:] = poison
    states[3, 3, 0] = poison  # finite again afterwards: it stays frozen all the same
    found = fields(st.chase(states, basis, Paper(), SteepestDescent(), inner_steps=2))
    assert found["diverged_at"].tolist() == [-1, 5, -1, 3]
    for key, value in found.items():
        assert torch.equal(value[[0, 2]], clean[key][[0, 2]]), key
    for row, first in ((1, 5), (3, 3)):
        assert torch.equal(found["weights"][row, :first], clean["weights"][row, :first])
        for key in ("estimate", "value", "excess", "ideal_weights", "coefficients"):
            assert torch.isfinite(found[key][row, :first]).all(), key
            assert torch.isnan(found[key][row, first:]).all(), key


@over(["gaussian", "polynomial", "user_defined"])
def test_a_chase_can_be_differentiated(name: str) -> None:
    basis, law = basis_of(name, count=3), SteepestDescent()

    def final(states: torch.Tensor, weights: torch.Tensor) -> tuple[torch.Tensor, ...]:
        result = st.chase(states, basis, Paper(), law, inner_steps=2, weights=weights)
        return result.weights, result.estimate, result.excess

    states = orbit(*STARTS[1:3], dt=0.3, steps=2).requires_grad_()
    assert torch.autograd.gradcheck(final, (states, uniform(2, 3).requires_grad_()), fast_mode=True)


def test_single_precision_stays_single_and_close() -> None:
    states = orbit(*STARTS, steps=5)
    single = st.chase(states.float(), basis_of("exponential", 3), Paper(), SteepestDescent())
    for key, value in fields(single).items():
        assert value.dtype == (torch.int64 if key == "diverged_at" else torch.float32), key
    torch.testing.assert_close(single.estimate.double(), run(states).estimate, rtol=1e-3, atol=1e-3)


def test_far_from_the_origin_nothing_overflows() -> None:
    """exp(|x|^2) is infinite at |x| = 60, and so would the Gram matrix be."""
    states = orbit((60.0, 0.0), dt=1e-4, steps=10)
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(3), 0.01))
    result = st.chase(states, basis, Cosine(0.5), SteepestDescent(), inner_steps=50)
    assert not result.diverged.any()
    assert torch.isfinite(result.estimate).all()
    torch.testing.assert_close(result.ideal_estimate, result.value, rtol=0, atol=0.2)
    assert ((result.estimate - result.ideal_estimate).abs()[:, -1] < 0.2).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"states": uniform(1, 5, 3)}, "`chase(states=...)` must have 2 entries in its last dimension"),
        ({"states": uniform(1, 0, 2)}, "`chase(states=...)` must have the shape (B, T, n); got (1, 0, 2)."),
        ({"law": SteepestDescent}, "`chase(law=...)` must be an object, and is the class"),
        ({"weights": uniform(3, 3)}, "`chase(weights=...)` must have the shape (3,) or (2, 3); got (3, 3)."),
        (
            {"target": lambda x: x},
            "The target `<lambda>` must map points of shape (..., n) to values of shape",
        ),
        ({"predictor": "nonsense"}, "chase(predictor=...)"),
    ],
)
def test_a_bad_argument_is_named_with_its_value(settings: dict[str, object], message: str) -> None:
    standard = {"states": orbit(*STARTS[:2]), "basis": basis_of("exponential", 3), "target": Paper()}
    with pytest.raises(ValueError, match=re.escape(message)):
        st.chase(**{**standard, "law": SteepestDescent(), **settings})


def test_weights_that_underflow_are_not_a_number_while_the_estimate_is_one() -> None:
    states = 30 * orbit(*STARTS[:2], steps=20)
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(3), 0.01))
    result = st.chase(states, basis, Paper(), st.optim.Exact())
    far = states.norm(dim=-1) > 28
    assert far.any()
    assert torch.isnan(result.weights[far]).all()
    assert torch.isnan(result.ideal_weights[far]).all()
    # Three centers at |x| r = .3 are 2 % off; the numbers themselves are good to rounding.
    torch.testing.assert_close(result.ideal_estimate, result.value, rtol=5e-2, atol=0)
    assert torch.isfinite(result.coefficients).all()
    assert not result.diverged.any()


# The weights alone.


@pytest.mark.filterwarnings("ignore:`torch.jit.script`")  # inside torch.func.jvp of torch 2.13
def test_gradients_flow_through_chase_weights() -> None:
    states, basis = circles(2, 3), BASES["exponential, moving radius"]

    def final(first: Tensor) -> Tensor:
        result = chase_weights(states, basis, targets.Quadratic(), LAW, inner_steps=2, weights=first)
        return result.weights[:, -1]

    first = torch.ones(2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(final, (first,))
    _, tangent = torch.func.jvp(final, (first.detach(),), (torch.ones_like(first),))
    assert bool((tangent != 0).any())


def test_chase_weights_refuses_no_piece_at_all() -> None:
    with pytest.raises(ValueError, match="at least one piece"):
        chase_weights([], BASES["exponential"], Paper(), LAW)


@pytest.mark.parametrize("run_chase", [chase, chase_weights])
def test_a_users_target_is_called_from_one_thread_with_all_rows_in_memory_order(run_chase) -> None:
    states = circles(20, 4)
    seen = []

    def target(x: Tensor) -> Tensor:
        seen.append((threading.get_ident(), x.shape[0]))
        return x.view(-1, 2).square().sum(-1).view(x.shape[:-1])

    got = run_chase(states, BASES["exponential"], target, LAW).weights
    assert {thread for thread, _ in seen} == {threading.get_ident()}
    assert {rows for _, rows in seen[2:]} == {20}  # after two tries with other numbers of rows
    want = run_chase(states, BASES["exponential"], targets.Quadratic(), LAW).weights
    torch.testing.assert_close(got, want, rtol=0, atol=1e-8 * float(want.abs().max()))
