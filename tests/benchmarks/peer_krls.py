"""Kernel recursive least squares with approximate linear dependency, many streams in one batch.

Y. Engel, S. Mannor and R. Meir, "The kernel recursive least-squares algorithm", IEEE Trans. Signal Process.
52 (2004). A sample whose feature is further than sqrt(nu) from the dictionary's span joins it; the streams
whose dictionaries grow at a step are computed apart, all others pay for the update of the weights alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

CAPACITY = 128


class KRLS:
    def __init__(self, width: float, nu: float) -> None:
        self.width, self.nu = width, nu
        self.size: Tensor | None = None

    def _start(self, x: Tensor) -> None:
        streams, dim = x.shape
        self.most = 1  # entries in use: nothing is computed beyond
        self.size = torch.zeros(streams, dtype=torch.int64)
        self.points = x.new_full((streams, CAPACITY, dim), torch.inf)
        self.inverse = x.new_zeros(streams, CAPACITY, CAPACITY)
        self.covariance = x.new_zeros(streams, CAPACITY, CAPACITY)
        self.weights = x.new_zeros(streams, CAPACITY)

    def _row(self, x: Tensor) -> Tensor:
        distance = (self.points[:, : self.most] - x[:, None, :2]).square().sum(-1)
        return (distance * (-0.5 / self.width**2)).exp()  # 0 where there is no point

    def predict(self, x: Tensor) -> Tensor:
        return (self._row(x) * self.weights[:, : self.most]).sum(-1)

    def partial_fit(self, x: Tensor, y: Tensor) -> None:
        if self.size is None:
            self._start(x[:, :2])
        m = self.most
        row = self._row(x)
        error = y - (row * self.weights[:, :m]).sum(-1)
        dual = torch.bmm(self.inverse[:, :m, :m], row.unsqueeze(-1))
        rest = 1 - (row * dual.squeeze(-1)).sum(-1)
        grows = (rest > self.nu) & (self.size < CAPACITY)
        stays = (~grows).to(x)
        product = torch.bmm(self.covariance[:, :m, :m], dual)
        scale = stays / (1 + (dual * product).sum((1, 2)))
        self.covariance[:, :m, :m].baddbmm_(product, product.mT * -scale[:, None, None])
        change = torch.bmm(self.inverse[:, :m, :m], product).squeeze(-1)
        self.weights[:, :m] += change * (scale * error).unsqueeze(-1)
        rows = grows.nonzero().squeeze(-1)
        if len(rows):
            self._grow(rows, x[rows, :2], dual[rows].squeeze(-1), rest[rows], error[rows])

    def _grow(self, rows: Tensor, x: Tensor, dual: Tensor, rest: Tensor, error: Tensor) -> None:
        m, at = dual.shape[1], self.size[rows]
        block = self.inverse[rows]
        block[:, :m, :m] += dual.unsqueeze(-1) * dual.unsqueeze(-2) / rest[:, None, None]
        index = torch.arange(len(rows))
        block[index, at, :m] = block[index, :m, at] = -dual / rest.unsqueeze(-1)
        block[index, at, at] = 1 / rest
        self.inverse[rows] = block
        self.covariance[rows, at, at] = 1.0
        self.weights[rows, :m] -= dual * (error / rest).unsqueeze(-1)
        self.weights[rows, at] = error / rest
        self.points[rows, at] = x
        self.size[rows] += 1
        self.most = min(CAPACITY, int(self.size.max()) + 1)
