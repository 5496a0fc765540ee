# %% [markdown]
# # A plant of your own
# x' = f(x) + g(x) u is a class with `drift` and `effectiveness`. Whatever takes a plant of the library
# takes yours.

# %%
import torch

from staf_torch import GaussianKernel, StaFBasis, StateFollowingCenters, chase, optim, rings, systems


class Trolley(systems.ControlAffineSystem):
    """position' = speed, speed' = -drag speed + u."""

    dim, inputs = 2, 1

    def drift(self, x):  # (..., n) -> (..., n)
        return torch.stack((x[..., 1], -0.2 * x[..., 1]), dim=-1)

    def effectiveness(self, x):  # (..., n) -> (..., n, m)
        zero = torch.zeros_like(x[..., 0])
        return torch.stack((zero, zero + 1), dim=-1).unsqueeze(-1)


# %% [markdown]
# Its kinetic energy and a spring's, followed along a hundred trajectories at once.

# %%
x = torch.randn(100, 2, dtype=torch.float64)
states = systems.simulate(Trolley(), x, dt=0.02, steps=100)
basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(6), radius=0.2))


def energy(x):
    return 0.5 * x.square().sum(-1)


result = chase(states, basis, energy, optim.PreconditionedDescent(), inner_steps=2)
error = (result.value - result.estimate).abs()[:, -1]
print(error.max())
assert error.max() < 1e-2
