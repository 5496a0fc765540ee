"""How the members of a bank are mixed."""

from __future__ import annotations

import torch

from staf_torch.online.bank import Bank
from staf_torch.online.bank_rules import BankShape


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
