"""Gaussian processes on few samples of the whole past."""

from __future__ import annotations

import torch
from torch import Tensor

from staf_torch.online.tracker_models import TrackerModels

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


def test_sample_that_is_known_takes_no_place_and_still_teaches() -> None:
    models, x = empty(16), torch.zeros(40, 2, dtype=torch.float64)
    learn(models, x, torch.ones(40, 1, dtype=torch.float64))
    assert models.counts[1].tolist() == [1.0, 1.0]
    assert models.counts[2].tolist() == [2.0, 2.0]  # the place in use and the next are checked in turn
    mean, variance = models.predict(x[0][:, None], RATE, NOISE, JITTER)
    assert (mean - 1).abs().max() < 0.01
    assert ((variance - NOISE) < NOISE / 30).all()


def test_what_was_learned_fades_to_nothing() -> None:
    (x, y), models = samples(10), empty(16, outputs=2)
    learn(models, x, y)
    learn(models, x[:1] + 100, y[:1], share=1e-12)
    mean, variance = models.predict(x[3][:, None], RATE, NOISE, JITTER)
    assert mean.abs().max() < 1e-5
    torch.testing.assert_close(variance, 1 + JITTER + NOISE)


def test_process_whose_inverse_has_drifted_begins_anew() -> None:
    (x, y), models = samples(10), empty(16, outputs=2)
    learn(models, x, y)
    models.inverse[:, 0] *= 1.5
    learn(models, x[:9] + 5, y[:9])
    assert models.counts[1, 0] < 10
    assert models.counts[1, 1] == 15
