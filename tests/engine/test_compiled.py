"""The compiled chase computes what the definition does, whatever is chased, by any law, in any batch."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers_chase import BASES, LAW, circles
from torch import Tensor, nn
from variants import Cauchy

from staf_torch import (
    ExponentialKernel,
    GaussianKernel,
    StaFBasis,
    StateFollowingCenters,
    chase,
    chase_weights,
    lanes,
    optim,
    rings,
)
from staf_torch.engine import chase_pieces, predictors
from staf_torch.engine.result import concatenate
from staf_torch.optim.base import LawState, UpdateLaw
from staf_torch.optim.objective import Objective
from staf_torch.targets import Cosine, Paper

pytestmark = [pytest.mark.compiled, pytest.mark.needs_compiler]

STATES = circles(9, 8)
WELL = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(3), 0.6))
GAUSS = StaFBasis(GaussianKernel(0.8), StateFollowingCenters(rings(3), 0.7))
MOVING, MATERN, POLYNOMIAL = (BASES[n] for n in ("exponential, moving radius", "matern", "polynomial"))
# Every law, predictor, kind of basis; a program each.
CASES = {
    "steepest descent": (WELL, LAW, None),
    "barzilai borwein": (POLYNOMIAL, optim.BarzilaiBorwein(), None),
    "conjugate gradient": (GAUSS, optim.ConjugateGradient(), predictors.Secant(guarded=True)),
    "exact": (MOVING, optim.Exact(), None),
    "fixed step": (GAUSS, optim.FixedStep(), predictors.Secant()),
    "heavy ball": (WELL, optim.HeavyBall(), None),
    "normalised LMS": (MOVING, optim.NormalisedLMS(0.7), None),
    "core preconditioner": (WELL, optim.PreconditionedDescent(), None),
    "jacobi preconditioner": (GAUSS, optim.PreconditionedDescent("jacobi"), predictors.Tangent(2)),
    "a user's kernel and function, ten centers": (
        StaFBasis(Cauchy(), StateFollowingCenters(rings(10), 1.4)),
        LAW,
        None,
    ),
}  # Nesterov's and least squares: below

# One with all results for every kind of basis of the library; of ten centers that pivot: below.
WHOLE = ("steepest descent", "barzilai borwein", "conjugate gradient", "exact")


def definition(call: Callable[..., Any], *args: Any, **options: Any) -> Any:
    with lanes.compiling("never"):
        return call(*args, **options)


@pytest.fixture
def compiled(caplog: pytest.LogCaptureFixture) -> Callable[..., Any]:
    """Call what must be compiled: the log says where it is not."""

    def run(call: Callable[..., Any], *args: Any, **options: Any) -> Any:
        with lanes.compiling("always"):
            result = call(*args, **options)
        assert not caplog.messages
        return result

    return run


def assert_close(got: object, want: object, tolerance: float) -> None:
    for field in dataclasses.fields(want):  # type: ignore[arg-type]
        a, b = getattr(got, field.name), getattr(want, field.name)
        if isinstance(b, Tensor):
            assert a.shape == b.shape
            assert a.dtype == b.dtype
            if b.is_floating_point():
                assert torch.equal(a.isnan(), b.isnan())
                scale = float(b.nan_to_num().abs().max()) + 1e-300
                torch.testing.assert_close(a, b, rtol=0, atol=tolerance * scale, equal_nan=True)
            else:
                assert torch.equal(a, b)


@pytest.mark.parametrize("name", CASES)
def test_the_compiled_chase_is_the_definition(name: str, compiled: Callable[..., Any]) -> None:
    basis, law, predictor = CASES[name]
    options = {"inner_steps": 2, "predictor": predictor}
    run = chase if name in WHOLE else chase_weights  # what is said beside the weights depends on no law
    target = user_target if "user" in name else Paper()
    got = compiled(run, STATES, basis, target, law, **options)
    want = definition(run, STATES, basis, target, law, **options)
    # Two iterations of this one reach the ideal weights: their excess is rounding.
    exact = name == "conjugate gradient"
    tiny = {f: getattr(want, f) * 0 for f in ("excess", "excess_before") if exact}
    same = dataclasses.replace(got, **tiny), dataclasses.replace(want, **tiny)
    assert_close(*same, 1e-10)


def test_matrices_of_many_centers_are_factored_in_loops(compiled: Callable[..., Any]) -> None:
    """A certificate and a Kalman filter of the weights: factors that pivot, triangles, eigenvalues, matrices
    carried."""
    law = optim.RecursiveLeastSquares()
    got = compiled(chase, STATES, MATERN, Paper(), law, inner_steps=1, certificate=True)
    want = definition(chase, STATES, MATERN, Paper(), law, inner_steps=1, certificate=True)
    assert_close(got, want, 1e-10)
    assert got.certificate is not None
    assert want.certificate is not None
    assert want.certificate.growth.isfinite().all()
    for a, b in zip(got.certificate, want.certificate, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-7, equal_nan=True)
    torch.testing.assert_close(got.estimate, want.estimate, rtol=1e-7, atol=1e-8)


STIFF = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(3), 0.05))
"""Of a condition number of 1000 and ten iterations: a rounding would become a digit."""


def test_rows_have_the_bits_that_they_have_in_any_batch_and_beside_any_row(
    compiled: Callable[..., Any],
) -> None:
    states = circles(300, 12)
    whole = compiled(chase_weights, states, STIFF, Paper(), LAW).weights
    for first, batch in ((0, 1), (193, 7), (200, 64)):
        part = compiled(chase_weights, states[first : first + batch], STIFF, Paper(), LAW).weights
        assert torch.equal(part, whole[first : first + batch])
    spoilt = states.clone()
    spoilt[5, 3:], spoilt[7, 9] = torch.nan, torch.inf
    result = compiled(chase_weights, spoilt, STIFF, Paper(), LAW)
    others = [i for i in range(300) if i not in (5, 7)]
    assert torch.equal(result.weights[others], whole[others])
    assert result.diverged_at[[5, 7]].tolist() == [3, 9]
    assert torch.equal(result.weights[5, 3:], whole[5, 2].expand(9, -1))


def test_pieces_of_time_continue_to_the_bit_and_remember_who_diverged(compiled: Callable[..., Any]) -> None:
    states = circles(9, 60)
    states[4, 45:] = states[2, 25:] = states[7, 19:] = torch.nan
    options = {"basis": STIFF, "target": Paper(), "law": LAW}
    whole = compiled(chase_weights, states, **options)
    parts = compiled(chase_weights, states.split(20, dim=1), **options)
    assert torch.equal(parts.weights, whole.weights)
    assert torch.equal(parts.diverged_at, whole.diverged_at)
    assert whole.diverged_at[[4, 2, 7]].tolist() == [45, 25, 19]
    assert torch.equal(parts.weights[7, 19:], whole.weights[7, 18].expand(41, -1))
    last = compiled(chase_weights, states.split(20, dim=1), **options, history=False)
    torch.testing.assert_close(last.weights[:, 0], whole.weights[:, -1], rtol=1e-14, atol=0)


def test_pieces_of_all_results_are_the_whole(compiled: Callable[..., Any]) -> None:
    """With a predictor, a certificate and a warning that remember the piece before."""
    predictor = predictors.Secant(guarded=True)
    states, options = 0.5 * circles(2, 12), {"predictor": predictor, "certificate": True, "inner_steps": 2}
    states[1, 5] *= 6.0  # beyond |x| r = 1 by a state of the second piece
    pieces = lambda *given: concatenate(list(chase_pieces(*given, **options)))  # noqa: E731
    with pytest.warns(UserWarning, match=r"> 1.*Shrink the radius") as seen:
        found = compiled(pieces, states.split([4, 1, 7], dim=1), WELL, Paper(), LAW)
    assert len(seen) == 1
    with pytest.warns(UserWarning, match="Shrink"):
        wanted = definition(chase, states, WELL, Paper(), LAW, **options)
    assert_close(found, wanted, 1e-8)
    for one, other in zip(found.certificate, wanted.certificate, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-9)


def test_another_radius_width_gain_or_phase_compiles_nothing(
    compiled: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def basis(width: float, radius: float) -> StaFBasis:
        return StaFBasis(GaussianKernel(width), StateFollowingCenters(rings(3), radius))

    options = {"inner_steps": 2, "predictor": predictors.Tangent(1)}
    compiled(chase, STATES, basis(0.8, 0.7), Cosine([1.0, 0.3], 0.2), optim.Nesterov(0.7), **options)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for name, value in (("PATH", str(tmp_path)), ("CXX", "")):  # from here on there is no compiler
        monkeypatch.setenv(name, value)
    # Numbers that are 1, equal to others, or a power of two.
    for width, radius, phase, step in ((1.0, 0.5, 0.0, 1.0), (0.5, 0.5, 0.5, 0.5), (0.9, 0.6, -1.0, 0.25)):
        args = STATES, basis(width, radius), Cosine([phase, 1.0], phase), optim.Nesterov(step)
        assert_close(compiled(chase, *args, **options), definition(chase, *args, **options), 1e-10)


def test_single_precision_stays_single(compiled: Callable[..., Any]) -> None:
    states = STATES.float()
    got = compiled(chase_weights, states, WELL, Paper(), LAW, inner_steps=2)
    want = definition(chase_weights, states, WELL, Paper(), LAW, inner_steps=2)
    assert_close(got, want, 2e-4)


def user_target(x: Tensor) -> Tensor:
    return x[..., 0].square() + (x[..., 0] * x[..., 1]).tanh()


class Scaled(Paper):
    def __init__(self, factor: Tensor) -> None:
        super().__init__()
        self.factor = factor

    def forward(self, x: Tensor) -> Tensor:
        value: Tensor = self.factor * super().forward(x)
        return value


def test_a_learned_target_keeps_its_gradient() -> None:
    factor = nn.Parameter(torch.tensor(2.0, dtype=torch.float64))
    result = chase_weights(STATES, GAUSS, Scaled(factor), LAW, inner_steps=2)
    (gradient,) = torch.autograd.grad(result.weights[:, -1].sum(), factor)
    # The chase is linear in V where the line searches are: they are invariant under its scale.
    want = result.weights[:, -1].sum() / 2
    torch.testing.assert_close(gradient, want.detach(), rtol=1e-6, atol=0)


# Laws and kernels of a user.


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


def test_a_law_of_a_user_may_carry_tensors_of_every_kind(compiled: Callable[..., Any]) -> None:
    found = compiled(chase, STATES, WELL, Paper(), Adaptive(), inner_steps=3)
    wanted = definition(chase, STATES, WELL, Paper(), Adaptive(), inner_steps=3)
    torch.testing.assert_close(found.weights, wanted.weights, rtol=1e-9, atol=1e-9)
    assert bool((found.excess[:, -1] < found.excess[:, 0]).all())


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
        (Broken((0.5,)), r"`Broken.init` must return a tuple of tensors; got \(0.5,\)"),
        (Broken((torch.zeros(3),)), r"B = 9; number 0 is \(3,\)"),
        (Broken((), torch.zeros(9, 4)), r"must return weights of the shape \(B, 3\); got \(9, 4\)"),
        (Broken((), None, (torch.zeros(9),)), r"must return a state of the shapes .* \[\]; got \[\(9,\)\]"),
    ],
)  # fmt: skip
def test_a_law_that_breaks_its_rules_is_named(law: UpdateLaw, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        chase(STATES, WELL, Paper(), law, inner_steps=1)
