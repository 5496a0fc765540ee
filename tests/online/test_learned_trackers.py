"""Hyperparameters of trackers by their likelihood on a stretch."""

from __future__ import annotations

import math

import pytest
import torch

from staf_torch.online.bank import Bank
from staf_torch.online.bank_rules import FADING, PLAIN, TURNED, TURNED_FADING, BankShape
from staf_torch.online.learned_trackers import Stretch, likelihoods, search, sensitivity


def stretch(count: int, outputs: int = 1, noise: float = 0.1) -> Stretch:
    """A function of x that changes along (2, 1) alone, with noise."""
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(count, 2, generator=draw, dtype=torch.float64)
    along = x @ torch.tensor([2.0, 1.0], dtype=torch.float64)
    y = torch.stack([(along * (k + 1) / 2).sin() for k in range(outputs)], -1)
    y = y + noise * torch.randn(y.shape, generator=draw, dtype=torch.float64)
    return Stretch(x, y, 0.5 * torch.arange(count, dtype=torch.float64))


def test_likelihood_is_that_of_the_gaussian_process_with_the_likeliest_amplitude() -> None:
    s, rate, noise, fade = stretch(30, outputs=2), 0.4, 0.02, 0.05
    age = torch.cdist(s.when[:, None], s.when[:, None])
    gram = (-rate * torch.cdist(s.at, s.at).square() - fade * age).exp()
    gram += noise * torch.eye(30, dtype=torch.float64)
    expected = 0.0
    for y in s.y.mT:
        amplitude = (y @ torch.linalg.solve(gram, y)) / 30
        law = torch.distributions.MultivariateNormal(torch.zeros_like(y), amplitude * gram)
        expected += float(law.log_prob(y)) + 15 * (1 + math.log(2 * math.pi) - math.log(30))
    each = (torch.tensor([value], dtype=torch.float64) for value in (rate, noise, fade))
    assert float(likelihoods(s, *each)) == pytest.approx(expected, rel=1e-9)


def test_search_finds_the_noise_and_a_width_that_no_neighbour_beats() -> None:
    s = stretch(120)
    found = search(s)
    gram = (-found.rate * torch.cdist(s.at, s.at).square()).exp()
    gram += found.noise * torch.eye(120, dtype=torch.float64)
    amplitude = float((s.y * torch.linalg.solve(gram, s.y)).mean())
    assert 0.007 < amplitude * found.noise < 0.014  # the noise is .01, in units of the amplitude
    rate = found.rate * torch.tensor([0.7, 1.0, 1.4], dtype=torch.float64)
    around = likelihoods(s, rate, torch.full_like(rate, found.noise), torch.zeros_like(rate))
    assert int(around.argmax()) == 1


def test_metric_counts_the_direction_in_which_the_function_changes() -> None:
    s = stretch(120)
    metric = sensitivity(s, search(s))
    directions = torch.tensor([[2.0, 1.0], [-1.0, 2.0]], dtype=torch.float64)
    along, across = (directions @ metric).norm(dim=1)
    assert along > 2.5 * across
    torch.testing.assert_close(metric.square().sum(), torch.tensor(2.0, dtype=torch.float64))


def test_metric_of_a_constant_is_that_of_the_units() -> None:
    s = stretch(40)
    metric = sensitivity(s._replace(y=torch.zeros_like(s.y)), search(s))
    torch.testing.assert_close(metric, torch.eye(2, dtype=torch.float64))


def test_compiled_bank_chooses_what_the_definition_does() -> None:
    shape, s = BankShape(2, 2, 128, 8), stretch(40, outputs=2)
    fast, slow = Bank(shape, 1, True), Bank(shape, 1, True)
    if not fast.compiled:
        pytest.skip("needs a C++ compiler")
    slow._run = None
    for x, y in zip(s.at[:, None], s.y[:, None], strict=True):
        slow.table.copy_(fast.table)
        fast.learn(x.contiguous(), y.contiguous())
    slow.learn(s.at[-1:], s.y[-1:])
    found, expected = (bank._definition.each(bank.table)[0] for bank in (fast, slow))
    for name in ("tracker_rate", "tracker_noise", "tracker_forgetting", "metric"):
        torch.testing.assert_close(found[name], expected[name], rtol=1e-6, atol=1e-9)
    lanes = [TURNED, PLAIN, FADING, TURNED_FADING]
    at_first = Bank(shape, 1, True)._definition.each(fast.table.clone())[0]
    fast._definition.clear(at_first)
    changed = found["tracker_rate"] != at_first["tracker_rate"]
    assert changed[lanes].all()
    assert int(changed.sum()) == 4
