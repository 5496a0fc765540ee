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


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 1), (4, 2)])
def test_riccati_equations_of_rows_are_solved_as_one_by_one(n: int, m: int) -> None:
    a, b = 10 ** uniform(20, 1, 1, seed=1) * uniform(20, n, n, seed=2), uniform(20, n, m, seed=3)
    q, r = torch.diag(1 + torch.arange(n).double()), 0.5 * torch.eye(m).double()
    rows = riccati_rows(a, b, q, torch.linalg.inv(r))
    for row in range(20):
        wanted = riccati(a[row], b[row], q, r)
        torch.testing.assert_close(rows[row], wanted, rtol=1e-9, atol=1e-9 * float(wanted.abs().max()))
        assert torch.equal(
            riccati_rows(a[row : row + 1], b[row : row + 1], q, torch.linalg.inv(r))[0], rows[row]
        )


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


def test_a_plant_of_unknown_parameters_is_learned_and_the_robust_policy_has_it_until_then() -> None:
    robust = adp.LQR(PENDULUM, COST)
    law = adp.LeastSquares([0.2, 0.7], deviation=[0.2, 0.6], floor=1e-4)
    windows = adp.IntegralWindows(PENDULUM, 0.05)
    control = adp.AdaptiveLQR(PENDULUM, COST, windows, law, robust=lambda x: robust(x) + 0.25, doublings=12)
    true = tensor([[0.05, 0.5], [0.2, 2.0], [0.1, 1.0]])
    z0 = CHANGING.start(tensor([[0.5, 0.0], [-0.5, 0.3], [0.2, -1.0]]), true)
    run = adp.simulate(
        adp.Measured(control, noise=0.0, dim=2),
        CHANGING,
        CHANGING.cost(COST),
        z0,
        dt=0.005,
        steps=150,
        compile=False,
    )
    torch.testing.assert_close(run["theta"][:, -1], true, rtol=2e-2, atol=2e-2)
    x, u, certain = run.state[:, :-1, :2], run.control[:, :-1], run["certain"][:, 1:-1].bool()
    assert not certain[:, 0].any()
    assert certain[:, -1].all()
    doubtful = ~certain
    torch.testing.assert_close(u[:, :-1][doubtful], (robust(x) + 0.25)[:, :-1][doubtful])
    gain = [adp.LQR(PENDULUM.believing(row), COST).k for row in run["theta"][:, -1]]
    last = -(torch.stack(gain) @ x[:, -1].unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(u[:, -1], last, rtol=1e-3, atol=1e-6)


def test_a_change_is_found_when_it_happens() -> None:
    law = adp.LeastSquares([0.1, 1.0], deviation=[0.2, 0.6], floor=1e-4, alarm=8.0)
    windows = adp.IntegralWindows(PENDULUM, 0.02)
    control = adp.AdaptiveLQR(PENDULUM, COST, windows, law, doublings=12)
    z0 = CHANGING.start(tensor([[1.0, 0.0], [1.0, 0.0]]), TRUE, tensor([[0.1, 0.6], [0.1, 1.0]]), at=0.5)
    run = adp.simulate(
        adp.Measured(control, noise=0.0, dim=2),
        CHANGING,
        CHANGING.cost(COST),
        z0,
        dt=0.005,
        steps=160,
        compile=False,
    )
    alarmed = run["alarmed_at"][:, -1]
    assert 0.5 <= float(alarmed[0]) <= 0.54
    assert float(alarmed[1]) == -1


def test_a_design_that_cannot_be_made_leaves_the_robust_policy_and_not_a_dead_row() -> None:
    law = adp.LeastSquares([0.1, 0.0], deviation=1.0)  # an input without effect
    control = adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, law, robust=lambda x: 0 * x[..., :1])
    run = adp.simulate(control, PENDULUM, COST, tensor([[0.1, 0.0]]), dt=0.01, steps=60, compile=False)
    assert not run.diverged.any()
    assert not run["certain"].any()


def test_behind_walls_parameters_are_learned_from_the_plant_and_the_design_is_of_the_barrier() -> None:
    def regressor(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        x1, x2 = x.unbind(-1)
        gain, none = (2 * x1).cos() + 2, torch.zeros_like(x1)
        rows = (x2, none, none, none), (none, x1, x2, x2 * gain.square())
        return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)

    def known(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return torch.stack((0 * x[..., 0], ((2 * x[..., 0]).cos() + 2) * u[..., 0]), dim=-1)

    true = [1.0, -1.0, -0.5, 0.5]
    box = systems.Barrier(
        adp.ParametricPlant(regressor, known, dim=2, inputs=1, theta=true), (-7, -5), (5, 7)
    )
    cost = adp.QuadraticCost(10.0, 0.1, dim=2, inputs=1)
    law = adp.LeastSquares([0.0] * 4, deviation=5.0, floor=1e-6)
    windows = adp.IntegralWindows(box.plant, 0.002, states=box.inverse)  # type: ignore[arg-type]
    model = adp.ParametricPlant.of_barrier(box)
    control = adp.AdaptiveLQR(model, cost, windows, law, robust=lambda s: -10 * s[..., 1:], doublings=8)
    s0 = box.transform(tensor([[-6.5, 6.5]]))
    run = adp.simulate(control, box, cost, s0, dt=0.001, steps=20, compile=False)
    assert bool(run["certain"][0, 6:].all())
    assert not bool(run["certain"][0, 1])
    torch.testing.assert_close(run["theta"][0, -1], tensor(true), rtol=0, atol=1e-3)
    lqr = adp.LQR(box, cost)
    torch.testing.assert_close(run.control[0, 15:20], lqr(run.state[0, 15:20]), rtol=1e-2, atol=1e-2)
    with pytest.raises(ValueError, match="must be around a ParametricPlant"):
        adp.ParametricPlant.of_barrier(systems.Barrier(systems.Pendulum(), -1.0, 1.0))
