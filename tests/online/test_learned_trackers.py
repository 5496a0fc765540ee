"""Hyperparameters of trackers by their likelihood on a stretch."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from staf_torch.online.bank import Bank
from staf_torch.online.bank_rules import FADING, PLAIN, TURNED, TURNED_FADING, BankShape
from staf_torch.online.learned_trackers import (
    Choice,
    Stretch,
    learn_hyperparameters,
    likelihoods,
    search,
    sensitivity,
)


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


def by_hand(s: Stretch) -> dict[str, tuple[float, float, float]]:
    """Rate, noise and fade of the four by grids that are written out: the same search, in NumPy."""

    def score(at: np.ndarray, rate: float, noise: float, fade: float) -> float:
        apart = np.square(at[:, None] - at).sum(-1)
        age = np.abs(when[:, None] - when)
        gram = np.exp(-rate * apart - fade * age) + max(noise, 1e-7) * np.eye(len(at))
        fits = (y * np.linalg.solve(gram, y)).sum(0)
        return float(-0.5 * y.shape[1] * np.linalg.slogdet(gram)[1] - 0.5 * len(y) * np.log(fits).sum())

    def best_of(at: np.ndarray, cases: list[tuple[float, float, float]]) -> tuple[float, float, float]:
        return max(cases, key=lambda case: score(at, *case))

    def around(at: np.ndarray, best: tuple[float, float, float], *by: float) -> tuple[float, float, float]:
        rate, noise, fade = best
        wider, noisier = by
        steps = [(a, b) for a in (0, -1, 1) for b in (0, -1, 1)]
        return best_of(at, [(rate / wider ** (2 * a), noise * noisier**b, fade) for a, b in steps])

    def plain(at: np.ndarray) -> tuple[float, float, float]:
        widths = [2.0**k for k in range(-2, 6)]  # in sqrt(n)
        rates = [1 / (2 * at.shape[1] * width**2) for width in widths]
        best = best_of(at, [(rate, noise, 0.0) for rate in rates for noise in (1e-6, 1e-4, 1e-2, 0.3)])
        return around(at, around(at, best, math.sqrt(2), 10.0), 2**0.25, math.sqrt(10))

    def fading(at: np.ndarray, best: tuple[float, float, float]) -> tuple[float, float, float]:
        rate, noise, _ = best
        fades = (5e-4, 5e-3, 1.5e-2, 5e-2)
        cases = [best, *((rate / by**2, noise / of, f) for by, of in ((1, 1), (2, 10)) for f in fades)]
        return around(at, best_of(at, cases), 2.0, 10.0)

    x, y, when = (part.numpy() for part in s)
    first = plain(x)
    turned = x @ sensitivity(s, Choice(*first, 0.0)).numpy()
    second = plain(turned)
    return {
        "plain": first,
        "turned": second,
        "fading": fading(x, first),
        "turned_fading": fading(turned, second),
    }


STRETCHES = {
    "smooth": stretch(30, noise=0.03),
    "noise alone": stretch(30, outputs=2, noise=20.0),
    "no noise": stretch(30, noise=0.0),
    "slow": stretch(30, noise=0.01)._replace(at=0.05 * stretch(30).at),
    "fast": stretch(30, noise=0.01)._replace(at=9.0 * stretch(30).at),
    "a walk": stretch(30)._replace(y=stretch(30).at.cumsum(0)),
    "a fast walk": stretch(30)._replace(y=stretch(30).at.cumsum(0), when=4.0 * stretch(30).when),
}


@pytest.mark.parametrize("name", STRETCHES)
def test_what_is_chosen_is_what_the_grids_written_out_say(name: str) -> None:
    s = STRETCHES[name]
    found, wanted = learn_hyperparameters(s), by_hand(s)
    for kind, (rate, noise, fade) in wanted.items():
        choice = getattr(found, kind)
        assert choice[:3] == pytest.approx((rate, max(noise, 1e-7), fade), rel=1e-9), kind
    torch.testing.assert_close(found.metric, sensitivity(s, found.plain))


def test_the_metric_is_the_mean_outer_product_of_gradients_and_a_tenth_of_its_trace() -> None:
    s, c = stretch(25, outputs=2), Choice(0.4, 0.02, 0.0, 0.0)
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
