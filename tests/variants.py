"""Every variant of the library, listed once. A new kernel, layout, radius, plant, target, law, predictor or
controller is added here, and the properties in the test modules then hold it to account."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import pytest
import torch
from torch import Tensor, nn

import staf_torch as st
from staf_torch import adp, optim, predictors, systems, targets

Point = list[float]
T = TypeVar("T")


def dot(y: Point, c: Point) -> float:
    return math.fsum(a * b for a, b in zip(y, c, strict=True))


def distance(y: Point, c: Point) -> float:
    return math.dist(y, c)


class Cauchy(st.Kernel):
    """A user's kernel: `forward` and nothing else."""

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        return 1 / (1 + (x1.unsqueeze(-2) - x2.unsqueeze(-3)).square().sum(-1))


class KernelCase(NamedTuple):
    make: Callable[[], st.Kernel]
    formula: Callable[[Point, Point], float]  # by the scalars of `math`, independent of the library
    derivatives: int = 2  # continuous ones in each argument, everywhere (2: two or more)
    learnable: Callable[[], st.Kernel] | None = None  # with all hyperparameters to be learned


def learned(value: float | Tensor) -> nn.Parameter:
    """A hyperparameter to be learned."""
    return nn.Parameter(torch.as_tensor(value, dtype=torch.float64).clone())


def _matern(smoothness: float, length: float) -> Callable[[Point, Point], float]:
    def formula(y: Point, c: Point) -> float:
        t = math.sqrt(2 * smoothness) * distance(y, c) / length
        polynomial = {0.5: 1.0, 1.5: 1 + t, 2.5: 1 + t + t * t / 3}[smoothness]
        return polynomial * math.exp(-t)

    return formula


KERNELS: dict[str, KernelCase] = {
    "exponential": KernelCase(
        st.ExponentialKernel, lambda y, c: math.exp(dot(y, c)), learnable=st.ExponentialKernel
    ),
    "gaussian": KernelCase(
        lambda: st.GaussianKernel(width=0.8),
        lambda y, c: math.exp(-(distance(y, c) ** 2) / (2 * 0.8**2)),
        learnable=lambda: st.GaussianKernel(learned(0.8)),
    ),
    "matern12": KernelCase(lambda: st.MaternKernel(0.5, 1.3), _matern(0.5, 1.3), derivatives=0),
    "matern32": KernelCase(lambda: st.MaternKernel(1.5, 0.9), _matern(1.5, 0.9)),
    "matern52": KernelCase(
        lambda: st.MaternKernel(2.5, 1.1),
        _matern(2.5, 1.1),
        learnable=lambda: st.MaternKernel(2.5, learned(1.1)),
    ),
    "inverse_multiquadric": KernelCase(
        lambda: st.InverseMultiquadricKernel(0.7), lambda y, c: (1 + (distance(y, c) / 0.7) ** 2) ** -0.5
    ),
    "rational_quadratic": KernelCase(
        lambda: st.RationalQuadraticKernel(alpha=1.7, length_scale=0.9),
        lambda y, c: (1 + distance(y, c) ** 2 / (2 * 1.7 * 0.9**2)) ** -1.7,
        learnable=lambda: st.RationalQuadraticKernel(learned(1.7), learned(0.9)),
    ),
    "polynomial": KernelCase(
        lambda: st.PolynomialKernel(degree=3, bias=0.7),
        lambda y, c: (0.7 + dot(y, c)) ** 3,
        learnable=lambda: st.PolynomialKernel(3, learned(0.7)),
    ),
    "anchored_exponential": KernelCase(
        lambda: st.AnchoredKernel(st.ExponentialKernel()), lambda y, c: math.expm1(dot(y, c))
    ),
    "anchored_gaussian": KernelCase(
        lambda: st.AnchoredKernel(st.GaussianKernel(0.8)),
        lambda y, c: (
            math.exp(-(distance(y, c) ** 2) / 1.28)
            - math.exp(-dot(y, y) / 1.28) * math.exp(-dot(c, c) / 1.28)
        ),
        learnable=lambda: st.AnchoredKernel(st.GaussianKernel(learned(0.8))),
    ),
    "user_defined": KernelCase(Cauchy, lambda y, c: 1 / (1 + distance(y, c) ** 2), learnable=Cauchy),
}
SMOOTH_KERNELS = {name: case for name, case in KERNELS.items() if case.derivatives >= 2}
LEARNABLE_KERNELS = {name: case.learnable for name, case in KERNELS.items() if case.learnable is not None}


class LayoutCase(NamedTuple):
    make: Callable[[], Tensor]
    count: int
    dim: int
    degree: int | None  # polynomials of this degree are determined by their values there; None: no claim


@functools.cache
def directions_of(name: str) -> Tensor:
    """The directions of a layout, made once: `ball` takes a second in four dimensions."""
    return LAYOUTS[name].make()


def _rings(count: int, degree: int) -> LayoutCase:
    return LayoutCase(lambda: st.rings(count), count, 2, degree)


def _ball(dim: int, degree: int) -> LayoutCase:
    count = math.comb(dim + degree, degree)
    return LayoutCase(lambda: st.ball(count, dim), count, dim, degree)


LAYOUTS: dict[str, LayoutCase] = {
    **{f"rings{m}": _rings(m, k) for m, k in ((3, 1), (6, 2), (10, 3), (15, 4), (21, 5), (28, 6))},
    **{f"polygon{m}": LayoutCase(lambda m=m: st.polygon(m), m, 2, 1 if m >= 3 else 0) for m in (1, 2, 3, 4)},
    **{f"simplex_in_{n}d": LayoutCase(lambda n=n: st.simplex(n), n + 1, n, 1) for n in (1, 2, 3, 4, 5)},
    **{
        f"cross_polytope_in_{n}d": LayoutCase(lambda n=n: st.cross_polytope(n), 2 * n, n, 1)
        for n in (1, 2, 3, 4, 5)
    },
    **{
        f"ball_in_{n}d_of_degree_{k}": _ball(n, k)
        for n, degrees in ((1, (1, 3, 6)), (2, (1, 2, 4)), (3, (1, 2, 3)), (4, (2, 3)), (5, (1, 2)))
        for k in degrees
    },
    "ball_of_no_full_degree": LayoutCase(lambda: st.ball(8, 3), 8, 3, 1),
    "ball_of_one": LayoutCase(lambda: st.ball(1, 3), 1, 3, 0),
}

RADII: dict[str, tuple[Callable[[], Any], Callable[[Point], float]]] = {
    "number": (lambda: 0.1, lambda x: 0.1),
    "constant": (lambda: st.ConstantRadius(0.2), lambda x: 0.2),
    "shrinking": (
        lambda: st.StateRadius(0.7, 0.01),
        lambda x: 0.7 * (dot(x, x) + 0.01) / (1 + dot(x, x)),
    ),
    "shrinking_with_gain": (
        lambda: st.StateRadius(0.3, 0.05, gain=2.0),
        lambda x: 0.3 * (dot(x, x) + 0.05) / (1 + 2 * dot(x, x)),
    ),
}

SYSTEMS: dict[str, Callable[[], systems.ControlAffineSystem]] = {
    "oscillator": systems.Oscillator,
    "fast_oscillator": lambda: systems.Oscillator(frequency=2.5),
    "linear": lambda: systems.Linear([[-0.1, 1.0], [-1.0, -0.3]]),
}
PLANTS: dict[str, Callable[[], systems.ControlAffineSystem]] = {
    "two_state": systems.TwoState,
    "two_state_as_printed": lambda: systems.TwoState(as_printed=True),
    "three_state": systems.ThreeState,
    "pendulum": systems.Pendulum,
    "van_der_pol": systems.VanDerPol,
    "planar_quadrotor": systems.PlanarQuadrotor,
    "cart_pole": systems.CartPole,
    "two_state_chain": systems.TwoStateChain,
    "two_link_robot": systems.TwoLinkRobot,
    "barrier": lambda: systems.Barrier(systems.TwoStateChain(), [-7.0, None], [5.0, 7.0]),
    "linear": lambda: systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]]),
    "linear_of_two_inputs": lambda: systems.Linear(
        [[0.1, 1.0, 0.0], [0.0, 0.2, 1.0], [0.3, 0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0], [0.0, 2.0]]
    ),
}
"""Plants with inputs."""

TARGETS: dict[str, tuple[Callable[[], nn.Module], Callable[[Point], float]]] = {
    "paper": (targets.Paper, lambda x: x[0] ** 2 + 5 * x[1] ** 2 + math.tanh(x[0] * x[1])),
    "quadratic": (lambda: targets.Quadratic(2.5), lambda x: 2.5 * dot(x, x)),
    "quadratic_matrix": (
        lambda: targets.Quadratic([[2.0, 0.5], [0.5, 1.0]]),
        lambda x: 2 * x[0] ** 2 + x[0] * x[1] + x[1] ** 2,
    ),
    "cosine": (
        lambda: targets.Cosine(frequency=[1.0, 2.0], phase=0.3),
        lambda x: math.cos(x[0] + 2 * x[1] + 0.3),
    ),
    "cosine_of_one_frequency": (lambda: targets.Cosine(1.5), lambda x: math.cos(1.5 * (x[0] + x[1]))),
}

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
PAPER_LAW = "steepest descent"


COSTS: dict[str, Callable[[], adp.Cost]] = {
    "avoidance": lambda: adp.AvoidanceCost(
        1.0, 1.0, 2, 1, obstacles=lambda x: (x[..., 0] - 3).square() + x[..., 1].square() - 0.25, reach=0.5
    ),
    "quadratic": lambda: adp.QuadraticCost(1.0, 1.0, 2, 1),
    "tracking": lambda: adp.TrackingCost(1.0, 1.0, 2, 1, path=lambda t: torch.stack((t, t), dim=-1)),
    "bounded_input": lambda: adp.BoundedInputCost(1.0, 0.1, 2, 1, bound=8.0),
}
VALUE_BASES: dict[str, Callable[[], adp.ValueBasis]] = {
    "staf": lambda: adp.StaFValueBasis(
        st.StaFBasis(
            st.AnchoredKernel(st.ExponentialKernel()),
            st.StateFollowingCenters(st.rings(3), st.StateRadius(0.7, 1e-5)),
        )
    ),
    "quadratic": lambda: adp.QuadraticBasis(2),
    "rbf_grid": lambda: adp.RBFGridBasis(2, 3, 1.0, 0.8),
}
ACTOR_CRITIC_LAWS: dict[str, Callable[[], adp.ActorCriticLaw]] = {
    "information": adp.Information,
    "published": adp.Published,
    "frozen": adp.Frozen,
    "policy_iteration": adp.PolicyIteration,
}
CONTROLLERS: dict[str, Callable[..., adp.Controller]] = {  # of two states and an input
    "lqr": lambda: adp.Feedback(adp.LQR(systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1))),
}


def over(variants: Iterable[str], name: str = "name") -> pytest.MarkDecorator:
    """`pytest.mark.parametrize` over the keys of one of the tables above."""
    return pytest.mark.parametrize(name, list(variants))


def by_turns(variants: Iterable[str], values: Sequence[T]) -> list[tuple[str, T]]:
    """Every variant beside one of the values, each value in its turn, where a product would show no more."""
    return [(name, values[k % len(values)]) for k, name in enumerate(variants)]
