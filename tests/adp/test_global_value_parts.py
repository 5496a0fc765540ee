"""A memory of a global value by parts: its tables, what arrives, what is searched, followed and chosen."""

from __future__ import annotations

import math
import pickle
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from helpers_plans import pushed
from torch import Tensor

from staf_torch import adp, deploy
from staf_torch.adp import global_value
from staf_torch.adp.plans import Trajectories

N, M, STEPS, AHEAD = 2, 2, 5, 3
LENGTH = STEPS + AHEAD + 1
PROBLEM = adp.SampledProblem(pushed, dim=2, inputs=2, low=[-1.0, -0.5], high=[0.5, 0.7], periodic=[0])


def symmetric(a: Tensor) -> Tensor:
    return 0.5 * (a + a.mT)


def library(values: Tensor | None = None) -> Trajectories:
    """Five trajectories that nobody optimised; the second does not arrive and the fourth is not finite."""
    if values is None:
        values = torch.linspace(1, 0, STEPS + 1, dtype=torch.float64) * tensor(
            [[3.0], [2.0], [4.0], [math.inf], [5.0]]
        )
        values = torch.where(torch.isnan(values), torch.inf, values)
        values[1, -1] = 1.0
    rows = len(values)
    state = (
        tensor([2.0, 0.6])
        * uniform(rows, STEPS + 1, N, seed=1)
        * torch.linspace(1, 0.1, STEPS + 1).double()[:, None]
    )
    state[4:] = state[4:] + tensor([2 * math.pi, 0.0])  # ends a turn further on
    return Trajectories(
        state,
        0.4 * uniform(rows, STEPS, M, seed=2),
        0.3 * uniform(rows, STEPS, M, N, seed=3),
        values,
        uniform(rows, STEPS + 1, N, seed=4),
        symmetric(uniform(rows, STEPS + 1, N, N, seed=5)) + 2 * torch.eye(N),
        torch.ones(rows) > 0,
    )


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> adp.GlobalValue:
    program = global_value.Program
    monkeypatch.setattr(global_value, "Program", lambda step, **given: program(step, compile=False, **given))
    region: Any = tensor([3.0, 1.0])
    return adp.GlobalValue(PROBLEM, library(), region, candidates=4, lookahead=AHEAD, spacing=0.05)


def goal_of(row: int) -> Tensor:
    return tensor([2 * math.pi if row == 4 else 0.0, 0.0])


def test_rows_of_the_tables_are_the_library_and_then_the_goal(known: adp.GlobalValue) -> None:
    made = library()
    assert known.length == LENGTH
    assert known.plans.shape == (5 * LENGTH, N + M + M * N)
    assert known.models.shape == (5 * LENGTH, N + 1 + N + N * N)
    for row in range(5):
        for k in range(LENGTH):
            plan, model = known.plans[row * LENGTH + k], known.models[row * LENGTH + k]
            if k < STEPS:
                parts = made.state[row, k], made.control[row, k], made.feedback[row, k].flatten()
                left = made.state[row, k], made.value[row, k : k + 1], made.gradient[row, k]
                bent = made.curvature[row, k].flatten()
            else:
                parts = goal_of(row), torch.zeros(M).double(), -PROBLEM.k.flatten()
                left = goal_of(row), torch.zeros(1).double(), torch.zeros(N).double()
                bent = 2 * PROBLEM.p.flatten()
            torch.testing.assert_close(plan, torch.cat(parts), rtol=0, atol=1e-12)
            torch.testing.assert_close(model, torch.cat((*left, bent)), rtol=0, atol=1e-12)
    assert known.arrives.tolist() == [True, False, True, False, True]
    assert {entry // LENGTH for entry in known.entries.tolist()} == {0, 2, 4}
    assert max(entry % LENGTH for entry in known.entries.tolist()) < STEPS
    assert known.resting == LENGTH - AHEAD - 1
    assert known.worst == 5.0
    images = known.images()
    turned = known.plans[known.entries, :N].clone()
    turned[:, 0] = torch.remainder(turned[:, 0] + math.pi, 2 * math.pi) - math.pi
    away = turned.clone()
    away[:, 0] -= 2 * math.pi * turned[:, 0].sign()
    torch.testing.assert_close(images, torch.cat((turned, away)) @ known.frame)


def test_what_leaves_more_than_a_hundredth_has_not_arrived() -> None:
    values = torch.zeros(4, STEPS + 1).double()
    values[:, 0] = tensor([1.0, 1.0, 100.0, 100.0])
    values[:, -1] = tensor([0.01 + 0.9e-9, 0.01 + 1.2e-9, 1.0, 1.01])
    found = adp.GlobalValue(PROBLEM, library(values), [3.0, 1.0], lookahead=AHEAD)
    assert found.arrives.tolist() == [True, False, True, False]
    assert found.candidates == min(48, len(found.entries))
    assert (found.spacing, found.lookahead) == (0.02, AHEAD)
    assert adp.GlobalValue(PROBLEM, library(values), [3.0, 1.0]).lookahead == 60
    with pytest.raises(ValueError, match=r"candidates=...\)` must be at least 1"):
        adp.GlobalValue(PROBLEM, library(values), [3.0, 1.0], candidates=0)
    with pytest.raises(ValueError, match=r"lookahead=...\)` must be at least 1"):
        adp.GlobalValue(PROBLEM, library(values), [3.0, 1.0], lookahead=0)


def followed(known: adp.GlobalValue, x: Tensor, entry: int) -> tuple[float, Tensor, bool]:
    """What a remembered plan costs from x (n,), its first control, and whether it ends near its end."""

    def control(x: Tensor, row: Tensor) -> Tensor:
        u = row[N : N + M] + row[N + M :].view(M, N) @ (x - row[:N])
        return torch.minimum(torch.maximum(u, PROBLEM.bounds.low), PROBLEM.bounds.high)

    first = known.plans[entry]
    x = x.clone()
    x[0] = first[0] + torch.remainder(x[0] - first[0] + math.pi, 2 * math.pi) - math.pi
    u, paid = control(x, first), 0.0
    for k in range(AHEAD):
        x, now = pushed(x, control(x, known.plans[entry + k]))
        paid += float(now)
    model = known.models[entry + AHEAD]
    d, value, bent = x - model[:N], float(model[N]), model[2 * N + 1 :].view(N, N)
    far = float((d / known.region).square().sum())
    if far >= 0.09:
        return paid + value + known.worst * (1 + far), u, False
    return paid + value + float(model[N + 1 : 2 * N + 1] @ d + 0.5 * d @ bent @ d), u, True


def test_the_cheapest_of_the_nearest_plans_is_followed(
    known: adp.GlobalValue, monkeypatch: pytest.MonkeyPatch
) -> None:
    x = tensor([3.0, 0.9]) * uniform(6, N, seed=7)
    x[3] += tensor([2 * math.pi, 0.0])
    entries, whole = known.nearest(x), known.choose(x)
    assert entries.shape == (6, 5)
    cost, control, covered = known.follow(x, entries)
    for row in range(6):
        several = [followed(known, x[row], int(entry)) for entry in entries[row]]
        assert cost[row].tolist() == pytest.approx([one[0] for one in several])
        assert covered[row].tolist() == [one[2] for one in several]
        best = min(range(5), key=lambda k: several[k][0])
        assert float(whole.value[row]) == pytest.approx(several[best][0])
        torch.testing.assert_close(whole.control[row], several[best][1])
        torch.testing.assert_close(control[row, best], several[best][1])
        assert int(whole.entry[row]) == int(entries[row, best])
        assert bool(whole.covered[row]) == several[best][2]
    monkeypatch.setattr(global_value, "_TOGETHER", 11)  # two rows of five candidates at once
    for mine, other in zip(known.follow(x, entries), (cost, control, covered), strict=True):
        assert torch.equal(mine, other)
    torch.testing.assert_close(known.value(x.view(2, 3, 2)), whole.value.view(2, 3))
    torch.testing.assert_close(known(x.view(2, 3, 2)), whole.control.view(2, 3, 2))
    for row in range(6):
        torch.testing.assert_close(known(x[row]), whole.control[row])
        torch.testing.assert_close(known(x[row : row + 1]), whole.control[row : row + 1])
    model = known.models[whole.entry]
    d = x - model[:, :N]
    d[:, 0] = torch.remainder(d[:, 0] + math.pi, 2 * math.pi) - math.pi
    bent = model[:, 2 * N + 1 :].view(-1, N, N)
    wanted = model[:, N + 1 : 2 * N + 1] + (bent @ d.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(known.gradient(x.view(2, 3, 2)), wanted.view(2, 3, 2))
    torch.testing.assert_close(known.model(x).value, model[:, N])
    levels = [whole.control, *(u.expand(6, 2) for u in PROBLEM.levels())]
    ahead = torch.stack([now + known.value(after) for after, now in (pushed(x, u) for u in levels)]).amin(0)
    torch.testing.assert_close(known.bellman_residual(x), (ahead - whole.value) / whole.value)


def test_what_is_exported_of_two_inputs_is_the_same(known: adp.GlobalValue) -> None:
    x = tensor([3.0, 0.9]) * uniform(6, N, seed=8)
    torch.testing.assert_close(deploy.policy_of(known)(x), known(x))


def test_far_is_what_costs_by_the_mean_of_the_curvatures_sizes(known: adp.GlobalValue) -> None:
    bent = known.models[known.entries, 2 * N + 1 :].view(-1, N, N) - 3 * torch.eye(N)  # some bend down
    known.models[known.entries, 2 * N + 1 :] = bent.flatten(1)
    scaled = bent * known.region[:, None] * known.region
    size = [torch.linalg.svd(one) for one in scaled]  # of a symmetric matrix: |H| = U S U'
    mean = torch.stack([u @ s.diag() @ u.mT for u, s, _ in size]).mean(0)
    mean = mean + 0.01 * mean.trace() / N * torch.eye(N)
    frame = known._frame()
    torch.testing.assert_close(frame @ frame.mT, mean / known.region[:, None] / known.region)
    x = uniform(3, N, seed=9)
    known.frame.copy_(frame)
    torch.testing.assert_close(known.seen(x).square().sum(-1), ((x @ frame @ frame.mT) * x).sum(-1))


def test_a_trajectory_that_must_not_help_is_no_candidate(known: adp.GlobalValue) -> None:
    x, own = known.library.state[[0, 2, 4], 1], torch.tensor([0, 2, 4])
    assert bool((known.nearest(x)[:, 0] // LENGTH == own).all())
    entries = known.nearest(x, own)
    assert entries.shape == (3, 5)
    assert bool((entries[:, :-1] // LENGTH != own[:, None]).all())
    assert bool((entries[:, -1] == known.resting).all())
    size = known.seen(x)
    for row in range(3):
        others = [e for e in known.entries.tolist() if e // LENGTH != int(own[row])]
        far = {e: float((known.seen(known.plans[e, :N]) - size[row]).norm()) for e in others}
        assert set(sorted(far, key=lambda e: far[e])[:1]) <= set(entries[row, :-1].tolist())
    known.candidates = 12
    near = known._rows[known._tree.query(size.numpy(), min(48, len(known._rows)))[1]]
    for row, entries in enumerate(known.nearest(x, own)[:, :-1].tolist()):  # the others, the nearest first
        assert entries == [e for e in near[row] if e // LENGTH != int(own[row])][:12]


def test_a_replayed_plan_ends_in_the_feedback_of_the_goal(known: adp.GlobalValue) -> None:
    x = tensor([[0.4 - 2 * math.pi, 0.1], [0.5, -0.2]])
    control, around = known.replay(x, torch.tensor([3, 4 * LENGTH + 1]), 12)
    for row, first in ((0, 3), (1, 4 * LENGTH + 1)):
        last = (first // LENGTH + 1) * LENGTH - 1
        rows = [min(first + k, last) for k in range(12)]
        assert torch.equal(control[row], known.plans[rows, N : N + M])
        assert torch.equal(around.feedback[row], known.plans[rows, N + M :].view(12, M, N))
        shift = around.state[row] - known.plans[rows, :N]
        turns = float(shift[0, 0]) / (2 * math.pi)
        assert turns == pytest.approx(round(turns), abs=1e-9)
        torch.testing.assert_close(shift, shift[:1].expand(12, N), rtol=0, atol=1e-9)
        assert abs(float(around.state[row, 0, 0] - x[row, 0])) <= math.pi


def test_a_memory_that_is_copied_answers_alike(known: adp.GlobalValue) -> None:
    x = tensor([3.0, 0.9]) * uniform(6, N, seed=7)
    assert torch.equal(pickle.loads(pickle.dumps(known))(x), known(x))
