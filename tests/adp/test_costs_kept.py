"""What a cost keeps in its state, and the sizes and bounds at which it is still one."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform

from staf_torch import adp, systems

FULL = tensor([[2.0, 0.5, 0.1, 0.0], [0.5, 1.5, 0.2, 0.1], [0.1, 0.2, 1.0, 0.3], [0.0, 0.1, 0.3, 1.2]])


def test_a_state_dict_has_the_matrices_and_not_what_follows_from_bounds() -> None:
    smooth = adp.BoundedInputCost(1.0, 1.0, dim=2, inputs=2, bound=[1.0, 2.0])
    coupled = adp.QuadraticCost(1.0, FULL[:2, :2], dim=2, inputs=2, low=-1.0, high=2.0)
    for cost in (smooth, coupled):
        assert sorted(cost.state_dict()) == ["q", "r", "r_inverse"]
    ended = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, terminal=3.0)
    assert sorted(ended.state_dict()) == ["end", "q", "r", "r_inverse"]
    torch.testing.assert_close(coupled.r_inverse @ FULL[:2, :2], torch.eye(2).double())


def test_four_inputs_that_are_bounded_may_be_weighed_together_and_five_may_not() -> None:
    cost = adp.QuadraticCost(1.0, FULL, dim=2, inputs=4, low=-0.3, high=0.2)
    effectiveness, gradient = uniform(5, 2, 4, seed=1), 4 * uniform(5, 2, seed=2)
    found = cost.policy(effectiveness, gradient)
    pull = (effectiveness.mT @ gradient.unsqueeze(-1)).squeeze(-1)

    def paid(u: torch.Tensor) -> torch.Tensor:
        return ((u @ FULL) * u).sum(-1) + (u * pull).sum(-1)

    assert bool(((found >= -0.3) & (found <= 0.2)).all())
    assert bool((found == 0.2).any())
    for k in range(200):
        other = (found + 0.1 * uniform(5, 4, seed=k)).clamp(-0.3, 0.2)
        assert bool((paid(other) >= paid(found) - 1e-12).all())
    five = torch.eye(5).double()
    five[0, 1] = five[1, 0] = 0.1
    with pytest.raises(ValueError, match="more than 4 bounded inputs"):
        adp.QuadraticCost(1.0, five, dim=2, inputs=5, low=-1.0)
    assert adp.QuadraticCost(1.0, five, dim=2, inputs=5).bounds is None


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-1.0, 0.0), (-1.0, None), (None, 1.0)])
def test_a_smooth_bound_is_finite_with_the_input_at_rest_inside(
    low: float | None, high: float | None
) -> None:
    with pytest.raises(ValueError, match="must be finite, with the input"):
        adp.BoundedInputCost(1.0, 1.0, dim=1, inputs=1, low=low, high=high)
    with pytest.raises(ValueError, match="must be finite, with the input"):
        adp.BoundedInputCost(1.0, 1.0, dim=1, inputs=1, low=-1.0, high=1.0, target_input=[1.0])


def test_a_plant_without_inputs_takes_any_cost_of_its_states() -> None:
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=3)
    assert cost.around(systems.Oscillator()) is cost
    for plant in (systems.TwoState(), systems.ThreeState()):
        with pytest.raises(ValueError, match=r"is for 2 states and 3 inputs"):
            cost.around(plant)
    free = adp.Gains(critic=0.0, actor_decay=0.0)
    assert (free.critic, free.actor_decay) == (0.0, 0.0)
    with pytest.raises(ValueError, match="must not be negative"):
        adp.Gains(actor=-1e-9)


def test_a_terminal_cost_is_of_the_state_alone_and_of_no_discount() -> None:
    def seen(x: torch.Tensor) -> torch.Tensor:
        return x[..., :1]

    for more in ({"output": seen}, {"discount": 0.1}):
        state = 1.0
        assert adp.QuadraticCost(state, 1.0, dim=2, inputs=1, **more).end is None  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="terminal"):
            adp.QuadraticCost(state, 1.0, dim=2, inputs=1, terminal=1.0, **more)  # type: ignore[arg-type]
    kept = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, terminal=[[2.0, 0.0], [0.0, 0.0]])
    assert kept.terminal(tensor([[3.0, 5.0]])).tolist() == [18.0]
