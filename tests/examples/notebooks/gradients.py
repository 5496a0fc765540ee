# %% [markdown]
# # Gradients through time
# What has `requires_grad` gets its gradient through a whole closed loop or a whole chase. Here the gains of a
# controller that learns are themselves learned: by the cost of what it does while it learns.

# %%
import matplotlib.pyplot as plt
import torch

from staf_torch import (
    AnchoredKernel,
    ExponentialKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    rings,
    run,
    systems,
)

plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
centers = StateFollowingCenters(rings(3), StateRadius(0.7, 1e-5))
basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(ExponentialKernel()), centers)).double()
points = adp.RandomPoints(4, StateRadius(2.1, 1e-5))
starts = torch.tensor([[-1.0, 1.0], [1.0, 1.0], [0.5, -1.0], [-1.0, -0.5]]).double()

# %% [markdown]
# The published gains are the start; their logarithms are learned, so that they stay positive. The first step
# compiles the loop and its adjoint, a later one takes a tenth of a second. It ends early: some steps
# further an actor that follows its critic too fast diverges from one of the four starts.

# %%
logarithms = torch.tensor([0.001, 0.25, 1.2, 0.01]).double().log().requires_grad_()
search, spent = torch.optim.Adam([logarithms], lr=0.2), []
for _ in range(21):
    gains = adp.Gains(*logarithms.exp())  # of the critic, its extrapolation, the actor, its decay, 1/s
    learner = adp.ActorCritic(basis, plant, cost, points, adp.Information(gains))
    loss = adp.simulate(learner, plant, cost, starts, dt=0.005, steps=1000).cost.mean()
    search.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(logarithms, 0.1)  # near gains with which learning fails the cost is steep
    search.step()
    spent.append(loss.item())
print(gains, f"cost {spent[0]:.3f} before, {spent[-1]:.3f} after")
assert spent[-1] < 0.92 * spent[0]

# %%
known = adp.simulate(adp.LQR(plant, cost), plant, cost, starts, dt=0.005, steps=1000).cost.mean()
figure, axes = plt.subplots(figsize=(3.4, 2.4), layout="constrained")
axes.plot(spent, label="learns, with these gains")
axes.axhline(known, linestyle=":", color="0.2", label="the LQR, which knows the plant")
axes.set(xlabel="step of Adam", ylabel="mean cost of four runs")
axes.legend()

# %% [markdown]
# The width of a kernel and the radius of its centers, beside the grid that an ablation would try.

# %%
found = run(
    "experiment=learn_kernel", "duration=2", "settle_time=1", "centers.count=3", "learn_kernel.steps=20"
)
print(found.metrics)
assert found.metrics["learned_error"] < found.metrics["start_error"]
found.figures()["learn_kernel"]
