"""The actor-critic whose weights wait for the identified model."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.tracking import regressor

PLANT, COST = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
TRUE = tensor([-1.0, 1.0, 0.0, -0.5, 0.0, -0.5])
FIRST = [1.0, 0.0, 1.0]  # of x'x


def both_rows(x: Tensor, u: Tensor) -> Tensor:
    s = regressor(x)
    zero = torch.zeros_like(s)
    return torch.stack((torch.cat((s, zero), -1), torch.cat((zero, s), -1)), dim=-2)


def pushed(x: Tensor, u: Tensor) -> Tensor:
    return (PLANT.effectiveness(x) * u.unsqueeze(-2)).sum(-1)


MODEL = adp.ParametricPlant(both_rows, pushed, dim=2, inputs=1, theta=TRUE)
LEARNER = adp.ActorCritic(
    adp.QuadraticBasis(2),
    PLANT,
    COST,
    adp.QuadraturePoints(3, 2, half_width=0.2),
    adp.PolicyIteration(),
    critic=FIRST,
    actor=FIRST,
)


def adaptive(law: adp.LeastSquares | None = None, **settings: object) -> adp.AdaptiveActorCritic:
    if law is None:
        law = adp.LeastSquares([0.0] * 6, deviation=3.0, floor=1e-5)
    windows = adp.IntegralWindows(MODEL, 0.01)
    return adp.AdaptiveActorCritic(LEARNER, MODEL, windows, law, **settings)  # type: ignore[arg-type]


def loop(control: adp.Controller, x0: Tensor, steps: int, plant: systems.Plant = PLANT) -> adp.LoopResult:
    return adp.simulate(control, plant, COST, x0, dt=0.01, steps=steps, compile=False)


def test_weights_wait_in_doubt_and_every_state_is_regulated_near_the_optimum() -> None:
    control = adaptive()
    # From the first three, weights that moved before the drift was known diverged.
    x0 = torch.cat((tensor([[0.858, 0.7204], [-1.8829, -1.4841], [-1.9202, -1.7179]]), uniform(5, 2) * 2))
    run = loop(control, x0, 150)
    now = control.knowledge(run.identifier)
    assert torch.equal(now.certain[:, 0], torch.zeros(len(x0)).double())
    assert bool((now.certain[:, -1] == 1).all())
    waited = now.certain.cumsum(1) == 0
    weights = run.critic_weights[waited]
    assert torch.equal(weights, tensor(FIRST).expand_as(weights))
    first, last = (PLANT.optimal_value(x, COST.q, COST.r) for x in (x0, run.state[:, -1]))
    assert first is not None
    assert last is not None
    assert float(((run.cost + last) / first).mean()) < 1.04
    assert float((last / first).max()) < 0.1


def test_where_the_model_is_certain_v_falls_for_every_theta_within_the_deviations() -> None:
    control = adaptive(confidence=2.0, share=1.0)
    x, critic = tensor([[1.0, -0.5]]), tensor([[0.6, 0.1, 0.9]])
    uniforms = x.new_zeros(1, control.draws, 2)
    terms = LEARNER.terms(x, critic, uniforms, MODEL.believing(TRUE))
    shape = torch.diag(tensor([1.0, 2.0, 0.5, 1.0, 1.5, 0.7]))

    def certain(scale: float) -> bool:
        estimate = control.law.init(x, TRUE[None])._replace(covariance=scale * shape[None])
        return bool(control._certain(x, critic, uniforms, terms, estimate))

    low, high = 1e-8, 1e4
    for _ in range(60):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if certain(middle) else (low, middle)
    slope, points = LEARNER.value_gradient(x, critic, uniforms), LEARNER.points(x, uniforms)
    directions = uniform(2000, 6, seed=1)
    errors = 2.0 * directions / directions.norm(dim=-1, keepdim=True) * (low * shape.diagonal()).sqrt()
    off = (both_rows(points, terms.control) @ errors[:, None, :, None]).squeeze(-1)  # (2000, P, 2)
    falls = -terms.rate + (slope * off).sum(-1)  # of V^, where the Bellman equation holds for theta^
    assert float(falls.max()) < 0
    assert float((falls / terms.rate).max()) > -0.5  # that is not because little is allowed


def test_a_model_that_is_known_makes_it_the_actor_critic() -> None:
    law = adp.LeastSquares(TRUE.tolist(), deviation=1e-9, floor=1.0)
    x0 = uniform(5, 2)
    found, wanted = loop(adaptive(law), x0, 15), loop(LEARNER, x0, 15)
    torch.testing.assert_close(found.state, wanted.state, rtol=0, atol=1e-7)
    torch.testing.assert_close(found.critic_weights, wanted.critic_weights, rtol=1e-5, atol=1e-5)


def test_rows_do_not_touch_and_what_was_learned_is_known_in_the_next_episode() -> None:
    control, x0 = adaptive(), uniform(6, 2)
    whole, alone = loop(control, x0, 40), loop(control, x0[2:3], 40)
    assert torch.equal(whole.state[2:3], alone.state)
    assert torch.equal(whole.identifier[2:3], alone.identifier)
    learned = control.knowledge(loop(control, tensor([[-1.5, 1.5]]), 80).identifier).estimate
    next_one = control.knowing(adp.Estimate(*(part[0, -1] for part in learned)))
    again = control.knowledge(loop(next_one, x0, 3).identifier)
    assert bool((again.certain[:, 1] == 1).all())  # from the first step
    assert bool((control.knowledge(loop(control, x0, 3).identifier).certain[:, 1] == 0).all())


def test_the_robust_policy_has_the_control_in_doubt() -> None:
    law = adp.LeastSquares([0.0] * 6, deviation=1e6, floor=1e3)  # nothing is ever learned
    robust = adp.LQR(PLANT, COST)
    x0 = uniform(4, 2)
    found = loop(adaptive(law, robust=robust), x0, 10)
    assert torch.equal(found.state, loop(adp.Feedback(robust), x0, 10).state)
    assert torch.equal(found.critic_weights[:, -1], tensor(FIRST).expand(4, 3))


def test_weights_begin_anew_where_the_plant_becomes_another_one() -> None:
    damping = adp.ParametricPlant(
        lambda x, u: torch.stack((torch.zeros_like(u), -x[..., 1:]), dim=-2),
        lambda x, u: torch.stack((x[..., 1], u[..., 0] - x[..., 0].sin()), dim=-1),
        dim=2,
        inputs=1,
        theta=[0.3],
        rows=[1],
    )
    plant = adp.ChangingPlant(damping)
    z0 = plant.start(tensor([[2.0, 0.0]]), before=[0.3], after=[3.0], at=0.5)
    law = adp.LeastSquares([0.0], deviation=3.0, floor=1e-4, alarm=8.0)
    inside = adp.AdaptiveActorCritic(LEARNER, damping, adp.IntegralWindows(damping, 0.01), law)
    control = adp.Measured(inside, noise=0.0, dim=2)
    run = adp.simulate(control, plant, plant.cost(COST), z0, dt=0.01, steps=80, compile=False)
    now = inside.knowledge(run.identifier)
    anew = int((now.estimate.resets[0] > 0).to(torch.int8).argmax())
    assert 50 <= anew <= 53
    before, after = ((run.critic_weights[0, k] - tensor(FIRST)).abs().max() for k in (anew - 1, anew))
    assert float(after) < 0.7 * float(before)
    assert float(now.estimate.theta[0, -1, 0]) == pytest.approx(3.0, abs=1e-2)
