"""`ChaseOptimizer` for the coefficients, in which the loss is quadratic, beside Adam for the rest."""

import torch
from torch import Tensor, nn

from staf_torch import GaussianKernel, StaF, StaFBasis, StateFollowingCenters, optim, rings


class LocalModels(nn.Module):  # eight local approximations behind a learned change of coordinates
    def __init__(self) -> None:
        super().__init__()
        width, radius = (nn.Parameter(torch.tensor(v, dtype=torch.float64)) for v in (0.5, 0.4))
        centers = StateFollowingCenters(rings(6), radius)
        self.local = StaF(StaFBasis(GaussianKernel(width), centers), batch_shape=(8,))
        self.warp = nn.Linear(2, 2).double()
        nn.init.eye_(self.warp.weight)

    def forward(self, y: Tensor) -> Tensor:
        return self.local(self.warp(y))


def train(steps: int = 40, chase: bool = True) -> float:
    """Mean square error of the fit to V = sin(3 x1 + x2); with ``chase=False`` by Adam alone."""
    model, x = LocalModels(), 2 * torch.rand(8, 2, dtype=torch.float64) - 1
    model.local.state.copy_(x)
    y = x.unsqueeze(-2) + 0.8 * torch.rand(8, 40, 2, dtype=torch.float64) - 0.4
    values = torch.sin(3 * y[..., 0] + y[..., 1])
    rest = [p for p in model.parameters() if p is not model.local.coefficients or not chase]
    adam = torch.optim.Adam(rest, lr=0.02)
    chaser = optim.ChaseOptimizer([model.local.coefficients], optim.ConjugateGradient(), inner_steps=6)
    for _ in range(steps):
        if chase:
            chaser.step(lambda: (model(y) - values).square().sum(-1))  # one problem a row
        adam.zero_grad()
        loss = (model(y) - values).square().mean()
        loss.backward()
        adam.step()
    return loss.item()
