"""How the members of a bank are mixed."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import tensor

from staf_torch.online.bank import Bank
from staf_torch.online.bank_rules import BankShape, Rules
from staf_torch.online.kalman_filter import SURPRISE
from staf_torch.online.mixture_definition import (
    _knots,
    _learn_map,
    _reweighed,
    _scores,
    _student,
    _weighed,
    judge,
)


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
    bank = Bank(BankShape(2, 1, 128, 8), 1, True)
    x = torch.randn(60, 1, 2, generator=draw, dtype=torch.float64)
    y = x[..., :1].sin() + 0.1 * torch.randn(60, 1, 1, generator=draw, dtype=torch.float64)
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


RULES = Rules.of(2, True)


def test_scores_are_likelihoods_of_student_s_law_with_the_member_s_variance_and_the_common_one() -> None:
    error, variance, common = tensor([[0.3, -2.0, 0.0]]), tensor([[0.5, 4.0, 1e-40]]), tensor([[0.7]])

    def law(scale: torch.Tensor) -> torch.Tensor:
        student = torch.distributions.StudentT(8.0, scale=scale.clamp(min=1e-30).sqrt())
        least = torch.distributions.StudentT(torch.tensor(8.0).double()).log_prob(torch.zeros(1).double())
        return student.log_prob(error) - least  # without the constant

    own, shared = law(variance), law(common) + 0.5 * common.log()
    torch.testing.assert_close(_student(RULES, error, common), shared)
    torch.testing.assert_close(_scores(RULES, error, variance, common), 0.6 * own + 0.4 * shared)


def test_what_is_far_behind_the_best_has_no_weight() -> None:
    logs = 3.0 + tensor([[0.0, math.log(0.021), math.log(0.019)], [math.log(0.5), 0.0, -1e9]])
    values = tensor([[1.0, 2.0, 1e6], [4.0, 1.0, 1e6]])
    wanted = tensor([(1 + 0.021 * 2) / 1.021, (0.5 * 4 + 1) / 1.5])
    torch.testing.assert_close(_weighed(RULES, logs, values), wanted)


def test_the_map_has_33_knots_a_quarter_of_a_unit_apart() -> None:
    means = tensor([0.0, 0.3, -0.3, 4.0, 3.99, -4.0, 1e9, -1e9])
    knots, parts = _knots(RULES, means)
    assert knots.tolist() == [[16, 17], [17, 18], [14, 15], [31, 32], [31, 32], [0, 1], [31, 32], [0, 1]]
    second = tensor([0.0, 0.2, 0.8, 1.0, 0.96, 0.0, 1.0, 0.0])
    torch.testing.assert_close(parts, torch.stack((1 - second, second), -1))
    places = ((knots - 16) * 0.25 * parts).sum(-1)
    torch.testing.assert_close(places, means.clamp(-4.0, 4.0))


def test_the_map_learns_where_it_was_told_by_how_much_is_known() -> None:
    draw = torch.Generator().manual_seed(0)
    s = {
        "straight": tensor([0.3, -0.3, 1.1]),
        "map": torch.rand(3, 2, 33, generator=draw, dtype=torch.float64),
    }
    before, value = s["map"].clone(), tensor([1.0, 2.0, 3.0])
    _learn_map(RULES, s, value, torch.tensor([True, False, True]))
    for row, (low, share) in enumerate([(17, 0.2), (14, 0.8), (20, 0.4)]):
        wanted = before[row].clone()
        if row != 1:
            correction, known = before[row]
            parts = (1 - share, share)
            error = value[row] - s["straight"][row]
            error = error - parts[0] * correction[low] - parts[1] * correction[low + 1]
            for knot, part in zip((low, low + 1), parts, strict=True):
                wanted[1, knot] = known[knot] * (1 - 0.005 * part) + part**2
                wanted[0, knot] = correction[knot] + part * error / (wanted[1, knot] + 10.0)
        torch.testing.assert_close(s["map"][row], wanted)
