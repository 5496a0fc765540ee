"""Hyperparameters of trackers by their likelihood on a stretch."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from staf_torch.online.mixture.members import (
    Hyperparameters,
    Stretch,
    TrackerModels,
    likelihoods,
    search,
    sensitivity,
)
from staf_torch.online.mixture.regressor import Bank
from staf_torch.online.mixture.rules import FADING, PLAIN, TURNED, TURNED_FADING, BankShape


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


def test_compiled_bank_chooses_what_the_definition_does() -> None:
    shape, s = BankShape(2, 2, 128, 8), stretch(40, outputs=2)
    fast, slow = Bank(shape, 1, True), Bank(shape, 1, True, compile=False)
    if not fast.compiled:
        pytest.skip("needs a C++ compiler")
    for x, y in zip(s.at[:, None], s.y[:, None], strict=True):
        slow.table.copy_(fast.table)
        fast.learn(x.contiguous(), y.contiguous())
    slow.learn(s.at[-1:], s.y[-1:])
    found, expected = (bank.definition.each(bank.table, bank.answers)[0] for bank in (fast, slow))
    for name in ("tracker_rate", "tracker_noise", "tracker_forgetting", "metric"):
        torch.testing.assert_close(found[name], expected[name], rtol=1e-6, atol=1e-9)
    lanes = [TURNED, PLAIN, FADING, TURNED_FADING]
    at_first = Bank(shape, 1, True).definition.each(fast.table.clone(), fast.answers)[0]
    fast.definition.clear(at_first)
    changed = found["tracker_rate"] != at_first["tracker_rate"]
    assert changed[lanes].all()
    assert int(changed.sum()) == 4


def test_the_metric_is_the_mean_outer_product_of_gradients_and_a_tenth_of_its_trace() -> None:
    s, c = stretch(25, outputs=2), Hyperparameters(0.4, 0.02, 0.0, 0.0)
    x = s.at.clone().requires_grad_()
    gram = (-0.4 * torch.cdist(s.at, s.at).square()).exp()
    solved = torch.linalg.solve(gram + 0.02 * torch.eye(25, dtype=torch.float64), s.y)
    outer = torch.zeros(2, 2, dtype=torch.float64)
    for column in solved.mT:
        mean = (-0.4 * (x[:, None] - s.at).square().sum(-1)).exp() @ column
        (slope,) = torch.autograd.grad(mean.sum(), x)
        outer += slope.mT @ slope
    wanted = 2 * (outer / outer.trace() + 0.1 * torch.eye(2)) / 1.2  # its trace is n
    metric = sensitivity(s, c)
    torch.testing.assert_close(metric @ metric.mT, wanted)
    assert not metric.triu(1).any()


RATE = torch.tensor([0.5, 2.0], dtype=torch.float64)
NOISE = torch.tensor([0.01, 0.1], dtype=torch.float64)
JITTER, WRONG = 1e-6, 0.1


def empty(places: int, dim: int = 2, outputs: int = 1) -> TrackerModels:
    size = places * (places + 1) // 2
    shapes = (places, dim, 2), (outputs, places, 2), (size, 2), (size, 2), (3, 2)
    return TrackerModels(*(torch.zeros(shape, dtype=torch.float64) for shape in shapes))


def learn(models: TrackerModels, x: Tensor, y: Tensor, share: float = 1.0) -> None:
    for point, value in zip(x, y, strict=True):
        models.learn(
            point[:, None], value, RATE, NOISE, torch.full((2,), share, dtype=torch.float64), JITTER, WRONG
        )


def samples(count: int) -> tuple[Tensor, Tensor]:
    x = torch.randn(count, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return x, torch.stack(((2 * x[:, 0]).sin(), x[:, 1] ** 2), -1)


def test_with_room_for_all_samples_it_is_the_gaussian_process() -> None:
    (x, y), models = samples(20), empty(32, outputs=2)
    learn(models, x, y)
    at = torch.tensor([0.3, -0.2], dtype=torch.float64)
    mean, variance = models.predict(at[:, None], RATE, NOISE, JITTER)
    for lane in range(2):
        gram = (-RATE[lane] * torch.cdist(x, x).square()).exp()
        gram += (JITTER + NOISE[lane]) * torch.eye(20, dtype=torch.float64)
        k = (-RATE[lane] * (x - at).square().sum(-1)).exp()
        solved = torch.linalg.solve(gram, torch.cat((y, k[:, None]), 1))
        torch.testing.assert_close(mean[:, lane], k @ solved[:, :2], rtol=1e-6, atol=1e-8)
        expected = 1 + JITTER + NOISE[lane] - k @ solved[:, 2]
        torch.testing.assert_close(variance[lane], expected, rtol=1e-6, atol=1e-8)


def test_full_process_keeps_its_size_and_what_matters() -> None:
    (x, y), models = samples(150), empty(24, outputs=2)
    learn(models, x, y)
    assert models.counts[1].max() <= 23
    errors = torch.stack(
        [models.predict(p[:, None], RATE, NOISE, JITTER)[0][:, 0] - v for p, v in zip(x, y, strict=True)]
    )
    assert errors.square().mean().sqrt() < 0.6 * y.std()
    inverse = torch.zeros(24, 24, dtype=torch.float64)
    first, second = torch.tril_indices(24, 24)
    inverse[first, second] = inverse[second, first] = models.inverse[:, 1]
    kept = inverse.diagonal() > 0
    points = models.points[kept][..., 1]
    gram = (-RATE[1] * torch.cdist(points, points).square()).exp()
    identity = torch.eye(len(points), dtype=torch.float64)
    torch.testing.assert_close(
        inverse[kept][:, kept] @ (gram + JITTER * identity), identity, rtol=0, atol=1e-6
    )
