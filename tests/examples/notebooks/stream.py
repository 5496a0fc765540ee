# %% [markdown]
# # A stream
# Samples (x, y) arrive one after the other, and x moves. Nothing is kept but the function around the latest
# x: a Kalman filter of V's values at M centers that follow it. Time and memory a sample are constant.

# %%
import torch

from staf_torch import GaussianKernel, StaFRegressor


def measured(x):
    """What a sensor says of an unknown function: its value and some noise."""
    return (2 * x).sin().sum(-1) + 0.05 * torch.randn(x.shape[:-1], dtype=x.dtype)


t = 0.05 * torch.arange(300, dtype=torch.float64)
path = torch.stack((t.cos(), (1.3 * t).sin()), dim=-1)  # (T, n): where the samples are taken
torch.manual_seed(0)

# %% [markdown]
# First predict, then learn. `return_std` gives the error to expect, the noise included, so that one can look
# whether it is honest.

# %%
model = StaFRegressor(GaussianKernel(0.9), radius=0.4, noise=0.05)
errors, expected = [], []
for k, x in enumerate(path):
    y = measured(x)
    if k >= 100:  # after some learning
        mean, std = model.predict(x, return_std=True)
        errors.append(float(mean - y))
        expected.append(float(std))
    model.partial_fit(x, y)
rms = torch.tensor(errors).square().mean().sqrt()
print(f"rms error {rms:.3f}, of which noise 0.050; expected {torch.tensor(expected).mean():.3f}")
assert rms < 0.08
assert 0.5 < rms / torch.tensor(expected).mean() < 1.5

# %% [markdown]
# A thousand streams side by side: (S, n) in place of (n,). No stream influences another.

# %%
many = StaFRegressor(GaussianKernel(0.9), radius=0.4, noise=0.05)
shifted = path[:100, None] + 0.1 * torch.randn(1000, 2, dtype=torch.float64)  # (T, S, n)
many.fit(shifted, measured(shifted))
guess = many.predict(shifted[-1])
assert guess.shape == (1000,)
print((guess - (2 * shifted[-1]).sin().sum(-1)).square().mean().sqrt())

# %% [markdown]
# Who does not know kernel, radius and noise lets the likelihood choose them; `MixtureRegressor` keeps samples
# and predicts with several models, more accurate and slower.

# %%
tuned = StaFRegressor().tune(path, measured(path)).fit(path, measured(path))
print(tuned.predict(path[-1]))
