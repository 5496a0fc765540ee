"""A swing-up by energy: the base policy for where an LQR does not reach."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from staf_torch import adp, systems


class Turning(systems.Pendulum):
    """The pendulum whose angle is one."""

    periodic = (0,)


PLANT = Turning(damping=0.0)
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-5.0, high=5.0)


def energy(x: Tensor) -> Tensor:
    return 0.5 * x[..., 1].square() + 9.81 * x[..., 0].cos()


def pump(**more: object) -> adp.EnergyShaping:
    return adp.EnergyShaping(PLANT, COST, energy, **{"gain": 1.0, "capture": 0.5, "period": 0.02} | more)


@torch.no_grad()
def test_pendulum_swings_up_from_everywhere_within_its_bounds_where_the_lqr_does_not() -> None:
    x0 = torch.tensor([[3.1, 0.0], [2.0, -1.0], [-1.0, 0.5], [0.0, 7.0]], dtype=torch.float64)
    policy = pump()
    ours, lqr = (
        adp.simulate(adp.Feedback(one), PLANT, COST, x0, dt=0.02, steps=steps, compile=False)
        for one, steps in ((policy, 260), (policy.lqr, 60))
    )
    assert (policy.lqr.cost.deviation(ours.state[:, -1]).norm(dim=-1) < 1e-3).all()
    assert (policy.lqr.cost.deviation(lqr.state[:, -1]).norm(dim=-1) > 0.1).any()
    assert ours.control[:, :-1].abs().max() <= 5
    # Where it pumps, the energy comes nearer to that of the goal at every step.
    x = torch.tensor([[2.5, 1.0]], dtype=torch.float64)
    after = systems.runge_kutta_step(lambda z: PLANT.rate(z, policy(x)), x, 0.02)
    top = energy(torch.zeros(1, 2, dtype=torch.float64))
    assert (energy(after) - top).abs() < (energy(x) - top).abs()


def test_bad_arguments_are_refused_by_name() -> None:
    free = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    with pytest.raises(ValueError, match=r"`EnergyShaping\(cost=...\)` or the plant must have bounds"):
        adp.EnergyShaping(PLANT, free, energy, gain=1.0, capture=1.0)
    for wrong in ({"gain": 0.0}, {"capture": -1.0}):
        with pytest.raises(ValueError, match=rf"`EnergyShaping\({next(iter(wrong))}=...\)` must be"):
            pump(**wrong)
    step = systems.StepPlant(lambda x, u: x + 0.1 * u, dim=1, inputs=1, dt=0.1)
    with pytest.raises(ValueError, match=r"`EnergyShaping\(system=...\)` must be a ControlAffineSystem"):
        adp.EnergyShaping(step, COST, energy, gain=1.0, capture=1.0)
