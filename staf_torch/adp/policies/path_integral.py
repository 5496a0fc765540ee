"""Model-predictive path integrals around a feedback: plans from random samples, without derivatives."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ...lanes import Program, scan
from ...lanes.tree import Tree
from ...numerics.checks import fail, hold, integer, one_or_each, positive, positive_real, trailing
from ...numerics.default_device import device_of, where_held
from ..loop.controller import Controller
from ..problem.sampled import SampledProblem, goal_of

_OUTSIDE = 1e-12  # share of a uniform number that is left away: its normal one is then finite
_NOISE = 0.5  # standard deviation, of the range of an input
_FINEST = 0.01  # share of the noise that the last sample has


class PathIntegral(Controller):
    """u_k = sat(sat(u_s - K d_k) + v_k): the goal's linear feedback and a change v of it, found by samples,

        v <- sum_i w_i v_i,  w_i ~ exp(-(S_i - min S) / (temperature (mean S - min S))),

    where S_i is what following v_i = v + e_i costs over T steps, with V_T at the end. Every period samples
    once around the plan of the period before. The plan itself, the feedback alone (v = 0) and the cheapest
    sample are candidates beside the mean, so that over its horizon the plan never costs more than the
    feedback. Samples are of the change, not of the control: around an unstable plant open-loop samples
    diverge, whichever is chosen.

    Example:
        >>> def step(x, u):  # a cart without friction, for 0.1 s
        ...     after = torch.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), dim=-1)
        ...     return after, 0.1 * (x.square().sum(-1) + u.square().sum(-1))
        >>> problem = adp.SampledProblem(step, dim=2, inputs=1, low=-1.0, high=1.0)
        >>> sampler = adp.PathIntegral(problem, steps=20, samples=32, compile=False)
        >>> x = torch.tensor([[2.0, 0.0]]).double()
        >>> uniform = 2 * torch.rand(1, sampler.draws, 2).double() - 1  # as `simulate` draws them
        >>> u, plan = sampler.step(x, sampler.init(x), uniform, dt=0.1)
        >>> u.shape
        torch.Size([1, 1])

        Shown by `staf_torch/adp/README.md`.

    Args:
        problem: plant, cost and bounds in steps; its period is that of the loop.
        steps: T.
        samples: of a period, at least 3.
        knots: of a sampled change, which is linear between them, 2 to T.
        noise: standard deviation of e at a knot, one number or one an input, in the input's units; by default
            half the range between the bounds, which then must be finite. The samples' own ones fall from
            there to a hundredth.
        temperature: positive; small ones follow the cheapest sample.
        compile: whether `lanes` compiles the rollouts.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Williams et al., "Information theoretic MPC for model-based reinforcement learning", ICRA (2017),
    there around no feedback and with a fixed temperature.
    """

    def __init__(
        self,
        problem: SampledProblem,
        *,
        steps: int,
        samples: int = 200,
        knots: int = 8,
        noise: float | Sequence[float] | None = None,
        temperature: float = 0.1,
        compile: bool = True,
    ) -> None:
        super().__init__()
        self.problem = problem
        self.steps = integer("PathIntegral", "steps", steps, least=2)
        self.samples = integer("PathIntegral", "samples", samples, least=3)
        self.knots = integer("PathIntegral", "knots", knots, least=2)
        if self.knots > self.steps:
            raise fail("PathIntegral", "knots", f"must be at most the {steps} steps", knots)
        self.temperature = positive_real("PathIntegral", "temperature", temperature)
        n, m = problem.dim, problem.inputs
        if noise is None:
            scale = _NOISE * (problem.bounds.high - problem.bounds.low)
            if not bool(torch.isfinite(scale).all()):
                raise fail("PathIntegral", "noise", "must be given where an input has no bounds", noise)
        else:
            scale = positive("PathIntegral", "noise", one_or_each("PathIntegral", "noise", noise, m))
        device = device_of(problem)
        self.noise = hold(self, "noise", scale.to(device))
        self.spread = hold(self, "spread", _hats(self.steps, self.knots).to(device))  # (T, knots)
        scales = torch.logspace(0, math.log10(_FINEST), self.samples, dtype=torch.float64, device="cpu")
        self.scales = hold(self, "scales", scales.to(device))  # (S,)
        self.draws = -(-self.samples * self.knots * m // n)
        self._roll = Program(self._rolled, name="sampled plans", compile=compile)

    @where_held("PathIntegral.init", goal_of)
    def init(self, x0: Tensor) -> Tensor:
        """No change of the feedback, (B, T, m)."""
        trailing(type(self).__name__, "x0", x0, 2)
        return x0.new_zeros(len(x0), self.steps, self.problem.inputs, dtype=self.noise.dtype)

    @where_held("PathIntegral.step", goal_of)
    def step(self, x: Tensor, carried: Tensor, uniform: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        """The first control of the improved plan (B, m), and the change a step further on."""
        given = trailing("PathIntegral.step", "x", x, 2, self.problem.dim).dtype
        count, m = len(x), self.problem.inputs
        x, uniform = x.to(self.noise.dtype), uniform.to(self.noise.dtype)
        plan = carried.unsqueeze(1)
        numbers = uniform.flatten(1)[:, : self.samples * self.knots * m]
        inside = 1 - max(_OUTSIDE, torch.finfo(x.dtype).eps)
        normal = math.sqrt(2) * (inside * numbers).erfinv().view(count, self.samples, self.knots, m)
        tried = plan + (self.spread @ normal) * self.scales[:, None, None] * self.noise  # (B, S, T, m)
        tried[:, 0], tried[:, 1] = plan[:, 0], 0.0
        cost = self.costs(x, tried)
        least, at = cost.min(1, keepdim=True)
        fine = torch.isfinite(cost)
        excess = torch.where(fine, cost - least, 0.0)
        mean = excess.sum(1, keepdim=True) / fine.sum(1, keepdim=True)
        least_mean = torch.finfo(mean.dtype).tiny  # all samples cost the same: equal weights
        sharp = excess / (self.temperature * mean).clamp(min=least_mean)
        weight = torch.where(fine, (-sharp).exp(), 0.0)
        blended = (weight[..., None, None] * torch.where(fine[..., None, None], tried, 0.0)).sum(1)
        blended = blended / weight.sum(1)[:, None, None]
        chosen = tried.gather(1, at[..., None, None].expand(-1, -1, self.steps, m)).squeeze(1)
        better = self.costs(x, blended.unsqueeze(1))[:, 0] < least[:, 0]
        plan = torch.where(better[:, None, None], blended, chosen)
        ahead = torch.cat((plan[:, 1:], torch.zeros_like(plan[:, :1])), dim=1)
        return self.problem.steered(x, plan[:, 0]).to(given), ahead

    @where_held("PathIntegral.costs", goal_of)
    def costs(self, x: Tensor, change: Tensor) -> Tensor:
        """Return the costs of changes of the feedback, inf if not finite: (B, n), (B, S, T, m) -> (B, S)."""
        cost = self._roll.over((change,), (x,))
        return torch.where(torch.isfinite(cost), cost, torch.inf)

    def _rolled(self, carry: Tree, _: Tree, row: tuple[Tensor, Tensor]) -> tuple[Tree, Tensor]:
        """`_paid` as the step of a row program."""
        return carry, self._paid(*row)

    def _paid(self, x: Tensor, change: Tensor) -> Tensor:
        """Return the cost of a change of the feedback, a row each: (R, n), (R, T, m) -> (R,)."""

        def step(now: tuple[Tensor, Tensor], change: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[()]]:
            after, cost = self.problem.advance(now[0], self.problem.steered(now[0], change))
            return (after, now[1] + cost), ()

        (last, paid), _ = scan(step, (x, torch.zeros_like(x[:, 0])), change)
        whole: Tensor = paid + self.problem.terminal(last)
        return whole


def _hats(steps: int, knots: int) -> Tensor:
    """Weights of the knots at each step, linear between the knots: (T, knots)."""
    place = torch.linspace(0, knots - 1, steps, dtype=torch.float64, device="cpu").unsqueeze(1)
    return (1 - (place - torch.arange(knots, dtype=torch.float64, device="cpu")).abs()).clamp(min=0)
