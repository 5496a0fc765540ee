"""Exact Gaussian processes of the last W samples of every stream, one batch: GPyTorch.

k((x, t), (x', t')) = exp(-|x - x'|^2 / 2 width^2) times Matern-1/2 in time, all streams with the same
settings, by batched Cholesky; the predictive variance is skipped.
"""

from __future__ import annotations

from typing import Any

import gpytorch
import torch
from drifting_streams import Method, grid
from torch import Tensor


class _Model(gpytorch.models.ExactGP):
    def __init__(self, x: Tensor, y: Tensor, width: float, memory: float, noise: float) -> None:
        likelihood = gpytorch.likelihoods.GaussianLikelihood(
            noise_constraint=gpytorch.constraints.GreaterThan(1e-10)
        )
        super().__init__(x, y, likelihood)
        self.mean_module = gpytorch.means.ZeroMean()
        space = gpytorch.kernels.RBFKernel(active_dims=(0, 1))
        space.lengthscale = width
        self.covar_module = space
        if memory < float("inf"):
            time = gpytorch.kernels.MaternKernel(nu=0.5, active_dims=(2,))
            time.lengthscale = memory
            self.covar_module = space * time
        self.double()
        likelihood.noise = noise**2

    def forward(self, x: Tensor) -> Any:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


class GP:
    def __init__(self, window: int, width: float, memory: float, noise: float) -> None:
        self.window, self.arguments = window, (width, memory, noise)
        self.x: Tensor | None = None
        self.model: _Model | None = None

    def partial_fit(self, x: Tensor, y: Tensor) -> None:
        if self.x is None:
            self.x, self.y = x.unsqueeze(1), y.unsqueeze(1)
            return
        self.x = torch.cat((self.x[:, -self.window + 1 :], x.unsqueeze(1)), dim=1)
        self.y = torch.cat((self.y[:, -self.window + 1 :], y.unsqueeze(1)), dim=1)

    def predict(self, x: Tensor) -> Tensor:
        if self.model is None:
            self.model = _Model(self.x, self.y, *self.arguments).eval()
        self.model.set_train_data(self.x, self.y, strict=False)
        with torch.no_grad(), gpytorch.settings.skip_posterior_variances():
            mean: Tensor = self.model(x.unsqueeze(1)).mean
        return mean.squeeze(1)


def methods(noise: float) -> list[Method]:
    found = []
    for window in (16, 32, 64):
        choices = grid(
            window=[window],
            width=[0.6, 0.9, 1.4],
            memory=[float("inf"), 1000.0, 200.0],
            noise=[noise, 2 * noise],
        )
        found.append(Method(f"GPyTorch, exact GP of {window} samples", GP, choices, 500))
    return found
