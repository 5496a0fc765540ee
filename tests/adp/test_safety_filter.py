"""Control barrier functions of a held control: the program, where the filter acts, what it keeps."""

from __future__ import annotations

import copy
import math
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, deploy, systems
from staf_torch.adp.halfspaces import cases, nearest_admissible
from staf_torch.deploy.c_header import runner_c

LINE = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
PLANE = systems.Linear(
    np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(2)).tolist(), np.kron([[0.0], [1.0]], np.eye(2)).tolist()
)
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
COST4 = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2)


def wall(x: Tensor, t: Tensor) -> Tensor:
    return x[:, 0] + 0.1


def disc(x: Tensor, t: Tensor) -> Tensor:
    return (x[:, 0] - 1).square() + x[:, 1].square() - 0.25


def passing(x: Tensor, t: Tensor) -> Tensor:
    """A disc that moves, and is not there before 0.2 s."""
    return torch.where(t < 0.2, 10.0, (x[:, 0] - 0.5 * t).square() + (x[:, 1] - 0.8).square() - 0.09)


def dense(wanted: np.ndarray, rows: np.ndarray, least: np.ndarray) -> np.ndarray | None:
    """The nearest point by Lawson and Hanson's least distance programming; None where there is none."""
    from scipy.optimize import nnls

    matrix = np.vstack([rows.T, (least - rows @ wanted)[None]])
    right = np.zeros(len(matrix))
    right[-1] = 1.0
    left = matrix @ nnls(matrix, right, maxiter=1000)[0] - right
    return None if np.linalg.norm(left) < 1e-9 else wanted - left[:-1] / left[-1]


@pytest.mark.parametrize(("m", "k"), [(1, 1), (1, 3), (2, 1), (2, 2), (2, 3), (3, 2), (4, 1)])
def test_the_program_has_the_solution_of_a_dense_solver(m: int, k: int) -> None:
    generator = torch.Generator().manual_seed(10 * m + k)
    normals = torch.randn(60, k, m, dtype=torch.float64, generator=generator)
    wanted = 2 * torch.randn(60, m, dtype=torch.float64, generator=generator)
    least = 0.5 * torch.randn(60, k, dtype=torch.float64, generator=generator)
    low, high = -uniform(m, low=0.2, high=1.2, seed=m), uniform(m, low=0.2, high=1.2, seed=k)
    high[0] = torch.inf if m > 1 else high[0]
    found = nearest_admissible(wanted, normals, least, low, high, cases(k, low.tolist(), high.tolist()))
    bounded = torch.isfinite(high)
    limits = torch.cat((torch.eye(m).double(), -torch.eye(m).double()[bounded]))
    ends = torch.cat((low, -high[bounded]))
    solved = 0
    for row in range(60):
        rows, right = torch.cat((normals[row], limits)), torch.cat((least[row], ends))
        best = dense(wanted[row].numpy(), rows.numpy(), right.numpy())
        if best is None:
            assert float(found.shortfall[row]) > 1e-6
            continue
        solved += 1
        assert np.abs(best - found.point[row].numpy()).max() < 1e-8
        assert float(found.shortfall[row]) < 1e-8
    assert solved > 10


def test_where_nothing_fits_the_bounds_hold_and_the_squares_of_what_is_missing_are_least() -> None:
    low, high = tensor([-1.0, -1.0]), tensor([1.0, 1.0])
    normals, least = tensor([[[2.0, 0.0], [-1.0, 0.5]]]), tensor([[3.0, 2.0]])
    found = nearest_admissible(
        tensor([[0.3, 0.2]]), normals, least, low, high, cases(2, [-1.0] * 2, [1.0] * 2)
    )
    assert bool((found.point.abs() <= 1).all())
    unit, far = normals[0] / normals[0].norm(dim=-1, keepdim=True), least[0] / normals[0].norm(dim=-1)

    def missing(u: Tensor) -> Tensor:
        return (far - u @ unit.mT).clamp(min=0).square().sum(-1)

    assert float(missing(uniform(4000, 2, seed=1)).min()) > float(missing(found.point)[0]) - 1e-9
    assert float(found.shortfall) == pytest.approx(float((far - unit @ found.point[0]).max()), abs=1e-12)
    twice = nearest_admissible(
        tensor([[0.0]]),
        tensor([[[1.0], [-1.0]]]),
        tensor([[0.5, 0.1]]),
        low[:1],
        high[:1],
        cases(2, [-1.0], [1.0]),
    )
    assert float(twice.point) == pytest.approx(0.2)  # 0.3 is missing on either side
    assert float(twice.shortfall) == pytest.approx(0.3)


def test_too_many_cases_are_refused() -> None:
    with pytest.raises(
        ValueError, match="6 inequalities of 3 bounded unknowns have 1702 cases, more than 1000"
    ):
        cases(6, [-1.0] * 3, [1.0] * 3)


def test_far_from_the_edge_not_a_bit_changes_and_rows_are_alone() -> None:
    guard = adp.SafetyFilter(
        lambda x: -x[..., 2:], PLANE, [disc, passing], dt=0.01, low=[-1.0, -2.0], high=1.5
    )
    x, u = uniform(40, 4, seed=1, low=-2.0, high=2.0), uniform(40, 2, seed=2, low=-0.9, high=0.9)
    t = uniform(40, low=0.0, high=2.0, seed=3)
    found = guard.restrain(x, u, t)
    far = (found.margin > 2.5).all(-1)
    assert 5 < int(far.sum()) < 35
    assert torch.equal(found.control[far], u[far])
    assert bool((found.control[~far] != u[~far]).any())
    for row in (0, 7, 23):
        alone = guard.restrain(x[row : row + 1], u[row : row + 1], t[row : row + 1])
        assert all(torch.equal(a[0], b[row]) for a, b in zip(alone, found, strict=True))
    assert torch.equal(found.margin, guard.margins(x, t))
    assert guard.restrain(x[:4].reshape(2, 2, 4), u[:4].reshape(2, 2, 2), 0.3).slack.shape == (2, 2)


def test_the_condition_is_met_by_the_plant_that_is_held() -> None:
    """By a simulation of its own, and where it acts with equality."""
    guard = adp.SafetyFilter(lambda x: x[..., :1] * 0 - 3, LINE, wall, dt=0.05, decay=2.0)
    x = tensor([[0.4, -0.5], [0.0, -0.1], [1.0, -1.8], [3.0, 1.0]])
    u = guard(x)
    assert guard.degree == (2,)
    assert float(u[3]) == -3.0
    position, speed, h = x[:3, 0], x[:3, 1], 0.05
    before = speed + 2 * (position + 0.1)
    after = speed + h * u[:3, 0] + 2 * (position + h * speed + 0.5 * h * h * u[:3, 0] + 0.1)
    dip = (0.25 * h * h * u[:3, 0]).clamp(min=0)  # of phi below its chord, where phi'' = 2 u > 0
    kept = (1 - math.exp(-2 * h)) * dip
    torch.testing.assert_close(after - math.exp(-2 * h) * before, kept, rtol=5e-3, atol=1e-9)


def test_a_wall_is_never_crossed_and_a_larger_margin_keeps_farther_away() -> None:
    x0 = torch.stack(
        (uniform(30, low=0.2, high=2.0, seed=4), uniform(30, low=-0.2, high=1.0, seed=5)), dim=-1
    )
    least = []
    for margin in (0.0, 0.05):
        guard = adp.SafetyFilter(lambda x: 0 * x[..., :1] - 3, LINE, wall, dt=0.1, decay=4.0, margin=margin)
        run = adp.simulate(guard, LINE, COST, x0, steps=10, compile=False)
        report = guard.report(run)
        assert report["constraint_violations"] == 0
        assert report["infeasible"] == []
        assert report["minimum_margin"] >= margin
        assert report["minimum_margin"] == pytest.approx(
            float(guard.margins(run.state, 0.0).min()), abs=1e-12
        )
        least.append(guard.margins(run.state[:, -1], 0.0)[:, 0])
    assert bool((least[0] < least[1]).all())


def test_discs_that_move_and_appear_are_avoided_within_the_bounds() -> None:
    lqr = adp.LQR(PLANE, COST4)
    guard = adp.SafetyFilter(lqr, PLANE, [disc, passing], dt=0.1, low=-1.0, high=1.0)
    assert guard.degree == (2, 2)
    assert guard.moving
    x0 = tensor([[2.0, 0.5, 0.0, 0.0], [1.5, -0.9, 0.0, 0.0]])
    run = adp.simulate(guard, PLANE, COST4, x0, steps=15, every=5, compile=False)
    report = guard.report(run)
    assert report["minimum_margin"] > 0
    assert 0 < report["acted"] < 1
    assert float(run.control[:, :-1].abs().max()) <= 1
    bare = adp.simulate(adp.Feedback(lqr), PLANE, COST4, x0, dt=0.1, steps=15, every=5, compile=False)
    assert float(guard.margins(bare.state, bare.time).min()) < 0
    assert "filtered" in guard.label


def test_rows_that_cannot_be_kept_are_named() -> None:
    guard = adp.SafetyFilter(lambda x: -x[..., 1:], LINE, wall, dt=0.05, low=-1.0, high=1.0)
    x0 = tensor([[1.0, 0.0], [0.0, -2.0], [2.0, 0.0]])
    run = adp.simulate(guard, LINE, COST, x0, steps=8, compile=False)
    report = guard.report(run)
    assert report["infeasible"] == [1]
    assert report["constraint_violations"] == 1
    assert report["minimum_margin"] < 0 < report["largest_slack"]
    assert float(run.control[1, 0]) == 1.0  # as much as there is


def test_degree_one_time_and_a_barrier_plant() -> None:
    slow = adp.SafetyFilter(lambda x: 0 * x[..., :1], LINE, lambda x, t: 0.5 - x[:, 1] + 0.1 * t, dt=0.01)
    assert slow.degree == (1,)
    with pytest.raises(ValueError, match=r"`SafetyFilter\(t=...\)` must be given"):
        slow(tensor([0.0, 0.4]))
    u = slow.restrain(tensor([0.0, 0.6]), tensor([5.0]), 2.0).control  # 0.1 below the wall, which flees
    assert float(u) == pytest.approx((1 - math.exp(-0.02)) / 0.01 * 0.1 + 0.1, rel=1e-6)
    box = systems.Barrier(LINE, [-1.0, None], [1.0, None])
    guard = adp.SafetyFilter(lambda s: 0 * s[..., :1] + 9.0, box, lambda s, t: 1 - s[:, 0], dt=0.1)
    assert guard.degree == (2,)
    run = adp.simulate(guard, box, COST, tensor([[0.0, 0.0]]), steps=8, compile=False)
    assert guard.report(run)["minimum_margin"] > 0
    assert guard.report(run)["acted"] > 0.4


def test_policies_of_all_kinds_stand_behind_it() -> None:
    x0 = tensor([[1.0, -0.3], [0.4, 0.0]])
    learner = adp.ActorCritic(adp.QuadraticBasis(2), LINE, COST, adp.RandomPoints(1, half_width=0.5))
    near = adp.near_optimal(LINE, COST, dt=0.05, low=-2.0, high=2.0)
    for policy in (
        adp.RolloutPolicy.of_lqr(LINE, COST),
        near,
        learner,
        adp.Supervised(learner, adp.LQR(LINE, COST), COST),
    ):
        guard = adp.SafetyFilter(policy, LINE, wall, dt=0.05)
        run = adp.simulate(guard, LINE, COST, x0, steps=2, compile=False)
        assert not bool(run.diverged.any())
        assert guard.report(run)["minimum_margin"] > 0
    with pytest.raises(ValueError, match="must be a function of x to be asked at x"):
        adp.SafetyFilter(learner, LINE, wall, dt=0.05)(x0)
    with pytest.raises(ValueError, match=r"must be that of the loop, 0\.1 s; got 0\.05"):
        adp.simulate(guard, LINE, COST, x0, dt=0.1, steps=1)


def test_weights_say_which_input_shall_move() -> None:
    def both(x: Tensor, t: Tensor) -> Tensor:
        return 1 - x[:, 2] - x[:, 3]

    x, want = tensor([0.0, 0.0, 0.5, 0.5]), tensor([1.0, 1.0])
    even = adp.SafetyFilter(lambda x: x, PLANE, both, dt=0.01).restrain(x, want).control
    dear = adp.SafetyFilter(lambda x: x, PLANE, both, dt=0.01, weight=[1e6, 1.0]).restrain(x, want).control
    torch.testing.assert_close(even, tensor([0.0, 0.0]), rtol=0, atol=1e-9)
    torch.testing.assert_close(dear, tensor([1.0, -1.0]), rtol=0, atol=1e-5)


@pytest.mark.needs_compiler
def test_in_c_it_is_the_same(tmp_path: Path) -> None:
    guard = adp.SafetyFilter(adp.LQR(PLANE, COST4), PLANE, [passing], dt=0.05, low=-1.0, high=1.0)
    policy = deploy.policy_of(guard)
    z = torch.cat((uniform(30, 4, seed=8), uniform(30, 1, low=0.0, high=1.0, seed=9)), dim=-1)
    deploy.export_c(policy, z[:1], tmp_path / "guard.h", ["control"])
    (control,) = runner_c(tmp_path / "guard.h", [2], torch.float64)(z)
    torch.testing.assert_close(control, policy(z), rtol=0, atol=1e-9)
    torch.testing.assert_close(policy(z), guard(z[:, :4], z[:, 4]))
    assert bool((control != guard.bounds.clip(adp.LQR(PLANE, COST4)(z[:, :4]))).any())


def test_a_copy_a_pickle_and_single_precision_are_the_same_filter() -> None:
    guard = adp.SafetyFilter(adp.LQR(LINE, COST), LINE, wall, dt=0.05)
    x = tensor([[0.3, -0.5], [1.0, 0.0]])
    for other in (copy.deepcopy(guard), pickle.loads(pickle.dumps(guard))):
        assert torch.equal(other(x), guard(x))
    single = guard(x.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), guard(x), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"plant": systems.StepPlant(lambda x, u: x + u, dim=1, inputs=1, dt=0.1)},
            "must be in continuous time",
        ),
        ({"constraints": []}, r"must be h\(x, t\) or a list of them"),
        ({"constraints": lambda x, t: x}, r"must map \(3, n\) to \(3,\), number 0; got \(3, 2\)"),
        (
            {"constraints": lambda x, t: 1 + 0 * x[:, 0]},
            "moves neither first nor second derivative of number 0",
        ),
        (
            {"decay": [200.0], "degree": 2},
            r"must be at most 1/dt = 100 where the relative degree is two; got",
        ),
        ({"decay": [1.0, 2.0]}, "must be one number or a list of 1"),
        ({"decay": 0.0}, r"`SafetyFilter\(decay=...\)` must be positive"),
        ({"margin": -1.0}, r"`SafetyFilter\(margin=...\)` must not be negative"),
        ({"weight": [1.0, 1.0]}, "must be one number or a list of 1"),
        ({"degree": 3}, "must be 1 or 2, one a constraint"),
        ({"dt": 0.0}, r"`SafetyFilter\(dt=...\)` must be positive"),
    ],
)
def test_what_breaks_a_rule_is_refused(given: dict[str, object], message: str) -> None:
    usual: dict[str, object] = {"policy": lambda x: x, "plant": LINE, "constraints": wall, "dt": 0.01}
    with pytest.raises(ValueError, match=message):
        adp.SafetyFilter(**{**usual, **given})  # type: ignore[arg-type]


@pytest.mark.parametrize(("stated", "most"), [({}, 0.3), ({"low": -0.2, "high": 0.2}, 0.2)])
def test_bounds_of_the_plant_hold_where_the_filter_states_none(stated: dict[str, float], most: float) -> None:
    plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    plant.bounds = systems.Bounds(-0.3, 0.3, 1)
    shield = adp.SafetyFilter(lambda x: 5.0 + 0 * x[..., :1], plant, wall, dt=0.01, **stated)
    assert shield(tensor([[1.0, 0.0]])).tolist() == [[most]]


class Turning(systems.ControlAffineSystem):
    """(p, angle)' = (v cos, v sin, w): what v moves changes within a hold as w turns it."""

    dim, inputs = 3, 2

    def drift(self, x: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def effectiveness(self, x: Tensor) -> Tensor:
        none, one = torch.zeros_like(x[..., 0]), torch.ones_like(x[..., 0])
        rows = (x[..., 2].cos(), none), (x[..., 2].sin(), none), (none, one)
        return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


@pytest.mark.parametrize("decay", [9.0, 60.0])
def test_a_condition_that_bends_is_met_or_the_slack_says_so(decay: float) -> None:
    """A unicycle turns by half a radian within a hold: no line is like its condition."""
    shield = adp.SafetyFilter(
        lambda x: x[..., :2], Turning(), disc, dt=0.1, low=[-1, -5], high=[1, 5], decay=decay, degree=1
    )
    x, angle = uniform(4000, 3, low=-1.0, high=1.0, seed=7), uniform(4000, low=0.0, high=6.28, seed=8)
    x[:, 0], x[:, 1] = (
        1 + (0.5 + 0.1 * x[:, 0].abs()) * angle.cos(),
        (0.5 + 0.1 * x[:, 1].abs()) * angle.sin(),
    )
    x = torch.cat((x[:, :2], 3.14 * x[:, 2:]), dim=-1)
    x = x[disc(x, tensor(0.0)) >= 0]
    wanted = uniform(len(x), 2, low=-1.0, high=1.0, seed=9) * tensor([1.0, 5.0])
    found = shield.restrain(x, wanted)

    def after(u: Tensor) -> tuple[Tensor, Tensor]:
        halves = [x]
        for _ in range(2):
            halves.append(
                systems.runge_kutta_step(lambda z: shield.plant.motion(z, u), halves[-1], 0.5 * shield.hold)
            )
        now, middle, end = (disc(each, tensor(0.0)) for each in halves)
        dip = (0.5 * (now + end) - middle).clamp(min=0)
        return end, dip + math.exp(-decay * shield.hold) * (now - dip)

    end, required = after(wanted)
    asked = (required - end).clamp(min=0)
    end, required = after(found.control)
    missing = (required - end).clamp(min=0)
    assert int((asked > 0).sum()) > 300
    met = found.slack < 1e-9
    assert bool((missing[met] <= 2e-6 * asked[met] + 1e-12).all())
    assert bool((missing[~met] > 0).all())
    assert float(met.double().mean()) > 0.9


@pytest.mark.parametrize("seed", range(4))
def test_of_two_inputs_the_squares_of_what_is_missing_are_least_wherever_nothing_fits(seed: int) -> None:
    normals, least = uniform(200, 3, 2, seed=seed), uniform(200, 3, seed=seed + 10, low=0.2, high=1.5)
    wanted, low, high = uniform(200, 2, seed=seed + 20), tensor([-0.8, -torch.inf]), tensor([torch.inf, 0.9])
    found = nearest_admissible(wanted, normals, least, low, high, cases(3, low.tolist(), high.tolist()))
    length = normals.norm(dim=-1)

    def missing(u: Tensor) -> Tensor:
        short = least / length - (normals / length.unsqueeze(-1) * u.unsqueeze(-2)).sum(-1)
        return short.clamp(min=0).square().sum(-1)

    none = found.shortfall > 1e-6
    assert 20 < int(none.sum()) < 200
    for size in (1e-3, 0.1, 2.0):
        for turn in range(60):
            other = found.point + size * uniform(200, 2, seed=100 + turn)
            other = torch.minimum(torch.maximum(other, low), high)
            assert bool((missing(other) >= missing(found.point) - 1e-8)[none].all())


def test_a_condition_that_no_control_moves_leaves_a_finite_slack_and_the_others_kept() -> None:
    still = systems.Linear([[0.0, 0.0], [0.0, 0.0]], [[0.0], [1.0]])  # x1 moves by nothing

    def both(x: Tensor, t: Tensor) -> Tensor:
        return torch.stack((0.5 - x[:, 0], 0.4 - x[:, 1]), dim=-1)

    def first(x: Tensor, t: Tensor) -> Tensor:
        return 0.5 - x[:, 0]

    def second(x: Tensor, t: Tensor) -> Tensor:
        return 0.4 - x[:, 1]

    guard = adp.SafetyFilter(
        adp.Feedback(lambda x: torch.ones_like(x[..., :1])),
        still,
        [first, second],
        dt=0.1,
        decay=1.0,
        degree=1,
    )
    x = tensor([[0.7, 0.39], [0.2, 0.39], [0.7, 0.0]])
    u, margin, slack = guard._definition(torch.cat((x, torch.ones(3, 1).double(), x[:, :1] * 0), -1)).split(
        [1, 2, 1], -1
    )
    assert bool(torch.isfinite(slack).all())
    torch.testing.assert_close(margin, both(x, x[:, 0]))
    assert (
        float((second(x + 0.1 * torch.cat((0 * u, u), -1), x[:, 0]) - 0.9 * second(x, x[:, 0])).min()) > -1e-9
    )


def test_who_rests_on_the_edge_violates_nothing() -> None:
    guard = adp.SafetyFilter(adp.Feedback(lambda x: 0 * x[..., :1]), LINE, lambda x, t: x[:, 0], dt=0.1)
    x0 = tensor([[0.0, 0.0], [1.0, 0.0]])
    run = adp.simulate(guard, LINE, COST, x0, dt=0.1, steps=3, compile=False)
    report = guard.report(run)
    assert report["minimum_margin"] == 0
    assert report["constraint_violations"] == 0


@pytest.mark.parametrize("m", [1, 2, 3])
def test_in_plain_torch_too_no_row_knows_what_the_others_are(m: int) -> None:
    normals, wanted, least = uniform(6, 2, m, seed=1), 2 * uniform(6, m, seed=2), uniform(6, 2, seed=3)
    wanted[2], least[3], normals[4], least[5] = 1e12, 1e12, 1e-9 * normals[4], 5.0  # the last: none fits
    low, high = torch.full((m,), -0.7, dtype=torch.float64), torch.full((m,), 0.9, dtype=torch.float64)
    table = cases(2, low.tolist(), high.tolist())
    together = nearest_admissible(wanted, normals, least, low, high, table)
    for k in range(6):
        rows = slice(k, k + 1)
        alone = nearest_admissible(wanted[rows], normals[rows], least[rows], low, high, table)
        torch.testing.assert_close(alone.point, together.point[rows], rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(alone.shortfall, together.shortfall[rows], rtol=1e-9, atol=1e-12)
