"""An actor-critic taken apart: what it begins with, its points and terms, what it learns and refuses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor, nn

import staf_torch as st
from staf_torch import adp, systems
from staf_torch.adp.bellman import bellman_error
from staf_torch.adp.tracking import (
    desired_rate,
    feedforward,
    input_gain,
    regressor,
    true_parameters,
)

PLANT, COST = systems.TwoState(), adp.QuadraticCost(2.0, 0.5, dim=2, inputs=1)
X, DRAWN = uniform(3, 2, seed=1), uniform(3, 2, 2, seed=2)
STAF = adp.StaFValueBasis(
    st.StaFBasis(
        st.AnchoredKernel(st.ExponentialKernel()),
        st.StateFollowingCenters(st.rings(3), st.StateRadius(0.7, 0.1)),
    )
)


def learner(**given: Any) -> adp.ActorCritic:
    settings: dict[str, Any] = {
        "basis": STAF,
        "model": PLANT,
        "cost": COST,
        "extrapolation": adp.RandomPoints(2, 0.4),
    }
    return adp.ActorCritic(**(settings | given))


def test_weights_begin_as_numbers_lists_or_a_row_each() -> None:
    begun = learner().init(X)
    assert begun.critic.tolist() == [[0.4] * 3] * 3
    assert begun.actor.tolist() == [[0.28] * 3] * 3
    torch.testing.assert_close(begun.gain, torch.eye(3).double().expand(3, 3, 3) / 250)
    assert begun.identifier.shape == (3, 0)
    own = uniform(3, 3, seed=3)
    gains = tensor([1.0, 2.0, 4.0])
    law = adp.Published()
    given = learner(critic=[0.1, 0.2, 0.3], actor=own, gain=gains, law=law)
    assert given.law is law
    assert given.label == "actor-critic (Published)"
    begun = given.init(X)
    assert begun.critic.tolist() == [[0.1, 0.2, 0.3]] * 3
    assert torch.equal(begun.actor, own)
    torch.testing.assert_close(begun.gain, gains[:, None, None] * torch.eye(3).double())
    begun.critic.zero_()
    assert given.init(X).critic.tolist() == [[0.1, 0.2, 0.3]] * 3
    single = learner(critic=2, actor=torch.ones(3)).init(X.float())
    assert single.critic.dtype == single.actor.dtype == single.gain.dtype == torch.float32
    assert single.critic.tolist() == [[2.0] * 3] * 3
    assert isinstance(learner().law, adp.Information)
    assert learner().draws == 2


@pytest.mark.parametrize("centers", ["moving", "fixed"])
@pytest.mark.parametrize("other", [False, True])
def test_bellman_terms_are_those_of_every_point(centers: str, other: bool) -> None:
    model = systems.TwoState(as_printed=True) if other else None
    at = PLANT if model is None else model
    control = learner(extrapolation=adp.RandomPoints(2, 0.4, centers))
    actor, critic = uniform(3, 3, seed=4), uniform(3, 3, seed=5)
    terms = control.terms(X, actor, DRAWN, model)
    delta = bellman_error(terms, critic)
    for row in range(3):
        points = [X[row], *(X[row] + 0.4 * z for z in DRAWN[row])]
        for j, y in enumerate(points):
            around = y if centers == "moving" else X[row]
            slopes = STAF.gradient(y, around)
            g = at.effectiveness(y)
            u = -0.5 / 0.5 * (g.mT @ slopes.mT @ actor[row])
            rate = 2.0 * float(y @ y) + 0.5 * float(u @ u)
            w = slopes @ (at.drift(y) + g @ u)
            torch.testing.assert_close(terms.control[row, j], u)
            torch.testing.assert_close(terms.regressor[row, j], w)
            torch.testing.assert_close(terms.push[row, j], slopes @ g @ g.mT @ slopes.mT @ actor[row] / 0.5)
            assert float(terms.rate[row, j]) == pytest.approx(rate)
            assert float(delta[row, j]) == pytest.approx(rate + float(w @ critic[row]))
            found = control.value_gradient(X, critic, DRAWN)[row, j]
            torch.testing.assert_close(found, slopes.mT @ critic[row])
    begun = control.init(X)
    if not other:
        wanted = control.terms(X, begun.actor, DRAWN)
        u, after = control.step(X, begun, DRAWN, 0.01)
        torch.testing.assert_close(u, wanted.control[:, 0])
        for part, right in zip(after, control.moved(wanted, begun, 0.01), strict=True):
            torch.testing.assert_close(part, right)
    torch.testing.assert_close(control.value(X, begun), (begun.critic * STAF(X, X)).sum(-1))


@pytest.mark.parametrize("kind", [adp.Information, adp.Published])
def test_rows_with_gains_of_their_own_are_those_rows_alone(kind: Any) -> None:
    each = [
        {"critic": 0.1 * k, "actor": 1.0 * k, "forgetting": 0.2 * k, "normalisation": 0.1} for k in (1, 2, 3)
    ]
    columns = {name: tensor([[row[name]] for row in each]) for name in ("critic", "actor", "forgetting")}
    gains = adp.Gains(**columns, normalisation=0.1)
    law = kind(gains)

    def run(law: Any, x0: Tensor, seed: int) -> adp.LoopResult:
        control = adp.Supervised(learner(law=law), adp.LQR(PLANT, COST), COST, 1.0)
        settings: dict[str, Any] = {"dt": 0.01, "steps": 5, "seed": seed, "compile": False}
        with torch.no_grad():
            return adp.simulate(control, PLANT, COST, x0, **settings)

    together = run(law, X, 4)
    assert law.gains is gains
    for row in range(3):
        alone = run(kind(adp.Gains(**each[row])), X[row : row + 1], 4 + row)
        for name in ("state", "critic_weights", "actor_weights", "running_cost"):
            one, other = getattr(together, name)[row], getattr(alone, name)[0]
            torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


class Points(nn.Module):
    """Points that someone made, of a shape that may not fit."""

    moving, draws, weights = True, 1, torch.ones(1, dtype=torch.float64)

    def __init__(self, shape: Any) -> None:
        super().__init__()
        self.shape = shape

    def forward(self, x: Tensor, uniform: Tensor) -> Tensor:
        assert x.dtype == uniform.dtype == torch.float64
        assert (x.shape, uniform.shape) == ((1, 2), (1, 1, 2))
        if self.shape is None:
            raise RuntimeError("a bad size")
        return torch.zeros(self.shape, dtype=torch.float64)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"model": systems.RatePlant(lambda x, u: u - x, dim=2, inputs=2)},
            r"\(model=...\)` must be a ControlAff",
        ),
        ({"model": systems.ThreeState()}, r"`ActorCritic\(basis=...\)` has 2 states, but the plant has 3"),
        ({"extrapolation": Points((1, 4, 3))}, r"around states \(B, 2\); got \(1, 4, 3\)"),
        (
            {"extrapolation": Points((2, 4, 2))},
            r"must make points \(B, N, 2\) around states \(B, 2\); got \(2, 4",
        ),
        (
            {"extrapolation": Points((1, 2))},
            r"must make points \(B, N, 2\) around states \(B, 2\); got \(1, 2\)",
        ),
        ({"extrapolation": Points((1, 1, 4, 2))}, r"must make points .*; got \(1, 1, 4, 2\)"),
        ({"extrapolation": Points(None)}, r"around states \(B, 2\) \(a bad size\); got Points"),
        ({"cost": adp.QuadraticCost(1.0, 1.0, 2, 1, discount=0.1)}, r"must have no discount: .*; got 0.1"),
        ({"critic": [0.1]}, r"`ActorCritic\(critic=...\)` must have 3 entries"),
        ({"actor": torch.ones(2, 4)}, r"`ActorCritic\(actor=...\)` must have 3 entries"),
        ({"gain": 0.0}, r"`ActorCritic\(gain=...\)` must be positive"),
    ],
)
def test_parts_that_do_not_fit_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        learner(**given)


def test_a_set_point_is_refused_with_its_place() -> None:
    plant = systems.Linear([[0.0, 1.0], [-1.0, 0.0]], [[0.0], [1.0]])
    cost = adp.QuadraticCost(1.0, 1.0, 2, 1, target=[1.0, 0.0])
    with pytest.raises(ValueError, match="must have no target: the laws regulate to the origin"):
        learner(model=plant, cost=cost)
    assert learner(extrapolation=Points((1, 4, 2))).draws == 1


# --- tracking -----------------------------------------------------------------------------------------------


def test_the_error_plant_is_written_out() -> None:
    theta = uniform(3, 2, seed=1)
    plant = adp.TwoStateTracking(theta)
    x, u = uniform(5, 4, seed=2), uniform(5, 1, seed=3)
    for row in range(5):
        e1, e2, d1, d2 = x[row].tolist()

        def s(a: float, b: float) -> np.ndarray:
            return np.array([a, b, b * (1 - (math.cos(2 * a) + 2) ** 2)])

        rate = np.array([d2 - d1, d2 - 2 * d1])
        push = (rate - theta.numpy().T @ s(d1, d2))[1] / (math.cos(2 * d1) + 2)
        gain = math.cos(2 * (e1 + d1)) + 2
        error = theta.numpy().T @ s(e1 + d1, e2 + d2) - rate
        wanted = [error[0], error[1] + gain * (push + float(u[row])), *rate]
        torch.testing.assert_close(plant.rate(x[row], u[row]), tensor(wanted))
        assert float(feedforward(x[row, 2:], theta)) == pytest.approx(push)
        torch.testing.assert_close(regressor(x[row, 2:]), tensor(s(d1, d2).tolist()))
        torch.testing.assert_close(desired_rate(x[row, 2:]), tensor(rate.tolist()))
        assert float(input_gain(x[row, 0] + x[row, 2])) == pytest.approx(gain)
    rows = uniform(5, 3, 2, seed=4)
    believed = plant.believing(rows)
    assert torch.equal(plant.theta, theta)
    for row in range(5):
        torch.testing.assert_close(believed.drift(x)[row], adp.TwoStateTracking(rows[row]).drift(x[row]))
    truth = adp.TwoStateTracking().theta
    assert truth.tolist() == true_parameters().tolist() == [[-1.0, -0.5], [1.0, 0.0], [0.0, -0.5]]
    assert adp.TwoStateTracking([[0.0, 1.0]] * 3).theta.shape == (3, 2)
    with pytest.raises(
        ValueError, match=r"`TwoStateTracking\(theta=...\)` must be \(..., 3, 2\); got \(2, 3\)"
    ):
        adp.TwoStateTracking(torch.zeros(2, 3))
    with pytest.raises(ValueError, match=r"`TwoStateTracking\(theta=...\)` must be finite"):
        adp.TwoStateTracking(torch.full((3, 2), torch.nan))
    cost = adp.tracking_cost([[2.0, 0.5], [0.5, 1.0]], 3.0)
    assert cost.q.tolist() == [[2, 0.5, 0, 0], [0.5, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    assert (cost.r.tolist(), cost.dim, cost.inputs) == ([[3.0]], 4, 1)


def test_the_stack_is_as_long_as_it_has_parameters_at_least() -> None:
    usual = adp.ConcurrentLearning(3, 2)
    assert (usual.size, usual.gain, usual.novelty) == (10, 1.0, 0.05)
    assert adp.ConcurrentLearning(3, 2, 3).size == 3
    assert adp.ConcurrentLearning(1, 1, 1).init(torch.zeros(2, 5, 1, 1)).rates.shape == (2, 5, 1, 1)
    for given, name in (((0, 1), "parameters"), ((1, 0), "outputs"), ((3, 2, 2), "size")):
        with pytest.raises(ValueError, match=rf"`ConcurrentLearning\({name}=...\)` must be at least"):
            adp.ConcurrentLearning(*given)
    for name in ("gain", "novelty"):
        with pytest.raises(ValueError, match=rf"`ConcurrentLearning\({name}=...\)` must be positive"):
            adp.ConcurrentLearning(1, 1, **{name: 0.0})  # type: ignore[arg-type]


def test_a_pair_enters_by_the_share_that_it_differs_and_leaves_by_the_least_eigenvalue() -> None:
    learning = adp.ConcurrentLearning(2, 1, size=3, novelty=0.5)
    y = tensor([1.0])
    state = learning.init(torch.zeros(2, 1).double())
    for s, filled in (([1.0, 0.0], 1), ([1.4, 0.0], 1), ([1.9, 0.0], 1), ([2.1, 0.0], 2), ([0.0, 0.1], 3)):
        state = learning.remember(state, tensor(s), y)
        assert int((state.regressors.norm(dim=-1) > 0).sum()) == filled
    for seed in range(6):
        s = 0.5 * uniform(2, seed=seed)
        stack = state.regressors
        gains = []
        for place in range(3):
            kept = torch.cat((stack[:place], s[None], stack[place + 1 :]))
            gains.append(float(np.linalg.eigvalsh((kept.mT @ kept).numpy())[0]))
        now = float(np.linalg.eigvalsh((stack.mT @ stack).numpy())[0])
        after = learning.remember(state, s, y + seed)
        wanted = stack.clone()
        if max(gains) > 1.001 * now:
            wanted[int(np.argmax(gains))] = s
        assert torch.equal(after.regressors, wanted)
        changed = (after.regressors != stack).any(-1)
        assert torch.equal(after.rates[:, 0], torch.where(changed, 1.0 + seed, state.rates[:, 0]))
        state = after
