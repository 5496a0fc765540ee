"""A box of states as the whole space: digits beside the wall, the wrapped plant, the published cases."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems

LOW, HIGH = [-7.0, -5.0], [5.0, 7.0]


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def chain() -> systems.Barrier:
    return systems.Barrier(systems.TwoStateChain(), LOW, HIGH)


class Offset(systems.ControlAffineSystem):
    """Two coordinates that rest at (1, -2) under the input 3; the first is an angle."""

    dim, inputs, periodic = 2, 1, (0,)

    def __init__(self) -> None:
        super().__init__()
        self.bounds = systems.Bounds(-9.0, 9.0, 1)

    def equilibrium(self) -> Tensor:
        return tensor([1.0, -2.0])

    def resting_input(self) -> Tensor:
        return tensor([3.0])

    def drift(self, x: Tensor) -> Tensor:
        return torch.stack((x[..., 1] + 2, (x[..., 0] - 1).sin() - 3 * (1 + (x[..., 1] + 2) / 2)), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.stack((0 * x[..., 0], 1 + (x[..., 1] + 2) / 2), dim=-1).unsqueeze(-1)


def exact(x: float, low: float, high: float, center: float) -> float:
    """The published formula in rational numbers and one logarithm of many digits."""
    from decimal import Decimal, localcontext

    with localcontext() as context:
        context.prec = 60
        a, b, c, y = (Decimal(v) for v in (low, high, center, x))
        return float(((y - a) * (b - c) / ((b - y) * (c - a))).ln())


@pytest.mark.parametrize("gap", [1.0, 1e-3, 1e-6, 1e-12])
def test_s_has_all_digits_next_to_a_wall_and_next_to_the_middle(gap: float) -> None:
    plant = chain()
    for x in ([-7 + gap, 7 - gap], [5 - gap, -5 + gap], [gap, -gap]):
        s = plant.transform(tensor(x))
        for k in range(2):
            assert float(s[k]) == pytest.approx(exact(x[k], LOW[k], HIGH[k], 0.0), rel=4e-16 * 4)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_there_and_back_in_random_boxes(dtype: torch.dtype) -> None:
    eps = torch.finfo(dtype).eps
    for seed in range(6):
        walls = 10 ** (3 * drawn(2, 3, seed=seed) - 1)
        plant = systems.Barrier(systems.Linear(-torch.eye(3), torch.eye(3)), -walls[0], walls[1])
        share = torch.cat((drawn(200, 3, seed=seed), 10 ** (-5 * drawn(200, 3, seed=seed + 50))))
        x = (plant.low + (plant.high - plant.low) * share).to(dtype)
        x = x[((x > plant.low.to(dtype)) & (x < plant.high.to(dtype))).all(-1)]
        s = plant.transform(x)
        assert s.dtype == dtype
        assert (plant.inverse(s) - x).abs().max() <= 20 * eps * walls.max()
        far = 60 * (2 * drawn(400, 3, seed=seed) - 1).to(dtype) / (1 if dtype == torch.float64 else 2)
        low, high = plant.walls(far)
        assert bool((low > 0).all() and (high > 0).all())
        again = plant.displaced(far, torch.zeros_like(far))
        assert ((again - far).abs() / (1 + far.abs())).max() <= 8 * eps


def test_the_wrapped_plant_moves_as_the_plant_does() -> None:
    plant = chain()
    x = plant.low + (plant.high - plant.low) * (0.05 + 0.9 * drawn(50, 2))
    u, s = drawn(50, 1, seed=1), plant.transform(x)
    stretch = torch.func.grad(lambda y: plant.inverse(y).sum())(s)  # dx/ds
    torch.testing.assert_close(plant.stretch(s), 1 / stretch, rtol=1e-12, atol=0)
    inner = plant.plant.rate(x, u)
    torch.testing.assert_close(plant.rate(s, u), inner / stretch, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(plant.velocity(s, u), inner, rtol=1e-12, atol=1e-12)


def test_what_a_plant_declares_is_carried_through() -> None:
    plant = systems.Barrier(Offset(), [0.0, None], [2.5, None])
    assert (plant.dim, plant.inputs) == (2, 1)
    assert plant.bounds is not None
    assert plant.periodic == ()  # the angle has walls: s of it does not repeat
    assert systems.Barrier(Offset(), [None, -3.0], [None, -1.0]).periodic == (0,)
    assert torch.equal(plant.transform(tensor([1.0, -2.0])), torch.zeros(2).double())
    around = plant.transform(tensor([0.5 + 2 * math.pi, -2.0]))
    torch.testing.assert_close(around, plant.transform(tensor([0.5, -2.0])), rtol=1e-14, atol=0)
    found = plant.linearisation()
    by_hand = torch.func.jacrev(lambda s: plant.rate(s, plant.resting_input()))(plant.equilibrium())
    torch.testing.assert_close(found.matrix, by_hand, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(found.input_matrix, plant.effectiveness(plant.equilibrium()))


def test_a_cost_of_x_is_a_cost_with_an_output() -> None:
    plant = chain()
    of_x = adp.QuadraticCost(2.0, 1.0, dim=2, inputs=1, output=plant.inverse)
    s = plant.transform(tensor([[-6.0, 6.0]]))
    assert float(of_x.state_rate(s)) == pytest.approx(2 * 72.0, rel=1e-12)
    k = adp.LQR(plant, of_x).k
    inner = adp.LQR(plant.plant, adp.QuadraticCost(2.0, 1.0, dim=2, inputs=1)).k
    torch.testing.assert_close(k * plant.stretch(plant.equilibrium()), inner, rtol=1e-9, atol=1e-9)


def followed(
    plant: systems.Barrier, cost: adp.Cost, s0: Tensor, dt: float, steps: int
) -> tuple[Tensor, float]:
    """The end and the cost under the LQR in s, its control following s: Runge-Kutta in s, as published."""
    lqr = adp.LQR(plant, cost)

    def field(z: Tensor) -> Tensor:
        s = z[:-1]
        u = lqr(s)
        return torch.cat((plant.rate(s, u), cost.rate(s, u)[None]))

    z = torch.cat((s0, s0.new_zeros(1)))
    for _ in range(steps):
        z = systems.runge_kutta_step(field, z, dt)
    return z[:-1], float(z[-1])


def test_published_two_states_under_the_lqr_in_s() -> None:
    plant, cost = chain(), adp.QuadraticCost(10.0, 0.1, dim=2, inputs=1)
    s0 = plant.transform(tensor([-6.5, 6.5]))
    assert s0.tolist() == pytest.approx([-3.472, 3.472], abs=5e-4)
    assert float(adp.LQR(plant, cost)(s0)) == pytest.approx(-22.0, abs=1e-3)  # the largest on the way
    first, paid = followed(plant, cost, s0, 0.004, 50)
    assert paid + followed(plant, cost, first, 0.025, 260)[1] == pytest.approx(70.782, abs=1e-3)


def robot_rate(x: Sequence[float], u: Sequence[float]) -> list[float]:
    """x' of the robot by scalars."""
    p1, p2, p3 = 3.473, 0.196, 0.242
    _, q2, w1, w2 = x
    c, s = math.cos(q2), math.sin(q2)
    left = [
        u[0] + p3 * s * w2 * w1 + p3 * s * (w1 + w2) * w2 - 5.3 * w1 - 8.45 * math.tanh(w1),
        u[1] - p3 * s * w1 * w1 - 1.1 * w2 - 2.35 * math.tanh(w2),
    ]
    one, cross = p1 + 2 * p3 * c, p2 + p3 * c
    det = one * p2 - cross * cross
    return [w1, w2, (p2 * left[0] - cross * left[1]) / det, (one * left[1] - cross * left[0]) / det]


def test_published_robot_under_the_lqr_in_s() -> None:
    """K is the library's; the loop is in x, by scalars."""
    low, high = [-7.0, -7.0, -5.0, -5.0], [5.0, 5.0, 7.0, 7.0]
    plant = systems.Barrier(systems.TwoLinkRobot(), low, high)
    gains = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2)).k.tolist()

    def field(z: list[float]) -> list[float]:
        x = z[:4]
        s = [math.log(b * (a - y) / (a * (b - y))) for y, a, b in zip(x, low, high, strict=True)]
        u = [-math.fsum(k * e for k, e in zip(row, s, strict=True)) for row in gains]
        return [*robot_rate(x, u), math.fsum(e * e for e in (*s, *u))]

    z, h = [-5.0, -5.0, 5.0, 5.0, 0.0], 0.02
    for _ in range(3000):
        k1 = field(z)
        k2 = field([y + 0.5 * h * k for y, k in zip(z, k1, strict=True)])
        k3 = field([y + 0.5 * h * k for y, k in zip(z, k2, strict=True)])
        k4 = field([y + h * k for y, k in zip(z, k3, strict=True)])
        z = [y + h / 6 * (a + 2 * b + 2 * c + d) for y, a, b, c, d in zip(z, k1, k2, k3, k4, strict=True)]
    assert z[4] == pytest.approx(63.12, abs=0.005)
    assert float(plant.transform(tensor(z[:4]))[0]) == pytest.approx(-0.215, abs=5e-4)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_millionth_from_the_wall_nobody_who_can_brake_leaves(dtype: torch.dtype) -> None:
    """Speed has a wall of its own; where x1 is, there is room to brake or it moves inward."""
    plant, cost = chain(), adp.QuadraticCost(10.0, 0.1, dim=2, inputs=1)
    x = torch.stack((-6.0 + 9.0 * drawn(300), tensor([7 - 1e-6, -5 + 1e-6] * 150)), dim=-1)
    inward = tensor([[5 - 1e-6, -3.0], [-7 + 1e-6, 5.0], [5 - 1e-6, -1e-3]])
    s0 = plant.transform(torch.cat((x, inward))).to(dtype)
    assert float(plant.margin(s0).max()) == pytest.approx(1e-6, rel=1e-5)
    run = adp.simulate(adp.Feedback(adp.LQR(plant, cost)), plant, cost, s0, dt=1e-3, steps=80, every=10)
    assert not bool(run.diverged.any())
    assert float(plant.margin(run.state).min()) > 0.99e-6


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        (-5.0, [5.0, -1.0], r"`Barrier\(high=...\)` must be above the equilibrium"),
        ([-5.0], 5.0, r"one for each of the 2 states; got \[-5.0\]"),
        (-5.0, math.nan, "must be finite or inf; got nan"),
    ],
)
def test_boxes_that_do_not_contain_the_equilibrium_are_refused(
    low: object, high: object, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        systems.Barrier(systems.TwoStateChain(), low, high)  # type: ignore[arg-type]


def test_a_robot_is_that_of_scalars_and_one_that_no_mass_matrix_has_is_refused() -> None:
    with pytest.raises(ValueError, match=r"`TwoLinkRobot\(inertia=...\)` must be positive"):
        systems.TwoLinkRobot(inertia=[0.3, 0.196, 0.242])
    robot, x, u = systems.TwoLinkRobot(), 2 * drawn(20, 4) - 1, drawn(20, 2)
    expected = tensor([robot_rate(*row) for row in zip(x.tolist(), u.tolist(), strict=True)])
    torch.testing.assert_close(robot.rate(x, u), expected, rtol=1e-12, atol=1e-12)


INF = math.inf
A, B = tensor([[0.0, 1.0, 0.2], [-2.0, -1.0, 0.1], [0.3, 0.0, -0.5]]), tensor([[0.0], [1.0], [0.5]])


class Aside(systems.Linear):
    """A linear plant that rests at (0.5, -1, 2) without an input."""

    center = (0.5, -1.0, 2.0)

    def equilibrium(self) -> Tensor:
        return tensor(self.center)

    def drift(self, x: Tensor) -> Tensor:
        return super().drift(x - tensor(self.center))


BOXES: dict[str, tuple[list[float], list[float]]] = {
    "both": ([-1.0, -2.0, 0.0], [2.5, 3.0, 2.1]),
    "low": ([-1.0, -INF, 0.0], [INF, INF, INF]),
    "high": ([-INF, -INF, -INF], [0.75, 1.0, INF]),
    "mixed": ([-INF, -1.5, -INF], [4.0, INF, INF]),
    "none": ([-INF] * 3, [INF] * 3),
}
X = tensor([[0.5, -1.0, 2.0], [0.6, -0.5, 1.5], [-0.9, -1.4, 0.1], [0.7, 0.9, 2.05], [0.499, -1.001, 2.001]])


def boxed(name: str) -> systems.Barrier:
    low, high = BOXES[name]
    return systems.Barrier(Aside(A, B), low, high)


def coordinate(x: float, low: float, high: float, c: float) -> float:
    if math.isinf(low) and math.isinf(high):
        return x - c
    down = 1.0 if math.isinf(low) else (x - low) / (c - low)
    up = 1.0 if math.isinf(high) else (high - x) / (high - c)
    return math.log(down / up)


def stretched(x: float, low: float, high: float) -> float:
    if math.isinf(low) and math.isinf(high):
        return 1.0
    return 1 / (x - low) + 1 / (high - x)


@pytest.mark.parametrize("name", BOXES)
def test_coordinates_are_the_logarithm_of_the_distances(name: str) -> None:
    box, (low, high) = boxed(name), BOXES[name]
    s = box.transform(X)
    walls = list(zip(low, high, Aside.center, strict=True))
    expected = [[coordinate(x, *w) for x, w in zip(row, walls, strict=True)] for row in X.tolist()]
    torch.testing.assert_close(s, tensor(expected), rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(box.coordinates(X), s, rtol=0, atol=0)
    torch.testing.assert_close(box.inverse(s), X, rtol=1e-13, atol=1e-13)
    rates = [[stretched(x, *w[:2]) for x, w in zip(row, walls, strict=True)] for row in X.tolist()]
    torch.testing.assert_close(box.stretch(s), tensor(rates), rtol=1e-11, atol=0)
    to_low, to_high = box.walls(s)
    torch.testing.assert_close(to_low, X - tensor(low), rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(to_high, tensor(high) - X, rtol=1e-12, atol=1e-13)
    margins = torch.minimum(X - tensor(low), tensor(high) - X).amin(-1)
    torch.testing.assert_close(box.margin(s), margins, rtol=1e-12, atol=1e-13)
    assert box.transform(X[0]).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("name", BOXES)
def test_steps_are_half_the_time_to_the_nearest_wall_ahead(name: str) -> None:
    box, (low, high) = boxed(name), BOXES[name]
    u = uniform(5, 1, seed=3)
    rates = ((X - tensor(Aside.center)) @ A.mT + u @ B.mT).tolist()
    found = box.step_limit(box.transform(X), u)
    torch.testing.assert_close(box.velocity(box.transform(X), u), tensor(rates), rtol=1e-11, atol=1e-11)
    for k, (x, rate) in enumerate(zip(X.tolist(), rates, strict=True)):
        times = [INF]
        for i in range(3):
            if rate[i] < 0:
                times.append((x[i] - low[i]) / -rate[i])
            if rate[i] > 0:
                times.append((high[i] - x[i]) / rate[i])
        assert float(found[k]) == pytest.approx(0.5 * min(times), rel=1e-9)


def test_inputs_at_their_bounds_are_inside_and_are_not_pushed_out() -> None:
    bounds = systems.Bounds([-1.0, 0.0], [2.0, INF], 2)
    u = tensor([[-1.0, 0.0], [2.0, 5.0], [0.5, 1.0], [-1.5, 1.0], [2.5, 1.0], [0.5, -0.1]])
    assert bounds.contain(u).tolist() == [True, True, True, False, False, False]
    assert bounds.clip(u).tolist() == [[-1, 0], [2, 5], [0.5, 1], [-1, 1], [2, 1], [0.5, 0]]
    moved = bounds.measured_from(tensor([0.5, 1.0]))
    assert (moved.low.tolist(), moved.high.tolist()) == ([-1.5, -1.0], [1.5, INF])
    assert repr(bounds) == "Bounds(low=[-1.0, 0.0], high=[2.0, inf])"
