"""Plants of unknown parameters, drifts without a form, policies on them: formulas, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import random_positive_definite, tensor, uniform
from helpers_adaptation import COST, PENDULUM, friction_and_inertia, gravity
from torch import Tensor

from staf_torch import GaussianKernel, adp, rings, systems

LAW = adp.LeastSquares([0.1, 1.0], deviation=0.5)
WINDOWS = adp.IntegralWindows(PENDULUM, 0.1)
KNOWN = systems.Linear([[0.0, 1.0], [-0.4, 0.2]], [[0.0], [1.0]])
CENTERS = 0.5 * rings(3)


def drift_of(**given: Any) -> adp.StreamDrift:
    usual = {"known": KNOWN, "kernel": GaussianKernel(2.0), "offsets": CENTERS}
    usual |= {"rows": [1], "deviation": 3.0, "length": 0.1, "floor": 0.05}
    return adp.StreamDrift(**(usual | given))  # type: ignore[arg-type]


def learned(drift: adp.StreamDrift) -> adp.DriftEstimate:
    rows, count = 4, drift.offsets.numel()
    sizes = random_positive_definite(3, rows, size=count, log_condition=1.0) / 12
    return adp.DriftEstimate(
        0.3 * uniform(rows, 2, seed=1), uniform(rows, len(drift.rows), count, seed=2), sizes
    )


@pytest.mark.parametrize("forgetting", [0.0, 0.7])
@pytest.mark.parametrize("rows", [[1], [0, 1]])
def test_a_drift_is_learned_as_a_kalman_filter_written_out_learns_its_weights(
    forgetting: float, rows: list[int]
) -> None:
    drift = drift_of(forgetting=forgetting, rows=rows)
    now, x = learned(drift), 0.3 * uniform(4, 2, seed=5)
    s, z, variance = (
        uniform(4, len(rows), 6, seed=6),
        uniform(4, len(rows), seed=7),
        tensor([0.0, 0.1, 0.2, 0.3]),
    )
    s = s[:, :1].expand_as(s)
    ready = torch.tensor([True, True, False, True])
    after = drift.step(now, adp.Equation(s, z, variance, ready), x, 0.2)
    assert torch.equal(after.anchor, now.anchor)  # within the ball nothing moves
    identity = torch.eye(6).double()
    for k in range(4):
        p, mean = now.covariance[k], now.mean[k]
        p = identity + (p - identity) / (1 + 0.2 * forgetting) if forgetting else p
        psi = drift.kernel((x[k] - now.anchor[k])[None], drift.offsets)[0] @ drift.basis
        rest = max(0.0, 1 - float(psi @ psi))
        noise = float(variance[k]) + 0.05**2 + (0.1 * 3.0) ** 2 * rest * float(x[k] @ x[k])
        if bool(ready[k]):
            h = 3.0 * s[k, 0]
            gain = p @ h / (float(h @ p @ h) + noise)
            mean = mean + torch.outer(z[k] - mean @ h, gain)
            p = p - torch.outer(gain, p @ h)
        torch.testing.assert_close(after.mean[k], mean, rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(after.covariance[k], p, rtol=1e-9, atol=1e-10)


def test_centers_that_move_take_with_them_what_the_old_ones_say_of_the_new() -> None:
    drift = drift_of(rows=[0, 1])
    now = learned(drift)
    x = now.anchor + tensor([[0.6, 0.0], [0.0, -0.55], [0.49, 0.0], [0.7, 0.7]])
    quiet = torch.zeros(4, 2, 6).double()
    ready = torch.tensor([True, True, True, False])
    after = drift.step(now, adp.Equation(quiet, quiet[..., 0], quiet[:, 0, 0], ready), x, 0.2)
    identity = torch.eye(6).double()
    for k, moved in enumerate((True, True, False, False)):
        there = drift.kernel(x[k] - now.anchor[k] + drift.offsets, drift.offsets)
        transfer = torch.kron(drift.basis.mT @ there @ drift.basis, torch.eye(2).double())
        mean, p = (
            now.mean[k] @ transfer.mT,
            identity - transfer @ (identity - now.covariance[k]) @ transfer.mT,
        )
        torch.testing.assert_close(after.anchor[k], x[k] if moved else now.anchor[k])
        torch.testing.assert_close(after.mean[k], mean if moved else now.mean[k], rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(
            after.covariance[k], p if moved else now.covariance[k], rtol=1e-9, atol=1e-10
        )


def test_what_is_believed_of_a_drift_is_the_sum_over_its_weights() -> None:
    drift = drift_of(rows=[0, 1])
    now, x = learned(drift), uniform(4, 2, seed=8)
    a, covariance = drift.slopes(now, x)
    mean, spread = drift.predict(now, x)
    whole, same = drift.matrix(now, x)
    for k in range(4):
        psi = drift.kernel((x[k] - now.anchor[k])[None], drift.offsets)[0] @ drift.basis
        features = torch.kron(psi[None], torch.eye(2).double())  # a = features weights
        wanted = 3.0 * now.mean[k] @ features.mT
        left = max(0.0, 1 - float(psi @ psi)) * torch.eye(2).double()
        size = 9.0 * (features @ now.covariance[k] @ features.mT + left)
        torch.testing.assert_close(a[k], wanted)
        torch.testing.assert_close(covariance[k], size)
        torch.testing.assert_close(mean[k], wanted @ x[k])
        torch.testing.assert_close(spread[k], (x[k] @ size @ x[k]).sqrt().expand(2))
        torch.testing.assert_close(whole[k], KNOWN.matrix + wanted)
        regressor = drift.window_of(now).model.regressor(x, x[:, :1])[k]
        torch.testing.assert_close(regressor, torch.outer(psi, x[k]).flatten().expand(2, 6))
    assert torch.equal(same, covariance)
    one = drift_of(rows=[1]).window_of(now).model.regressor(x, x[:, :1])
    assert not bool(one[:, 0].any())
    assert bool(one[:, 1].any())


def test_a_known_rate_of_the_seventh_degree_counts_exactly() -> None:
    def rate(x: Tensor, u: Tensor) -> Tensor:
        a, b = x.unbind(-1)
        return torch.stack((a**7 - 2 * b**5 + a * b, 3 * a**3 * b**4 - b + u[..., 0]), dim=-1)

    known = systems.RatePlant(rate, dim=2, inputs=1)
    if not isinstance(known, systems.ControlAffineSystem):
        known = adp.ParametricPlant(lambda x, u: 0 * x.unsqueeze(-1), rate, dim=2, inputs=1, theta=[0.0])
    drift, x = drift_of(known=known), uniform(9, 2, seed=3)
    a, _ = drift.matrix(drift.init(x), x)
    torch.testing.assert_close(
        (a @ x.unsqueeze(-1)).squeeze(-1), rate(x, 0 * x[:, :1]), rtol=1e-11, atol=1e-12
    )


def test_a_drift_is_refused_what_it_cannot_be() -> None:
    drift = drift_of(noise=0.2, smooth=True)
    assert (drift.windows.noise, drift.windows.smooth, drift.windows.length) == (0.2, True, 0.1)
    assert drift.radius == pytest.approx(0.5)
    assert (drift.windows.model.rows, drift.windows.model.inputs, drift.windows.model.dim) == ([1], 1, 2)
    wrong: tuple[tuple[str, Any], ...] = (
        ("known", systems.Pendulum),
        ("kernel", torch.nn.Identity()),
        ("offsets", [[0.1, 0.1]]),
        ("offsets", CENTERS[0]),
        ("offsets", CENTERS[:, :1]),
        ("offsets", torch.zeros(3, 2).double()),
        ("offsets", CENTERS * torch.nan),
        ("forgetting", -0.1),
        ("noise", -0.1),
    )
    for name, value in wrong:
        with pytest.raises(ValueError, match=rf"{name}=..."):
            drift_of(**{name: value})


def plant_of(**given: Any) -> adp.ParametricPlant:
    usual = {"regressor": friction_and_inertia, "known": gravity, "dim": 2, "inputs": 1, "theta": [0.1, 1.0]}
    return adp.ParametricPlant(**(usual | given))  # type: ignore[arg-type]


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "no states": ({"dim": 0}, "dim"),
    "no parameters": ({"theta": []}, "theta"),
    "one number": ({"theta": 0.1}, "theta"),
    "no number": ({"theta": [0.1, math.nan]}, "theta"),
    "too many parameters": ({"theta": [0.1, 1.0, 2.0]}, r"regressor=...\)` must map \(4, 2\) to \(4, 2, 3\)"),
    "no rows": ({"rows": []}, "rows"),
    "rows twice": ({"rows": [1, 1]}, "rows"),
    "rows in another order": ({"rows": [1, 0]}, "must be numbers of the 2 states, in order"),
    "a row that is not there": ({"rows": [1, 2]}, "rows"),
    "a row that is left out": ({"rows": [0]}, "must have all states whose regressor does not vanish"),
    "no tensor": (
        {"regressor": lambda x, u: 1.0},
        r"regressor=...\)` must map \(4, 2\) to \(4, 2, 2\); got 1",
    ),
    "known of another shape": (
        {"known": lambda x, u: x[..., :1]},
        r"known=...\)` must map \(4, 2\) to \(4, 2\)",
    ),
    "a square of the input": (
        {"known": lambda x, u: x + 0.01 * u.square()},
        r"known=...\)` must be affine in u",
    ),
    "a little of a square": ({"known": lambda x, u: x + 1e-7 * u.square()}, "must be affine in u"),
    "a sine of the input": (
        {"regressor": lambda x, u: torch.stack((x, x * u.sin()), -1)},
        r"regressor=...\)` must be affine in u",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_plant_that_is_none_is_refused(case: str) -> None:
    given, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        plant_of(**given)


def test_a_plant_may_have_one_state_no_inputs_large_rates_and_parameters_of_rows() -> None:
    still = adp.ParametricPlant(lambda x, u: x.unsqueeze(-1), dim=1, inputs=0, theta=[2.0])
    assert still.effectiveness(torch.ones(3, 1).double()).shape == (3, 1, 0)
    assert still.drift(tensor([3.0])).tolist() == [6.0]
    assert still.rows == [0]
    plant_of(known=lambda x, u: 1e9 * (x + u))  # rounding is measured by its size
    many = plant_of(theta=uniform(3, 2, seed=1))
    assert many.parameters_count == 2
    x, u = uniform(3, 2, seed=2), uniform(3, 1, seed=3)
    wanted = gravity(x, u) + (friction_and_inertia(x, u) @ many.theta.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(many.rate(x, u), wanted)
    assert plant_of(theta=torch.tensor([1, 2])).theta.dtype == torch.float64


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
    assert (model.dim, model.inputs, model.rows, model.periodic) == (2, 1, [1], box.periodic)
    assert model.bounds is inside.bounds
    assert torch.equal(model.theta, inside.theta)
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
    for x, u in ((tensor([0.1, 0.0]), held), (at, tensor([0.4])), (tensor([0.2, 0.1]), held)):
        with pytest.raises(ValueError, match=rule):
            plant.family(x, u)
    with pytest.raises(ValueError, match=rule):
        plant.family()


def test_a_doubt_is_the_double_sum_over_the_parameters() -> None:
    control = adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, LAW, confidence=2.0)
    family, p = PENDULUM.family(), random_positive_definite(1, 3, size=2)
    covariance, k = random_positive_definite(2, 3, size=2), uniform(3, 1, 2, seed=4)
    found = control._doubt(covariance, p, k)
    for row in range(3):
        weight = torch.linalg.inv(torch.eye(2).double() + k[row].mT @ k[row])
        terms = []
        for i in range(2):
            slope = family.a_slopes[i] - family.b_slopes[i] @ k[row]
            terms.append(p[row] @ slope + (p[row] @ slope).mT)
        wanted = sum(
            4 * covariance[row, i, j] * (weight @ terms[i] @ weight @ terms[j]).trace()
            for i in range(2)
            for j in range(2)
        )
        torch.testing.assert_close(found[row], wanted)
    assert math.isinf(float(control._doubt(covariance * torch.nan, p, k)[0]))


def test_an_adaptive_policy_begins_where_it_is_told_and_refuses_what_it_cannot_be() -> None:
    control, x0 = adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, LAW, doublings=6, a_step=2), uniform(3, 2, seed=1)
    now = control.adaptation(control.init(x0).identifier)
    assert now.alarmed_at.tolist() == [-1.0] * 3
    assert now.time.tolist() == now.stage.tolist() == now.certain.tolist() == [0.0] * 3
    own = uniform(3, 2, seed=2)
    other = control.starting_from(own)
    assert torch.equal(other.adaptation(other.init(x0).identifier).estimate.theta, own)
    assert torch.equal(control.adaptation(control.init(x0).identifier).estimate.theta, LAW.first.expand(3, 2))
    lqr = adp.LQR(PENDULUM.believing(LAW.first), COST)
    torch.testing.assert_close(control.robust(x0), lqr(x0))
    assert (control.redesign.doublings, control.redesign.a_step) == (6, 2)
    assert adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, LAW, doublings=6).redesign.a_step == 6
    fading = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, discount=0.1)
    few = adp.LeastSquares([0.1], deviation=0.5)
    make: tuple[tuple[Callable[[], object], str], ...] = (
        (lambda: adp.AdaptiveLQR(PENDULUM, fading, WINDOWS, LAW), r"cost=...\)` must have no discount"),
        (
            lambda: adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, few),
            "law=...\\)` must have the model's 2 parameters",
        ),
        (lambda: adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, LAW, probe=-0.1), "probe"),
        (lambda: adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, LAW, confidence=0.0), "confidence"),
        (lambda: adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, LAW, doublings=0), "doublings"),
        (
            lambda: adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, LAW, doublings=6, a_step=4),
            "must divide the 6 doublings",
        ),
        (lambda: adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, LAW, a_step=0), "a_step"),
        (lambda: adp.DriftLQR(drift_of(), fading), r"cost=...\)` must have no discount"),
        (lambda: adp.DriftLQR(drift_of(), COST, doublings=6, a_step=4), "must divide the 6 doublings"),
        (lambda: adp.DriftLQR(drift_of(), COST, doublings=0), "doublings"),
        (lambda: adp.DriftLQR(drift_of(), COST, a_step=0), "a_step"),
        (lambda: adp.DriftLQR(drift_of(), COST, confidence=0.0), "confidence"),
    )
    for each, message in make:
        with pytest.raises(ValueError, match=message):
            each()
    assert adp.AdaptiveLQR(PENDULUM, COST, WINDOWS, LAW, doublings=1).redesign.doublings == 1
    drifting = adp.DriftLQR(drift_of(), COST, doublings=4, a_step=1)
    torch.testing.assert_close(drifting.robust(x0), adp.LQR(KNOWN, COST)(x0))
    assert (drifting.redesign.doublings, drifting.redesign.a_step) == (4, 1)


def test_a_tracker_pushes_by_its_gains_and_learns_from_its_error_at_once() -> None:
    plant = adp.ParametricPlant(
        lambda z, u: torch.stack((z.sin(), z), dim=-1), lambda z, u: u, dim=1, inputs=1, theta=[2.0, 1.0]
    )
    feedback, gain, rate = tensor([2.0, 3.0]), tensor([0.5, 0.7]), tensor([1.0, 4.0])
    tracker = adp.ConcurrentTracker(
        *(plant, lambda z: (0.5 * z.cos(), -0.2 + 0 * z)),
        **{
            "length": [0.1, 0.2],
            "feedback": feedback,
            "gain": gain,
            "rate": rate,
            "size": 3,
            "first": [0.3, -0.1],
        },
    )
    x = tensor([[0.4], [-0.6]])
    start = tracker.init(x)
    now = tracker.tracking(start.identifier)
    assert torch.equal(now.theta, tensor([[0.3, -0.1]] * 2))
    assert now.window.length.tolist() == [0.1, 0.2]
    assert now.stack.s.shape == (2, 3, 1, 2)
    u, after = tracker.step(x, start, x, 0.05)
    error, y = x - 0.5 * x.cos(), torch.cat((x.sin(), x), -1)
    theta = now.theta + 0.05 * rate[:, None] * y * error  # nothing is remembered yet
    torch.testing.assert_close(tracker.tracking(after.identifier).theta, theta)
    torch.testing.assert_close(u, -0.2 - (y * theta).sum(-1, keepdim=True) - feedback[:, None] * error)
    torch.testing.assert_close(tracker.tracking(after.identifier).window.u, u)
    plain = adp.ConcurrentTracker(plant, lambda z: (z, z), length=0.1, feedback=1.0, gain=1.0)
    assert plain.stack.size == 20
    assert not bool(plain.tracking(plain.init(x).identifier).theta.any())
    for name in ("length", "feedback", "gain", "rate"):
        for wrong in (0.0, [1.0, -1.0], [[1.0]]):
            given: dict[str, Any] = {"length": 0.1, "feedback": 1.0, "gain": 1.0} | {name: wrong}
            with pytest.raises(ValueError, match=rf"`ConcurrentTracker\({name}=...\)` must be positive"):
                adp.ConcurrentTracker(plant, lambda z: (z, z), **given)


def test_a_learner_and_its_model_belong_together() -> None:
    learner = adp.ActorCritic(adp.QuadraticBasis(2), PENDULUM, COST, adp.RandomPoints(1, half_width=0.5))
    wide = adp.ParametricPlant(lambda x, u: x.unsqueeze(-1), dim=3, inputs=1, theta=[0.1])
    with pytest.raises(ValueError, match=r"model=...\)` must have the 2 states of the learner's basis"):
        adp.AdaptiveActorCritic(learner, wide, WINDOWS, LAW)
    with pytest.raises(ValueError, match=r"law=...\)` must have the model's 2 parameters"):
        adp.AdaptiveActorCritic(learner, PENDULUM, WINDOWS, adp.LeastSquares([0.1], deviation=1.0))
    for name in ("confidence", "share"):
        with pytest.raises(ValueError, match=rf"`AdaptiveActorCritic\({name}=...\)` must be positive"):
            adp.AdaptiveActorCritic(learner, PENDULUM, WINDOWS, LAW, **{name: 0.0})
    one = adp.AdaptiveActorCritic(learner, PENDULUM, WINDOWS, LAW)
    assert one.draws == learner.draws
    known = adp.Estimate(tensor([0.7, 2.0]), torch.eye(2).double(), tensor(0.5), tensor(3.0))
    started = one.knowing(known)
    x0 = uniform(3, 2, seed=1)
    now = started.knowledge(started.init(x0).identifier)
    for part, given in zip(now.estimate, known, strict=True):
        assert torch.equal(part, given.expand(part.shape))
    assert torch.equal(one.knowledge(one.init(x0).identifier).estimate.theta, LAW.first.expand(3, 2))
