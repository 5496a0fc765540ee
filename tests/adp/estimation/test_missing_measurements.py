"""Measurements that are missing are skipped and counted, those that are angles compared around the circle."""

from __future__ import annotations

import functools
import math

import pytest
import torch
from helpers import tensor, uniform
from helpers_adaptation import PENDULUM
from helpers_adp import Yaw
from torch import Tensor

from staf_torch import GaussianKernel, adp, rings, systems
from staf_torch.adp.adaptation.identification import Equation
from staf_torch.adp.estimation import Belief, KalmanFilter
from staf_torch.adp.loop.controller import Carried

KINDS = (adp.ExtendedKalman, adp.UnscentedKalman)
LINEAR = systems.Linear([[0.0, 1.0], [-1.0, -0.5]], [[0.0], [1.0]])
LOST = torch.nan
DT = 0.05


def believed(rows: int) -> Belief:
    root = uniform(rows, 2, 2, seed=1) + torch.eye(2).double()
    return Belief(uniform(rows, 2, seed=2), root @ root.mT, uniform(rows, 1, seed=3))


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_output_is_one_that_was_never_there(kind: type[KalmanFilter]) -> None:
    both = kind(LINEAR, lambda x: x, noise=[0.1, 0.3], process=0.1)
    second = kind(LINEAR, lambda x: x[..., 1:], noise=[0.3], process=0.1)
    y, later = uniform(3, 2, seed=4), torch.zeros(3, dtype=torch.bool)
    whole = both.step(believed(3), y, DT, later)
    y[0, 0], y[1] = LOST, LOST  # of the first row one sensor, of the second both
    found, alone = both.step(believed(3), y, DT, later), second.step(believed(3), y[:, 1:], DT, later)
    without = both.predicted(believed(3), DT)
    for part in ("mean", "covariance"):
        torch.testing.assert_close(getattr(found, part)[0], getattr(alone, part)[0], rtol=1e-12, atol=1e-13)
        assert torch.equal(getattr(found, part)[1], getattr(without, part)[1])
        assert torch.equal(getattr(found, part)[2], getattr(whole, part)[2])
    assert found.missed is not None
    assert found.missed.tolist() == [[1.0, 0.0], [1.0, 1.0], [0.0, 0.0]]
    again = both.step(found, y, DT, later)
    assert again.missed is not None
    assert again.missed.tolist() == [[2.0, 0.0], [2.0, 2.0], [0.0, 0.0]]


class Lossy(adp.Controller):
    """Hands on the state, with a NaN in the first entry (or all) of some rows, every few steps."""

    def __init__(self, inner: adp.Controller, every: int, rows: list[int], whole: bool = True) -> None:
        super().__init__()
        self.inner, self.every, self.rows, self.whole = inner, every, rows, whole
        self.draws, self.period = inner.draws, inner.period

    def init(self, x0: Tensor) -> Carried:
        return x0.new_zeros(len(x0)), self.inner.init(x0)

    def recorded(self, carried: Carried) -> dict[str, Tensor]:
        return self.inner.recorded(carried[1])

    def step(self, x: Tensor, carried: Carried, uniform: Tensor, dt: float) -> tuple[Tensor, Carried]:
        count, inner = carried
        hit = torch.zeros_like(x, dtype=torch.bool)
        hit[self.rows, : x.shape[-1] if self.whole else 1] = True
        lost = hit & (count % self.every == 0).unsqueeze(-1)  # the first among them
        u, inner = self.inner.step(torch.where(lost, LOST, x), inner, uniform, dt)
        return u, (count + 1, inner)


def run(control: adp.Controller, plant: systems.Plant, rows: list[int], every: int = 5, steps: int = 50):  # type: ignore[no-untyped-def]
    cost, x0 = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1), tensor([[-0.3, 0.2], [0.4, 0.0], [0.1, 0.1]])
    x0 = torch.cat((x0, x0[:2]))  # the last two beside the first two without a loss
    return adp.simulate(Lossy(control, every, rows), plant, cost, x0, dt=0.02, steps=steps, compile=False)


def adaptive(name: str) -> adp.Controller:
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    windows, law = adp.IntegralWindows(PENDULUM, 0.05), adp.LeastSquares([0.3, 0.6], deviation=[0.3, 0.5])
    if name == "lqr":
        return adp.AdaptiveLQR(PENDULUM, cost, windows, law)
    if name == "filtered":
        return adp.AdaptiveLQR(
            PENDULUM, cost, windows, law, filter=adp.ConsiderFilter(PENDULUM, noise=0.01, process=0.1)
        )
    if name == "actor-critic":
        points = adp.QuadraturePoints(3, 2, half_width=0.2)
        first = {"critic": 2.0, "actor": 2.0}
        learner = adp.ActorCritic(
            adp.QuadraticBasis(2), PENDULUM, cost, points, adp.PolicyIteration(), **first
        )
        robust = adp.LQR(PENDULUM, cost)  # has the control all the time: of a pendulum the law is no friend
        return adp.AdaptiveActorCritic(learner, PENDULUM, windows, law, robust=robust, share=1e-9)
    known = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    drift = adp.StreamDrift(
        known, GaussianKernel(2.0), 0.5 * rings(3), rows=[1], deviation=10.0, length=0.05, forgetting=0.1
    )
    robust = adp.LQR(PENDULUM, cost)
    return adp.DriftLQR(drift, cost, robust=robust)


@pytest.mark.parametrize("name", ["lqr", "filtered", "actor-critic", "drift"])
def test_an_adaptive_controller_holds_counts_and_learns_on_where_measurements_are_missing(name: str) -> None:
    steps = 25 if name == "drift" else 50  # it takes its time in plain torch
    lossy = run(adaptive(name), PENDULUM, [0], steps=steps)
    assert not bool(lossy.diverged.any())
    assert lossy["missed"][:, -1].tolist() == [steps / 5, 0.0, 0.0, 0.0, 0.0]
    torch.testing.assert_close(lossy.state[1], lossy.state[4], rtol=1e-12, atol=1e-14)
    assert not torch.equal(lossy.control[0], lossy.control[3])
    if name != "filtered":
        held = lossy.control[0]
        torch.testing.assert_close(held[5:-1:5], held[4:-2:5], rtol=0, atol=0)
        assert float(held[0].abs()) == 0.0  # the first measurement was missing
    if "theta" in lossy.recorded:
        torch.testing.assert_close(lossy["theta"][0, -1], tensor([0.1, 1.0]), rtol=0, atol=0.05)
    assert float(lossy.state[0, -1].norm()) < float(lossy.state[0, 0].norm())


def test_a_window_with_a_missing_measurement_gives_no_equation() -> None:
    for windows in (adp.IntegralWindows(PENDULUM, 0.04), adp.SlopeWindows(PENDULUM, 0.04)):
        now, ready, u = windows.init(torch.zeros(2, 2).double()), [], torch.ones(2, 1).double()
        for k in range(9):
            x = uniform(2, 2, seed=k)
            if k == 3:
                x[1, 0] = LOST
            now, equation = windows.step(now, x, 0.01)
            now = windows.holding(now, u)
            ready.append(equation.ready.tolist())
            assert bool(torch.isfinite(equation.s).all() & torch.isfinite(equation.z).all())
        ends = [[k for k, flags in enumerate(ready) if flags[row]] for row in range(2)]
        assert ends == [[4, 8], [8]]  # of the second row the window from 4 on
        assert now.missed.tolist() == [0.0, 1.0]


def test_a_slope_over_a_window_knows_how_often_an_angle_has_turned() -> None:
    wheel = adp.ParametricPlant(
        lambda x, u: torch.ones_like(x).unsqueeze(-1), dim=1, inputs=1, theta=[50.0], periodic=(0,)
    )
    windows, found = adp.SlopeWindows(wheel, 0.2), []
    now = windows.init(torch.zeros(1, 1).double())
    for k in range(21):
        x = tensor([[math.remainder(0.5 * k, 2 * math.pi)]])
        now, equation = windows.step(now, x, 0.01)
        found += [float(equation.z)] if bool(equation.ready) else []
    assert found == pytest.approx([50.0])


def equation(s: list[list[float]], z: list[float]) -> Equation:
    return Equation(tensor([s]), tensor([z]), torch.zeros(1).double(), torch.tensor([True]))


def test_identifiers_leave_out_what_is_not_finite_row_by_row() -> None:
    rows, z = [[1.0, 2.0], [1.0, -1.0]], [11.0, -1.0]
    law, size = adp.LeastSquares([0.0, 0.0], deviation=10.0), functools.partial(adp.HistoryStack, 2, 2)
    known = law.step(law.init(torch.zeros(1, 2).double()), equation(rows, z), DT)
    half = law.step(known, equation(rows, [LOST, -1.0]), DT)
    only = law.step(known, equation(rows[1:], z[1:]), DT)
    torch.testing.assert_close(half.theta, only.theta, rtol=0, atol=0)
    assert half.missed is not None
    assert float(half.missed) == 1.0
    stack = size(4).init(torch.zeros(1, 2).double())
    for lost in ([LOST, LOST], [LOST, -1.0], z):
        stack = size(4).take(stack, equation(rows, lost))
    assert (float(stack.missed), float(stack.filled)) == (2.0, 2.0)
    torch.testing.assert_close(torch.linalg.solve(stack.gram, stack.moment), tensor([[3.0, 4.0]]))
    learning = adp.ConcurrentLearning(2, 1, size=2)
    first = learning.step(
        learning.init(torch.zeros(1, 2, 1).double()), tensor([[1.0, 0.0]]), tensor([[2.0]]), DT
    )
    after = learning.step(first, tensor([[0.0, 1.0]]), tensor([[LOST]]), DT)
    assert bool(torch.isfinite(after.theta).all())
    assert float(after.stack.missed) == 1.0


def test_what_a_large_equation_leaves_is_gone_with_it() -> None:
    stacks = adp.HistoryStack(rows=1, parameters=2, size=2)
    now = stacks.init(torch.zeros(1, 1).double())
    for s in ([1e-3, 0.0], [1e9, 1e9], [1e9, -1e9], [0.0, 1e-3]):
        now = stacks.take(now, equation([s], [0.0]))
    torch.testing.assert_close(now.gram, (now.s.mT @ now.s).sum(1))


@pytest.mark.parametrize("deviation", [1e3, 1e6])
def test_a_covariance_that_shrank_below_rounding_does_not_stay_0(deviation: float) -> None:
    law = adp.LeastSquares([0.0], deviation=deviation, floor=1e-6, forgetting=0.1)
    now = law.init(torch.zeros(1, 1).double())
    for k in range(300):
        now = law.step(now, equation([[1.0]], [2.0 if k < 150 else 3.0]), 1.0)
        assert float(now.covariance) > 0
    assert float(now.theta) == pytest.approx(3.0, abs=1e-3)
    for kind in KINDS:
        filter = kind(LINEAR, lambda x: x[..., :1], noise=[1e-6], process=0.1)
        belief = Belief(
            torch.zeros(1, 2).double(), deviation**2 * torch.eye(2)[None].double(), torch.zeros(1, 1)
        )
        for k in range(3):
            belief = filter.corrected(belief, tensor([[2.0 + k]]))
            assert float(torch.linalg.eigvalsh(belief.covariance).min()) > 0
        assert float(belief.mean[0, 0]) == pytest.approx(3.0, abs=1e-3)  # the mean of three


def test_a_state_that_is_never_measured_is_found_by_the_model() -> None:
    filter, x, u = adp.ConsiderFilter(PENDULUM, noise=0.01), tensor([[0.1, 0.3]]), torch.zeros(1, 1).double()
    sure = adp.LeastSquares([0.1, 1.0], deviation=1e-6).init(x)
    now = filter.init(x)
    for _ in range(40):
        now = filter.step(now, torch.cat((x[:, :1], torch.full_like(x[:, :1], LOST)), -1), u, sure, 0.02)
        seen = x
        x = systems.runge_kutta_step(lambda at: PENDULUM.motion(at, u), x, 0.02)
    torch.testing.assert_close(now.mean, seen, rtol=0, atol=1e-2)
    assert now.missed.tolist() == [[0.0, 40.0]]


@pytest.mark.parametrize(
    ("kind", "unit", "turn"),
    [(adp.ExtendedKalman, 180 / math.pi, 360.0), (adp.UnscentedKalman, 1.0, 2 * math.pi)],
)
def test_a_measured_angle_is_compared_around_the_circle(
    kind: type[KalmanFilter], unit: float, turn: float
) -> None:
    filter = kind(Yaw(), lambda x: unit * x[..., :1], noise=[0.01 * unit], process=0.1)
    x = torch.stack(
        (0.1 + 2.0 * DT * torch.arange(80), torch.full((80,), 2.0)), -1
    ).double()  # two turns and more
    start, spread = tensor([[0.0, 1.5]] * 2), 0.3 * torch.eye(2).double().expand(2, 2, 2)
    belief = Belief(start, spread, torch.zeros(2, 1).double())
    for k in range(80):
        y = unit * x[k : k + 1, :1]
        both = torch.cat((torch.remainder(y + turn / 2, turn) - turn / 2, y))  # of the row wrapped, and not
        belief = filter.step(belief, both, DT, torch.tensor([k == 0] * 2))
    torch.testing.assert_close(belief.mean, x[-1].expand(2, 2), rtol=0, atol=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bearing_by_atan2_is_an_angle_where_it_is_named_one(kind: type[KalmanFilter]) -> None:
    def bearing(x: Tensor) -> Tensor:
        return torch.atan2(x[..., 1:], x[..., :1])

    filter = kind(LINEAR, bearing, noise=[0.05], periodic=[0])
    belief = Belief(tensor([[-1.0, 0.05]]), 0.02 * torch.eye(2)[None].double(), torch.zeros(1, 1).double())
    after = filter.corrected(belief, tensor([[-math.pi + 0.02]]))  # on the other side of the jump
    assert float(after.mean[0, 1]) < 0.03
    assert float((after.mean - belief.mean).norm()) < 0.1
    with pytest.raises(ValueError, match="periodic"):
        kind(LINEAR, bearing, noise=[0.05], periodic=[1])


def test_an_observed_loop_goes_on_where_a_sensor_fails_and_says_how_often() -> None:
    plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)

    def seen(x: Tensor) -> Tensor:  # nothing is seen on one side
        return torch.where(x[..., :1] > 0.15, LOST, x[..., :1])

    filter = adp.ExtendedKalman(plant, lambda x: x[..., :1], noise=[0.01], process=0.05)
    inside = adp.Observed(adp.Feedback(adp.LQR(plant, cost)), filter, deviation=0.1, mean=[0.2, 0.0])
    control = adp.Measured(inside, noise=0.01, dim=1, output=seen)
    x0 = tensor([[0.2, 0.0], [-0.1, 0.0]])
    found = adp.simulate(control, plant, cost, x0, dt=0.02, steps=120)
    assert not bool(found.diverged.any())
    missed = found["outputs_missed"][:, -1, 0]
    assert float(missed[0]) > 0
    assert float(found.state[:, -1].norm(dim=-1).max()) < 0.2


def test_a_tracker_follows_an_angle_around_the_circle_and_holds_where_it_sees_nothing() -> None:
    plant = adp.ParametricPlant(
        lambda z, u: z.sin().unsqueeze(-1), lambda z, u: u, dim=1, inputs=1, theta=[2.0], periodic=(0,)
    )

    def rest(z: Tensor) -> tuple[Tensor, Tensor]:
        return torch.full_like(z, 3.0), torch.zeros_like(z)

    tracker = adp.ConcurrentTracker(plant, rest, length=0.05, feedback=2.0, gain=2000.0, size=5)
    cost, x0 = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1), tensor([[-2.0], [2.5 + 4 * math.pi]])
    found = adp.simulate(Lossy(tracker, 30, [0]), plant, cost, x0, dt=0.01, steps=300, compile=False)
    ends = tensor([3.0 - 2 * math.pi, 3.0 + 4 * math.pi])
    torch.testing.assert_close(found.state[:, -1, 0], ends, rtol=0, atol=0.02)
    torch.testing.assert_close(found["theta"][:, -1, 0], tensor([2.0, 2.0]), rtol=0, atol=0.05)
    assert found["missed"][:, -1].tolist() == [10.0, 0.0]
