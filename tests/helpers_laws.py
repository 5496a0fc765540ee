"""Every update law, predictor, kernel and system once, for the tests of the laws."""

from __future__ import annotations

import torch
from torch import Tensor

from staf_torch import (
    AnchoredKernel,
    ExponentialKernel,
    GaussianKernel,
    InverseMultiquadricKernel,
    Kernel,
    MaternKernel,
    PolynomialKernel,
    RationalQuadraticKernel,
    StaFBasis,
    StateFollowingCenters,
    optim,
    predictors,
    rings,
    systems,
    targets,
)
from staf_torch.objective import Known, NativeError

LAWS: dict[str, optim.UpdateLaw] = {
    "steepest descent": optim.SteepestDescent(),
    "fixed step": optim.FixedStep(),
    "fixed absolute step": optim.FixedStep(0.1, relative=False),
    "heavy ball": optim.HeavyBall(),
    "heavy ball, stated": optim.HeavyBall(1.0, 0.9),
    "nesterov": optim.Nesterov(),
    "nesterov, stated": optim.Nesterov(0.9, 0.8),
    "conjugate gradient": optim.ConjugateGradient(),
    "preconditioned by the core": optim.PreconditionedDescent("core"),
    "jacobi": optim.PreconditionedDescent("jacobi"),
    "exact": optim.Exact(),
    "barzilai-borwein": optim.BarzilaiBorwein(),
    "recursive least squares": optim.RecursiveLeastSquares(process_noise=0.0, measurement_noise=1e-3),
    "normalised lms": optim.NormalisedLMS(),
}
RATED = {name: law for name, law in LAWS.items() if law.contraction(torch.ones(())) is not None}
DESCENDING = {
    name: LAWS[name]
    for name in ("steepest descent", "fixed step", "fixed absolute step", "conjugate gradient", "jacobi")
}
PREDICTORS: dict[str, predictors.Predictor | None] = {
    "none": None,
    "secant": predictors.Secant(),
    "secant, guarded": predictors.Secant(guarded=True),
    "tangent, order 1": predictors.Tangent(order=1),
    "tangent, order 2": predictors.Tangent(),
}
# Every law, and every predictor with one law of each kind of state.
PAIRS = [(law, "none") for law in LAWS] + [
    (law, predictor)
    for predictor in PREDICTORS
    for law in ("steepest descent", "heavy ball", "recursive least squares")
    if predictor != "none"
]
KERNELS: dict[str, Kernel] = {
    "exponential": ExponentialKernel(),
    "gaussian": GaussianKernel(),
    "matern": MaternKernel(),
    "inverse multiquadric": InverseMultiquadricKernel(),
    "rational quadratic": RationalQuadraticKernel(),
    "polynomial": PolynomialKernel(),
    "anchored": AnchoredKernel(ExponentialKernel()),
}
SYSTEMS: dict[str, systems.ControlAffineSystem] = {
    "oscillator": systems.Oscillator(),
    "linear": systems.Linear([[-0.1, 1.0], [-1.0, -0.1]]),
}


def basis(kernel: Kernel | None = None, count: int = 3, radius: float = 0.1) -> StaFBasis:
    """Rings around the state."""
    return StaFBasis(kernel or ExponentialKernel(), StateFollowingCenters(rings(count), radius))


def states(batch: int = 1, steps: int = 60, dt: float = 0.05, system: str = "oscillator") -> Tensor:
    """Trajectories, the first from (1, 0): (B, steps + 1, 2)."""
    generator = torch.Generator().manual_seed(1)
    around = 2 * torch.rand(batch, 2, generator=generator, dtype=torch.float64) - 1
    around[0] = torch.tensor([1.0, 0.0])
    return systems.simulate(SYSTEMS[system], around, dt=dt, steps=steps)


def quadratic(batch: int = 5, count: int = 4, condition: float = 30.0, seed: int = 0) -> NativeError:
    """Random quadratics with the eigenvalues 1 .. condition, and a sample at a state."""
    generator = torch.Generator().manual_seed(seed)
    random = torch.randn(batch, count, count + 2, generator=generator, dtype=torch.float64)
    q = torch.linalg.qr(random[..., :count])[0]
    eigenvalues = torch.logspace(0, 1, count, base=condition, dtype=torch.float64)
    gram = (q * eigenvalues) @ q.mT
    known = Known(row=random[..., count + 1], sampled=random[:, 0, 0])
    return NativeError((gram + gram.mT) / 2, random[..., count], known)


def iterate(law: optim.UpdateLaw, objective: NativeError, weights: Tensor, steps: int) -> Tensor:
    """The weights after every iteration, the first ones included: (steps + 1, ..., M)."""
    state = law.begin(objective, weights, law.init(weights))
    path = [weights]
    for _ in range(steps):
        weights, state = law.step(objective, weights, state)
        path.append(weights)
    return torch.stack(path)


TARGET = targets.Paper()
