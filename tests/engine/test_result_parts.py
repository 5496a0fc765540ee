"""What a result of a chase is put together from, and what of it is kept."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from helpers_chase import BASES, LAW, circles
from torch import Tensor

from staf_torch import chase, chase_weights, targets
from staf_torch.engine import row_program
from staf_torch.engine.certificate import Certificate, first_link
from staf_torch.engine.quantities import unless, with_certificate
from staf_torch.engine.result import concatenate
from staf_torch.lanes.program import Program


def test_a_certificate_comes_to_a_result_without_what_is_lost() -> None:
    result = chase(circles(2, 3), BASES["gaussian"], targets.Paper(), LAW, inner_steps=1)
    assert result.certificate is None
    lost = torch.tensor([[False, False, True], [True, False, False]])
    numbers = torch.arange(6.0).double().reshape(2, 3)
    vouched = Certificate(numbers, numbers + 1, numbers + 2, numbers + 3, torch.ones(2, 3, dtype=torch.bool))
    found = with_certificate(result, vouched, lost)
    for field in dataclasses.fields(result):
        if field.name != "certificate":
            assert getattr(found, field.name) is getattr(result, field.name)
    assert found.certificate is not None
    for name, own in vouched._asdict().items():
        part = getattr(found.certificate, name)
        gone = ~part if name == "violated" else part.isnan()
        assert torch.equal(gone, lost)
        assert torch.equal(part[~lost], own[~lost])
    wide = unless(lost, torch.ones(2, 3, 4))
    assert torch.equal(wide.isnan().all(-1), lost)
    assert torch.equal(wide.isnan().any(-1), lost)


@pytest.mark.parametrize("run", [chase, chase_weights])
def test_a_row_may_be_lost_from_its_first_time_on(run: Any) -> None:
    states = circles(3, 4)
    states[1, 0], states[2, 2] = torch.nan, torch.inf
    result = run(states, BASES["gaussian"], targets.Paper(), LAW, inner_steps=1)
    assert result.diverged_at.tolist() == [-1, 0, 2]
    assert result.diverged.tolist() == [False, True, True]


@pytest.mark.parametrize("certificate", [False, True])
def test_pieces_of_time_are_joined_and_a_single_one_is_itself(certificate: bool) -> None:
    whole = chase(
        circles(2, 5), BASES["gaussian"], targets.Paper(), LAW, inner_steps=1, certificate=certificate
    )
    assert concatenate([whole]) is whole

    def part(begin: int, end: int) -> Any:
        own = {
            field.name: getattr(whole, field.name)[:, begin:end]
            for field in dataclasses.fields(whole)
            if field.name not in ("diverged_at", "certificate")
        }
        vouched = whole.certificate
        cut = None if vouched is None else Certificate(*(term[:, begin:end] for term in vouched))
        return type(whole)(**own, diverged_at=torch.tensor([end, -1]), certificate=cut)

    found = concatenate(iter([part(0, 2), part(2, 3), part(3, 5)]))
    for field in dataclasses.fields(whole):
        own, other = getattr(found, field.name), getattr(whole, field.name)
        if field.name == "certificate":
            assert (own is None) == (other is None) == (not certificate)
            for one, two in zip(own or (), other or (), strict=True):
                assert torch.equal(one, two)
        elif field.name == "diverged_at":
            assert own.tolist() == [5, -1]
        else:
            assert torch.equal(own, other)


@pytest.mark.compiled
@pytest.mark.parametrize("history", [False, True])
def test_a_chase_without_history_records_one_time_a_piece(
    history: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[int] = []

    def defined(self: Program, carry: Any, states: Tensor, **options: Any) -> Any:
        after, outputs = Program.definition(self, carry, states, **options)
        kept.append(outputs.weights.shape[1])
        return after, outputs

    monkeypatch.setattr(Program, "compiles", lambda self, *given: True)
    monkeypatch.setattr(Program, "__call__", defined)
    monkeypatch.setattr(row_program, "_SHORTEST", 1)
    pieces = circles(2, 7).split([4, 3], 1)
    found = chase_weights(pieces, BASES["gaussian"], targets.Paper(), LAW, inner_steps=1, history=history)
    assert kept == ([4, 3] if history else [1, 1])
    assert found.weights.shape[1] == (7 if history else 1)


def test_the_first_link_has_no_error() -> None:
    gram, gain, error = torch.ones(2, 3, 3), torch.arange(2.0), torch.ones(2, 3)
    link = first_link(gram, gain, error)
    assert link.gram is gram
    assert link.log_gain is gain
    assert link.error.shape == (2, 3)
    assert not link.error.any()
