"""The fused recursion computes what the plain-torch recursion defines."""

from __future__ import annotations

import pytest
import torch
from helpers_fused import (
    assert_equal_to_rounding,
    needs_compiler,
    problem,
    reference,
    run,
)

from staf_torch.approximation.basis import GramStructure
from staf_torch.engine import compiled
from staf_torch.engine.compiled import CompiledInputs, History
from staf_torch.engine.recursion import Carry


@needs_compiler
@pytest.mark.parametrize(
    ("count", "shared", "dtype"),
    [
        *((count, True, torch.float64) for count in (1, 3, 6, 7, 10)),  # a number of centers is a build
        *((count, False, torch.float64) for count in (3, 10)),
        *((count, True, torch.float32) for count in (3, 10)),
    ],
)
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
@pytest.mark.parametrize("count", [3, 10])
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
@pytest.mark.parametrize("count", [3, 10])
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
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("count", [3, 10])
def test_rows_of_a_batch_have_the_bits_they_have_alone(count: int, shared: bool) -> None:
    structure, values, carry = problem(77, 5, count, torch.float64, shared=shared, seed=1)
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
        structure = GramStructure(gain.new_ones(1, 1), None, gain)
        given = CompiledInputs(structure, gain.new_zeros(rows, 1, 1))
        compiled.advance(0, gain.unsqueeze(-1), given, carry, History(out))
        want = gain[:, 0].double().exp()
        assert float(((out[0, 0].double() - want) / want).abs().max()) <= 2 * torch.finfo(dtype).eps
