"""A StaF value on top of a learned dynamics network: gradients go through both, and on into the policy."""

import torch
from torch import Tensor, nn

from staf_torch import GaussianKernel, StaF, StaFBasis, StateFollowingCenters, rings


class World(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.dynamics = nn.Sequential(nn.Linear(3, 32), nn.Tanh(), nn.Linear(32, 2)).double()
        self.value = StaF(StaFBasis(GaussianKernel(2.0), StateFollowingCenters(rings(6), radius=1.0)))
        self.gains = nn.Parameter(torch.tensor([-1.5, -0.5], dtype=torch.float64))

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        return x + 0.1 * self.dynamics(torch.cat((x, u.unsqueeze(-1)), dim=-1))

    def cost_to_go(self, x: Tensor) -> Tensor:
        """Cost of a step of the policy u = gains'x, and V^ where the network says that it leads."""
        u = x @ self.gains
        return 0.1 * x.square().sum(-1) + 0.01 * u.square() + 0.95 * self.value(self(x, u))


def train(steps: int = 200) -> tuple[float, float, Tensor]:
    """For an inverted pendulum: root mean square errors of model and Bellman equation, and the gains."""
    world = World()
    network, value = list(world.dynamics.parameters()), [world.value.coefficients]
    groups = [{"params": [*network, world.gains]}, {"params": value, "lr": 0.2}]
    adam = torch.optim.Adam(groups, lr=0.02)
    for _ in range(steps):
        x, u = 2 * torch.rand(128, 2).double() - 1, 4 * torch.rand(128).double() - 2
        seen = x + 0.1 * torch.stack((x[:, 1], x[:, 0].sin() + u), dim=-1)  # the plant
        surprise, bellman = world(x, u) - seen, world.value(x) - world.cost_to_go(x)
        adam.zero_grad()
        world.cost_to_go(x).mean().backward(inputs=[world.gains])
        (100 * surprise.square().mean() + bellman.square().mean()).backward(inputs=network + value)
        adam.step()
    return surprise.square().mean().sqrt().item(), bellman.square().mean().sqrt().item(), world.gains.detach()
