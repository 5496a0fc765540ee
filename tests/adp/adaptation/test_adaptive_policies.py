"""Plants of unknown parameters, drifts without a form, policies on them: formulas, and what is refused."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import changed, tensor, uniform
from helpers_adaptation import COST, DAMPING, friction_and_inertia, gravity
from torch import Tensor

from staf_torch import GaussianKernel, adp, rings, systems
from staf_torch.adp.adaptation.identification import Estimate
from staf_torch.systems.two_state_tracking import regressor

KNOWN = systems.Linear([[0.0, 1.0], [-0.4, 0.2]], [[0.0], [1.0]])
CENTERS = 0.5 * rings(3)


def drift_of(**given: Any) -> adp.StreamDrift:
    usual = {"known": KNOWN, "kernel": GaussianKernel(2.0), "offsets": CENTERS}
    usual |= {"rows": [1], "deviation": 3.0, "length": 0.1, "floor": 0.05}
    return adp.StreamDrift(**(usual | given))  # type: ignore[arg-type]


def test_a_known_rate_of_the_seventh_degree_counts_exactly() -> None:
    def rate(x: Tensor, u: Tensor) -> Tensor:
        a, b = x.unbind(-1)
        return torch.stack((a**7 - 2 * b**5 + a * b, 3 * a**3 * b**4 - b + u[..., 0]), dim=-1)

    known = adp.ParametricPlant(lambda x, u: 0 * x.unsqueeze(-1), rate, dim=2, inputs=1, theta=[0.0])
    drift, x = drift_of(known=known), uniform(9, 2, seed=3)
    a, _ = drift.matrix(drift.init(x), x)
    torch.testing.assert_close(
        (a @ x.unsqueeze(-1)).squeeze(-1), rate(x, 0 * x[:, :1]), rtol=1e-11, atol=1e-12
    )


def plant_of(**given: Any) -> adp.ParametricPlant:
    usual = {"regressor": friction_and_inertia, "known": gravity, "dim": 2, "inputs": 1, "theta": [0.1, 1.0]}
    return adp.ParametricPlant(**(usual | given))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"theta": [0.1, 1.0, 2.0]}, r"regressor=...\)` must map \(4, 2\) to \(4, 2, 3\)"),
        ({"rows": [1, 0]}, "must be numbers of the 2 states, in order"),
        ({"known": lambda x, u: x + 0.01 * u.square()}, r"known=...\)` must be affine in u"),
        (
            {"regressor": lambda x, u: torch.stack((x, x * u.sin()), -1)},
            r"regressor=...\)` must be affine in u",
        ),
    ],
)
def test_a_plant_that_is_none_is_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plant_of(**given)


def test_a_plant_may_have_no_inputs_and_parameters_of_rows() -> None:
    still = adp.ParametricPlant(lambda x, u: x.unsqueeze(-1), dim=1, inputs=0, theta=[2.0])
    assert still.effectiveness(torch.ones(3, 1).double()).shape == (3, 1, 0)
    assert still.drift(tensor([3.0])).tolist() == [6.0]
    many, x, u = plant_of(theta=uniform(3, 2, seed=1)), uniform(3, 2, seed=2), uniform(3, 1, seed=3)
    wanted = gravity(x, u) + (friction_and_inertia(x, u) @ many.theta.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(many.rate(x, u), wanted)


def test_a_plant_of_effectiveness_or_behind_walls_is_that_plant() -> None:
    source = systems.Pendulum()
    source.bounds = systems.Bounds(-2.0, 3.0, 1)
    faulty = adp.ParametricPlant.of_effectiveness(source)
    assert (faulty.dim, faulty.inputs, faulty.periodic, faulty.rows) == (2, 1, source.periodic, [0, 1])
    assert faulty.bounds is source.bounds
    x, u = uniform(5, 2, seed=1), uniform(5, 1, seed=2)
    torch.testing.assert_close(faulty.rate(x, u), source.rate(x, u))
    half = faulty.believing(tensor([0.5]))
    torch.testing.assert_close(
        half.rate(x, u), source.drift(x) + 0.5 * (source.effectiveness(x) @ u.unsqueeze(-1))[..., 0]
    )
    inside = plant_of(theta=[0.3, 2.0], rows=[1], bounds=systems.Bounds(-1.0, 1.0, 1))
    box = systems.Barrier(inside, [-1.0, -3.0], [1.5, 3.0])
    model = adp.ParametricPlant.of_barrier(box)
    assert model.bounds is inside.bounds
    torch.testing.assert_close(model.rate(x, u), box.rate(x, u))


def test_a_family_is_the_slopes_at_a_set_point() -> None:
    def regressor(x: Tensor, u: Tensor) -> Tensor:
        push = u - 0.3
        return torch.stack(
            (torch.cat((x[..., :1] - 0.2, push), -1), torch.cat((push, x[..., 1:] * x[..., :1]), -1)), -2
        )

    def known(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((x[..., 1] * 2, (x[..., 0] - 0.2).sin() + 5 * (u[..., 0] - 0.3)), dim=-1)

    plant = adp.ParametricPlant(regressor, known, dim=2, inputs=1, theta=[0.5, -0.7])
    at, held = tensor([0.2, 0.0]), tensor([0.3])
    family = plant.family(at, held)
    theta = uniform(3, 2, seed=1)
    a, b = family.at(theta)
    for k in range(3):
        mine = plant.believing(theta[k])
        torch.testing.assert_close(a[k], torch.func.jacrev(mine.rate, argnums=0)(at, held))
        torch.testing.assert_close(b[k], torch.func.jacrev(mine.rate, argnums=1)(at, held))
    rule = "must vanish at the set-point, so that the plant rests there whatever theta is"
    for x, u in ((tensor([0.1, 0.0]), held), (at, tensor([0.4]))):
        with pytest.raises(ValueError, match=rule):
            plant.family(x, u)


PLANT = systems.TwoState()
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
    run = loop(control, x0, 120)
    certain = run["certain"]
    assert torch.equal(certain[:, 0], torch.zeros(len(x0)).double())
    assert bool((certain[:, -1] == 1).all())
    waited = certain.cumsum(1) == 0
    weights = run.critic_weights[waited]
    assert torch.equal(weights, tensor(FIRST).expand_as(weights))
    first, last = (PLANT.optimal_value(x, COST.q, COST.r) for x in (x0, run.state[:, -1]))
    assert first is not None
    assert last is not None
    assert float(((run.cost + last) / first).mean()) < 1.04
    assert float((last / first).max()) < 0.1


def test_where_the_model_is_certain_v_falls_for_every_theta_within_the_deviations() -> None:
    control = adaptive(confidence=3.0, share=1.0)
    x, critic = tensor([[1.0, -0.5]]), tensor([[0.6, 0.1, 0.9]])
    uniforms = x.new_zeros(1, control.draws, 2)
    terms = LEARNER.terms(x, critic, uniforms, MODEL.believing(TRUE))
    shape = torch.diag(tensor([1.0, 2.0, 0.5, 1.0, 1.5, 0.7]))

    def certain(scale: float) -> bool:
        estimate = changed(control.law.init(x, TRUE[None]), covariance=scale * shape[None])
        return bool(control.certain(x, critic, uniforms, terms, estimate))

    low, high = 1e-8, 1e4
    for _ in range(40):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if certain(middle) else (low, middle)
    slope, points = LEARNER.value_gradient(x, critic, uniforms), LEARNER.points(x, uniforms)
    directions = uniform(2000, 6, seed=1)
    errors = 3.0 * directions / directions.norm(dim=-1, keepdim=True) * (low * shape.diagonal()).sqrt()
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
    whole, alone = loop(control, x0, 20), loop(control, x0[2:3], 20)
    assert torch.equal(whole.state[2:3], alone.state)
    assert torch.equal(whole["theta"][2:3], alone["theta"])
    learned = loop(control, tensor([[-1.5, 1.5]]), 40).carried.estimate
    next_one = control.knowing(Estimate(*(part[0] for part in learned)))
    assert bool((loop(next_one, x0, 3)["certain"][:, 1] == 1).all())  # from the first step
    assert bool((loop(control, x0, 3)["certain"][:, 1] == 0).all())


def test_the_robust_policy_has_the_control_in_doubt() -> None:
    law = adp.LeastSquares([0.0] * 6, deviation=1e6, floor=1e3)  # nothing is ever learned
    robust = adp.LQR(PLANT, COST)
    x0 = uniform(4, 2)
    found = loop(adaptive(law, robust=robust), x0, 10)
    assert torch.equal(found.state, loop(adp.Feedback(robust), x0, 10).state)
    assert torch.equal(found.critic_weights[:, -1], tensor(FIRST).expand(4, 3))


def test_weights_begin_anew_where_the_plant_becomes_another_one() -> None:
    plant = adp.ChangingPlant(DAMPING)
    z0 = plant.start(tensor([[2.0, 0.0]]), before=[0.3], after=[3.0], at=0.5)
    law = adp.LeastSquares([0.0], deviation=3.0, floor=1e-4, alarm=8.0)
    inside = adp.AdaptiveActorCritic(LEARNER, DAMPING, adp.IntegralWindows(DAMPING, 0.01), law)
    control = adp.Measured(inside, noise=0.0, dim=2)
    run = adp.simulate(control, plant, plant.cost(COST), z0, dt=0.01, steps=60, compile=False)
    anew = int((run["resets"][0] > 0).to(torch.int8).argmax())
    assert 50 <= anew <= 53
    before, after = ((run.critic_weights[0, k] - tensor(FIRST)).abs().max() for k in (anew - 1, anew))
    assert float(after) < 0.7 * float(before)
    assert float(run["theta"][0, -1, 0]) == pytest.approx(3.0, abs=1e-2)
