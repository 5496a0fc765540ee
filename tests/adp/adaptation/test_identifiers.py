"""Equations of windows, the history stack, concurrent learning and least squares."""

from __future__ import annotations

import itertools

import pytest
import torch
from helpers import changed, tensor, uniform
from helpers_adaptation import PENDULUM, TRUE, equations
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.adaptation.concurrent_learning import ConcurrentGradient

MODEL = PENDULUM.believing(tensor([7.0, 7.0]))  # theta of the model is not used


def collected(windows: adp.IntegralWindows, dt: float, steps: int, noise: Tensor | None = None):
    """The equations along a trajectory under a swept input, S (B, K, n, p) and z (B, K, n)."""
    x = tensor([[0.3, -0.2], [0.0, 1.0], [-0.5, 0.0]]) if noise is None else noise.new_zeros(len(noise), 2)
    now, found = windows.init(x), []
    for k in range(steps):
        seen = x if noise is None else x + noise[:, k]
        now, equation = windows.step(now, seen, dt)
        if bool(equation.ready[0]):
            found.append(equation)
        u = torch.full((len(x), 1), 5 * dt * k, dtype=x.dtype).sin() * 3
        now = windows.holding(now, u)
        x = systems.runge_kutta_step(lambda x, u=u: PENDULUM.motion(x, u), x, dt)
    return found


@pytest.mark.parametrize("shape", ["box", "smooth"])
def test_an_integral_holds_up_to_the_second_order_of_the_step(shape: str) -> None:
    left = []
    for dt in (0.02, 0.01):
        found = collected(adp.IntegralWindows(MODEL, 0.2, shape=shape), dt, round(1.0 / dt) + 1)
        assert len(found) == 5
        left.append(max(float((e.z - e.s @ TRUE).abs().max()) for e in found))
    assert 3.4 < left[0] / left[1] < 4.6
    assert left[1] < 1e-3


@pytest.mark.parametrize("shape", ["box", "smooth"])
def test_the_noise_of_an_equation_has_the_variance_that_is_stated(shape: str) -> None:
    generator = torch.Generator().manual_seed(3)
    noise = 1e-3 * torch.randn(2000, 41, 2, dtype=torch.float64, generator=generator)
    windows = adp.IntegralWindows(MODEL, 0.4, shape=shape, noise=1e-3)
    (equation,) = collected(windows, 0.01, 41, noise)
    (clean,) = collected(windows, 0.01, 41, 0 * noise[:1])
    ratio = (equation.z - clean.z)[:, 0].var() / equation.variance[0]
    assert 0.9 < float(ratio) < 1.1  # of 2000 rows the variance is known to 3 %
    if shape == "smooth":
        assert float(equation.variance[0]) < 0.1 * 2e-6


def least(s: Tensor) -> float:
    """The least eigenvalue of the sum of S'S over (N, n, p)."""
    return float(torch.linalg.eigvalsh((s.mT @ s).sum(0))[0])


@pytest.mark.parametrize("at_once", [False, True])
def test_the_stack_takes_the_place_that_an_exhaustive_search_finds(at_once: bool) -> None:
    stack, rows = adp.HistoryStack(1, 3, size=4, novelty=0.0), 5
    now = stack.init(uniform(rows, 1))
    want: list[list[Tensor]] = [[] for _ in range(rows)]
    replaced = 0
    for equation in equations(20, rows, uniform(3, seed=9), states=1):
        now = stack.take(now, equation) if at_once else now
        for turn in range(0 if at_once else 6):
            now = stack.step(now, equation if turn == 0 else changed(equation, ready=equation.ready & False))
        for row, kept in enumerate(want):
            if len(kept) < 4:
                kept.append(equation.s[row])
                continue
            trials = [[*kept[:k], equation.s[row], *kept[k + 1 :]] for k in range(4)]
            values = [least(torch.stack(trial)) for trial in trials]
            best = max(range(4), key=values.__getitem__)
            if values[best] > 1.001 * least(torch.stack(kept)):
                kept[:] = trials[best]
                replaced += 1
    assert replaced > 10
    for row, kept in enumerate(want):
        assert torch.equal(now.s[row], torch.stack(kept))
    torch.testing.assert_close((now.s * uniform(3, seed=9)).sum(-1), now.z, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(now.gram, (now.s.mT @ now.s).sum(1), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(now.moment, (now.s * now.z.unsqueeze(-1)).sum((1, 2)), rtol=1e-12, atol=1e-12)


def test_equal_equations_do_not_fill_a_stack() -> None:
    stack = adp.HistoryStack(2, 2, size=3)
    now = stack.init(uniform(4, 2))
    for equation in equations(1, 4, TRUE) * 3:
        now = stack.step(now, equation)
    assert now.filled.tolist() == [1.0] * 4


@pytest.mark.parametrize("gain", [5.0, 1e6])
def test_concurrent_learning_is_exact_without_noise_at_every_gain(gain: float) -> None:
    stack, law = adp.HistoryStack(2, 4, size=4), ConcurrentGradient(gain, rate=2.0)
    true = uniform(3, 4, seed=5)
    now, theta = stack.init(uniform(3, 2)), torch.zeros(3, 4).double()
    for equation in itertools.islice(itertools.cycle(equations(6, 3, true)), 100):
        now = stack.step(now, equation)
        theta = law.step(theta, now.gram, now.moment, 0.5)
    torch.testing.assert_close(theta, true, rtol=1e-10, atol=1e-10)


def test_the_step_of_concurrent_learning_solves_its_implicit_equation() -> None:
    s, z, push = uniform(3, 8, 3, seed=1), uniform(3, 8, seed=2), uniform(3, 3, seed=3)
    gram, moment = s.mT @ s, (s * z.unsqueeze(-1)).sum(1)
    gain, rate = tensor([0.1, 1.0, 10.0]), tensor([2.0, 1.0, 0.5])
    theta = uniform(3, 3, seed=4)
    after = ConcurrentGradient(gain, rate).step(theta, gram, moment, 0.2, push)
    pull = (s * (z - (s * after[:, None]).sum(-1)).unsqueeze(-1)).sum(1)
    wanted = 0.2 * rate[:, None] * (push + gain[:, None] * pull)
    torch.testing.assert_close(after - theta, wanted, rtol=1e-10, atol=1e-12)


def test_least_squares_are_those_of_all_equations_at_once_with_the_first_estimate() -> None:
    law = adp.LeastSquares([1.0, -1.0, 0.5], deviation=[2.0, 1.0, 0.5], floor=0.3)
    given = [changed(e, z=e.z + uniform(4, 2, seed=70)) for e in equations(7, 4, uniform(4, 3, seed=8))]
    now = law.init(uniform(4, 2))
    for equation in given:
        now = law.step(now, equation, 0.1)
    prior = torch.linalg.inv(law.prior)
    information = prior + sum(e.s.mT @ e.s for e in given) / 0.09
    moment = prior @ law.first + sum((e.s.mT @ e.z.unsqueeze(-1)).squeeze(-1) for e in given) / 0.09
    torch.testing.assert_close(now.covariance, torch.linalg.inv(information), rtol=1e-9, atol=1e-12)
    wanted = torch.linalg.solve(information, moment.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(now.theta, wanted, rtol=1e-9, atol=1e-12)


def test_forgetting_never_opens_the_covariance_beyond_its_first_size() -> None:
    law = adp.LeastSquares([0.0, 0.0], deviation=2.0, forgetting=3.0)
    now = law.init(torch.zeros(1, 2).double())
    quiet = changed(equations(1, 1, TRUE)[0], ready=torch.tensor([False]))
    now = law.step(now, equations(1, 1, TRUE)[0], 0.1)
    traces = []
    for _ in range(60):
        now = law.step(now, quiet, 0.1)
        traces.append(float(now.covariance.diagonal(dim1=-2, dim2=-1).sum()))
    assert traces[0] < traces[20]
    assert traces[-1] <= 8.0


@pytest.mark.parametrize("outputs", [1, 3])
def test_the_step_solves_its_implicit_equation(outputs: int) -> None:
    """theta+ - theta = gain dt sum_j s_j (y_j - theta+'s_j)' over the stack and the present pair."""
    learning = adp.ConcurrentLearning(3, outputs, size=3, gain=2.0)
    state = learning.init(uniform(3, outputs, seed=1))
    for k in range(5):
        s, y = uniform(3, seed=2 + k), uniform(outputs, seed=20 + k)
        before, state = state, learning.step(state, s, y, 0.1)
        pairs = [*zip(state.regressors, state.rates, strict=True), (s, y)]
        pull = sum(torch.outer(a, b - state.theta.mT @ a) for a, b in pairs)
        torch.testing.assert_close(state.theta - before.theta, 2.0 * 0.1 * pull, rtol=1e-10, atol=1e-12)


def test_windows_double_from_the_first_up_to_the_longest() -> None:
    windows = adp.IntegralWindows(MODEL, 0.08, first=0.02)
    now, ends = windows.init(torch.zeros(1, 2).double()), []
    for k in range(32):
        now, equation = windows.step(now, torch.zeros(1, 2).double(), 0.01)
        ends += [k] if bool(equation.ready) else []
    assert ends == [2, 6, 14, 22, 30]


def test_slopes_over_a_window_are_exact_where_the_rate_is_constant() -> None:
    plant = adp.ParametricPlant(
        lambda x, u: u.unsqueeze(-1), lambda x, u: 0 * x + 3.0, dim=1, inputs=1, theta=[2.0]
    )
    windows, x, u, found = adp.SlopeWindows(plant, 0.5), torch.zeros(1, 1).double(), tensor([[1.5]]), 0
    now = windows.init(x)
    for _ in range(9):
        now, equation = windows.step(now, x, 0.125)
        now, x = windows.holding(now, u), x + 0.125 * plant.motion(x, u)
        if bool(equation.ready):
            torch.testing.assert_close(equation.s[..., 0] * 2.0, equation.z, rtol=1e-12, atol=0)
            found += 1
    assert found == 2
