"""SciPy's RBFInterpolator(neighbors=) of the last W samples, with the time as a further coordinate: it has
no batch, so one stream after the other."""

from __future__ import annotations

import torch
from drifting_streams import Method, grid
from scipy.interpolate import RBFInterpolator
from torch import Tensor

WINDOW = 64


class Neighbours:
    def __init__(self, neighbours: int, width: float, memory: float, noise: float) -> None:
        self.neighbours, self.width, self.memory, self.noise = neighbours, width, memory, noise
        self.x: Tensor | None = None

    def _scaled(self, x: Tensor) -> Tensor:
        return torch.cat((x[..., :2], x[..., 2:] * (self.width / self.memory)), dim=-1)

    def partial_fit(self, x: Tensor, y: Tensor) -> None:
        x, y = self._scaled(x).unsqueeze(1), y.unsqueeze(1)
        if self.x is not None:
            x = torch.cat((self.x[:, -WINDOW + 1 :], x), dim=1)
            y = torch.cat((self.y[:, -WINDOW + 1 :], y), dim=1)
        self.x, self.y = x, y

    def predict(self, x: Tensor) -> Tensor:
        query = self._scaled(x).numpy()
        found = [
            RBFInterpolator(
                points.numpy(),
                values.numpy(),
                neighbors=min(self.neighbours, len(points)),
                kernel="gaussian",
                epsilon=0.5**0.5 / self.width,
                smoothing=self.noise**2,
            )(at[None])[0]
            for points, values, at in zip(self.x, self.y, query, strict=True)
        ]
        return torch.tensor(found, dtype=torch.float64)


def methods(noise: float) -> list[Method]:
    choices = grid(neighbours=[16, 32], width=[0.6, 0.9], memory=[1e9, 50.0], noise=[noise])
    return [Method("SciPy RBFInterpolator", Neighbours, choices, 8)]
