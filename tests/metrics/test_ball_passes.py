"""When the pass over states is compiled, and what it finds, from the definition written out."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import basis_of, uniform
from torch import Tensor

import staf_torch as st
from staf_torch.centers import probe_points
from staf_torch.metrics import ball_error
from staf_torch.metrics.ball_error import PROBES, StateErrorPass
from staf_torch.targets import Paper


class Program:
    """Stands for a compiled program: tells what it is asked, and counts rows."""

    def __init__(self, ready: bool = True) -> None:
        self.ready, self.asked, self.rows = ready, 0, 0

    def compiles(self, carry: Any, now: Any, row: tuple[Tensor, ...], *, steps: int) -> bool:
        assert (carry, now, steps) == ((), (), 1)
        assert {part.dim() for part in row} == {2}
        self.asked += 1
        return self.ready

    def __call__(self, carry: Any, now: Any, row: tuple[Tensor, ...], *, steps: int) -> Any:
        assert (carry, now, steps) == ((), (), 1)
        self.rows += len(row[0])
        return None, tuple(k + torch.arange(len(row[0])).double() for k in range(5))


class Kept:
    """Stands for the programs that are kept: gives the one it has, or none."""

    def __init__(self, program: Program | None) -> None:
        self.program, self.wanted = program, 0

    def of(self, *parts: Any) -> Program | None:
        self.wanted += 1
        return self.program


def asked(errors: StateErrorPass, states: int) -> Any:
    x = uniform(states, 2, low=0.3, seed=states)
    weights = uniform(states, 6, seed=1)
    return errors(x.unsqueeze(0), weights.unsqueeze(0), weights.unsqueeze(0))


def test_a_pass_is_compiled_once_it_pays(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = Kept(Program())
    monkeypatch.setattr(ball_error, "_kept", kept)
    errors = StateErrorPass(basis_of("gaussian", 6, 0.3), Paper(), 5, expected=29_990)
    assert errors.compiled is False
    asked(errors, 9)
    assert (errors.compiled, kept.wanted) == (False, 0)
    found = asked(errors, 1)  # the thirty-thousandth
    assert (errors.compiled, kept.wanted) == (True, 1)
    assert [float(part) for part in found] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert {part.shape for part in found} == {(1, 1)}
    found = asked(errors, 4)
    assert found.ball_floor_error.tolist() == [[1.0, 2.0, 3.0, 4.0]]
    assert kept.wanted == 1
    assert kept.program is not None
    assert (kept.program.asked, kept.program.rows) == (2, 5)


@pytest.mark.parametrize(
    ("compile", "program", "compiled"),
    [
        (True, True, True),
        (True, False, False),
        (True, None, False),
        (False, True, False),
        ("auto", True, False),
    ],
)
def test_a_pass_is_compiled_where_it_shall_and_can_be(
    compile: bool | str, program: bool | None, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Kept(None if program is None else Program(program))
    monkeypatch.setattr(ball_error, "_kept", kept)
    basis = basis_of("gaussian", 6, 0.3)
    errors = StateErrorPass(basis, Paper(), 5, compile=compile)
    found, plain = asked(errors, 3), asked(StateErrorPass(basis, Paper(), 5, compile=False), 3)
    assert errors.compiled is compiled
    assert (kept.wanted > 0) is (compile is True)
    assert torch.equal(found.ball_error, plain.ball_error) is not compiled
    never = StateErrorPass(basis, Paper(), 5, compile=False, expected=10**6)
    asked(never, 3)
    assert never.compiled is False


@pytest.mark.parametrize("lead", [(7,), (2, 4)])
@pytest.mark.parametrize("radius", [0.4, st.StateRadius(0.5, 0.1)])
@pytest.mark.parametrize("name", ["exponential", "gaussian", "matern52", "polynomial"])
def test_errors_are_those_of_the_definition(name: str, radius: Any, lead: tuple[int, ...]) -> None:
    basis, target = basis_of(name, 6, radius), Paper()
    x = uniform(*lead, 2, low=0.3, seed=3)
    flat = x.reshape(-1, 2)
    weights = basis.ideal_weights(x, target)
    off = weights * (1 + 0.1 * uniform(*lead, 6, seed=4))
    gain, scaled = basis.kernel.log_gain(x), basis.gram_structure(x)
    held = off if gain is None else off * gain.exp().unsqueeze(-1)
    s = basis.kernel.log_scale(x, basis.centers.offsets(x))
    held = held if s is None else held * s.exp()
    found = StateErrorPass(basis, target, compile=False)(x, held, weights)
    for row, at in enumerate(flat):
        z = float(basis.centers.radius(at)) * probe_points(PROBES, 2)
        sigma = basis(at + z, at)
        chosen, best = off.reshape(-1, 6)[row], weights.reshape(-1, 6)[row]
        exact = target(at + z)
        parts = [part.reshape(-1)[row] for part in found]
        torch.testing.assert_close(parts[0], (exact - sigma @ chosen).abs().max(), rtol=1e-6, atol=1e-9)
        torch.testing.assert_close(parts[1], (exact - sigma @ best).abs().max(), rtol=1e-4, atol=1e-7)
        y = at.clone().requires_grad_()
        (target(y) - basis(y[None], at)[0] @ chosen).backward()
        torch.testing.assert_close(parts[2], y.grad.norm(), rtol=1e-6, atol=1e-8)
        torch.testing.assert_close(parts[4], best @ target(basis.centers(at)), rtol=1e-6, atol=1e-9)
    kappa = torch.linalg.cond(scaled.scaled()).expand(lead)
    torch.testing.assert_close(found.condition_number, kappa, rtol=1e-5, atol=0)


def test_a_target_that_is_constant_has_no_gradient() -> None:
    basis = basis_of("gaussian", 6, 0.3)
    x = uniform(3, 2)
    found = StateErrorPass(basis, lambda y: torch.ones(y.shape[:-1]).double(), compile=False)(
        x, torch.zeros(3, 6).double(), torch.zeros(3, 6).double()
    )
    assert found.gradient_error.tolist() == [0.0] * 3
    assert found.ball_error.tolist() == [1.0] * 3
