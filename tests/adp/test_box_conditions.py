"""What a box filter asks of a held control, beside a mass whose way is a parabola and dense cubics."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.box_filter import Held, _excursion, _summit

MASS = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
HOLD = 0.1
SHARE = torch.linspace(0, 1, 4001, dtype=torch.float64)


def cubic(first: Tensor, last: Tensor, rise: Tensor, fall: Tensor, length: float) -> Tensor:
    """Hermite's, at many places: (B,) each -> (P, B)."""
    t = SHARE.unsqueeze(-1)
    one, two = (1 + 2 * t) * (1 - t) ** 2, t**2 * (3 - 2 * t)
    return one * first + two * last + length * (t * (1 - t) ** 2 * rise - t**2 * (1 - t) * fall)


@pytest.mark.parametrize("length", [0.02, 1.0, 3.0])
def test_the_summit_of_a_cubic_that_begins_to_rise_is_its_largest_value(length: float) -> None:
    first, last, fall = (uniform(400, seed=k) for k in range(3))
    rise = uniform(400, low=0.0, high=9.0, seed=3) / length
    fall = 4 * fall / length
    found = _summit(first, last, rise, fall, tensor(length))
    dense = cubic(first, last, rise, fall, length).amax(0)
    torch.testing.assert_close(found, dense, rtol=0, atol=2e-6)
    assert bool((found >= dense - 1e-14).all())
    assert 100 < int((found > torch.maximum(first, last)).sum()) < 390


def test_the_summit_of_what_falls_first_and_rises_last_is_an_end() -> None:
    first, last = uniform(100, seed=1), uniform(100, seed=2)
    rise, fall = -uniform(100, low=0.0, seed=3), uniform(100, low=0.0, seed=4)
    assert torch.equal(_summit(first, last, rise, fall, tensor(1.0)), torch.maximum(first, last))


@pytest.mark.parametrize("rise", [1.0, 0.0, -1.0])
def test_the_summit_of_a_line_has_a_slope(rise: float) -> None:
    def summit(rise: Tensor) -> Tensor:
        return _summit(tensor([0.0]), rise, rise, rise, tensor(1.0)).sum()

    slope = torch.func.grad(summit)(tensor([rise]))
    assert bool(torch.isfinite(slope).all())
    assert float(summit(tensor([rise]))) == max(0.0, rise)


def test_an_excursion_is_that_of_two_cubics_towards_a_wall() -> None:
    middle, end = uniform(200, 2, seed=1), uniform(200, 2, seed=2)
    rates = tuple(5 * uniform(200, 2, seed=k) for k in (3, 4, 5))
    held = Held(middle, end, rates)  # type: ignore[arg-type]
    for k, side in ((0, 1), (1, -1)):
        found = _excursion(held, k, side, tensor(0.4))
        a, b, c = (side * rate[:, k] for rate in rates)
        half, last = side * middle[:, k], side * end[:, k]
        dense = torch.maximum(
            cubic(torch.zeros(200).double(), half, a, b, 0.2).amax(0), cubic(half, last, b, c, 0.2).amax(0)
        )
        rises = (a > 0) & (b > 0) | (a > 0) & (c > 0) & (b < 0)
        assert int(rises.sum()) > 60
        torch.testing.assert_close(found[rises], dense[rises], rtol=0, atol=1e-5)
        assert bool((found >= 0).all())


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
    u, share, hold = guard(s), guard.share(s), guard.hold(s)
    shorter = guard.held(s, 0.5 * hold)
    assert (u.shape, share.shape, hold.shape) == ((12, 1), (12,), (12,))
    for shape in ((3, 2, 2), (4, 3)):
        deep = s.unflatten(0, shape)
        found = guard(deep)
        assert found.shape == (*shape, 1)
        torch.testing.assert_close(found.reshape(12, 1), u)
        torch.testing.assert_close(guard.share(deep).flatten(), share)
        torch.testing.assert_close(guard.hold(deep).flatten(), hold)
        torch.testing.assert_close(guard.held(deep, 0.5 * guard.hold(deep)).reshape(12, 1), shorter)
    torch.testing.assert_close(guard(s[4]), u[4])
    assert float((shorter - u).abs().max()) > 1
    with pytest.raises(ValueError, match=r"`BoxFilter\(s=...\)`"):
        guard(s[:, :1])


class Counted(adp.BoxFilter):
    """How often its conditions are made straight."""

    count = 0

    def inequalities(self, s: Tensor, u: Tensor, hold: Tensor, left: Tensor) -> tuple[Tensor, Tensor]:
        self.count += 1
        return super().inequalities(s, u, hold, left)


@pytest.mark.parametrize(
    ("apart", "speed", "count"), [(0.9, 0.0, 0), (0.1, 1.0, 5), (0.1, 2.5, 10), (0.1, 9.0, 10)]
)
def test_conditions_are_made_straight_five_times_for_each_share_that_is_tried(
    apart: float, speed: float, count: int
) -> None:
    box = walled(-9.0, 1.0, most=30.0)
    guard = Counted(lambda s: 3.0 + 0 * s[..., :1], box, dt=HOLD)
    guard(box.transform(tensor([[1 - apart, speed]])))
    assert guard.count == count


def test_conditions_are_lines_through_their_values() -> None:
    box = systems.Barrier(systems.TwoStateChain(), low=[-7.0, -5.0], high=[5.0, 7.0])
    guard = adp.BoxFilter(lambda s: s[..., :1], box, dt=0.01)
    x = torch.stack((5 - uniform(9, low=0.0, high=0.1, seed=1), uniform(9, low=1.0, high=4.0, seed=2)), -1)
    s, u = box.transform(x), 10 * uniform(9, 1, seed=3)
    hold, left = torch.full((9,), 0.01).double(), torch.full((9,), 0.5).double()
    normal, least = guard.inequalities(s, u, hold, left)
    assert normal.shape == (9, 4, 1)
    value = guard._conditions(s, u, hold, left)
    torch.testing.assert_close((normal * u.unsqueeze(-2)).sum(-1) - least, value, rtol=1e-9, atol=1e-6)
    more, less = (guard._conditions(s, u + small, hold, left) for small in (1e-4, -1e-4))
    torch.testing.assert_close(normal[..., 0], (more - less) / 2e-4, rtol=1e-4, atol=1e-4)


def test_degrees_are_found_for_every_walled_coordinate() -> None:
    plant = systems.Linear([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]], [[0.0], [1.0], [0.0]])
    for low, high, walls, degree in (
        ([-1.0, -2.0, None], [None, 3.0, None], [(0, -1), (1, -1), (1, 1)], [2, 1, 1]),
        ([None, None, None], [1.0, None, None], [(0, 1)], [2]),
    ):
        guard = adp.BoxFilter(lambda s: s[..., :1], systems.Barrier(plant, low, high), dt=0.1)
        assert (guard.walls, guard.degree) == (walls, degree)
        assert not guard.renewed
        assert guard.period == 0.1
    with pytest.raises(ValueError, match="not so coordinate 2"):
        adp.BoxFilter(lambda s: s[..., :1], systems.Barrier(plant, [-1.0, None, -1.0], None), dt=0.1)


class Inside(systems.Linear):
    """A mass on a line that moves where it may be, and nowhere else."""

    def __init__(self, low: list[float], high: list[float]) -> None:
        super().__init__([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        self.low, self.high = torch.tensor(low).double(), torch.tensor(high).double()

    def drift(self, x: Tensor) -> Tensor:
        inside = ((x >= self.low) & (x <= self.high)).all(-1, keepdim=True)
        return torch.where(inside, super().drift(x), 0.0)


def test_degrees_are_looked_for_within_the_box() -> None:
    low, high = [-1.0, -0.5], [2.0, 3.0]
    guard = adp.BoxFilter(lambda s: s[..., :1], systems.Barrier(Inside(low, high), low, high), dt=0.1)
    assert guard.degree == [2, 2, 1, 1]


def test_a_coordinate_that_the_input_moves_keeps_half_of_its_distance() -> None:
    box = systems.Barrier(MASS, [None, -1.0], [None, 2.0])
    guard = adp.BoxFilter(lambda s: 40.0 * torch.sign(s[..., :1]), box, dt=HOLD)
    assert guard.degree == [1, 1]
    x = torch.stack((uniform(30, seed=1), uniform(30, low=-0.9, high=1.9, seed=2)), dim=-1)
    found = guard(box.transform(x))[:, 0]
    up, down = 0.5 * (2 - x[:, 1]) / HOLD, -0.5 * (x[:, 1] + 1) / HOLD
    wanted = 40.0 * torch.sign(box.transform(x)[:, 0])
    torch.testing.assert_close(found, torch.minimum(torch.maximum(wanted, down), up), rtol=1e-6, atol=1e-6)
