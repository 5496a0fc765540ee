import torch

from staf_torch import Kernel
from staf_torch.numerics.checks import hold


class Cauchy(Kernel):
    """k(y, c) = 1 / (1 + |y - c|^2 / width^2)."""

    def __init__(self, width=1.0):
        super().__init__()
        hold(self, "width", torch.as_tensor(width, dtype=torch.float64))

    def forward(self, x1, x2):  # (..., P, n), (..., M, n) -> (..., P, M)
        square = (x1.unsqueeze(-2) - x2.unsqueeze(-3)).square().sum(-1)
        return 1 / (1 + square / self.width[..., None, None].to(x1).square())
