import torch

from staf_torch.systems import ControlAffineSystem, Units


class Trolley(ControlAffineSystem):
    """position' = speed,  mass speed' = u - drag speed."""

    dim = 2
    inputs = 1
    units = Units("m, m/s", "N")
    spread = 0.25

    def __init__(self, mass=1.0, drag=0.2):
        super().__init__()
        self.mass, self.drag = float(mass), float(drag)

    def drift(self, x):  # f: (..., n) -> (..., n)
        return torch.stack((x[..., 1], -self.drag / self.mass * x[..., 1]), dim=-1)

    def effectiveness(self, x):  # g: (..., n) -> (..., n, m)
        zero = torch.zeros_like(x[..., 0])
        return torch.stack((zero, zero + 1 / self.mass), dim=-1).unsqueeze(-1)
