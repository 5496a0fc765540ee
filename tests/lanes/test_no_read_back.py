"""No step reads a tensor back to the host: on the meta device, which has no numbers, that would raise."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch import centers, kernels, lanes, optim
from staf_torch.optim.objective import NativeError, Precomputed

DIRECTIONS = torch.tensor([[1.0, 0.0], [-0.5, 0.8], [-0.5, -0.8]], dtype=torch.float64)


@pytest.mark.parametrize("kernel", [kernels.ExponentialKernel(), kernels.GaussianKernel(1.0)])
@pytest.mark.parametrize("radius", [0.3, centers.StateRadius(0.7, 0.01)])
@pytest.mark.parametrize("law", [optim.SteepestDescent(), optim.ConjugateGradient(), optim.Nesterov()])
def test_a_chase_on_a_device_stays_there(kernel: Any, radius: Any, law: optim.UpdateLaw) -> None:
    following = centers.StateFollowingCenters(DIRECTIONS, radius)

    def step(carry: Any, x: Tensor, _: Any) -> Any:
        near = following(x)
        gram = kernel(near, near)
        objective = NativeError(gram, near.square().sum(-1), Precomputed(extremes=torch.ones_like(x) * 2.0))
        carry = carry[0], law.begin(objective, *carry)
        carry = lanes.repeat(2, lambda c: law.step(objective, *c), carry)
        return carry, carry[0]

    states = torch.empty(5, 4, 2, dtype=torch.float64, device="meta")
    weights = states.new_empty(5, 3)
    end, history = lanes.Program(step)((weights, law.init(weights)), states)
    assert end[0].device.type == history.device.type == "meta"
    assert history.shape == (5, 4, 3)


def test_the_meta_device_notices_a_value_that_is_read() -> None:
    x = torch.empty(3, 2, device="meta")
    with pytest.raises((RuntimeError, NotImplementedError), match="meta"):
        lanes.Program(lambda x, _, __: (x if bool((x > 0).all()) else -x, ()))(x, steps=1)
