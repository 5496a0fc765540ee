"""Box-constrained DDP by its parts: regularisation of a row, lengths of steps, a step of the recursion."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp
from staf_torch.adp import trajectory_optimisation
from staf_torch.adp.plans import LocalModel, Plan, Reference
from staf_torch.adp.sampled_problem import Derivatives
from staf_torch.adp.traced_search import TracedSearch
from staf_torch.adp.trajectory_optimisation import Found, Model, slopes_of_minimum

INF = math.inf


def waved(low: float | None = None, high: float | None = None) -> adp.SampledProblem:
    """Two states and two inputs, of which the cost bends down in places and the plant is not linear."""

    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        after = torch.stack(
            (
                x[..., 0] + 0.3 * x[..., 1],
                x[..., 1] + 0.3 * (x[..., 0].sin() + u[..., 0] + u[..., 1] * x[..., 0]),
            ),
            dim=-1,
        )
        waves = u.square() + 0.8 - 0.8 * (3 * u).cos()
        return after, 0.3 * (x.square().sum(-1) + waves.sum(-1))

    return adp.SampledProblem(step, dim=2, inputs=2, low=low, high=high)


PROBLEM = waved()
# A row: what its plan costs at first, and of each search: the cost it finds, what its model promises, and
# whether that had a minimum. The last entry is repeated.
Script = tuple[float, list[tuple[float, float, bool]]]
TOLERANCE = 2.0**-10
NO, SMALL = (2.0, 0.0, False), (9.0, 0.0, True)
DOWN = [(0.8 - 0.1 * k, -1.0, True) for k in range(4)]
SCRIPTS: list[Script] = [
    (INF, []),
    (1.0, [(1.0, -TOLERANCE, True)]),  # little is promised
    (1.0, [(1.0 - TOLERANCE, -1.0, False)]),  # little is gained
    (1.0, [(1.0, -1.0, True)]),  # nothing pays
    (1.0, [NO, NO, NO, NO, (0.9, -1.0, True), SMALL, *DOWN, SMALL]),  # little is promised by a stiff model
    (64.0, [(64.0 - 2 * k, -1.0, True) for k in range(1, 31)]),  # gains all the time
    (-1.0, [(-1.0, TOLERANCE, True)]),  # costs may be negative
    (1.0, [(0.9, -1.0, True), (0.9, -1.0, True)]),  # nothing pays after the first step
]


class Scripted(adp.BoxDDP):
    """A search whose steps are written down."""

    def __init__(self, **given: Any) -> None:
        super().__init__(PROBLEM, **{"steps": 3, "tolerance": TOLERANCE, "compile": False} | given)
        self.tried: dict[int, list[tuple[float, float]]] = {k: [] for k in range(len(SCRIPTS))}
        self.derived: list[list[int]] = []

    def _rollouts(self, x0: Tensor, *more: Any) -> Plan:
        cost = tensor([script[0] for script in SCRIPTS])
        state = x0[:, :1].unsqueeze(1).expand(-1, 4, 2).clone()
        return Plan(state, torch.zeros(len(x0), 3, 2).double(), cost, cost[:, None].expand(-1, 4).clone())

    def _derivatives(self, plan: Plan) -> Derivatives:
        self.derived.append(plan.state[:, 0, 0].int().tolist())
        mark = torch.stack((plan.state[:, 0, 0], plan.cost), dim=1)
        return Derivatives(mark, mark.clone(), mark.clone(), mark.clone())

    def _search(self, plan: Plan, known: Any, mu: Tensor, full: Tensor, terminal: LocalModel) -> Found:
        which = plan.state[:, 0, 0].int().tolist()
        for part in known:
            assert torch.equal(part, torch.stack((plan.state[:, 0, 0], plan.cost), dim=1))
        assert torch.equal(terminal.state[:, 0], plan.state[:, 0, 0])
        found = []
        for place, row in enumerate(which):
            steps = SCRIPTS[row][1]
            found.append(steps[min(len(self.tried[row]), len(steps) - 1)])
            self.tried[row].append((float(mu[place]), float(full[place])))
        cost = tensor([one[0] for one in found])
        new = Plan(plan.state, plan.control + 1, cost, plan.paid + 1)
        return Found(new, cost, tensor([one[1] for one in found]), torch.tensor([one[2] for one in found]))

    def _models(self, plan: Plan, converged: Tensor, terminal: LocalModel) -> Any:
        return plan, converged


def scripted(**given: Any) -> tuple[Scripted, Plan, list[bool]]:
    search = Scripted(**given)
    x = torch.arange(float(len(SCRIPTS))).double()[:, None].expand(-1, 2)
    control, still = torch.zeros(len(x), 3, 2).double(), x.unsqueeze(1).expand(-1, 3, -1)
    found: Any = search._solve(
        x,
        control,
        Reference(still, torch.zeros(len(x), 3, 2, 2).double()),
        LocalModel(x, x[:, 0], x, still[:, :2]),
    )
    return search, found[0], found[1].tolist()


def test_a_row_is_regularised_more_where_nothing_pays_and_less_where_a_step_does() -> None:
    search, plan, converged = scripted(iterations=28)
    assert converged == [False, True, True, False, True, False, True, False]
    tried = {row: [mu for mu, _ in rows] for row, rows in search.tried.items()}
    assert tried[0] == []
    assert tried[1] == tried[2] == tried[6] == [1e-3]
    assert tried[3] == pytest.approx([1e-3 * 8**k for k in range(14)])  # the next were more than 1e9
    stiff = [1e-3 * 8**k for k in range(5)] + [1.6384 * factor for factor in (1, 8, 3.2, 1.28, 0.512, 0.2048)]
    assert tried[4] == pytest.approx(stiff)
    assert tried[5] == pytest.approx([max(1e-3 * 0.4**k, 1e-9) for k in range(len(tried[5]))])
    assert len(tried[5]) > 20
    assert tried[7] == pytest.approx([1e-3, *(4e-4 * 8**k for k in range(14))])
    fulls = {row: [full for _, full in rows] for row, rows in search.tried.items()}
    assert fulls[3] == [1.0, 0.0] * 7
    assert fulls[7] == [1.0] + [1.0, 0.0] * 7
    assert set(fulls[5]) == {1.0}
    assert plan.cost[[1, 2, 3, 4, 6, 7]].tolist() == pytest.approx(
        [1.0, 1.0 - TOLERANCE, 1.0, 0.5, -1.0, 0.9]
    )
    assert plan.control[[1, 2, 3, 4, 7], 0, 0].tolist() == [0.0, 1.0, 0.0, 5.0, 1.0]
    assert search.derived[:3] == [[1, 2, 3, 4, 5, 6, 7], [5, 7], [5]]  # what did not move keeps its own


def test_a_search_ends_after_its_iterations_and_where_no_row_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    search, _, converged = scripted(iterations=1)
    assert [len(rows) for rows in search.tried.values()] == [0, 1, 1, 1, 1, 1, 1, 1]
    assert converged[:3] == [False, True, True]
    monkeypatch.setattr(f"{__name__}.SCRIPTS", SCRIPTS[:3])
    search, _, _ = scripted(iterations=28)
    assert [len(rows) for rows in search.tried.values()] == [0, 1, 1]


@pytest.mark.parametrize(("numbers", "pieces"), [(96 * 2 + 95, [2, 2, 1]), (95, [1] * 5), (96 * 5, [5])])
def test_rows_are_searched_together_as_long_as_their_derivatives_fit(
    numbers: int, pieces: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []

    def solve(self: Any, x0: Tensor, u: Tensor, reference: Reference, terminal: LocalModel) -> Any:
        found.append(len(x0))
        assert len(u) == len(reference.state) == len(reference.feedback) == len(terminal.value) == len(x0)
        return (x0,)

    monkeypatch.setattr(adp.BoxDDP, "_solve", solve)
    monkeypatch.setattr(trajectory_optimisation, "Trajectories", lambda *columns: columns[0])
    monkeypatch.setattr(trajectory_optimisation, "_NUMBERS", numbers)
    x0 = uniform(5, 2, seed=1)
    search = adp.BoxDDP(PROBLEM, steps=2, compile=False)
    assert torch.equal(search.solve(x0), x0)  # type: ignore[arg-type]
    assert found == pieces
    assert [program.compile for program in (search._expand, search._back, search._forth)] == [False] * 3


def test_lengths_that_are_tried_are_the_five(monkeypatch: pytest.MonkeyPatch) -> None:
    search, asked = adp.BoxDDP(PROBLEM, steps=2, compile=False), []
    start = search._rollouts
    monkeypatch.setattr(search, "_rollouts", lambda *given: asked.append(given[5].tolist()) or start(*given))
    search.solve(uniform(1, 2, seed=1))
    assert asked[0] == [1.0]
    assert asked[1] == pytest.approx([1.0, 0.5, 0.2, 0.07, 0.02])


@pytest.mark.parametrize("full", [0.0, 1.0])
def test_a_step_of_the_recursion_is_the_least_of_a_quadratic_function(full: float) -> None:
    n, m, mu = 2, 2, 0.7
    search = adp.BoxDDP(PROBLEM, steps=2, compile=False)
    first, second = uniform(1, n, n + m, seed=1), uniform(1, n, n + m, n + m, seed=2)
    second = second + second.mT
    root = uniform(1, n + m, n + m, seed=3)
    cost_first, cost_second = uniform(1, n + m, seed=4), root @ root.mT + 3 * torch.eye(n + m)
    gradient, bent = uniform(1, n, seed=5), torch.eye(n).double()[None] * 2
    after = Model(gradient, bent, tensor([-0.5]), tensor([1.0]))
    now = first, second, cost_first, cost_second, torch.zeros(1, m).double()
    model, (change, feedback, slope, curvature) = search.backward(after, now, (tensor([mu]), tensor([full])))

    def q(z: Tensor) -> Tensor:
        d = first[0] @ z
        ahead = gradient[0] @ d + 0.5 * d @ bent[0] @ d
        ahead = ahead + full * 0.5 * torch.einsum("i,ijk,j,k->", gradient[0], second[0], z, z)
        return ahead + cost_first[0] @ z + 0.5 * z @ cost_second[0] @ z

    none = torch.zeros(n + m).double()
    q1 = torch.func.jacrev(q)(none)
    q2: Any = torch.func.jacrev(torch.func.jacrev(q))(none)
    firm = q2[n:, n:] + mu * cost_second[0].diagonal()[n:].mean() * torch.eye(m)
    torch.testing.assert_close(change[0], -torch.linalg.solve(firm, q1[n:]))
    torch.testing.assert_close(feedback[0], -torch.linalg.solve(firm, q2[n:, :n]))
    followed = lambda x: q(torch.cat((x, change[0] + feedback[0] @ x)))  # noqa: E731
    torch.testing.assert_close(model.promised[0], -0.5 + followed(none[:n]))
    torch.testing.assert_close(model.gradient[0], torch.func.jacrev(followed)(none[:n]))
    second_of: Any = torch.func.jacrev(torch.func.jacrev(followed))(none[:n])
    torch.testing.assert_close(model.curvature[0], second_of)
    assert model.gradient is slope
    assert model.curvature is curvature
    assert model.definite.tolist() == [1.0]
    stuck = after._replace(definite=tensor([0.0]))
    assert search.backward(stuck, now, (tensor([mu]), tensor([full])))[0].definite.tolist() == [0.0]


def test_inputs_at_a_bound_do_not_answer_and_the_others_do_without_them() -> None:
    hessian, cross = tensor([[[2.0, 0.5], [0.5, 1.0]]]), tensor([[[1.0, 2.0], [3.0, 4.0]]])
    for free, wanted in (
        ([True, True], -torch.linalg.solve(hessian[0], cross[0])),
        ([False, True], tensor([[0.0, 0.0], [-3.0, -4.0]])),
        ([True, False], tensor([[-0.5, -1.0], [0.0, 0.0]])),
        ([False, False], torch.zeros(2, 2).double()),
    ):
        torch.testing.assert_close(slopes_of_minimum(hessian, cross, torch.tensor([free]))[0], wanted)
    one = slopes_of_minimum(tensor([[[4.0]]]), tensor([[[2.0, 8.0]]]), torch.tensor([[True]]))
    assert one.tolist() == [[[-0.5, -2.0]]]


def test_models_are_those_of_gauss_where_the_full_ones_have_no_minimum_or_are_not_finite(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    search, asked = adp.BoxDDP(PROBLEM, steps=1, compile=False), []
    bent = torch.eye(2).double().repeat(4, 1, 1)
    bent[2, 1, 0] = INF

    def backwards(plan: Plan, known: Any, mu: Tensor, full: Tensor, terminal: Any) -> Any:
        asked.append((mu.tolist(), full.tolist()))
        mark = full[:, None].clone()
        out = mark[..., None], mark[..., None, None].expand(4, 1, 2, 2), mark[..., None].expand(4, 1, 2)
        definite = tensor([1.0, 0.0, 1.0, 1.0])
        return Model(full, bent, full, definite), (*out, mark[..., None, None].expand(4, 1, 2, 2))

    monkeypatch.setattr(search, "_backwards", backwards)
    monkeypatch.setattr(search, "_derivatives", lambda plan: None)
    state, cost = uniform(4, 2, 2, seed=1), tensor([1.0, 2.0, 3.0, INF])
    plan = Plan(state, uniform(4, 1, 2, seed=2), cost, uniform(4, 2, seed=3))
    ends = LocalModel(uniform(4, 2, seed=4), torch.zeros(4), uniform(4, 2, seed=5), uniform(4, 2, 2, seed=6))
    found = search._models(plan, torch.tensor([True, False, True, True]), ends)
    assert asked == [([1e-9] * 4, [1.0] * 4), ([1e-9] * 4, [0.0] * 4)]
    assert found.feedback[:, 0, 0, 0].tolist() == [1.0, 0.0, 0.0, 1.0]
    assert found.gradient[:, 0, 0].tolist() == [1.0, 0.0, 0.0, 1.0]
    assert found.curvature[:, 0, 0, 0].tolist() == [1.0, 0.0, 0.0, 1.0]
    assert found.converged.tolist() == [True, False, True, False]
    assert torch.equal(found.curvature[:, 1], ends.curvature)
    away = state[:, -1] - ends.state
    torch.testing.assert_close(
        found.gradient[:, 1], ends.gradient + (ends.curvature @ away[..., None])[..., 0]
    )
    torch.testing.assert_close(found.value, torch.stack((plan.paid.sum(1), plan.paid[:, 1]), dim=1))


@torch.no_grad()
@pytest.mark.parametrize(("iterations", "low", "high"), [(1, None, None), (6, -0.6, 0.9)])
def test_search_as_a_program_takes_the_steps_of_the_search_where_many_do_not_pay(
    iterations: int, low: float | None, high: float | None
) -> None:
    problem = waved(low, high)
    search = adp.BoxDDP(problem, steps=3, iterations=iterations, compile=False)
    x, control = 2 * uniform(8, 2, seed=1), 1.4 * uniform(8, 3, 2, seed=2)
    around = Reference(x.unsqueeze(1).expand(-1, 3, -1), 0.3 * uniform(8, 3, 2, 2, seed=3))
    found = search.solve(x, control, around)
    state, u, feedback = TracedSearch(search)(x, control, around)
    for traced, plain in ((state, found.state), (u, found.control), (feedback, found.feedback)):
        torch.testing.assert_close(traced, plain, rtol=0, atol=1e-8)


# A row of the traced search: cost, mu, full, active; definite, promised; the costs of the five lengths; then
# what is wanted: cost, mu, full, active, the length that is taken.
WORSE = [2.0] * 5
ROWS: list[tuple[list[float], list[float], list[float], list[float]]] = [
    ([1.0, 1e-3, 1, 1], [1, -1.0], [1.5, 0.4, 0.6, 2.0, 2.0], [0.4, 4e-4, 1, 1, 0.5]),
    ([1.0, 1e-3, 0, 0], [1, -1.0], [0.5] * 5, [1.0, 1e-3, 0, 0, 0.0]),  # not active
    ([1.0, 1e-3, 1, 1], [0, -1.0], [0.5] * 5, [1.0, 8e-3, 0, 1, 0.0]),  # no minimum
    ([1.0, 1e-3, 0, 1], [1, -TOLERANCE], [1.0] * 5, [1.0, 8e-3, 1, 0, 0.0]),  # little is promised
    ([1.0, 1e-3, 1, 1], [0, -TOLERANCE], [1.0] * 5, [1.0, 8e-3, 0, 1, 0.0]),  # by no minimum
    ([1.0, 1e-3, 1, 1], [1, -1.0], [1.0 - TOLERANCE, *WORSE[1:]], [1.0 - TOLERANCE, 4e-4, 1, 0, 1.0]),
    ([1.0, 1.6, 1, 1], [1, 0.0], WORSE, [1.0, 12.8, 0, 1, 0.0]),  # of a stiff model
    ([1.0, 0.9, 1, 1], [1, 0.0], WORSE, [1.0, 7.2, 0, 0, 0.0]),
    ([1.0, 2e8, 1, 1], [1, -1.0], WORSE, [1.0, 1.6e9, 0, 0, 0.0]),
    ([1.0, 1e8, 1, 1], [1, -1.0], WORSE, [1.0, 8e8, 0, 1, 0.0]),
    ([1.0, 1e-3, 1, 1], [1, -1.0], [INF, math.nan, -INF, math.nan, INF], [1.0, 8e-3, 0, 1, 0.0]),
    ([1.0, 2e-9, 1, 1], [1, -1.0], [2.0, 2.0, 0.5, 0.5, 0.7], [0.5, 1e-9, 1, 1, 0.2]),  # the longer of two
    ([-1.0, 1e-3, 1, 1], [1, TOLERANCE], WORSE, [-1.0, 8e-3, 0, 0, 0.0]),
    ([64.0, 1e-3, 1, 1], [1, -64.0], [64.0 - 64 * TOLERANCE, 99, 99, 99, 99], [63.9375, 4e-4, 1, 0, 1.0]),
    ([64.0, 1e-3, 1, 1], [1, -64.0], [99, 99, 99, 99, 63.9], [63.9, 4e-4, 1, 1, 0.02]),
    ([64.0, 1e-3, 1, 1], [1, -64.0 * TOLERANCE], [99.0] * 5, [64.0, 8e-3, 0, 0, 0.0]),
]


def test_a_row_of_the_traced_search_goes_on_as_that_of_the_search() -> None:
    now, model, tried, wanted = (tensor([row[k] for row in ROWS]) for k in range(4))
    calls, none = [], torch.zeros(len(ROWS), 3, 2).double()

    class Traced(TracedSearch):
        def _derivatives(self, state: Tensor, u: Tensor) -> Any:
            return ()

        def _backwards(self, state: Any, u: Any, known: Any, mu: Tensor, full: Tensor, ends: Any) -> Any:
            assert torch.equal(torch.stack((mu, full), dim=1), now[:, 1:3])
            end = Model(mu, mu, model[:, 1], model[:, 0])
            return end, (none + 1, none + 2, mu, mu)

        def _cost(self, x: Tensor, around: Any, length: Tensor, ends: Any) -> Tensor:
            calls.append(float(length[0]))
            return tried[:, len(calls) - 1]

        def _rolled(self, x: Tensor, around: Any, length: Tensor, ends: Any) -> Any:
            assert torch.equal(x, state[:, 0])
            for part, given in zip(around, (state[:, :-1], none, none + 1, none + 2), strict=True):
                assert torch.equal(part, given)
            mark = length[:, None, None].expand(-1, 4, 2)
            return mark, mark[:, :3] + 7, length

    search = adp.BoxDDP(PROBLEM, steps=3, tolerance=TOLERANCE, compile=False)
    state = torch.arange(4.0).double()[None, :, None].expand(len(ROWS), 4, 2) - 9
    found = Traced(search)._iterated((state, none, *now.unbind(1)), None)  # type: ignore[arg-type]
    assert calls == pytest.approx([1.0, 0.5, 0.2, 0.07, 0.02])
    torch.testing.assert_close(torch.stack(found[2:], dim=1), wanted[:, :4], rtol=1e-12, atol=0)
    better = wanted[:, 4] > 0
    torch.testing.assert_close(found[0][better][:, 0, 0], wanted[better, 4])
    torch.testing.assert_close(found[1][better][:, 0, 0], wanted[better, 4] + 7)
    assert torch.equal(found[0][~better], state[~better])
    assert torch.equal(found[1][~better], none[~better])
