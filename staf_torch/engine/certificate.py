"""What a gradient chase can vouch for, step by step."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..numerics.linalg import condition_number
from ..optim.objective import NativeError
from .problem import Problem
from .recursion import Inputs, Link, Recursion

_ROUNDING = 1e3  # multiples of eps w'Kw by which a computed excess may miss


class Certificate(NamedTuple):
    """The measured terms of one inequality, and the inequality, at every time.

    Let e_k = |a_k - w_k|^2 in the norm |v|_k^2 = v'K(c(x_k))v, after the correction at x_k. From x_{k-1} to
    x_k the norm changes, the ideal weights move, and a predictor may move the weights along:

        |v|_k <= growth_k |v|_{k-1} for every v, growth_k^2 = lambda_max(K_{k-1}^-1 K_k),
        drift_k = |(a_k^- - a_{k-1}) - (w_k - w_{k-1})|_k, without a predictor |w_k - w_{k-1}|_k,
        sqrt(e_k) <= bound_k = delta_k^{its/2} (growth_k sqrt(e_{k-1}) + drift_k),

    by the triangle inequality for the weights a_k^- before the correction, and the law's contraction.
    growth_k is 1 + O(dt) and drift_k at most dt max |w'|: this is the bound of MATH.md with the factor that
    it leaves out. At the first time growth is 1 and drift is sqrt(e) before the correction. NaN where the law
    has no known rate, K is numerically singular, or the trajectory has diverged.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> states = systems.simulate(systems.Oscillator(), x0, dt=0.01, steps=50)
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> result = chase(states, basis, targets.Paper(), optim.SteepestDescent(), certificate=True)
        >>> bool(result.certificate.violated.any())
        False

        Shown by `staf certificate=true`.
    """

    rate: Tensor  # (B, T) delta_k^its, the factor in the excess that the law promises for the correction
    growth: Tensor  # (B, T)
    drift: Tensor  # (B, T)
    bound: Tensor  # (B, T) on sqrt(e_k)
    violated: Tensor  # (B, T) bool: e_k > bound_k^2 by more than rounding


def certify(
    problem: Problem, inputs: Inputs, run: Recursion, ideal: Tensor, last: Link | None
) -> tuple[Certificate, Link]:
    """Return the certificate of one chunk of time, and the link to the next.

    Args:
        problem: law and iterations.
        inputs: e^{-g} K, V(c) and g, (B, C, ...).
        run: weights before and after the correction, (B, C, M), in units of e^{-g}.
        ideal: ideal weights, (B, C, M), in units of e^{-g}.
        last: of the chunk before, None at the start.
    """
    objective, log_gain = NativeError(inputs.gram, inputs.values), inputs.log_gain
    before, after = run.before, run.after
    gram, error = objective.gram, after - ideal
    if last is None:
        last = Link(gram[:, 0], log_gain[:, 0], torch.zeros_like(error[:, 0]))
    grams = torch.cat((last.gram[:, None], gram), dim=1)
    gains = torch.cat((last.log_gain[:, None], log_gain), dim=1)
    errors = torch.cat((last.error[:, None], error), dim=1)
    change = gains[:, 1:] - gains[:, :-1]
    held = errors[:, :-1] * change.exp()[..., None]

    def norm(vector: Tensor, at: Tensor, gain: Tensor) -> Tensor:
        square = torch.linalg.vecdot(vector, NativeError(at, vector).curvature(vector))
        length: Tensor = (square.clamp(min=0) * (-gain).exp()).sqrt()  # negative by rounding alone
        return length

    rate = problem.law.contraction(condition_number(gram))
    rate = (
        torch.full_like(log_gain, torch.nan)
        if rate is None
        else rate.expand(log_gain.shape) ** problem.inner_steps
    )
    growth = _growth(grams) * (change / 2).exp()
    drift = norm(before - ideal - held, gram, log_gain)
    bound = rate.sqrt() * (growth * norm(errors, grams, gains)[:, :-1] + drift)
    native = torch.linalg.vecdot(ideal, objective.values).abs()
    excess, inverse_gain = objective.excess(after, ideal), (-log_gain).exp()
    rounding = _ROUNDING * torch.finfo(gram.dtype).eps * native
    violated = excess * inverse_gain > bound.square() * (1 + 1e-9) + rounding * inverse_gain
    link = Link(gram[:, -1], log_gain[:, -1], error[:, -1])
    return Certificate(rate, growth, drift, bound, violated), link


def _growth(grams: Tensor) -> Tensor:
    """sqrt(lambda_max(K_{k-1}^-1 K_k)) of consecutive matrices: (B, 1 + C, M, M) -> (B, C).

    As the largest singular value of L_{k-1}^-1 L_k: forming the product would square the condition.
    """
    factor, failed = torch.linalg.cholesky_ex(grams)
    fine = (failed == 0) & torch.isfinite(factor).all(-1).all(-1)
    fine = fine[:, 1:] & fine[:, :-1]
    identity = torch.eye(grams.shape[-1], dtype=grams.dtype, device=grams.device)
    here = torch.where(fine[..., None, None], factor[:, 1:], identity)
    there = torch.where(fine[..., None, None], factor[:, :-1], identity)
    ratio = torch.linalg.solve_triangular(there, here, upper=False)
    return torch.where(fine, torch.linalg.svdvals(ratio)[..., 0], torch.nan)
