"""The memory of local models: near the optimum of the pendulum's swing-up, and what it says about itself."""

from __future__ import annotations

import logging
import math
import pickle
import re

import pytest
import torch
from helpers import tensor, uniform
from helpers_plans import pushed
from helpers_swingup import GRID, REGION, RESETS, double_integrator
from torch import Tensor

from staf_torch import adp, deploy
from staf_torch.adp.planning.global_value_learning import best_from, swept
from staf_torch.adp.planning.trajectories import Trajectories, rows_of


def test_swing_up_costs_what_dynamic_programming_costs_and_what_its_value_says(
    memory: adp.GlobalValue,
) -> None:
    spent, x, found = 0.0, RESETS, memory.choose(RESETS)
    for _ in range(200):
        x, paid = memory.problem.advance(x, memory(x))
        spent = spent + paid
    assert float(spent.mean() / GRID.mean()) < 1.01
    assert float(memory.problem.terminal(x).max()) < 1e-3
    assert bool(found.covered.all())
    assert float((found.value / spent).log().abs().median()) < 1e-3
    assert float(memory.bellman_residual(RESETS).abs().median()) < 1e-3
    near = tensor([[0.01, -0.02]])
    torch.testing.assert_close(memory(near), memory.problem.linear_feedback(near), rtol=1e-2, atol=1e-3)


def test_gradient_is_the_slope_of_the_value(memory: adp.GlobalValue) -> None:
    library = rows_of(memory.library, memory.library.converged & memory.arrives)
    x, h = library.state[library.cost.argsort()[[10, 30]], 3], 1e-5
    for i, e in enumerate(h * torch.eye(2, dtype=torch.float64)):
        rise = (memory.value(x + e) - memory.value(x - e)) / (2 * h)
        torch.testing.assert_close(memory.gradient(x)[:, i], rise, rtol=1e-2, atol=1e-2)


# A memory of plans that nobody optimised, row by row ----------------------------------------------------

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


@pytest.fixture(scope="module")
def known() -> adp.GlobalValue:
    """A memory of plans that nobody optimised."""
    return adp.GlobalValue(
        PROBLEM, library(), tensor([3.0, 1.0]), candidates=4, lookahead=AHEAD, spacing=0.05
    )


def test_what_leaves_more_than_a_hundredth_has_not_arrived() -> None:
    values = torch.zeros(4, STEPS + 1).double()
    values[:, 0] = tensor([1.0, 1.0, 100.0, 100.0])
    values[:, -1] = tensor([0.01 + 0.9e-9, 0.01 + 1.2e-9, 1.0, 1.01])
    found = adp.GlobalValue(PROBLEM, library(values), [3.0, 1.0], lookahead=AHEAD)
    assert found.arrives.tolist() == [True, False, True, False]
    with pytest.raises(ValueError, match="must have a trajectory that arrives"):
        adp.GlobalValue(PROBLEM, library(torch.full_like(values, torch.inf)), [3.0, 1.0])


def followed(known: adp.GlobalValue, x: Tensor, entry: int) -> tuple[float, Tensor, bool]:
    """What a remembered plan costs from x (n,), its first control, and whether it ends near its end."""

    def apart(x: Tensor, y: Tensor) -> Tensor:
        away = x - y
        angle = torch.remainder(away[:1] + math.pi, 2 * math.pi) - math.pi
        return torch.cat((angle, away[1:]))

    def control(x: Tensor, row: Tensor) -> Tensor:
        u = row[N : N + M] + row[N + M :].view(M, N) @ apart(x, row[:N])
        return torch.minimum(torch.maximum(u, PROBLEM.bounds.low), PROBLEM.bounds.high)

    first = known.plans[entry]
    x = first[:N] + apart(x, first[:N])
    u, paid = control(x, first), 0.0
    for k in range(AHEAD):
        x, now = pushed(x, control(x, known.plans[entry + k]))
        paid += float(now)
    model = known.models[entry + AHEAD]
    d, value, bent = apart(x, model[:N]), float(model[N]), model[2 * N + 1 :].view(N, N)
    far = float((d / known.region).square().sum())
    if far >= 0.09:
        return paid + value + known.worst * (1 + far), u, False
    return paid + value + float(model[N + 1 : 2 * N + 1] @ d + 0.5 * d @ bent @ d), u, True


def test_a_row_without_numbers_has_no_control_and_leaves_the_others_theirs(known: adp.GlobalValue) -> None:
    x = tensor([3.0, 0.9]) * uniform(3, N, seed=8)
    healthy = known(x[[0, 2]])
    x[1, 0] = math.nan
    found = known(x)
    assert torch.equal(found[[0, 2]], healthy)
    assert bool(found[1].isnan().all())


def test_the_cheapest_of_the_nearest_plans_is_followed(known: adp.GlobalValue) -> None:
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
    sure = torch.where(whole.covered, whole.value, math.inf)
    torch.testing.assert_close(known.value(x.view(2, 3, 2)), sure.view(2, 3))
    torch.testing.assert_close(known(x.view(2, 3, 2)), whole.control.view(2, 3, 2))
    assert known(x[:0]).shape == (0, M)
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


def test_what_is_exported_of_two_inputs_and_what_is_pickled_is_the_same(known: adp.GlobalValue) -> None:
    x = tensor([3.0, 0.9]) * uniform(6, N, seed=8)
    torch.testing.assert_close(deploy.policy_of(known)(x), known(x))
    assert torch.equal(pickle.loads(pickle.dumps(known))(x), known(x))


def test_a_trajectory_that_must_not_help_is_no_candidate(known: adp.GlobalValue) -> None:
    x, own = known.library.state[[0, 2, 4], 1], torch.tensor([0, 2, 4])
    assert bool((known.nearest(x)[:, 0] // LENGTH == own).all())
    entries = known.nearest(x, own)
    assert entries.shape == (3, 5)
    assert bool((entries[:, :-1] // LENGTH != own[:, None]).all())
    assert bool((entries[:, -1] == known.resting).all())


def test_a_memory_grows_by_what_it_did_not_know_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    problem = double_integrator(-1.0, 1.0)

    def learned(seed: int, rounds: int) -> adp.GlobalValue:
        given = {"steps": 60, "trajectories": 3, "states": 4, "candidates": 7, "lookahead": 8}
        return adp.learn_global_value(problem, [2.0, 1.0], rounds=rounds, seed=seed, **given)

    with caplog.at_level(logging.INFO, "staf_torch.adp.planning.global_value_learning"):
        grown = learned(3, 2)
    said = [re.search(r"([0-9.]+) % of 4 fresh", record.getMessage()) for record in caplog.records]
    unknown = sum(4 - round(0.04 * float(share[1])) for share in said if share)
    assert len(said) == 2
    assert len(grown.library.cost) == 3 + unknown
    assert 0 < unknown < 8
    first = learned(3, 0)
    assert (len(first.library.cost), first.lookahead) == (3, 8)
    assert bool((first.library.state[:, 0].abs() <= tensor([2.0, 1.0])).all())
    torch.testing.assert_close(grown.library.state[:3, 0], first.library.state[:, 0])  # of the seed


def test_plans_that_a_memory_begins_from_are_never_worse_than_it_and_a_sweep_raises_no_cost(
    memory: adp.GlobalValue,
) -> None:
    search = adp.BoxDDP(memory.problem, steps=120, iterations=40, tolerance=1e-5)
    x = torch.cat((RESETS[:2], tensor([[3.0, 0.2]])))
    found = best_from(memory, search, x)
    assert bool((found.cost <= memory.choose(x).value * (1 + 1e-6)).all())
    torch.testing.assert_close(found.state[:, 0], x)
    torch.testing.assert_close(best_from(memory, search, x[2:3]).cost, found.cost[2:3], rtol=1e-9, atol=0)
    rough = adp.BoxDDP(memory.problem, steps=120, iterations=2).solve(memory.library.state[:6, 0])
    small = adp.GlobalValue(memory.problem, rough, REGION, candidates=8)
    better = swept(small, search)
    assert bool((better.cost <= rough.cost).all())
    assert bool((better.cost < 0.99 * rough.cost).any())
    torch.testing.assert_close(better.state[:, 0], rough.state[:, 0])
