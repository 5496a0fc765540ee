"""Tensors to numbers: what a gradient chase reached over its window of settled times."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .ball_floor import BallFloor
from .basis import StaFBasis, Target
from .centers import probe_points
from .chase import ChaseResult
from .linalg import condition_number
from .local import evaluate_scaled
from .optim import UpdateLaw

_PROBES = 97  # points of the ball to take a supremum over; in the plane 64 of them on its edge
_BLOCK = 2**18  # numbers in a temporary of `ball_error`, so that it stays in cache


class ChaseMetrics:
    """The metrics of a gradient chase, gathered piece by piece so that memory does not grow with time.

    Each is the worst over the times t >= settle_time and over the trajectories that did not diverge;
    None where there is no such time or trajectory.

    Attributes of the dictionary that `summary` returns:
        ultimate_error, ultimate_error_before, floor_error: max |V - V^| at the state after correction,
            before it, and with the ideal weights.
        ultimate_excess, ultimate_excess_before: max (a - w)'K(a - w).
        ball_error: max over the closed ball of radius nu(x) of |V - V^|, after correction.
        ball_floor_error: the same with the ideal weights: what kernel, radius and layout allow at best.
        rounding_floor: eps max |V(x)|, with eps of the precision; no error below it means anything.
        gradient_error: max |grad V - grad V^| at the state, centers frozen.
        condition_number: max kappa(K(c(x))).
        settling_time: the first time (s) from which the excess never again exceeds `ultimate_excess`.
        contraction_violations: steps whose excess shrank by less than the law's rate promises.
        certificate_violations: times that break the bound of their `Certificate`; only where one was made.
        diverged_fraction: diverged trajectories / all.
    """

    def __init__(
        self,
        basis: StaFBasis,
        target: Target,
        law: UpdateLaw,
        *,
        inner_steps: int,
        dt: float,
        settle_time: float,
    ) -> None:
        self._basis, self._target, self._law = basis, target, law
        self._inner_steps, self._dt = inner_steps, dt
        self._first = math.ceil(settle_time / dt - 1e-9)  # index of the first settled time
        self._time = 0
        self._worst: dict[str, Tensor] = {}  # name -> (B,)
        self._early: list[Tensor] = []  # excess before the window, (B, C) a piece
        self._violations: Tensor | None = None  # (B,) int64
        self._uncertified: Tensor | None = None  # (B,) int64, of the certificate
        self._diverged = torch.zeros(0, dtype=torch.bool)
        self._floor = BallFloor(basis, target, _PROBES)

    def add(self, result: ChaseResult) -> None:
        """Take in the next piece of time."""
        length = result.state.shape[1]
        skip = min(max(self._first - self._time, 0), length)
        self._time += length
        self._diverged = result.diverged
        if skip > 0:
            self._early.append(result.excess[:, :skip])
        if skip == length:
            return
        at = slice(skip, None)
        x, excess, before = result.state[:, at], result.excess[:, at], result.excess_before[:, at]
        value, coefficients = result.value[:, at], result.coefficients[:, at]
        gram = self._basis.gram_structure(x).scaled()
        kappa = condition_number(gram).expand(value.shape)
        found = {
            "ultimate_error": (value - result.estimate[:, at]).abs(),
            "ultimate_error_before": (value - result.estimate_before[:, at]).abs(),
            "floor_error": (value - result.ideal_estimate[:, at]).abs(),
            "ultimate_excess": excess,
            "ultimate_excess_before": before,
            "ball_error": ball_error(self._basis, self._target, x, coefficients),
            "ball_floor_error": self._floor(x),
            "rounding_floor": torch.finfo(value.dtype).eps * value.abs(),
            "gradient_error": gradient_error(self._basis, self._target, x, coefficients),
            "condition_number": kappa,
        }
        for name, quantity in found.items():
            worst = quantity.amax(dim=1)
            self._worst[name] = torch.maximum(self._worst[name], worst) if name in self._worst else worst
        rate = self._law.contraction(kappa)
        if rate is not None:
            native = (result.ideal_weights[:, at] * self._basis.values(x, self._target)).sum(-1)
            rounding = 1e3 * torch.finfo(x.dtype).eps * native.abs()
            broken = excess > rate**self._inner_steps * before * (1 + 1e-9) + rounding
            count = broken.sum(dim=1)
            self._violations = count if self._violations is None else self._violations + count
        if rate is not None and result.certificate is not None:
            count = result.certificate.violated[:, at].sum(dim=1)
            self._uncertified = count if self._uncertified is None else self._uncertified + count

    def summary(self) -> dict[str, float | None]:
        """Name to number; None where there is nothing to report."""
        kept = ~self._diverged
        metrics: dict[str, float | None] = dict.fromkeys(_WORST)
        if bool(kept.any()) and self._worst:
            metrics |= {name: float(worst[kept].max()) for name, worst in self._worst.items()}
        metrics["settling_time"] = self._settling_time(kept)
        metrics["contraction_violations"] = _count(self._violations, kept)
        if self._uncertified is not None:
            metrics["certificate_violations"] = _count(self._uncertified, kept)
        metrics["diverged_fraction"] = float(self._diverged.double().mean())
        return {
            name: number if number is not None and math.isfinite(number) else None
            for name, number in metrics.items()
        }

    def _settling_time(self, kept: Tensor) -> float | None:
        if not self._worst or not bool(kept.any()):
            return None
        if not self._early:
            return 0.0
        above = torch.cat(self._early, dim=1) > self._worst["ultimate_excess"][:, None]
        index = torch.arange(1, above.shape[1] + 1, device=above.device)
        last = torch.where(above, index, 0).amax(dim=1)
        return float(last[kept].max()) * self._dt


def _count(violations: Tensor | None, kept: Tensor) -> float | None:
    return None if violations is None or not bool(kept.any()) else float(violations[kept].sum())


_WORST = (
    "ultimate_error",
    "ultimate_error_before",
    "floor_error",
    "ultimate_excess",
    "ultimate_excess_before",
    "ball_error",
    "ball_floor_error",
    "rounding_floor",
    "gradient_error",
    "condition_number",
)


def ball_error(basis: StaFBasis, target: Target, x: Tensor, coefficients: Tensor) -> Tensor:
    """sup |V - V^| over a fixed set of points of the closed ball of radius nu(x) around x.

    Args:
        x: states, (..., T, n).
        coefficients: b of `ChaseResult.coefficients`, (..., T, M).

    Returns:
        (..., T).
    """
    probes = probe_points(_PROBES, basis.dim).to(x)
    times = max(1, _BLOCK // (_PROBES * max(1, x.numel() // x.shape[-2])))
    blocks = zip(x.split(times, dim=-2), coefficients.split(times, dim=-2), strict=True)
    return torch.cat([_ball_error(basis, target, probes, *block) for block in blocks], dim=-1)


def _ball_error(basis: StaFBasis, target: Target, probes: Tensor, x: Tensor, b: Tensor) -> Tensor:
    nu, offsets = basis.centers.radius(x)[..., None, None], basis.centers.offsets(x)
    worst = x.new_zeros(x.shape[:-1])
    for some in probes.split(64):
        z = nu * some
        estimate = evaluate_scaled(basis.kernel, offsets, x, z, b)
        error = (target(x.unsqueeze(-2) + z) - estimate).abs().amax(-1)
        worst = torch.maximum(worst, error)
    return worst


def gradient_error(basis: StaFBasis, target: Target, x: Tensor, coefficients: Tensor) -> Tensor:
    """|grad V - grad V^| at the state, with the centers frozen: (..., n), (..., M) -> (...)."""
    offsets = basis.centers.offsets(x)

    def estimate(z: Tensor) -> Tensor:
        return evaluate_scaled(basis.kernel, offsets, x, z.unsqueeze(-2), coefficients).sum()

    approximate = torch.func.grad(estimate)(torch.zeros_like(x))
    exact = torch.func.grad(lambda at: target(at).sum())(x)
    error: Tensor = (exact - approximate).norm(dim=-1)
    return error
