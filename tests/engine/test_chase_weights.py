"""The chase for its weights alone: the same weights, in pieces, blocks and layouts of any kind."""

from __future__ import annotations

import threading

import pytest
import torch
from helpers_chase import BASES, LAW, circles
from torch import Tensor

from staf_torch import chase, chase_weights, engine, optim, targets


@pytest.mark.parametrize("name", BASES)
def test_chase_weights_are_those_of_chase(name: str) -> None:
    states, basis = circles(9, 12), BASES[name]
    want = chase(states, basis, targets.Paper(), LAW, inner_steps=3).weights
    options = {"basis": basis, "target": targets.Paper(), "law": LAW, "inner_steps": 3}
    atol = 1e-8 * float(want.abs().max())
    pieces = list(states.split(5, dim=1))
    for got in (chase_weights(states, **options), chase_weights(pieces, **options)):
        torch.testing.assert_close(got.weights, want, rtol=0, atol=atol)
    last = chase_weights(pieces, **options, history=False).weights
    torch.testing.assert_close(last, want[:, -1:], rtol=0, atol=atol)


def test_a_diverged_row_keeps_the_last_weights_it_had() -> None:
    states = circles(3, 8)
    states[1, 4:] = torch.nan
    for result in (
        chase(states, BASES["exponential"], targets.Paper(), LAW),
        chase_weights(states, BASES["exponential"], targets.Paper(), LAW),
    ):
        assert result.diverged_at.tolist() == [-1, 4, -1]
        assert bool(torch.isfinite(result.weights).all())
        assert torch.equal(result.weights[1, 4:], result.weights[1, 3].expand(4, -1))


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


@pytest.mark.parametrize("given", [torch.zeros(3, 2), torch.zeros(2, 0, 2), torch.zeros(2, 3, 5)])
def test_chase_weights_refuses_states_of_another_shape(given: Tensor) -> None:
    with pytest.raises(ValueError, match=r"`chase_weights\(states=\.\.\.\)` must"):
        chase_weights(given.double(), BASES["exponential"], targets.Paper(), LAW)


def test_chase_weights_refuses_no_piece_at_all() -> None:
    with pytest.raises(ValueError, match="at least one piece"):
        chase_weights([], BASES["exponential"], targets.Paper(), LAW)


def test_chase_weights_takes_a_predictor() -> None:
    states, basis, predictor = circles(4, 6), BASES["gaussian"], engine.predictors.Tangent()
    want = chase(states, basis, targets.Paper(), LAW, inner_steps=1, predictor=predictor).weights
    got = chase_weights(states, basis, targets.Paper(), LAW, inner_steps=1, predictor=predictor).weights
    torch.testing.assert_close(got, want, rtol=0, atol=1e-10 * float(want.abs().max()))


@pytest.mark.parametrize("name", BASES)
@pytest.mark.parametrize(
    "law", [optim.Exact(), optim.NormalisedLMS(), optim.Nesterov()], ids=lambda law: type(law).__name__
)
def test_chase_weights_gives_every_law_what_it_needs(name: str, law: optim.UpdateLaw) -> None:
    states, basis = circles(9, 12), BASES[name]
    want = chase(states, basis, targets.Paper(), law, inner_steps=3).weights
    got = chase_weights(states, basis, targets.Paper(), law, inner_steps=3).weights
    torch.testing.assert_close(got, want, rtol=0, atol=1e-8 * float(want.abs().max()))


@pytest.mark.parametrize("run_chase", [chase, chase_weights])
def test_a_users_target_is_called_from_one_thread_with_all_rows_in_memory_order(run_chase) -> None:
    states = circles(200, 4)
    seen = []

    def target(x: Tensor) -> Tensor:
        seen.append((threading.get_ident(), x.shape[0]))
        return x.view(-1, 2).square().sum(-1).view(x.shape[:-1])

    got = run_chase(states, BASES["exponential"], target, LAW).weights
    assert set(seen) == {(threading.get_ident(), 200)}
    want = run_chase(states, BASES["exponential"], targets.Quadratic(), LAW).weights
    torch.testing.assert_close(got, want, rtol=0, atol=1e-8 * float(want.abs().max()))


def test_a_piece_keeps_its_record_of_divergence_when_the_next_one_diverges() -> None:
    states = circles(3, 8)
    states[1, 6] = torch.nan
    first, second = engine.chase_pieces(states.split(4, dim=1), BASES["exponential"], targets.Paper(), LAW)
    assert first.diverged_at.tolist() == [-1, -1, -1]
    assert second.diverged_at.tolist() == [-1, 6, -1]


@pytest.mark.parametrize("run_chase", [chase, chase_weights])
def test_a_reach_beyond_one_is_warned_of_once(run_chase) -> None:
    with pytest.warns(UserWarning, match="Shrink the radius") as seen:
        run_chase(5 * circles(3, 8), BASES["exponential"], targets.Paper(), LAW)
    assert len(seen) == 1
