"""The fused recursion computes what the plain-torch recursion defines."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch
from torch import Tensor

import staf_torch.chase.fused  # noqa: F401  (the module; the package's name `chase` is the function)
from staf_torch import (
    ExponentialKernel,
    GaussianKernel,
    MaternKernel,
    PolynomialKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    ball,
    chase,
    chase_weights,
    optim,
    rings,
    systems,
    targets,
)
from staf_torch.basis import GramStructure

fused_module = sys.modules["staf_torch.chase.fused"]
correct_module = sys.modules["staf_torch.chase.correct"]
chase_module = sys.modules["staf_torch.chase"]
compiled_module = sys.modules["staf_torch.chase._compiled"]
recursion_module = sys.modules["staf_torch.chase.recursion"]
Carry, History, fused = recursion_module.Carry, fused_module.History, fused_module.fused

LAW = optim.SteepestDescent()


@pytest.fixture(autouse=True)
def _chase_is_fused_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(correct_module, "_FUSE_CHASE", True)


needs_compiler = pytest.mark.skipif(
    fused_module.compiled("double") is None, reason="no C++ compiler: the reference runs instead"
)
# Steepest descent passes rounding on, some ten times an iteration at worst; ten iterations, well conditioned.
TOLERANCE = {torch.float64: 1e-10, torch.float32: 5e-3}


def problem(
    batch: int, times: int, count: int, dtype: torch.dtype, *, shared: bool, seed: int
) -> tuple[GramStructure, Tensor, Carry]:
    """Random well-conditioned structure, values and carry."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)

    root = normal(*(() if shared else (batch, times)), count, count)
    core = root @ root.mT / count + torch.eye(count, dtype=dtype)
    structure = GramStructure(core, 0.1 * normal(batch, times, count), normal(batch, times))
    never = torch.full((batch,), -1)
    return structure, normal(batch, times, count), Carry(normal(batch, count), (), normal(batch), 7, never)


def copied(carry: Carry) -> Carry:
    return Carry(carry.weights.clone(), (), carry.log_gain.clone(), carry.time, carry.diverged_at.clone())


def reference(structure: GramStructure, values: Tensor, carry: Carry, steps: int = 10):
    gram = structure.scaled().expand(*values.shape, values.shape[-1])
    return recursion_module.recursion(gram, values, structure.log_gain, LAW, steps, carry)


def run(structure: GramStructure, values: Tensor, carry: Carry, steps: int = 10):
    """(before, after, carry), histories as (B, C, M)."""
    batch, times, count = values.shape
    before, after = values.new_empty(times, count, batch), values.new_empty(times, count, batch)
    carry = fused(structure, values, steps, copied(carry), History(before, after))
    return before.permute(2, 0, 1), after.permute(2, 0, 1), carry


def assert_equal_to_rounding(got: Tensor, want: Tensor) -> None:
    torch.testing.assert_close(got, want, rtol=0, atol=TOLERANCE[want.dtype] * float(want.abs().max()))


@needs_compiler
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 7, 8, 10, 15, 28])
def test_fused_equals_the_reference(count: int, shared: bool, dtype: torch.dtype) -> None:
    for seed, (batch, times) in enumerate([(1, 9), (7, 4), (16, 3), (33, 3), (130, 2)]):
        structure, values, carry = problem(batch, times, count, dtype, shared=shared, seed=seed)
        want = reference(structure, values, carry)
        before, after, end = run(structure, values, carry)
        assert_equal_to_rounding(before, want.before)
        assert_equal_to_rounding(after, want.after)
        torch.testing.assert_close(end.log_gain, want.carry.log_gain, rtol=0, atol=0)
        assert end.time == want.carry.time
        assert bool((end.diverged_at == -1).all())


@needs_compiler
@pytest.mark.parametrize("steps", [1, 2, 5, 20])
def test_any_number_of_iterations(steps: int) -> None:
    structure, values, carry = problem(5, 4, 3, torch.float64, shared=True, seed=steps)
    assert_equal_to_rounding(
        run(structure, values, carry, steps)[1], reference(structure, values, carry, steps).after
    )


@needs_compiler
@pytest.mark.parametrize("count", [3, 9])
def test_structures_without_scale_or_gain(count: int) -> None:
    structure, values, carry = problem(20, 3, count, torch.float64, shared=True, seed=0)
    for bare in (
        structure._replace(log_scale=None),
        structure._replace(log_gain=None),
        GramStructure(structure.core, structure.log_scale[0, 0], None),
    ):
        full = bare._replace(log_gain=torch.zeros(20, 3) if bare.log_gain is None else bare.log_gain)
        flat = carry if bare.log_gain is not None else carry._replace(log_gain=torch.zeros(20))
        assert_equal_to_rounding(run(bare, values, flat)[1], reference(full, values, flat).after)


@needs_compiler
@pytest.mark.parametrize("count", [3, 9])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_row_that_diverges_stays_behind_alone(count: int, bad: float) -> None:
    structure, values, carry = problem(19, 6, count, torch.float64, shared=True, seed=3)
    clean = run(structure, values, carry)[1]
    values = values.clone()
    values[4, 2, 0] = bad  # one value of one row
    structure.log_scale[11, 3, 1] = bad  # the Gram matrix of another
    structure.log_gain[17, 0] = bad
    want = reference(structure, values, carry)
    before, after, end = run(structure, values, carry)
    torch.testing.assert_close(end.diverged_at, want.carry.diverged_at)
    assert end.diverged_at[[4, 11, 17]].tolist() == [9, 10, 7]
    torch.testing.assert_close(end.log_gain, want.carry.log_gain, rtol=0, atol=0)
    assert_equal_to_rounding(before, want.before)
    assert_equal_to_rounding(after, want.after)
    others = [i for i in range(19) if i not in (4, 11, 17)]
    assert torch.equal(after[others], clean[others])


@needs_compiler
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("count", [3, 6, 15])
def test_rows_of_a_batch_have_the_bits_they_have_alone(count: int, dtype: torch.dtype) -> None:
    for shared in (True, False):
        structure, values, carry = problem(77, 5, count, dtype, shared=shared, seed=1)
        together = run(structure, values, carry)[1]
        for i in (0, 16, 31, 76):
            core = structure.core if shared else structure.core[i : i + 1]
            alone = GramStructure(core, structure.log_scale[i : i + 1], structure.log_gain[i : i + 1])
            row = Carry(carry.weights[i : i + 1], (), carry.log_gain[i : i + 1], 7, carry.diverged_at[:1])
            assert torch.equal(run(alone, values[i : i + 1], row)[1][0], together[i])


@needs_compiler
def test_pieces_of_time_continue_to_the_bit() -> None:
    structure, values, carry = problem(21, 9, 3, torch.float64, shared=True, seed=2)
    whole = run(structure, values, carry)[1]
    parts = []
    for at in (slice(0, 1), slice(1, 5), slice(5, 9)):
        piece = structure._replace(log_scale=structure.log_scale[:, at], log_gain=structure.log_gain[:, at])
        _, after, carry = run(piece, values[:, at], carry)
        parts.append(after)
    assert torch.equal(torch.cat(parts, dim=1), whole)


@needs_compiler
def test_the_exponentials_of_the_fused_recursion_are_exact_to_two_units() -> None:
    for dtype, limit in ((torch.float64, 700.0), (torch.float32, 85.0)):
        gain = torch.linspace(-limit, limit, 4001, dtype=dtype).unsqueeze(-1)
        rows = gain.shape[0]
        carry = Carry(gain.new_ones(rows, 1), (), gain.new_zeros(rows), 0, torch.full((rows,), -1))
        out = gain.new_empty(1, 1, rows)
        fused(
            GramStructure(gain.new_ones(1, 1), None, gain), gain.new_zeros(rows, 1, 1), 0, carry, History(out)
        )
        want = gain[:, 0].double().exp()
        assert float(((out[0, 0].double() - want) / want).abs().max()) <= 2 * torch.finfo(dtype).eps


BASES = {
    "exponential": StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), 0.3)),
    "exponential, moving radius": StaFBasis(
        ExponentialKernel(), StateFollowingCenters(rings(3), StateRadius(0.3, 0.5))
    ),
    "gaussian": StaFBasis(GaussianKernel(0.7), StateFollowingCenters(ball(10, 2), 0.5)),
    "matern": StaFBasis(MaternKernel(1.5, 0.8), StateFollowingCenters(rings(10), 0.5)),
    "polynomial": StaFBasis(PolynomialKernel(2), StateFollowingCenters(rings(3), 0.5)),
}


def circles(batch: int, times: int) -> Tensor:
    angle = torch.arange(batch, dtype=torch.float64)
    x0 = torch.stack((angle.cos(), 0.8 * angle.sin()), dim=-1)
    return systems.simulate(systems.Oscillator(), x0, dt=0.05, steps=times - 1)


@needs_compiler
@pytest.mark.parametrize("name", BASES)
def test_chase_is_the_same_with_either_recursion(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    states, basis = circles(9, 12), BASES[name]
    got = chase(states, basis, targets.Paper(), LAW, inner_steps=3)
    monkeypatch.setattr(correct_module, "fusible", lambda *_: False)
    want = chase(states, basis, targets.Paper(), LAW, inner_steps=3)
    for field in ("estimate", "estimate_before", "excess", "excess_before", "coefficients", "weights"):
        a, b = getattr(got, field), getattr(want, field)
        torch.testing.assert_close(a, b, rtol=0, atol=1e-8 * float(b.abs().max()))


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


def test_chase_weights_in_blocks_of_rows_have_the_bits_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    options = {"basis": BASES["exponential"], "target": targets.Paper(), "law": LAW}
    states = circles(9, 6)
    whole = chase_weights(states, **options, weights=torch.ones(9, 6))
    monkeypatch.setattr(sys.modules["staf_torch.chase.weights"], "_ROWS", 4)
    blocks = chase_weights(states, **options, weights=torch.ones(9, 6))
    torch.testing.assert_close(blocks.weights, whole.weights, rtol=1e-9, atol=1e-9)


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


def test_without_a_compiler_the_reference_runs_and_the_log_says_so_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    states, basis = circles(4, 5), BASES["exponential"]
    want = chase_weights(states, basis, targets.Paper(), LAW).weights
    compiled_module.compiled.cache_clear()
    compiled_module._said.clear()
    monkeypatch.setattr(compiled_module.shutil, "which", lambda _: None)
    try:
        with caplog.at_level(logging.INFO):
            got = chase_weights(states, basis, targets.Paper(), LAW).weights
            chase(states.float(), basis, targets.Paper(), LAW)
    finally:
        compiled_module.compiled.cache_clear()
        compiled_module._said.clear()
    torch.testing.assert_close(got, want, rtol=0, atol=1e-8 * float(want.abs().max()))
    assert len([r for r in caplog.records if r.name.startswith("staf_torch")]) == 1


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


def test_chase_weights_refuses_a_predictor() -> None:
    with pytest.raises(ValueError, match=r"`chase_weights\(predictor=\.\.\.\)` must be None"):
        chase_weights(
            circles(2, 3),
            BASES["exponential"],
            targets.Paper(),
            LAW,
            predictor=chase_module.predictors.Secant(),
        )


@pytest.mark.parametrize("name", BASES)
@pytest.mark.parametrize("law", [optim.Exact(), optim.NormalisedLMS(), optim.Nesterov()], ids=repr)
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
    first, second = chase_module.chase_pieces(
        states.split(4, dim=1), BASES["exponential"], targets.Paper(), LAW
    )
    assert first.diverged_at.tolist() == [-1, -1, -1]
    assert second.diverged_at.tolist() == [-1, 6, -1]


@pytest.mark.parametrize("run_chase", [chase, chase_weights])
def test_a_reach_beyond_one_is_warned_of_once(run_chase) -> None:
    with pytest.warns(UserWarning, match="Shrink the radius") as seen:
        run_chase(5 * circles(3, 8), BASES["exponential"], targets.Paper(), LAW)
    assert len(seen) == 1


FAULTS = {
    "no compiler": {"PATH": "/nonexistent"},
    "failing build": {"CXX": "/bin/false"},
    "nowhere to write": {"HOME": "/proc", "TMPDIR": "/proc"},
}


@pytest.mark.parametrize("fault", FAULTS)
def test_no_fault_of_a_build_is_more_than_one_line_of_the_log(fault: str, tmp_path: Path) -> None:
    program = """
import sys, tempfile, torch, staf_torch as st
sys.modules["staf_torch.chase.correct"]._FUSE_CHASE = True
tempfile.tempdir = __import__("os").environ.get("TMPDIR")
basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(3), 0.1))
for dtype in (torch.float64, torch.float32):
    for run in (st.chase, st.chase_weights):
        weights = run(torch.ones(2, 3, 2, dtype=dtype), basis, st.targets.Paper(), st.optim.SteepestDescent())
        assert weights.weights.isfinite().all()
"""
    unset = ("CXX", "XDG_CACHE_HOME")
    environment = {name: value for name, value in os.environ.items() if name not in unset}
    if "HOME" not in FAULTS[fault]:
        environment["XDG_CACHE_HOME"] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        env=environment | FAULTS[fault],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert "runs in plain torch" in done.stderr


def test_a_chase_asks_for_no_build_and_its_rows_do_not_depend_on_the_batch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(correct_module, "fusible", lambda *_: pytest.fail("asked for the compiled recursion"))
    states = circles(400, 120)
    together = chase(states, BASES["exponential"], targets.Paper(), LAW, inner_steps=5)
    for row in (0, 199, 399):
        alone = chase(states[row : row + 1], BASES["exponential"], targets.Paper(), LAW, inner_steps=5)
        scale = float(alone.weights.abs().max())
        torch.testing.assert_close(together.weights[row], alone.weights[0], rtol=0, atol=1e-12 * scale)
