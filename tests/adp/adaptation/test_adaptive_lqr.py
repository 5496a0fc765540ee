"""The policy that is redesigned while it runs: its Riccati equations, its doubt, its loops."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform
from helpers_adaptation import COST, PENDULUM, TRUE

from staf_torch import adp, systems
from staf_torch.numerics.linalg import riccati
from staf_torch.numerics.riccati import riccati_rows

WINDOWS = adp.IntegralWindows(PENDULUM, 0.1, shape="smooth", first=0.02, noise=0.01)
LAW = adp.LeastSquares([0.2, 0.7], deviation=[0.2, 0.6], floor=1e-4, forgetting=0.1, alarm=8.0)
CHANGING = adp.ChangingPlant(PENDULUM)


def adaptive(**settings: object) -> adp.AdaptiveLQR:
    return adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, LAW, **settings)  # type: ignore[arg-type]


def test_riccati_equations_of_rows_are_solved_as_one_by_one() -> None:
    a, b = 10 ** uniform(9, 1, 1, seed=1) * uniform(9, 4, 4, seed=2), uniform(9, 4, 2, seed=3)
    q, r = torch.diag(1 + torch.arange(4).double()), 0.5 * torch.eye(2).double()
    for row, found in enumerate(riccati_rows(a, b, q, torch.linalg.inv(r))):
        wanted = riccati(a[row], b[row], q, r)
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9 * float(wanted.abs().max()))


def test_where_the_policy_is_certain_every_theta_within_the_deviations_is_stabilised() -> None:
    control, family = adaptive(confidence=2.0), PENDULUM.family()
    theta = tensor([[0.3, 0.9]])
    a, b = family.at(theta)
    p = riccati_rows(a, b, COST.q, COST.r_inverse)
    k = b.mT @ p
    shape = tensor([[1.0, 0.3], [0.3, 0.5]])
    # The largest covariance of this shape of which the policy is still certain.
    scale = float(control.doubt(shape[None], p, k))
    covariance = shape / scale * (1 - 1e-9)
    assert float(control.doubt(covariance[None], p, k)) < 1
    directions = uniform(2000, 2, seed=4)
    edge = 2.0 * directions / directions.norm(dim=-1, keepdim=True) @ torch.linalg.cholesky(covariance).mT
    closed_a, closed_b = family.at(theta + edge)
    closed = closed_a - closed_b @ k
    falls = p @ closed + (p @ closed).mT
    assert float(torch.linalg.eigvalsh(falls)[:, -1].max()) < 0
    assert float(edge.norm(dim=-1).max()) > 0.1  # that is not because nothing is allowed


@pytest.fixture(scope="module")
def learned() -> adp.LoopResult:
    """Three plants that stay as they are, and one whose inertia changes after half a second."""
    law = adp.LeastSquares([0.2, 0.7], deviation=[0.2, 0.6], floor=1e-4, alarm=8.0)
    windows = adp.IntegralWindows(PENDULUM, 0.02)
    control = adp.AdaptiveLQR(PENDULUM, COST, windows, law, robust=robust, doublings=12)
    before = torch.cat((THETA[:3], tensor([[0.1, 1.0]])))
    x0 = tensor([[0.5, 0.0], [-0.5, 0.3], [0.2, -1.0], [1.0, 0.0]])
    z0, seen = CHANGING.start(x0, before, THETA, at=0.5), adp.Measured(control, noise=0.0, dim=2)
    return adp.simulate(seen, CHANGING, CHANGING.cost(COST), z0, dt=0.005, steps=130, compile=False)


THETA = tensor([[0.05, 0.5], [0.2, 2.0], [0.1, 1.0], [0.1, 0.6]])
ROBUST = adp.LQR(PENDULUM, COST)


def robust(x: torch.Tensor) -> torch.Tensor:
    return ROBUST(x) + 0.25


def test_a_plant_of_unknown_parameters_is_learned_and_the_robust_policy_has_it_until_then(learned) -> None:
    torch.testing.assert_close(learned["theta"][:3, -1], THETA[:3], rtol=2e-2, atol=2e-2)
    x, u, certain = learned.state[:, :-1, :2], learned.control[:, :-1], learned["certain"][:, 1:-1].bool()
    assert not certain[:, 0].any()
    assert certain[:, -1].all()
    torch.testing.assert_close(u[:, :-1][~certain], robust(x)[:, :-1][~certain])
    gain = [adp.LQR(PENDULUM.believing(row), COST).k for row in learned["theta"][:, -1]]
    last = -(torch.stack(gain) @ x[:, -1].unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(u[:, -1], last, rtol=1e-3, atol=1e-6)


def test_a_change_is_found_when_it_happens(learned) -> None:
    *others, changed = learned["alarmed_at"][:, -1].tolist()
    assert others == [-1.0] * 3
    assert 0.5 <= changed <= 0.54
    assert float(learned["theta"][3, -1, 1]) == pytest.approx(0.6, rel=0.05)


def test_a_design_that_cannot_be_made_leaves_the_robust_policy_and_not_a_dead_row() -> None:
    law = adp.LeastSquares([0.1, 0.0], deviation=1.0)  # an input without effect
    control = adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, law, robust=lambda x: 0 * x[..., :1])
    run = adp.simulate(control, PENDULUM, COST, tensor([[0.1, 0.0]]), dt=0.01, steps=20, compile=False)
    assert not run.diverged.any()
    assert not run["certain"].any()


def test_behind_walls_parameters_are_learned_from_the_plant_and_the_design_is_of_the_barrier() -> None:
    box = systems.Barrier(PENDULUM, (-2.0, -5.0), (2.0, 5.0))
    law = adp.LeastSquares([0.2, 0.7], deviation=[0.2, 0.6], floor=1e-6)
    windows = adp.IntegralWindows(PENDULUM, 0.002, states=box.inverse)
    model = adp.ParametricPlant.of_barrier(box)
    control = adp.AdaptiveLQR(model, COST, windows, law, robust=lambda s: -10 * s[..., 1:], doublings=8)
    s0 = box.transform(tensor([[0.5, -2.0]]))
    run = adp.simulate(control, box, COST, s0, dt=0.001, steps=20, compile=False)
    assert bool(run["certain"][0, 10:].all())
    assert not bool(run["certain"][0, 1])
    torch.testing.assert_close(run["theta"][0, -1], TRUE, rtol=0, atol=1e-3)
    lqr = adp.LQR(box, COST)
    torch.testing.assert_close(run.control[0, 15:20], lqr(run.state[0, 15:20]), rtol=1e-2, atol=1e-2)
    with pytest.raises(ValueError, match="must be around a ParametricPlant"):
        adp.ParametricPlant.of_barrier(systems.Barrier(systems.Pendulum(), -1.0, 1.0))
