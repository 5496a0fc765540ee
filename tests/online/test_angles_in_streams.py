"""A feature that is an angle is followed around the circle, wherever it is given."""

from __future__ import annotations

import math
import pickle

import pytest
import torch
from helpers import uniform
from torch import Tensor

from staf_torch import StaFRegressor

TURN = 2 * math.pi


def stream(rows: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    """An angle that goes on, the same in [-pi, pi], and what is learned: (T, S, 2) twice, (T, S)."""
    time = torch.arange(50).double()
    angle = 0.15 * time[:, None] + torch.arange(rows).double()
    other = 0.3 * uniform(50, rows, seed=1).cumsum(0) / 5
    wrapped = torch.remainder(angle + math.pi, TURN) - math.pi
    return torch.stack((angle, other), -1), torch.stack((wrapped, other), -1), angle.sin() + other


@pytest.mark.parametrize("settings", [{}, {"scaling": True, "robust": 2.5}])
def test_a_wrapped_angle_is_learned_as_one_that_goes_on(settings: dict) -> None:
    going, wrapped, y = stream()
    plain, turning = StaFRegressor(**settings), StaFRegressor(periodic=[-2], **settings)
    for k in range(len(y)):
        if k:
            torch.testing.assert_close(
                turning.predict(wrapped[k]), plain.predict(going[k]), rtol=0, atol=1e-9
            )
        plain.partial_fit(going[k], y[k])
        turning.partial_fit(wrapped[k], y[k])
    many = wrapped[-1, :, None] + TURN * torch.tensor([[0.0, 0.0], [1.0, 0.0], [-5.0, 0.0]]).double()
    found = turning.predict(many)
    torch.testing.assert_close(found, found[:, :1].expand(-1, 3), rtol=0, atol=1e-9)


def test_records_states_and_streams_that_come_and_go_know_the_turn() -> None:
    going, wrapped, y = stream()
    wrapped[7, 1, 0] = torch.nan  # held, as another coordinate
    going[7, 1, 0] = torch.nan
    model, plain = StaFRegressor(periodic=[0]).fit(wrapped, y), StaFRegressor().fit(going, y)
    at = wrapped[-1]
    torch.testing.assert_close(model.predict(at), plain.predict(going[-1]), rtol=0, atol=1e-9)
    for ours, theirs in zip(model.smooth(wrapped, y), plain.smooth(going, y), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)
    again = StaFRegressor(periodic=[0]).load_state_dict(model.state_dict())
    for other in (again, pickle.loads(pickle.dumps(model))):
        assert torch.equal(other.predict(at), model.predict(at))
    with pytest.raises(ValueError, match=r"periodic=\[0\]"):
        StaFRegressor().load_state_dict(model.state_dict())
    both = model.add(1).drop([0])
    assert torch.equal(both.predict(torch.stack((at[1], at[1])))[0], again.predict(at)[1])
    with pytest.raises(ValueError, match="periodic"):
        StaFRegressor(periodic=[2]).fit(wrapped, y)
