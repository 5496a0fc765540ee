"""A safety filter for all parameters that are still possible."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform
from helpers_adaptation import COST, PENDULUM, TRUE
from torch import Tensor

from staf_torch import adp, systems

DT = 0.01
WANTED = adp.Feedback(lambda x: -10 * (x[..., :1] - 1.0) - 3 * x[..., 1:])  # beyond the edge
WINDOWS = adp.IntegralWindows(PENDULUM, 0.1, first=0.03)


def edge(x: Tensor, t: Tensor) -> Tensor:
    return 0.5 - x[:, 0]


def guard(low: Tensor, high: Tensor, wanted: adp.Controller = WANTED, **settings: float) -> adp.RobustFilter:
    law = adp.LeastSquares(
        (0.5 * (low + high)).tolist(), deviation=(0.25 * (high - low).abs() + 1e-9).tolist()
    )
    box = {"theta_low": low.tolist(), "theta_high": high.tolist()}
    return adp.RobustFilter(wanted, PENDULUM, edge, WINDOWS, law, dt=DT, decay=4.0, **box, **settings)


def test_where_theta_is_known_it_is_the_safety_filter_of_that_plant() -> None:
    x = tensor([[0.49, 0.0], [0.3, 0.5], [-0.4, 0.1]])
    filter = adp.SafetyFilter(WANTED.policy, PENDULUM, edge, dt=DT, decay=4.0, degree=2)
    known = guard(TRUE, TRUE)
    u = known.step(x, known.init(x), x.new_zeros(3, 0, 2), DT)[0]
    assert known.init(x).least_margin.tolist() == [1e300] * 3  # nothing was seen
    torch.testing.assert_close(u, filter(x), rtol=1e-9, atol=1e-9)
    assert torch.equal(u[2], WANTED.policy(x)[2])  # far from the edge nothing is changed


def test_the_control_meets_the_condition_of_every_theta_of_the_box() -> None:
    low, high = tensor([0.0, 0.6]), tensor([0.4, 1.5])
    safe, x = guard(low, high), tensor([[0.45, 0.15]]).repeat(50, 1)
    u = safe.step(x, safe.init(x), x.new_zeros(50, 0, 2), DT)[0]
    theta = low + (high - low) * (0.5 + 0.5 * uniform(50, 2, seed=1))
    z = adp.ChangingPlant(PENDULUM).start(x, theta, at=1.0)
    normal, least, _ = safe.filter.inequalities(z, u, x[:, 0])
    missing = least[:, 0] - (normal[:, 0] * u).sum(-1)
    assert float(missing.max()) < 0.02  # of some 10: what is not affine in theta over a hold
    assert not torch.equal(u, WANTED.policy(x))


def test_an_edge_is_kept_while_the_parameters_are_learned_compiled_as_defined() -> None:
    plant = adp.ParametricPlant.of_effectiveness(systems.Pendulum())  # one parameter: a shorter program
    law, windows = adp.LeastSquares([1.05], deviation=0.225), adp.IntegralWindows(plant, 0.1, first=0.03)
    box = {"theta_low": [0.6], "theta_high": [1.5]}
    safe = adp.RobustFilter(WANTED, plant, edge, windows, law, dt=DT, decay=4.0, **box)
    truth, true = adp.ChangingPlant(plant), tensor([[0.6], [1.5], [1.0]])
    z0 = truth.start(tensor([[0.2, 0.3], [0.4, 0.0], [-0.5, 1.0]]), true)
    seen, cost = adp.Measured(safe, noise=0.0, dim=2), truth.cost(COST)
    run = adp.simulate(seen, truth, cost, z0, dt=DT, steps=150, compile=True)
    assert float(run.state[..., 0].max()) < 0.5
    assert float(run.state[:, -1, 0].min()) > 0.45  # and it comes near
    torch.testing.assert_close(run["least_margin"][:, -1], (0.5 - run.state[:, :-1, 0]).amin(1))
    torch.testing.assert_close(run["theta"][:, -1], true, rtol=1e-2, atol=0)
    assert float(run["largest_slack"].max()) < 1e-9
    assert float(run["acted"][:, -1].min()) > 0
    few = adp.simulate(seen, truth, cost, z0, dt=DT, steps=2, compile=False)
    torch.testing.assert_close(run.state[:, :3], few.state, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(run.control[:, :2], few.control[:, :2], rtol=1e-9, atol=1e-9)


def test_a_box_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="theta_low"):
        guard(tensor([0.0, 2.0]), TRUE)
    with pytest.raises(ValueError, match="confidence"):
        guard(0 * TRUE, TRUE, confidence=0.0)


@pytest.mark.parametrize(("gain", "least"), [(1.5, 0.3), (0.2, 0.1), (-4.0, 1.0)])
def test_a_control_is_left_to_the_last_bit_where_and_only_where_every_corner_allows_it(
    gain: float, least: float
) -> None:
    mild = adp.Feedback(lambda x: gain * x[..., :1] + least)
    low, high = tensor([0.0, 0.6]), tensor([0.4, 1.5])
    safe = guard(low, high, mild)
    x = uniform(300, 2, seed=5, low=-0.6, high=0.6)
    wanted, u = mild.policy(x), safe.step(x, safe.init(x), x.new_zeros(300, 0, 2), DT)[0]
    rooms = []
    for first in (0.0, 0.4):
        for second in (0.6, 1.5):
            z = adp.ChangingPlant(PENDULUM).start(x, tensor([first, second]).repeat(300, 1), at=1.0)
            normal, least, _ = safe.filter.inequalities(z, wanted, x[:, 0])
            rooms.append(((normal * wanted.unsqueeze(-2)).sum(-1) - least).amin(-1))
    room, left = torch.stack(rooms).amin(0), (u == wanted).all(-1)
    assert 30 < int(left.sum()) < 290
    assert bool(left[room > 1e-6].all())
    assert not bool(left[room < -1e-6].any())
