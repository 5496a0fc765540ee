"""A StaF critic and a network actor, trained together by Adam: optimal regulation of the paper's plant."""

import torch
from torch import Tensor, nn

from staf_torch import GaussianKernel, StaF, StaFBasis, StateFollowingCenters, rings, systems


class ActorCritic(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        width = nn.Parameter(torch.tensor(2.0, dtype=torch.float64))  # a Parameter is learned, a tensor fixed
        self.critic = StaF(StaFBasis(GaussianKernel(width), StateFollowingCenters(rings(6), radius=1.2)))
        self.critic.fit_(torch.zeros(2, dtype=torch.float64), lambda y: 2 * y.square().sum(-1))  # a guess
        self.actor = nn.Sequential(nn.Linear(2, 32), nn.Tanh(), nn.Linear(32, 1)).double()

    def loss(self, x: Tensor, f: Tensor, g: Tensor) -> Tensor:
        """Bellman error for the critic, Hamiltonian for the actor; each takes the other as it is."""
        u, slope = self.actor(x), self.critic.gradient(x)
        along = (slope * (f + g * u.detach())).sum(-1)
        bellman = x.square().sum(-1) + u.detach().square().squeeze(-1) + along
        push = (slope.detach() * g).sum(-1, keepdim=True)
        return bellman.square().mean() + (u.square() + push * u).mean()


def train(steps: int = 300) -> float:
    """Mean error of the policy over [-1, 1]^2, where u* = -(cos 2 x1 + 2) x2."""
    model, plant = ActorCritic(), systems.TwoState()
    groups = [{"params": model.critic.parameters(), "lr": 0.1}, {"params": model.actor.parameters()}]
    optimizer = torch.optim.Adam(groups, lr=0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        x = 2 * torch.rand(128, 2, dtype=torch.float64) - 1
        optimizer.zero_grad()
        model.loss(x, plant.drift(x), plant.effectiveness(x).squeeze(-1)).backward()
        optimizer.step()
        schedule.step()
    return (model.actor(x) + (torch.cos(2 * x[:, :1]) + 2) * x[:, 1:]).abs().mean().item()
