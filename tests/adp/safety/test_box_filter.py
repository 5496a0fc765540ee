"""A filter around a policy of barrier coordinates: what can be kept inside is, what cannot is said."""

from __future__ import annotations

import functools
from collections.abc import Callable

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems

CHAIN = systems.TwoStateChain()
BOX = systems.Barrier(CHAIN, low=[-7.0, -5.0], high=[5.0, 7.0])
COST = adp.QuadraticCost(10.0, 0.1, dim=2, inputs=1)
OF_S = adp.LQR(BOX, COST)
DT = 1e-3
WALL = systems.Barrier(CHAIN, low=None, high=[5.0, None])


def beside_the_walls(count: int) -> Tensor:
    """States 1e-6 from a wall of x1 with all speeds, and half of them slow."""
    speed = torch.cat(
        (uniform(count // 2, low=-4.9, high=6.9, seed=1), uniform(count // 2, low=-0.2, high=0.2, seed=0))
    )
    at = torch.where(torch.arange(count) % 3 > 0, 5 - 1e-6, -7 + 1e-6).double()
    return torch.stack((at, speed), dim=-1)


@functools.cache
def can_be_kept(count: int) -> Tensor:
    """Whether the hardest braking that leaves the speed inside keeps x1 inside, from states beside the walls:
    u by bisection."""
    x = beside_the_walls(count)
    outward = torch.sign(x[:, 0])
    low, high = torch.zeros(len(x)).double(), torch.full((len(x),), 2e4).double()
    for _ in range(20):
        middle = 0.5 * (low + high)
        inside = (followed(x, -outward * middle)[..., 1].add(-1).abs() < 6).all(0)
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    return (followed(x, -outward * low)[..., 0].add(1).abs() < 6).all(0)


def followed(x: Tensor, u: Tensor, pieces: int = 30) -> Tensor:
    """x at so many times of a hold."""
    states = []
    for _ in range(pieces):
        x = systems.runge_kutta_step(lambda y: CHAIN.rate(y, u.unsqueeze(-1)), x, DT / pieces)
        states.append(x)
    return torch.stack(states)


def test_what_can_be_kept_stays_inside_and_the_rest_is_named() -> None:
    s0 = BOX.transform(beside_the_walls(16))
    guard = adp.BoxFilter(OF_S, BOX, dt=DT)
    run = adp.simulate(adp.Feedback(guard), BOX, COST, s0, steps=1, substeps=16, compile=False)
    kept = can_be_kept(16)
    assert 3 < int(kept.sum()) < 13
    assert torch.equal(guard.share(s0) < 1, kept)
    assert torch.equal(~run.diverged, kept)
    bare = adp.simulate(adp.Feedback(OF_S), BOX, COST, s0, dt=DT, steps=1, substeps=16, compile=False)
    assert int(bare.diverged.sum()) > int(run.diverged.sum())


def test_a_control_that_is_renewed_in_time_keeps_every_start() -> None:
    s0 = BOX.transform(beside_the_walls(12))
    guard = adp.BoxFilter(OF_S, BOX, dt=DT, renewed=True)
    assert float(guard.hold(s0).min()) < 1e-6
    assert float(guard.hold(BOX.transform(tensor([0.0, 1.0])))) == DT
    settings = {"steps": 1, "substeps": 6, "renew": True, "compile": False}
    run = adp.simulate(adp.Feedback(guard), BOX, COST, s0, **settings)  # type: ignore[arg-type]
    assert not bool(run.diverged.any())


@pytest.mark.compiled
def test_substeps_are_few_away_from_walls_and_many_beside_them() -> None:
    guard = adp.Feedback(adp.BoxFilter(adp.LQR(WALL, COST), WALL, dt=DT, renewed=True))
    near = WALL.transform(beside_the_walls(18))[beside_the_walls(18)[:, 0] > 0]
    away = WALL.transform(tensor([[0.0, 1.0], [-3.0, 2.0], [2.0, -1.0]]))
    settings = {"dt": DT, "steps": 2, "renew": True}

    def run(s0: Tensor, substeps: int | tuple[int, int], compile: bool = False) -> adp.LoopResult:
        more = settings | {"substeps": substeps, "compile": compile}
        return adp.simulate(guard, WALL, COST, s0, **more)  # type: ignore[arg-type]

    mixed, compiled = (run(torch.cat((near, away)), (1, 6), compile) for compile in (False, True))
    assert not bool(mixed.diverged.any())
    torch.testing.assert_close(compiled.state, mixed.state, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(compiled.cost, mixed.cost, rtol=1e-9, atol=1e-12)
    alone = run(away, 1)
    torch.testing.assert_close(mixed.state[12:], alone.state, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(mixed.cost[12:], alone.cost, rtol=1e-13, atol=1e-13)
    # Of as many at least as at most every one is taken, away from walls too.
    torch.testing.assert_close(run(away, (6, 6)).state, run(away, 6).state, rtol=0, atol=0)


def test_a_way_that_is_a_line_has_a_control() -> None:
    # With the control that is wanted x1 goes straight to its wall: in float32 the cubic is a line.
    guard = adp.BoxFilter(OF_S, BOX, dt=DT, renewed=True)
    for dtype in (torch.float64, torch.float32):
        u = guard(BOX.transform(tensor([[4.999999, 3.4938383727974553]])).to(dtype))
        assert float(u) == pytest.approx(-2.103e7, rel=1e-3)  # v^2/d, by v = 3.49 and d = 5e-7


def test_where_no_wall_is_near_not_a_bit_changes_and_rows_are_alone() -> None:
    x = torch.stack((uniform(40, low=-6, high=4, seed=2), uniform(40, low=-4, high=6, seed=3)), dim=-1)
    s = BOX.transform(x)
    near, guard = BOX.transform(beside_the_walls(8)), adp.BoxFilter(OF_S, BOX, dt=DT)
    mixed = guard(torch.cat((near, s)))
    assert torch.equal(mixed[8:], OF_S(s))
    assert torch.equal(guard(near[3]), mixed[3])


def test_a_robot_with_two_inputs_and_walls_for_all_of_its_states() -> None:
    robot = systems.TwoLinkRobot()
    box = systems.Barrier(robot, low=[-7.0, -7.0, -5.0, -5.0], high=[5.0, 5.0, 7.0, 7.0])
    cost = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2)
    lqr = adp.LQR(box, cost)
    guard = adp.BoxFilter(lqr, box, dt=DT)
    assert guard.degree == [2, 2, 2, 2, 1, 1, 1, 1]
    x = tensor([[4.997, -6.997, 4.0, -4.0], [-5.0, -5.0, 5.0, 5.0]])
    s0 = box.transform(x)
    assert torch.equal(guard(s0)[1], lqr(s0)[1])
    run = adp.simulate(adp.Feedback(guard), box, cost, s0, steps=1, substeps=4, compile=False)
    assert not bool(run.diverged.any())
    bare = adp.simulate(adp.Feedback(lqr), box, cost, s0, dt=DT, steps=1, substeps=1, compile=False)
    assert bare.diverged.tolist() == [True, False]


def test_what_breaks_a_rule_is_refused() -> None:
    with pytest.raises(ValueError, match=r"`BoxFilter\(box=...\)` must be a systems.Barrier"):
        adp.BoxFilter(OF_S, CHAIN, dt=DT)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"`BoxFilter\(dt=...\)` must be positive"):
        adp.BoxFilter(OF_S, BOX, dt=0.0)
    three = systems.Linear([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0] * 3], [[0.0], [0.0], [1.0]])
    far = systems.Barrier(three, [-1.0, None, None], None)
    with pytest.raises(ValueError, match="move every walled coordinate or its speed; not so coordinate 0"):
        adp.BoxFilter(lambda s: s[..., :1], far, dt=DT)


# What is asked of a held control, beside a mass whose way is a parabola --------------------------------

HOLD = 0.1


def walled(low: float | None, high: float | None, most: float | None = None) -> systems.Barrier:
    plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    if most is not None:
        plant.bounds = systems.Bounds(-most, most, 1)
    return systems.Barrier(plant, [low, None], [high, None])


def peak(v: Tensor, u: Tensor, hold: Tensor | float) -> Tensor:
    """How far a mass comes within a hold, at least 0."""
    end = v * hold + 0.5 * u * hold**2
    turns = (v > 0) & (u < 0) & (-v / torch.where(u == 0, 1.0, u) < hold)
    return torch.where(turns, -0.5 * v.square() / torch.where(u == 0, 1.0, u), end).clamp(min=0)


def nearest(asked: Callable[[Tensor], Tensor], wanted: Tensor) -> Tensor:
    """The largest u up to the wanted one that meets what is asked, by bisection."""
    low, high = wanted - 1e5, wanted.clone()
    for _ in range(80):
        middle = 0.5 * (low + high)
        meets = asked(middle)
        low, high = torch.where(meets, middle, low), torch.where(meets, high, middle)
    return torch.where(asked(wanted), wanted, low)


def states(rows: int = 60) -> tuple[Tensor, Tensor, Tensor]:
    """Near the upper wall at 1, their distances and their speeds."""
    apart, speed = uniform(rows, low=0.01, high=0.5, seed=1), uniform(rows, low=-1.0, high=4.0, seed=2)
    return torch.stack((1 - apart, speed), dim=-1), apart, speed


def asked_of(speed: Tensor, apart: Tensor, u: Tensor, left: float) -> Tensor:
    """A share is left where the wall would be met within the hold, or nearly; else there is room to brake."""
    end, last = speed * HOLD + 0.5 * u * HOLD**2, speed + u * HOLD
    room = (1 - left) * apart
    return torch.where(speed * HOLD > 2 * room, peak(speed, u, HOLD) <= room, apart - end >= HOLD * last)


@pytest.mark.parametrize("side", [1, -1])
def test_the_control_is_the_nearest_that_leaves_half_and_room_to_brake(side: int) -> None:
    x, apart, speed = states()
    box = walled(-9.0 if side > 0 else -1.0, 1.0 if side > 0 else 9.0)
    guard = adp.BoxFilter(lambda s: side * 3.0 + 0 * s[..., :1], box, dt=HOLD)
    wanted = torch.full_like(apart, 3.0)

    def asked(u: Tensor) -> Tensor:
        return asked_of(speed, apart, u, 0.5)

    s = box.transform(side * x)
    found = side * guard(s)[:, 0]
    expected = nearest(asked, wanted)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    assert 10 < int((expected < 3.0).sum()) < 60
    used = torch.maximum(peak(speed, found, HOLD) / apart, peak(-speed, -found, HOLD) / (10 - apart))
    torch.testing.assert_close(guard.share(s), used, rtol=1e-6, atol=1e-7)
    assert float(guard.share(s).max()) < 2 / 3


def test_where_bounds_leave_no_half_a_thousandth_has_to_do() -> None:
    x, apart, speed = states()
    box = walled(-9.0, 1.0, most=30.0)
    guard = adp.BoxFilter(lambda s: 3.0 + 0 * s[..., :1], box, dt=HOLD)
    wanted, found, cases = torch.full_like(apart, 3.0), guard(box.transform(x))[:, 0], []
    for left in (0.5, 1e-3):

        def asked(u: Tensor, left: float = left) -> Tensor:
            return asked_of(speed, apart, u, left)

        cases.append(nearest(asked, wanted))
    half, most = cases
    first, second = half > -29.9, (half < -30.1) & (most > -29.9)
    assert int(first.sum()) > 10
    assert int(second.sum()) > 3
    torch.testing.assert_close(found[first], half[first], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(found[second], most[second], rtol=1e-4, atol=1e-3)
    assert bool((found >= -30).all())


def test_a_control_that_is_renewed_is_held_for_half_the_time_to_a_wall_and_stops_by_then() -> None:
    x, apart, speed = states()
    box = walled(-0.5, 1.0)
    guard = adp.BoxFilter(lambda s: 3.0 + 0 * s[..., :1], box, dt=HOLD, renewed=True)
    s = box.transform(x)
    hold = guard.hold(s)
    below = x[:, 0] + 0.5
    expected = torch.full_like(hold, HOLD)
    for distance, towards in ((below, -speed), (apart, speed)):
        short = 0.5 * distance / torch.where(towards > 0, towards, 1.0)
        expected = torch.where((towards > 0) & (short < expected), short, expected)
    torch.testing.assert_close(hold, expected)
    assert 10 < int((hold < HOLD).sum()) < 60
    assert torch.equal(adp.BoxFilter(guard.policy, box, dt=HOLD).hold(s), torch.full_like(hold, HOLD))
    away = speed > 0  # what matters is the upper wall alone
    torch.testing.assert_close(guard.hold(s.unflatten(0, (3, 4, 5))).flatten(), hold)

    def asked(u: Tensor) -> Tensor:
        end, last = speed * hold + 0.5 * u * hold**2, speed + u * hold
        calm = torch.where(hold < HOLD, last <= 0, apart - end >= hold * last)
        return torch.where(speed * hold > apart, peak(speed, u, hold) <= 0.5 * apart, calm)

    wanted = torch.full_like(apart, 3.0)
    torch.testing.assert_close(guard(s)[away, 0], nearest(asked, wanted)[away], rtol=1e-4, atol=1e-4)


def test_rows_of_any_dimensions_are_rows() -> None:
    x, _, _ = states(12)
    box = walled(-2.0, 1.0)
    guard = adp.BoxFilter(lambda s: 3.0 + 0 * s[..., :1], box, dt=HOLD, renewed=True)
    s = box.transform(x)
    deep = s.unflatten(0, (3, 2, 2))
    torch.testing.assert_close(guard(deep), guard(s).unflatten(0, (3, 2, 2)))
    torch.testing.assert_close(guard.share(deep), guard.share(s).unflatten(0, (3, 2, 2)))
    shorter = guard.held(s, 0.5 * guard.hold(s))
    torch.testing.assert_close(guard.held(deep, 0.5 * guard.hold(deep)).reshape(12, 1), shorter)
    torch.testing.assert_close(guard(s[4]), guard(s)[4])
    with pytest.raises(ValueError, match=r"`BoxFilter\(s=...\)`"):
        guard(s[:, :1])


def test_a_coordinate_that_the_input_moves_keeps_half_of_its_distance() -> None:
    box = systems.Barrier(systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]), [None, -1.0], [None, 2.0])
    guard = adp.BoxFilter(lambda s: 40.0 * torch.sign(s[..., :1]), box, dt=HOLD)
    assert (guard.walls, guard.degree) == ([(1, -1), (1, 1)], [1, 1])
    x = torch.stack((uniform(30, seed=1), uniform(30, low=-0.9, high=1.9, seed=2)), dim=-1)
    found = guard(box.transform(x))[:, 0]
    up, down = 0.5 * (2 - x[:, 1]) / HOLD, -0.5 * (x[:, 1] + 1) / HOLD
    wanted = 40.0 * torch.sign(box.transform(x)[:, 0])
    torch.testing.assert_close(found, torch.minimum(torch.maximum(wanted, down), up), rtol=1e-6, atol=1e-6)
