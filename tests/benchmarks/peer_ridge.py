"""scikit-learn's KernelRidge of the last W samples, with the time as a further coordinate: it has no batch,
so one stream after the other."""

from __future__ import annotations

import torch
from drifting_streams import Method, grid
from sklearn.kernel_ridge import KernelRidge
from torch import Tensor


class Ridge:
    def __init__(self, window: int, width: float, memory: float, noise: float) -> None:
        self.window, self.width, self.memory, self.noise = window, width, memory, noise
        self.x: Tensor | None = None

    def _scaled(self, x: Tensor) -> Tensor:
        return torch.cat((x[..., :2], x[..., 2:] * (self.width / self.memory)), dim=-1)

    def partial_fit(self, x: Tensor, y: Tensor) -> None:
        x, y = self._scaled(x).unsqueeze(1), y.unsqueeze(1)
        if self.x is not None:
            x = torch.cat((self.x[:, -self.window + 1 :], x), dim=1)
            y = torch.cat((self.y[:, -self.window + 1 :], y), dim=1)
        self.x, self.y = x, y

    def predict(self, x: Tensor) -> Tensor:
        query = self._scaled(x).numpy()
        found = []
        for points, values, at in zip(self.x, self.y, query, strict=True):
            model = KernelRidge(alpha=self.noise**2, kernel="rbf", gamma=0.5 / self.width**2)
            found.append(model.fit(points.numpy(), values.numpy()).predict(at[None])[0])
        return torch.tensor(found, dtype=torch.float64)


def methods(noise: float) -> list[Method]:
    choices = grid(window=[16, 64], width=[0.6, 0.9], memory=[1e9, 50.0], noise=[noise])
    return [Method("scikit-learn KernelRidge", Ridge, choices, 8)]
