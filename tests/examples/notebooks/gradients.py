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
# The published gains are the start; their logarithms are learned, so that they stay positive, by steps down
# the gradient. A step that does not pay is not taken, and the next one is half as long: an actor that follows
# its critic too fast diverges, from one of four starts, and the cost beyond such gains is steep. The first
# step compiles the loop and its adjoint, a later one takes a tenth of a second.


# %%
def spends(logarithms):
    gains = adp.Gains(*logarithms.exp())  # of the critic, its extrapolation, the actor, its decay, 1/s
    learner = adp.ActorCritic(basis, plant, cost, points, adp.Information(gains))
    return adp.simulate(learner, plant, cost, starts, dt=0.005, steps=400).cost.mean()


at = torch.tensor([0.001, 0.25, 1.2, 0.01]).double().log().requires_grad_()
loss, length = spends(at), 0.3
spent, (slope,) = [loss.item()], torch.autograd.grad(loss, at)
for _ in range(8):
    further = (at - length * slope / slope.norm()).detach().requires_grad_()
    tried = spends(further)
    if tried < loss:  # which a cost that is NaN is not
        at, loss, length = further, tried, min(1.5 * length, 0.5)
        (slope,) = torch.autograd.grad(loss, at)
    else:
        length = 0.5 * length
    spent.append(loss.item())
print(at.exp().tolist(), f"cost {spent[0]:.3f} before, {spent[-1]:.3f} after")
assert spent[-1] < 0.95 * spent[0]

# %%
known = adp.simulate(adp.LQR(plant, cost), plant, cost, starts, dt=0.005, steps=400).cost.mean()
figure, axes = plt.subplots(figsize=(3.4, 2.4), layout="constrained")
axes.plot(spent, label="learns, with these gains")
axes.axhline(known, linestyle=":", color="0.2", label="the LQR, which knows the plant")
axes.set(xlabel="step", ylabel="mean cost of four runs")
axes.legend()

# %% [markdown]
# The width of a kernel and the radius of its centers, beside the grid that an ablation would try.

# %%
found = run(
    "experiment=learn_kernel", "duration=2", "settle_time=1", "centers.count=3", "learn_kernel.steps=10"
)
print(found.metrics)
assert found.metrics["learned_error"] < found.metrics["start_error"]
found.figures()["learn_kernel"]
