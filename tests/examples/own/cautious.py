from staf_torch.optim import UpdateLaw
from staf_torch.optim.base import line_search


class Cautious(UpdateLaw):
    """a <- a + s lambda g: a share s of the exact line search."""

    def __init__(self, share=0.8):
        self.share = float(share)

    def step(self, objective, weights, state):
        g = objective.descent(weights)
        return weights + self.share * line_search(objective, g, g) * g, state

    def products(self, count, iterations):
        return iterations + 1  # one product with K an iteration, and one to begin
