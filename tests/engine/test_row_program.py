"""The compiled chase computes what the definition does, whatever is chased, in any batch."""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
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
    engine,
    optim,
    rings,
)
from staf_torch.engine import predictors, row_program
from staf_torch.lanes import compiler
from staf_torch.targets import Cosine, Paper

pytestmark = [pytest.mark.compiled, pytest.mark.needs_compiler]

TIMES = 20
STATES = circles(9, TIMES)
WELL = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(3), 0.6))
MANY = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(15), 0.9))
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


@pytest.fixture
def definition(monkeypatch: pytest.MonkeyPatch):
    """Run a chase by the definition, whatever its length."""

    def run(call, *args, **kwargs):
        with monkeypatch.context() as patch:
            patch.setattr(row_program, "_SHORTEST", 10**9)
            return call(*args, **kwargs)

    return run


def compiled(call, *args, **kwargs):
    """A chase that must have been compiled."""
    before = logging.getLogger("staf_torch.lanes.program")
    said: list[logging.LogRecord] = []
    handler = logging.Handler()
    handler.emit = said.append  # type: ignore[method-assign]
    before.addHandler(handler)
    try:
        result = call(*args, **kwargs)
    finally:
        before.removeHandler(handler)
    assert not said, said[0].getMessage()
    return result


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
def test_the_compiled_chase_is_the_definition(name: str, definition) -> None:
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


def test_a_certificate_is_compiled(definition) -> None:
    got = compiled(chase, STATES, WELL, Paper(), LAW, inner_steps=2, certificate=True)
    want = definition(chase, STATES, WELL, Paper(), LAW, inner_steps=2, certificate=True)
    assert got.certificate is not None
    assert want.certificate is not None
    for a, b in zip(got.certificate, want.certificate, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-9)


def test_matrices_of_many_centers_are_factored_in_loops(definition) -> None:
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


def test_many_centers_stay_loops_over_arrays() -> None:
    problem = engine.problem.Problem("chase", MANY, Paper(), LAW, 10)
    carry = row_program.first_carry(problem, engine.recursion.start(problem, STATES, None))
    text = row_program.Program(row_program.Step(problem, True)).text(carry, STATES)
    assert text.count("\n") < 3000  # a compiler takes some 2 seconds for them


def test_rows_have_the_bits_that_they_have_in_any_batch_and_beside_any_row() -> None:
    """Ten iterations at a condition number of 10^4: a rounding would become a digit."""
    states, basis = circles(300, 17), BASES["exponential"]
    whole = compiled(chase_weights, states, basis, Paper(), LAW).weights
    for first, batch in ((0, 1), (193, 7), (200, 64)):
        part = chase_weights(states[first : first + batch], basis, Paper(), LAW).weights
        assert torch.equal(part, whole[first : first + batch])
    spoilt = states.clone()
    spoilt[5, 3:], spoilt[7, 9] = torch.nan, torch.inf
    result = chase_weights(spoilt, basis, Paper(), LAW)
    others = [i for i in range(300) if i not in (5, 7)]
    assert torch.equal(result.weights[others], whole[others])
    assert result.diverged_at[[5, 7]].tolist() == [3, 9]
    assert torch.equal(result.weights[5, 3:], whole[5, 2].expand(14, -1))


def test_chunks_of_time_continue_to_the_bit_and_remember_who_diverged() -> None:
    states = circles(9, 60)
    states[4, 45:] = states[2, 25:] = states[7, 19:] = torch.nan
    options = {"basis": BASES["exponential"], "target": Paper(), "law": LAW}
    whole = chase_weights(states, **options)
    parts = chase_weights(states.split(20, dim=1), **options)
    assert torch.equal(parts.weights, whole.weights)
    assert torch.equal(parts.diverged_at, whole.diverged_at)
    assert whole.diverged_at[[4, 2, 7]].tolist() == [45, 25, 19]
    assert torch.equal(parts.weights[7, 19:], whole.weights[7, 18].expand(41, -1))
    last = chase_weights(states.split(20, dim=1), **options, history=False)
    torch.testing.assert_close(last.weights[:, 0], whole.weights[:, -1], rtol=1e-14, atol=0)


def test_another_radius_width_gain_or_phase_compiles_and_traces_nothing(
    definition, monkeypatch: pytest.MonkeyPatch
) -> None:
    def basis(width: float, radius: float) -> StaFBasis:
        return StaFBasis(GaussianKernel(width), StateFollowingCenters(rings(3), radius))

    options = {"inner_steps": 2, "predictor": predictors.Tangent(1)}
    compiled(chase, STATES, basis(0.8, 0.7), Cosine([1.0, 0.3], 0.2), optim.Nesterov(0.7), **options)
    monkeypatch.setattr(compiler, "_run", None)
    monkeypatch.setattr(row_program.Program, "_build", None)
    # Numbers that are 1, equal to others, or a power of two.
    for width, radius, phase, step in ((1.0, 0.5, 0.0, 1.0), (0.5, 0.5, 0.5, 0.5), (0.9, 0.6, -1.0, 0.25)):
        args = STATES, basis(width, radius), Cosine([phase, 1.0], phase), optim.Nesterov(step)
        assert_close(compiled(chase, *args, **options), definition(chase, *args, **options), 1e-10)


def test_single_precision_stays_single(definition) -> None:
    states = STATES.float()
    got = compiled(chase_weights, states, WELL, Paper(), LAW, inner_steps=2)
    want = definition(chase_weights, states, WELL, Paper(), LAW, inner_steps=2)
    assert_close(got, want, 2e-4)


def user_target(x: Tensor) -> Tensor:
    return x[..., 0].square() + (x[..., 0] * x[..., 1]).tanh()


def test_a_callable_that_cannot_be_compiled_is_said_once(
    definition, caplog: pytest.LogCaptureFixture
) -> None:
    def reads_memory(x: Tensor) -> Tensor:
        return torch.from_numpy(np.square(x.detach().numpy())).sum(-1)

    for _ in range(2):
        got = chase_weights(STATES, WELL, reads_memory, LAW, inner_steps=2)
    assert_close(got, definition(chase_weights, STATES, WELL, reads_memory, LAW, inner_steps=2), 1e-12)
    said = [r.getMessage() for r in caplog.records if r.name.startswith("staf_torch")]
    assert len(said) == 1
    assert "numpy" in said[0]


class Scaled(Paper):
    def __init__(self, factor: Tensor) -> None:
        super().__init__()
        self.factor = factor if isinstance(factor, nn.Parameter) else (factor,)[0]

    def forward(self, x: Tensor) -> Tensor:
        value: Tensor = self.factor * super().forward(x)
        return value


@pytest.mark.parametrize("run", [chase, chase_weights])
@pytest.mark.parametrize("kind", [nn.Parameter, Tensor.requires_grad_])
def test_a_learned_target_keeps_its_gradient(run, kind) -> None:
    factor = kind(torch.tensor(2.0, dtype=torch.float64))
    result = run(STATES, GAUSS, Scaled(factor), LAW, inner_steps=2)
    (gradient,) = torch.autograd.grad(result.weights[:, -1].sum(), factor)
    # The chase is linear in V where the line searches are: they are invariant under its scale.
    want = result.weights[:, -1].sum() / 2
    torch.testing.assert_close(gradient, want.detach(), rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("run", "basis", "steps"), [(chase, WELL, 2), (chase_weights, BASES["exponential"], 10)]
)
def test_a_reach_beyond_one_is_warned_of_once(run, basis: StaFBasis, steps: int) -> None:
    states = 3.0 * circles(9, TIMES)
    states[1, 2:] = torch.inf
    with pytest.warns(UserWarning, match=r"\|x\| r = |Shrink") as seen:
        run(2 * states, basis, Paper(), LAW, inner_steps=steps)
    assert len(seen) == 1
