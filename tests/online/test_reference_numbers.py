"""Predictions on one stream, as they were: what any constant of the two modes changes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers_streams import MODELS, hard_stream
from torch import Tensor

import staf_torch as st
from staf_torch.online.bank import Bank


def predictions(model: st.StaFRegressor, steps: int) -> Tensor:
    """Mean and deviation of every thirtieth sample, before it is learned."""
    x, y = hard_stream(steps)
    found = []
    for k in range(steps):
        if k % 30 == 29:
            found.append(torch.cat([part.reshape(-1) for part in model.predict(x[k], return_std=True)]))
        model.partial_fit(x[k], y[k])
    return torch.stack(found)


WANTED: dict[str, list[list[float]]] = {
    "filter": [
        [0.787991374, 0.0984753474],
        [-0.857362883, 0.219568791],
        [1.37342886, 0.595942481],
        [-0.38874006, 0.450967168],
        [1.21955495, 1.72589956],
        [-0.922264582, 2.93918685],
        [0.0296480892, 2.821364],
        [7.94539559, 3.30011373],
        [1.54916929, 1.56459188],
        [-0.28462115, 1.94608504],
        [2.13083861, 1.60817581],
    ],
    "filter of a kernel": [
        [0.882961397, 0.0790107103],
        [-0.594309377, 0.125439199],
        [1.91505577, 0.13974053],
        [-0.316563004, 0.397360441],
        [1.24131496, 0.795207432],
        [-0.705728509, 2.08696175],
        [0.522972003, 2.6481701],
        [3.95128736, 2.8562156],
        [0.861944474, 1.01742947],
        [-0.300037962, 1.46019397],
        [1.35325791, 1.66191603],
    ],
    "tuned filter": [
        [0.888956288, 0.0302549852],
        [-0.633684022, 0.195251568],
        [1.88388226, 0.0385204462],
        [-0.306384541, 0.4858233],
        [1.38961769, 1.81851143],
        [-0.79869684, 3.60010591],
        [0.00266605329, 5.45294095],
        [-0.744380408, 4.85412067],
        [1.41622895, 2.75325105],
        [-0.259514613, 6.96201322],
        [1.75828716, 6.27523364],
    ],
    "bank": [
        [0.867963967, 0.121869328],
        [-0.569437126, 0.0725023459],
        [1.75763951, 0.102551404],
        [-0.409282714, 0.0542395926],
        [1.29978688, 0.0644419442],
        [-0.865328474, 0.283752076],
        [0.613588933, 1.87046104],
        [3.75941571, 8.87156656],
        [0.89199746, 0.933581944],
        [-0.212477619, 0.941045074],
        [1.66583918, 1.06922363],
    ],
    "bank that keeps all": [
        [0.873337867, 0.12202945],
        [-0.568966693, 0.0718204739],
        [1.75255918, 0.106736402],
        [-0.40654822, 0.0555620266],
        [1.30468546, 0.0655421377],
        [-0.935789833, 0.471439424],
        [0.6089919, 2.21659936],
        [3.82088741, 20.0418011],
        [0.904542857, 0.756281313],
        [-0.489425912, 0.918389249],
        [1.23635892, 1.24864199],
    ],
}

TUNED = [
    [0.821217993, 3.79935981, 2.45071376],
    [1, 0.999944854, 0.999936861],
    [0.25, 0.25, 0.25],
]


@pytest.mark.parametrize("name", MODELS)
def test_predictions_are_the_recorded_ones(name: str) -> None:
    found = predictions(MODELS[name](), 330)
    torch.testing.assert_close(
        found, torch.tensor(WANTED[name], dtype=torch.float64), rtol=3e-4, atol=1e-6
    )  # of the definition, too


def test_predictions_of_the_definition_are_the_recorded_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Bank.__init__

    def defined(bank: Bank, *given: Any, **named: Any) -> None:
        made(bank, *given, **named)
        bank._run = None

    monkeypatch.setattr(Bank, "__init__", defined)
    found = predictions(MODELS["bank"](), 60)
    torch.testing.assert_close(found, torch.tensor(WANTED["bank"])[:2].double(), rtol=3e-4, atol=1e-6)


def test_what_tuning_finds_is_the_recorded() -> None:
    """Streams of which one prefers near centers and others far ones, one forgets and others do not."""
    x, y = hard_stream(120)
    time = torch.arange(120, dtype=torch.float64)
    several = torch.stack((y, (0.3 * x[:, 0]).exp(), torch.where(time < 60, x[:, 0], -x[:, 0])), 1)
    tuned = st.StaFRegressor().tune(x.unsqueeze(1).expand(-1, 3, -1), several)
    assert tuned._tuning is not None
    found = torch.stack((tuned._tuning.likelihood, tuned._tuning.forgetting, tuned._tuning.radius))
    torch.testing.assert_close(found, torch.tensor(TUNED, dtype=torch.float64), rtol=1e-4, atol=1e-6)
