# %% [markdown]
# # A first approximation
# A controller needs its value function where the state is. So take a state x, a ball of radius r around
# it, a few kernels with centers in the ball, and the weights with which they reproduce V at the centers.

# %%
import torch

from staf_torch import GaussianKernel, StaF, StaFBasis, StateFollowingCenters, rings


def valley(x):
    """A function of your own: any torch code, (..., n) -> (...)."""
    return x[..., 0].sin() + x[..., 0] * x[..., 1] ** 2


basis = StaFBasis(GaussianKernel(width=1.0), StateFollowingCenters(rings(6), radius=0.1))
x = torch.tensor([1.0, 0.5], dtype=torch.float64)
staf = StaF(basis).fit_(x, valley)

# %% [markdown]
# Inside the ball the error is small, outside it means nothing: the approximation is local, as it is meant
# to be.

# %%
angle = torch.linspace(0, 6.28, 50, dtype=torch.float64)
circle = torch.stack((angle.cos(), angle.sin()), dim=-1)
errors = {}
for distance in (0.05, 0.1, 1.0):
    y = x + distance * circle
    errors[distance] = float((staf(y) - valley(y)).detach().abs().max())
print(errors)
assert errors[0.05] < errors[0.1] < 1e-2 < errors[1.0]

# %% [markdown]
# The gradient, which a controller asks for, comes from the same coefficients.

# %%
exact = torch.tensor([x[0].cos() + x[1] ** 2, 2 * x[0] * x[1]])
assert (staf.gradient(x[None])[0] - exact).abs().max() < 0.02

# %% [markdown]
# A thousand states side by side: one row each, and no row influences another.

# %%
states = torch.randn(1000, 2, dtype=torch.float64)
many = StaF(basis, batch_shape=(1000,)).fit_(states, valley)
assert many.rowwise(states + 0.02).shape == (1000,)
