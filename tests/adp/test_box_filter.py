"""A filter around a policy of barrier coordinates: what can be kept inside is, what cannot is said."""

from __future__ import annotations

import copy
import functools
import pickle

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
# Who brakes before the one wall comes to the other one: half of the program of four walls.
CORNER = systems.Barrier(CHAIN, low=[None, -5.0], high=[5.0, None])
OF_CORNER = adp.LQR(CORNER, COST)
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


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_what_can_be_kept_stays_inside_and_the_rest_is_named(dtype: torch.dtype) -> None:
    s0 = BOX.transform(beside_the_walls(40)).to(dtype)
    guard = adp.BoxFilter(OF_S, BOX, dt=DT)
    run = adp.simulate(adp.Feedback(guard), BOX, COST, s0, steps=2, substeps=16, compile=False)
    kept = can_be_kept(40)
    assert 10 < int(kept.sum()) < 30
    assert torch.equal(guard.share(s0) < 1, kept)
    assert torch.equal(~run.diverged, kept)
    if dtype == torch.float64:  # whatever is wanted
        idle = adp.BoxFilter(lambda s: torch.zeros_like(s[..., :1]), BOX, dt=DT)
        assert torch.equal(idle.share(s0) < 1, kept)
    bare = adp.simulate(adp.Feedback(OF_S), BOX, COST, s0, dt=DT, steps=2, substeps=16, compile=False)
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


@pytest.mark.parametrize("wrong", [(4, 2), (0, 2), 0, (1, 2.5)])
def test_fewer_substeps_at_most_than_at_least_are_refused(wrong: object) -> None:
    with pytest.raises(ValueError, match=r"`simulate\(substeps=...\)` must be"):
        adp.simulate(adp.Feedback(OF_S), BOX, COST, tensor([[0.0, 0.0]]), dt=DT, steps=1, substeps=wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_way_that_is_a_line_has_slopes(dtype: torch.dtype) -> None:
    # With the control that is wanted x1 goes straight to its wall: in float32 the cubic is a line.
    s = BOX.transform(tensor([[4.999999, 3.4938383727974553]])).to(dtype)
    guard = adp.BoxFilter(OF_S, BOX, dt=DT, renewed=True)
    hold = guard.hold(s)
    normal, least = guard.inequalities(s, OF_S(s), hold, torch.full_like(hold, 0.5))
    assert bool(torch.isfinite(normal).all())
    assert bool(torch.isfinite(least).all())
    assert float(guard(s)) == pytest.approx(-2.103e7, rel=1e-3)  # v^2/d, by v = 3.49 and d = 5e-7


@pytest.mark.compiled
def test_compiled_it_keeps_the_same_starts() -> None:
    s0 = CORNER.transform(beside_the_walls(40))[beside_the_walls(40)[:, 0] > 0]
    guard = adp.BoxFilter(OF_CORNER, CORNER, dt=DT)
    run = adp.simulate(adp.Feedback(guard), CORNER, COST, s0, steps=4, substeps=16, compile=True)
    assert torch.equal(run.diverged, guard.share(s0) >= 1)
    assert 5 < int(run.diverged.sum()) < len(s0) - 5


def test_where_no_wall_is_near_not_a_bit_changes_and_rows_are_alone() -> None:
    x = torch.stack((uniform(40, low=-6, high=4, seed=2), uniform(40, low=-4, high=6, seed=3)), dim=-1)
    s = BOX.transform(x)
    guard = adp.BoxFilter(OF_S, BOX, dt=DT)
    assert torch.equal(guard(s), OF_S(s))
    near = BOX.transform(beside_the_walls(8))
    mixed = guard(torch.cat((near, s)))
    assert torch.equal(mixed[:8], guard(near))
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
    bare = adp.simulate(adp.Feedback(lqr), box, cost, s0, dt=DT, steps=1, substeps=4, compile=False)
    assert bare.diverged.tolist() == [True, False]


def test_bounds_hold_where_they_and_the_walls_contradict_each_other() -> None:
    class Weak(systems.TwoStateChain):
        bounds = systems.Bounds(-40.0, 40.0, 1)

    box = systems.Barrier(Weak(), low=[-7.0, -5.0], high=[5.0, 7.0])
    guard = adp.BoxFilter(OF_S, box, dt=DT)
    s = box.transform(tensor([[4.999, 3.0], [4.999, 0.01]]))
    assert float(guard(s)[0]) == -40.0
    assert (guard.share(s) < 1).tolist() == [False, True]


def test_copies_and_pickles_are_the_same_filter() -> None:
    guard = adp.BoxFilter(OF_S, BOX, dt=DT)
    s = BOX.transform(beside_the_walls(4))
    u = guard(s)
    for other in (copy.deepcopy(guard), pickle.loads(pickle.dumps(guard))):
        assert torch.equal(other(s), u)


def test_what_breaks_a_rule_is_refused() -> None:
    with pytest.raises(ValueError, match=r"`BoxFilter\(box=...\)` must be a systems.Barrier"):
        adp.BoxFilter(OF_S, CHAIN, dt=DT)  # type: ignore[arg-type]
    for wrong in (0.0, -1.0):
        with pytest.raises(ValueError, match=r"`BoxFilter\(dt=...\)` must be positive"):
            adp.BoxFilter(OF_S, BOX, dt=wrong)
    with pytest.raises(ValueError, match=r"`BoxFilter\(box=...\)` must have a wall"):
        adp.BoxFilter(OF_S, systems.Barrier(CHAIN, None, None), dt=DT)
    three = systems.Linear([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0] * 3], [[0.0], [0.0], [1.0]])
    far = systems.Barrier(three, [-1.0, None, None], None)
    with pytest.raises(ValueError, match="move every walled coordinate or its speed; not so coordinate 0"):
        adp.BoxFilter(lambda s: s[..., :1], far, dt=DT)
    walk = adp.SafetyFilter(lambda x: x[..., 1:], CHAIN, lambda x, t: 5 - x[:, 0], dt=DT)
    with pytest.raises(ValueError, match=r"`ClosedLoop\(renew=...\)` needs a feedback law"):
        adp.simulate(walk, CHAIN, COST, tensor([[0.0, 0.0]]), steps=1, substeps=2, renew=True)
