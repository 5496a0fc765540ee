# %% [markdown]
# # Which kernel, how many centers, what radius
# In n = 2, rings of 3, 6, 10, 15 points are as many as the polynomials of degree 1, 2, 3, 4 have
# coefficients. Each step gains one power of r. A smooth kernel keeps the order; a Matern kernel stops at its
# own smoothness.

# %%
import math

import torch

from staf_torch import ExponentialKernel, MaternKernel, StaF, StaFBasis, StateFollowingCenters, rings
from staf_torch.targets import Paper

V, x = Paper(), torch.tensor([0.7, -0.4], dtype=torch.float64)
angle = torch.linspace(0, 2 * math.pi, 64, dtype=torch.float64)
circle = torch.stack((angle.cos(), angle.sin()), dim=-1)


def error(kernel, count, radius):
    """Largest error on the edge of the ball."""
    staf = StaF(StaFBasis(kernel, StateFollowingCenters(rings(count), radius=radius))).fit_(x, V)
    y = x + radius * circle
    return float((staf(y) - V(y)).detach().abs().max())


# %%
for kernel in (ExponentialKernel(), MaternKernel(smoothness=1.5)):
    for count in (3, 6, 10):
        small, large = error(kernel, count, 0.05), error(kernel, count, 0.1)
        order = math.log2(large / small)
        print(f"{type(kernel).__name__:20} M={count:2}  error at r=0.1 {large:.1e}, order {order:.1f}")

# %% [markdown]
# Read: with the exponential kernel the order grows with the count. So choose the radius from what the state
# does in a few time steps, then the count from the accuracy that is wanted.

# %%
orders = [
    math.log2(error(ExponentialKernel(), M, 0.1) / error(ExponentialKernel(), M, 0.05)) for M in (3, 6, 10)
]
assert all(abs(order - wanted) < 0.5 for order, wanted in zip(orders, (2, 3, 4), strict=True))
