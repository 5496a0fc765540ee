# %% [markdown]
# # Chasing
# When the state moves, the ideal weights move. Solving for them at each time costs M^3; a few iterations of
# an update law, started from the last weights, cost M^2 each and stay close: the weights chase their ideal
# values.

# %%
import torch

from staf_torch import GaussianKernel, StaFBasis, StateFollowingCenters, chase, optim, rings, run, systems
from staf_torch.targets import Paper

basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.3))
x = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
states = systems.simulate(systems.Oscillator(), x, dt=0.01, steps=600)  # (B, T, n)

# %% [markdown]
# `excess` is how much worse the present weights are than the ideal ones, in the norm of the kernel's space.

# %%
settled = {}
for inner_steps in (1, 10):
    result = chase(states, basis, Paper(), optim.SteepestDescent(), inner_steps=inner_steps)
    settled[inner_steps] = float(result.excess[0, 300:].max())
print(settled)
assert settled[10] < settled[1]

# %% [markdown]
# The same as an experiment, with its figure and its run directory; `staf animation=true` shows it in motion.

# %%
found = run("kernel=gaussian", "centers.radius=0.3", "duration=1.0", "settle_time=0.5")
assert found.metrics["diverged_fraction"] == 0
found.figures()["gradient_chase"]
