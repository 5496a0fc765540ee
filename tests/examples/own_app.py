"""A Hydra application of one's own around a StaF layer; its settings come from `pkg://staf_torch.conf`."""

import hydra
import torch
from hydra.utils import instantiate
from torch import nn

from staf_torch import StaF, StaFBasis

OPTIONS = {"version_base": "1.3"} if hydra.__version__ < "1.4" else {"execution_whitelist": ("staf_torch.*",)}


class Critic(nn.Module):
    def __init__(self, basis):
        super().__init__()
        self.trend, self.rest = nn.Linear(2, 1, dtype=torch.float64), StaF(basis)

    def forward(self, y):
        return self.trend(y).squeeze(-1) + self.rest(y)


@hydra.main(config_path=".", config_name="own_app", **OPTIONS)
def main(cfg):
    torch.manual_seed(cfg.seed)
    basis = StaFBasis(instantiate(cfg.kernel), instantiate(cfg.centers))
    target, critic = instantiate(cfg.target), Critic(basis)
    optimizer = torch.optim.Adam(critic.parameters(), lr=cfg.rate)
    for _ in range(cfg.steps):
        y = cfg.centers.radius * (2 * torch.rand(64, 2, dtype=torch.float64) - 1)
        loss = (critic(y) - target(y)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    print(f"loss={float(loss.detach()):.4e}")
    return float(loss.detach())


if __name__ == "__main__":
    main()
