"""What is learned of a hard stream, recorded: all that a model keeps, in both modes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers_streams import MODELS, hard_stream
from recorded import Record

import staf_torch as st
from staf_torch.online.bank import Bank
from staf_torch.online.bank_rules import BankShape


def several(steps: int = 90) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Three streams with two outputs, one of which is not told now and then; times that are not even."""
    x, y = hard_stream(steps)
    both = torch.stack((y, (0.5 * x[:, 0]).exp()), -1)
    states = torch.stack((x, x.flip(-1), 0.5 * x - 0.2), 1)
    values = torch.stack((both, -both, both.flip(-1)), 1)
    values[7::11, 0, 1] = torch.nan
    lapse = (0.5 + torch.arange(steps).double().sin().abs()).unsqueeze(-1).expand(steps, 3)
    return states, values, lapse


def learned(model: st.StaFRegressor, steps: int) -> Any:
    x, y = hard_stream(steps)
    for k in range(steps):
        model.partial_fit(x[k], y[k])
    return kept_by(model), model.predict(x[-5:], return_std=True)


def kept_by(model: st.StaFRegressor) -> dict[str, Any]:
    """All that is learned, the table of a bank by its parts."""
    state = model.state_dict()
    if isinstance(model._streams_, Bank):
        streams = model._streams_._definition.each(state["table"])
        state["table"] = {name: torch.stack([each[name] for each in streams]) for name in streams[0]}
        state["table"] = without_rounding(state["table"])
    return state


def without_rounding(parts: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """What every processor finds: inverses with entries of 1e8 are not, nor is each weight of kernels that
    are all but dependent, of which the sum is known."""
    rounding = ("tracker_inverse", "tracker_known", "filters")
    return {name: part for name, part in parts.items() if name not in rounding}


def learned_of_several(model: st.StaFRegressor) -> Any:
    x, y, lapse = several()
    for k in range(len(x)):
        if k == 40:
            model.reset(streams=[1])
        if k == 60:
            model.drop([0]).add(1)
            x, y, lapse = (part.roll(1, 1) for part in (x, y, lapse))
        model.partial_fit(x[k], y[k], lapse=lapse[k])
    return kept_by(model), model.predict(x[-1], return_std=True)


def of_the_definition(neighbours: int, memory: int, steps: int, gone: int = 10**6) -> Any:
    bank = Bank(BankShape(2, 1, memory, neighbours), 1, True)
    bank._run = None
    x, y = hard_stream(steps)
    y[gone:] = 1e4 + y[gone:]  # elsewhere for good
    for k in range(steps):
        bank.predict(x[k : k + 1])
        bank.learn(x[k : k + 1], y[k : k + 1].unsqueeze(-1))
    return without_rounding(bank._definition.each(bank.table)[0])


def smoothed() -> Any:
    x, y = hard_stream(80)
    time = torch.arange(80).double() + 0.3 * torch.arange(80).double().sin()
    return st.StaFRegressor(scaling=True).smooth(x, y, time)


CASES: dict[str, Callable[[], Any]] = {
    **{name: lambda make=make: learned(make(), 200) for name, make in MODELS.items()},  # type: ignore[misc]
    "filters of several": lambda: learned_of_several(st.StaFRegressor(scaling=True)),
    "filters that doubt": lambda: learned_of_several(st.StaFRegressor("matern", 0.8, robust=3.0, follow=0.5)),
    "banks of several": lambda: learned_of_several(st.StaFRegressor(memory=128, neighbours=8)),
    "the definition": lambda: of_the_definition(8, 128, 136),
    "the definition of a stream that goes elsewhere": lambda: of_the_definition(8, 128, 48, gone=34),
    "smoothed": smoothed,
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_learned_is_the_recorded(name: str, record: Record) -> None:
    # of a bank built for another processor, some parts differ by 5e-5; of a kernel's filter, each weight
    of_a_bank = "bank" in name or "definition" in name
    without = "0.table" if name == "filter of a kernel" else "\n"
    record(CASES[name](), rtol=1e-3 if of_a_bank else 1e-5, without=without)
