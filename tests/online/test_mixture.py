"""How the members of a bank are mixed."""

from __future__ import annotations

import pytest
import torch

from staf_torch.online.bank import Bank
from staf_torch.online.bank_rules import BankShape
from staf_torch.online.kalman_filter import SURPRISE
from staf_torch.online.mixture_definition import _reweighed, judge


def test_what_a_function_that_saturates_takes_is_mapped_and_other_functions_are_left() -> None:
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(350, 1, 2, generator=draw, dtype=torch.float64)
    seen = x.sum(-1, keepdim=True) + 0.1 * torch.randn(350, 1, 1, generator=draw, dtype=torch.float64)
    errors = {}
    for name, y in (("saturates", (5 * seen).tanh()), ("does not", seen)):
        bank, found = Bank(BankShape(2, 1, 128, 8), 1, True), []
        for k in range(350):
            bank.predict(x[k])
            stream = bank._definition.each(bank.table)[0]
            value = (y[k, 0] - stream["center"][2:]) / stream["spread"][2:]
            found.append(torch.stack((stream["blend"][:, -1], stream["straight"], stream["mean"])) - value)
            bank.learn(x[k], y[k])
        errors[name] = torch.stack(found[150:]).square().mean(0).sqrt()[:, 0]
    mapped, straight, mean = errors["saturates"]
    assert mapped < 0.85 * straight
    assert mean < 0.95 * straight
    _, straight, mean = errors["does not"]
    assert mean < 1.01 * straight


def test_no_single_error_moves_the_calibration_far() -> None:
    draw = torch.Generator().manual_seed(1)
    bank = Bank(BankShape(1, 1, 128, 8), 1, True)
    x = torch.randn(60, 1, 1, generator=draw, dtype=torch.float64)
    y = x.sin() + 0.1 * torch.randn(60, 1, 1, generator=draw, dtype=torch.float64)
    rules, definition = bank._definition.rules, bank._definition
    for k in range(60):
        bank.predict(x[k])
        bank.learn(x[k], y[k])
    for size in (3.0, 1e2, 1e6):
        stream = definition.each(bank.table.clone())[0]
        before = stream["calibration"].clone()
        judge(rules, stream, stream["mean"] + size, torch.tensor([True]), stream.number("clock"))
        assert bool(stream["calibration"] > before)
        most = 1 + max(rules.error_rate, 1 / 60) * (SURPRISE - 1)
        assert bool(stream["calibration"] <= before * most * (1 + 1e-9))


@pytest.mark.parametrize("count", [2, 5, 40])
@pytest.mark.parametrize("share", [0.0, 0.001, 0.3])
def test_weights_add_up_and_none_is_below_its_equal_share(count: int, share: float) -> None:
    logs = 30 * torch.randn(7, count, dtype=torch.float64, generator=torch.Generator().manual_seed(count))
    weights = _reweighed(share, logs).exp()
    torch.testing.assert_close(weights.sum(-1), torch.ones(7, dtype=torch.float64))
    assert bool((weights >= share / count * (1 - 1e-12)).all())
    assert torch.equal(weights.argsort(-1)[:, -1], logs.argsort(-1)[:, -1])
