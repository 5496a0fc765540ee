"""Recursive least squares: a Kalman filter of the weights."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import non_negative, positive_real, real
from .base import LawState, UpdateLaw
from .objective import Objective


class RecursiveLeastSquares(UpdateLaw):
    """A Kalman filter for noisy samples y = V(c) + e = K a + e, e ~ N(0, R I), of drifting weights.

    Once a time step P <- P + Q I, and at every iteration
    G = P K (K P K + R I)^-1, a <- a + G (y - K a), P <- (I - G K) P (I - G K)' + R G G'.
    The weights and P are the posterior mean and covariance; with Q = 0 and one iteration a time they are
    the regularised least-squares fit to all samples so far. Every iteration counts as a new measurement,
    so leave it at one. Q, R and the prior are in the weights of the chase, in units of e^{-g(x)} (the
    kernel's `log_gain`): e^{|x|^2} times the paper's for the exponential kernel.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.5))
        >>> states = torch.tensor([[[1.0, 0.5]]]).double()  # (B, T, n)
        >>> result = chase(states, basis, targets.Paper(), optim.RecursiveLeastSquares(), inner_steps=1)
        >>> bool(result.excess.max() < 0.1 * result.excess_before.max())
        True

        Shown by `staf optimizer=recursive_least_squares`.

    Args:
        process_noise: Q, variance by which a weight drifts in a time step; 0 never forgets.
        measurement_noise: R, positive, variance of a sample of V.
        prior: variance of the weights at the start, positive.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Kalman, "A new approach to linear filtering and prediction problems" (1960), Joseph's form.
    """

    def __init__(
        self, process_noise: float = 1.0, measurement_noise: float = 1e-4, prior: float = 1e4
    ) -> None:
        name = "RecursiveLeastSquares"
        non_negative(name, "process_noise", process_noise)
        self.process_noise = real(name, "process_noise", process_noise)
        self.measurement_noise = positive_real(name, "measurement_noise", measurement_noise)
        self.prior = positive_real(name, "prior", prior)

    def init(self, weights: Tensor) -> LawState:
        return (self.prior * _identity(weights).expand(*weights.shape, weights.shape[-1]).clone(),)

    def begin(self, objective: Objective, weights: Tensor, state: LawState) -> LawState:
        (covariance,) = state
        return (covariance + self.process_noise * _identity(weights),)

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        (covariance,) = state
        gram, identity = objective.gram, _identity(weights)
        innovation = objective.descent(weights) / 2  # y - K a
        cross = gram @ covariance  # K P
        predicted = cross @ gram.mT + self.measurement_noise * identity
        factor, failed = torch.linalg.cholesky_ex(predicted)
        # A row without a factor (not finite, or P lost to rounding) learns nothing from this sample.
        fine = (failed == 0)[..., None, None]
        gain = torch.cholesky_solve(cross, torch.where(fine, factor, identity)).mT
        left = identity - gain @ gram
        posterior = left @ covariance @ left.mT + self.measurement_noise * gain @ gain.mT
        corrected = weights + (gain * innovation.unsqueeze(-2)).sum(-1)
        posterior = (posterior + posterior.mT) / 2
        return (
            torch.where(fine.squeeze(-1), corrected, weights),
            (torch.where(fine, posterior, covariance),),
        )

    def products(self, count: int, iterations: int) -> int:
        return 6 * count * iterations  # six of M x M x M numbers, each M products

    def rescale(self, state: LawState, factor: Tensor) -> LawState:
        (covariance,) = state
        return (covariance * factor.unsqueeze(-1).square(),)


def _identity(weights: Tensor) -> Tensor:
    return torch.eye(weights.shape[-1], dtype=weights.dtype, device=weights.device)
