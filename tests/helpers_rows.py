"""Everything with numbers, and between which numbers they may differ from row to row."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from helpers_adaptation import COST as PENDULUM_COST
from helpers_adaptation import PENDULUM as PARAMETRIC
from torch import Tensor

import staf_torch as st
from staf_torch import adp, optim, predictors, systems, targets

Run = Callable[[slice, torch.dtype], Any]
"""Of some rows, in a dtype: tensors of theirs."""
Ends = tuple[Any, Any]
"""Numbers, or lists of them, between which the numbers of the rows are spread."""


class Case(NamedTuple):
    numbers: dict[str, Ends]
    run: Callable[..., Run]  # from these numbers
    tolerance: float = 0.0  # in plain torch, as sums have another order there


ROWS = 7
X0 = torch.tensor([[-1.0, 1.0], [0.5, 0.5], [0.2, -0.7], [0.1, 0.3], [0.6, -0.2], [-0.4, 0.3], [0.9, 0.1]])
STATES = torch.stack([X0 + 0.02 * k * X0.flip(1) for k in range(4)], dim=1)  # (B, T, n)
TWO, COST, PENDULUM = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1), systems.Pendulum()
LIMITED = adp.QuadraticCost(1.0, 1.0, 2, 1, low=-2.0, high=2.0)
LQR, PENDULUM_LQR = adp.LQR(TWO, COST), adp.LQR(PENDULUM, COST)
RINGS = st.rings(3)
WINDOWS = adp.IntegralWindows(PARAMETRIC, 0.04)
LAW = adp.LeastSquares([0.1, 1.0], 0.5)


def chase(
    kernel: Any = None,
    radius: Any = 0.3,
    directions: Any = RINGS,
    law: Any = None,
    target: Any = None,
    by: Any = None,
) -> Run:
    centers = st.StateFollowingCenters(directions, radius)
    basis = st.StaFBasis(st.GaussianKernel(0.7) if kernel is None else kernel, centers)
    law, target = law or optim.SteepestDescent(), target or targets.Paper()
    return lambda rows, real: (
        st.chase_weights(STATES[rows].to(real), basis, target, law, predictor=by).weights
    )


def trajectory(plant: systems.ControlAffineSystem) -> Run:
    x0 = torch.linspace(-0.3, 0.4, ROWS * (plant.dim or 2)).reshape(ROWS, -1)
    return lambda rows, real: systems.simulate(plant, x0[rows].to(real), dt=0.01, steps=3)


def loop(
    controller: Any = LQR,
    plant: systems.Plant = TWO,
    cost: adp.Cost = COST,
    dt: float = 0.02,
    **settings: Any,
) -> Run:
    def run(rows: slice, real: torch.dtype) -> Any:
        seeds = [*range(ROWS)][rows]
        found = adp.simulate(
            controller, plant, cost, X0[rows].to(real), dt=dt, steps=3, seed=seeds, substeps=1, **settings
        )
        return found.state, found.cost, found.recorded

    return run


def learner(basis: Any = None, law: Any = None, points: Any = None, **settings: Any) -> Run:
    basis = adp.QuadraticBasis(2) if basis is None else basis
    points = adp.QuadraturePoints(2, 2, 0.5) if points is None else points
    return loop(adp.ActorCritic(basis, TWO, COST, points, law, **settings))


def staf(
    kernel: Any = None, radius: Any = 0.3, gradient: str = "total", directions: Any = RINGS
) -> adp.ValueBasis:
    kernel = st.AnchoredKernel(st.ExponentialKernel()) if kernel is None else kernel
    return adp.StaFValueBasis(st.StaFBasis(kernel, st.StateFollowingCenters(directions, radius)), gradient)


def angle(x: Tensor) -> Tensor:
    return x[..., :1]


def observed(kind: Any, noise: Any = (0.01,), process: Any = 0.01, mass: Any = 1.0, **guess: Any) -> Run:
    filter_ = kind(systems.Pendulum(mass), angle, noise=noise, process=process)
    inside = adp.Observed(adp.Feedback(PENDULUM_LQR), filter_, **{"deviation": 0.5, **guess})
    return loop(adp.Measured(inside, noise=0.01, dim=1, output=angle), PENDULUM)


def identified(windows: Any = WINDOWS, law: Any = LAW, **settings: Any) -> Run:
    control = adp.AdaptiveLQR(PARAMETRIC, PENDULUM_COST, windows, law, doublings=3, **settings)
    return loop(control, PARAMETRIC, PENDULUM_COST)


def sampled(mass: Any = 1.0, **settings: Any) -> Run:
    problem = adp.SampledProblem.of(systems.Pendulum(mass), LIMITED, dt=0.02)
    given = {"noise": 0.5, "temperature": 0.1, **settings}
    return loop(adp.PathIntegral(problem, steps=4, samples=5, knots=2, compile=False, **given), PENDULUM)


def pumped(mass: Any = 1.0, gain: Any = 1.0, capture: Any = 1.0) -> Run:
    def energy(x: Tensor) -> Tensor:
        return 0.5 * x[..., 1] ** 2 + 9.81 * x[..., 0].cos()

    pump = adp.EnergyShaping(systems.Pendulum(mass), LIMITED, energy, gain=gain, capture=capture)
    return loop(adp.Feedback(pump), PENDULUM)


def tracked(**settings: Any) -> Run:
    gains = {"length": 0.04, "feedback": 1.0, "gain": 1.0, "rate": 1.0, **settings}

    def still(x: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(x[:, :1]), torch.zeros_like(x[:, :1])

    return loop(adp.ConcurrentTracker(PARAMETRIC, still, **gains), PARAMETRIC)


def boxed(low: Any = -3.0, high: Any = 2.0) -> Run:
    box = systems.Barrier(systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]), [low, -9.0], [high, 9.0])
    return loop(adp.Feedback(adp.BoxFilter(adp.LQR(box, COST), box, dt=0.02)), box)


def stated(mass: Any = 1.0) -> Run:
    def rate(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((x[..., 1], u[..., 0] - mass * x[..., 0]), dim=-1)

    plant = systems.RatePlant(rate, dim=2, inputs=1)
    return loop(adp.LQR(plant, COST), plant)


def improved(mass: Any = 1.0, weight: Any = 1.0, radius: Any = 0.1) -> Run:
    cost = adp.QuadraticCost(weight, 1.0, 2, 1)
    policy = adp.near_optimal(systems.Pendulum(mass), cost, dt=0.05, radius=radius, reach="local")
    return lambda rows, real: policy(X0[rows].to(real))


def optimum(mass: Any = 1.0, weight: Any = 1.0, terminal: Any = 1.0) -> Run:
    cost = adp.QuadraticCost(weight, 1.0, 2, 1)
    settings = {"terminal": terminal, "horizon": 0.5, "intervals": 4}
    shooting = adp.DirectShooting(systems.Pendulum(mass), cost, **settings)

    def run(rows: slice, real: torch.dtype) -> Any:
        found = shooting.solve(0.3 * X0[rows].to(real))
        return found.value, found.gradient, found.state, found.plan, found.converged

    return run


def drift(**settings: Any) -> Run:
    known = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    stated = {"deviation": 2.0, "length": 0.04, "floor": 1e-3, **settings}
    centers = 0.5 * torch.tensor([[1.0, 0.0], [-0.5, 0.9], [-0.5, -0.9]]).double()
    found = adp.StreamDrift(known, st.GaussianKernel(stated.pop("width", 2.0)), centers, rows=[1], **stated)
    return loop(adp.DriftLQR(found, PENDULUM_COST, doublings=3), PENDULUM, PENDULUM_COST)


def robust(wall: Any = 0.9, **settings: Any) -> Run:
    plant = adp.ParametricPlant.of_effectiveness(PENDULUM)
    law, windows = adp.LeastSquares([1.05], deviation=0.2), adp.IntegralWindows(plant, 0.1, first=0.03)
    box = {"theta_low": [0.6], "theta_high": [1.5], "decay": 4.0, **settings}
    wanted = adp.Feedback(lambda x: -10 * (x[..., :1] - 1.0) - 3 * x[..., 1:])
    safe = adp.RobustFilter(wanted, plant, lambda x, t: wall - x[:, 0], windows, law, dt=0.02, **box)
    return loop(safe, plant, PENDULUM_COST)


def changing(mass: Any = 1.0, before: Any = (1.0,), after: Any = (0.5,)) -> Run:
    plant = adp.ChangingPlant(adp.ParametricPlant.of_effectiveness(systems.Pendulum(mass)))

    def run(rows: slice, real: torch.dtype) -> Any:
        return systems.simulate(plant, plant.start(X0[rows].to(real), before, after, 0.015), dt=0.01, steps=3)

    return run


def referred(error: Any = 10.0, gain: Any = 5.0) -> Run:
    plant, cost = systems.TwoStateTracking(), adp.tracking_cost(error, 1.0)
    basis = adp.LeadingCoordinates(adp.QuadraticBasis(2), 4)
    learner = adp.ActorCritic(basis, plant, cost, adp.RandomPoints(1, 0.3))
    identifier = adp.ConcurrentLearning(3, 2, 6, gain=gain)
    tracker = adp.IdentifyingTracker(learner, plant, identifier, torch.zeros(3, 2).double())
    z0 = torch.cat((0.3 * X0, torch.tensor([[0.0, 1.0]]).expand(ROWS, 2)), dim=-1)
    return lambda rows, real: (
        adp.simulate(
            tracker, plant, cost, z0[rows].to(real), dt=0.01, steps=3, seed=[*range(ROWS)][rows]
        ).state
    )


def problem(mass: Any = 1.0, bound: Any = 2.0) -> tuple[systems.Plant, adp.Cost]:
    """A plant and a cost with bounds of its inputs."""
    return systems.Pendulum(mass), adp.QuadraticCost(1.0, 1.0, 2, 1, low=-bound, high=bound)


def planned(**numbers: Any) -> Run:
    search = adp.BoxDDP(adp.SampledProblem.of(*problem(**numbers), dt=0.1), steps=4, compile=False)
    return lambda rows, real: search.solve(X0[rows].to(real))


def followed(**numbers: Any) -> Run:
    sampled = adp.SampledProblem.of(*problem(**numbers), dt=0.1)
    return loop(adp.RecedingHorizon(sampled, steps=3, iterations=1, compile=False), *problem(**numbers), 0.1)


def walled(wall: Any = -0.2, decay: Any = 1.0, bound: Any = 3.0) -> Run:
    plant, settings = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]), {"decay": decay, "dt": 0.05}
    lqr = adp.LQR(plant, COST)
    safe = adp.SafetyFilter(lqr, plant, lambda x, t: x[:, 0] - wall, low=-bound, high=bound, **settings)
    return lambda rows, real: safe.restrain(X0[rows].to(real), lqr(X0[rows].to(real)))


def centered(radius: Any) -> Run:
    centers = st.StateFollowingCenters(RINGS, radius)
    return lambda rows, real: centers(X0[rows].to(real))


def streamed(width: Any = 1.0, **settings: Any) -> Run:
    angle = 0.05 * torch.arange(12.0).unsqueeze(-1) + torch.arange(float(ROWS))
    x = torch.stack((angle.sin(), 0.7 * angle.sin()), dim=-1)

    def run(rows: slice, real: torch.dtype) -> Any:
        model = st.StaFRegressor(st.GaussianKernel(width), **settings)
        return model.fit(x[:, rows].to(real), x[:, rows].to(real).sin().sum(-1)).predict(x[0, rows], True)

    return run


def avoided(spot: Any = (1.8,), weight: Any = 1.0, bound: Any = 1.0) -> Run:
    robot, at = systems.Linear([[0.0]], [[1.0]]), torch.as_tensor(spot, dtype=torch.float64)

    def disc(x: Tensor) -> Tensor:
        return (x - at.to(x)).square().sum(-1) - 0.04

    box = {"obstacles": disc, "reach": 0.3, "weight": weight, "low": -1.0, "high": bound}
    cost, few = adp.AvoidanceCost(1.0, 1.0, 1, 1, **box), {"shrink": [1.0], "iterations": 1, "compile": False}
    return lambda rows, real: tuple(
        adp.plan_around(robot, cost, X0[rows, :1].to(real), dt=0.1, steps=4, **few)[1:]
    )


class Spring(systems.ControlAffineSystem):
    """A user's plant, whose number is a buffer."""

    dim, inputs = 2, 1

    def __init__(self, stiffness: Any) -> None:
        super().__init__()
        self.register_buffer("stiffness", torch.as_tensor(stiffness, dtype=torch.float64))

    def drift(self, x: Tensor) -> Tensor:
        return torch.stack((x[..., 1], -self.get_buffer("stiffness") * x[..., 0] - 0.1 * x[..., 1]), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape, 1)


class Gained(adp.Controller):
    """A user's controller, whose number is an attribute."""

    def __init__(self, gain: Any) -> None:
        super().__init__()
        self.gain = gain

    def init(self, x0: Tensor) -> Tensor:
        return self.gain * x0[:, 0]

    def step(self, x: Tensor, carried: Tensor, uniform: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        carried = carried + dt * x[:, 0]
        return -(self.gain * (x.sum(-1) + carried)).unsqueeze(-1), carried


GAINS = {
    **{
        "critic": (0.001, 0.01),
        "critic_extrapolated": (0.2, 0.3),
        "actor": (1.0, 1.4),
        "forgetting": (0.003, 0.03),
    },
    **{"actor_decay": (0.01, 0.02), "normalisation": (0.05, 0.1), "information": (0.9, 1.0)},
}
EYE = torch.eye(2).tolist()
TWICE = (2 * torch.eye(2)).tolist()
WIDER = st.rings(3) * 0.8
CASES: dict[str, Case] = {
    # plants
    "pendulum": Case(
        {"mass": (0.5, 2.0), "length": (0.5, 1.5), "damping": (0.0, 0.3), "gravity": (9.0, 10.0)},
        lambda **n: trajectory(systems.Pendulum(**n)),
    ),
    "cart_pole": Case(
        {"cart": (0.5, 2.0), "pole": (0.1, 0.3), "half_length": (0.4, 0.6)},
        lambda **n: trajectory(systems.CartPole(**n)),
    ),
    "planar_quadrotor": Case(
        {"mass": (0.5, 2.0), "inertia": (0.1, 0.2)}, lambda **n: trajectory(systems.PlanarQuadrotor(**n))
    ),
    "van_der_pol": Case({"damping": (0.5, 2.0)}, lambda **n: trajectory(systems.VanDerPol(**n))),
    "oscillator": Case({"frequency": (0.5, 2.0)}, lambda **n: trajectory(systems.Oscillator(**n)), 1e-15),
    "linear": Case(
        {"matrix": ([[-0.1, 1.0], [-1.0, -0.3]], [[-0.2, 1.5], [-1.0, -0.1]])},
        lambda **n: trajectory(systems.Linear(**n)),
        1e-15,
    ),
    "two_state_chain": Case(
        {"theta": ([1.0, -1.0, -0.5, 0.5], [0.8, -1.0, -0.4, 0.6])},
        lambda **n: trajectory(systems.TwoStateChain(**n)),
    ),
    "two_link_robot": Case(
        {
            "friction": ([5.3, 1.1, 8.45, 2.35], [5.0, 1.0, 8.0, 2.0]),
            "inertia": ([3.473, 0.196, 0.242], [3.5, 0.2, 0.2]),
        },
        lambda **n: trajectory(systems.TwoLinkRobot(**n)),
    ),
    "points of a barrier": Case(
        {"low": ([-2.0, -9.0], [-3.0, -8.0])},
        lambda low: lambda rows, real: systems.Barrier(TWO, low, [2.0, 9.0]).inverse(X0[rows].to(real)),
    ),
    "barrier": Case(
        {"low": ([-7.0, -6.0], [-6.0, -7.0]), "high": ([5.0, 7.0], [6.0, 7.0])},
        lambda **n: trajectory(systems.Barrier(systems.TwoStateChain(), **n)),
    ),
    # costs
    "quadratic_cost": Case(
        {
            "state": (1.0, 2.0),
            "control": (0.5, 1.0),
            "low": (-0.5, -1.0),
            "high": (0.5, 1.0),
            "discount": (0.1, 1.0),
        },
        lambda **n: loop(cost=adp.QuadraticCost(dim=2, inputs=1, **{"state": 1.0, "control": 1.0, **n})),
    ),
    "matrices of a cost": Case(
        {"state": (EYE, TWICE), "terminal": (EYE, TWICE), "control": ([[1.0]], [[2.0]])},
        lambda **n: loop(cost=adp.QuadraticCost(dim=2, inputs=1, **{"state": 1.0, "control": 1.0, **n})),
    ),
    "set-points": Case(
        {"target": ([0.0, 0.0], [0.3, 0.0])},
        lambda target: loop(cost=adp.QuadraticCost(1.0, 1.0, 2, 1, target=target), plant=PENDULUM),
    ),
    "bounded_input_cost": Case(
        {"bound": (1.0, 8.0), "control": (0.1, 0.2)},
        lambda **n: loop(
            cost=adp.BoundedInputCost(1.0, dim=2, inputs=1, **{"bound": 8.0, "control": 0.1, **n})
        ),
    ),
    "avoidance_cost": Case(
        {"reach": (0.4, 0.6), "weight": (1.0, 2.0)},
        lambda **n: loop(
            cost=adp.AvoidanceCost(
                *(1.0, 1.0, 2, 1), obstacles=lambda x: x[..., 0].square() - 0.1, **{"reach": 0.5, **n}
            )
        ),
    ),
    "lqr": Case(
        {"q": (1.0, 2.0), "discount": (0.1, 1.0)},
        lambda q=1.0, discount=0.0: loop(adp.LQR(TWO, adp.QuadraticCost(q, 1.0, 2, 1, discount=discount))),
    ),
    "lqr of a period": Case(
        {"mass": (0.5, 2.0), "bound": (1.0, 2.0)}, lambda **n: loop(adp.LQR(*problem(**n), period=0.05))
    ),
    "user's plant": Case(
        {"stiffness": (0.5, 4.0), "q": (1.0, 3.0)},
        lambda stiffness=1.0, q=1.0: loop(
            LQR, Spring(stiffness), adp.QuadraticCost(q, 1.0, 2, 1, low=-2.0, high=2.0)
        ),
    ),
    "supervised": Case(
        {"trust": (0.3, 0.6)},
        lambda trust: loop(adp.Supervised(adp.Feedback(lambda x: 10 * x[..., 1:]), LQR, COST, trust)),
    ),
    "user's controller": Case({"gain": (0.5, 1.0)}, lambda gain: loop(Gained(gain))),
    # kernels, radii, directions, targets, laws, predictors
    "gaussian": Case(
        {"width": (0.5, 1.5)}, lambda width: chase(st.GaussianKernel(width), by=predictors.Tangent()), 1e-9
    ),
    "anchored_gaussian": Case(
        {"width": (0.5, 1.5)}, lambda width: chase(st.AnchoredKernel(st.GaussianKernel(width))), 1e-9
    ),
    "matern": Case(
        {"length_scale": (0.8, 1.5)}, lambda length_scale: chase(st.MaternKernel(2.5, length_scale)), 1e-9
    ),
    "inverse_multiquadric": Case(
        {"c": (0.5, 1.0)}, lambda c: chase(st.InverseMultiquadricKernel(c), by=predictors.Secant(True)), 1e-9
    ),
    "rational_quadratic": Case(
        {"alpha": (1.0, 2.0), "length_scale": (0.5, 1.0)},
        lambda alpha=1.7, length_scale=0.9: chase(st.RationalQuadraticKernel(alpha, length_scale)),
        1e-9,
    ),
    "polynomial": Case({"bias": (0.5, 1.0)}, lambda bias: chase(st.PolynomialKernel(3, bias)), 1e-9),
    "centers": Case({"radius": (0.1, 0.3)}, centered),
    "constant_radius": Case({"radius": (0.1, 0.4)}, lambda radius: chase(radius=radius), 1e-9),
    "state_radius": Case(
        {"radius": (0.3, 0.7), "offset": (0.01, 0.05), "gain": (1.0, 2.0)},
        lambda radius=0.3, offset=0.05, gain=1.0: chase(radius=st.StateRadius(radius, offset, gain)),
        1e-9,
    ),
    "directions": Case(
        {"directions": (RINGS.tolist(), WIDER.tolist())},
        lambda directions: chase(directions=torch.as_tensor(directions, dtype=torch.float64)),
        1e-9,
    ),
    "quadratic_target": Case({"matrix": (1.0, 2.0)}, lambda matrix: chase(target=targets.Quadratic(matrix))),
    "matrix of a target": Case(
        {"matrix": (EYE, TWICE)}, lambda matrix: chase(target=targets.Quadratic(matrix))
    ),
    "cosine": Case(
        {"frequency": ([1.0, 2.0], [2.0, 1.0]), "phase": (0.0, 1.0)},
        lambda **n: chase(target=targets.Cosine(**n)),
    ),
    "fixed_step": Case({"step": (0.2, 0.9)}, lambda step: chase(law=optim.FixedStep(step))),
    "absolute_step": Case(
        {"step": (0.02, 0.1)}, lambda step: chase(law=optim.FixedStep(step, relative=False))
    ),
    "heavy_ball": Case(
        {"step": (0.5, 1.0), "momentum": (0.5, 0.9)},
        lambda step=1.0, momentum=0.9: chase(law=optim.HeavyBall(step, momentum)),
    ),
    "nesterov": Case(
        {"step": (0.5, 0.9), "momentum": (0.5, 0.9)}, lambda **n: chase(law=optim.Nesterov(**n))
    ),
    "normalised_lms": Case({"step": (0.5, 0.9)}, lambda step: chase(law=optim.NormalisedLMS(step))),
    "recursive_least_squares": Case(
        {"process_noise": (0.0, 1.0), "measurement_noise": (1e-3, 1e-2), "prior": (1e3, 1e4)},
        lambda **n: chase(law=optim.RecursiveLeastSquares(**n)),
    ),
    # what learns while it controls
    "information": Case(
        {**GAINS, "bound": (5.0, 10.0)},
        lambda bound=None, **n: learner(law=adp.Information(adp.Gains(**n), bound)),
    ),
    "published": Case(
        {**GAINS, "bound": (5.0, 10.0)},
        lambda bound=None, **n: learner(law=adp.Published(adp.Gains(**n), bound)),
        1e-14,
    ),
    "policy_iteration": Case(
        {"damping": (1e-3, 1e-2), "settling": (0.01, 0.02)}, lambda **n: learner(law=adp.PolicyIteration(**n))
    ),
    "first weights": Case(
        {"critic": ([0.3] * 3, [0.5] * 3), "actor": (0.2, 0.4), "gain": (200.0, 300.0)},
        lambda **n: learner(law=adp.Frozen(), **n),
    ),
    "random_points": Case(
        {"half_width": (0.3, 0.5)}, lambda half_width: learner(points=adp.RandomPoints(2, half_width))
    ),
    "quadrature_points": Case(
        {"half_width": (0.3, 0.5)},
        lambda half_width: learner(points=adp.QuadraturePoints(2, 2, half_width, "fixed", around="origin")),
    ),
    "rbf_grid": Case(
        {"half_width": (1.0, 2.0), "width": (0.5, 1.0)}, lambda **n: learner(adp.RBFGridBasis(2, 2, **n))
    ),
    "staf_value_basis": Case(
        {"radius": (0.2, 0.4), "directions": (RINGS.tolist(), WIDER.tolist())},
        lambda radius=0.3, directions=RINGS: learner(
            staf(radius=radius, directions=torch.as_tensor(directions, dtype=torch.float64))
        ),
    ),
    "gaussian value basis": Case(
        {"width": (0.5, 0.7)},
        lambda width: learner(staf(st.AnchoredKernel(st.GaussianKernel(width)), gradient="partial")),
    ),
    # estimation, adaptation
    "measured": Case(
        {"noise": ([0.0, 0.1], [0.1, 0.2])},
        lambda noise: loop(adp.Measured(adp.Feedback(LQR), noise=noise, dim=2)),
    ),
    "extended_kalman": Case(
        {"noise": ([0.01], [0.1]), "process": (0.01, 0.1), "deviation": (0.1, 1.0), "mass": (0.8, 1.2)},
        lambda **n: observed(adp.ExtendedKalman, **n),
        1e-14,
    ),
    "unscented_kalman": Case(
        {"noise": ([0.01], [0.1]), "process": ([0.01, 0.0], [0.1, 0.1]), "mean": ([0.0, 0.0], [0.1, 0.1])},
        lambda **n: observed(adp.UnscentedKalman, **n),
        1e-14,
    ),
    "least_squares": Case(
        {
            "theta": ([0.1, 1.0], [0.2, 0.8]),
            "deviation": (0.3, 0.5),
            "floor": (1e-6, 1e-5),
            "forgetting": (0.1, 0.2),
            "alarm": (3.0, 5.0),
        },
        lambda **n: identified(law=adp.LeastSquares(**{"theta": [0.1, 1.0], "deviation": 0.5, **n})),
        1e-14,
    ),
    "windows": Case(
        {"length": (0.03, 0.04), "noise": (0.0, 0.01)},
        lambda **n: identified(adp.IntegralWindows(PARAMETRIC, **{"length": 0.04, **n})),
        1e-14,
    ),
    "adaptive_lqr": Case({"confidence": (2.0, 3.0), "probe": (0.1, 0.2)}, lambda **n: identified(**n), 1e-14),
    "consider_filter": Case(
        {"noise": (0.01, 0.02), "process": ([0.0, 0.1], [0.1, 0.2])},
        lambda **n: identified(filter=adp.ConsiderFilter(PARAMETRIC, **{"noise": 0.01, **n})),
        1e-14,
    ),
    "stream_drift": Case(
        {
            "deviation": (1.0, 2.0),
            "length": (0.03, 0.04),
            "noise": (0.0, 0.01),
            "floor": (1e-3, 1e-2),
            "forgetting": (0.1, 0.2),
            "width": (1.5, 2.0),
        },
        lambda **n: drift(**n),
        1e-9,
    ),
    "stream": Case(
        {
            "width": (0.6, 1.2),
            "radius": (0.3, 0.6),
            "noise": (0.03, 0.1),
            "amplitude": (0.8, 1.5),
            "forgetting": (0.99, 0.999),
            "follow": (0.5, 1.0),
            "robust": (2.0, 3.0),
        },
        streamed,
        1e-9,
    ),
    # what plans and guards
    "box_ddp": Case({"mass": (0.5, 2.0), "bound": (1.0, 2.0)}, planned),
    "receding_horizon": Case({"mass": (0.5, 2.0), "bound": (1.0, 2.0)}, followed),
    "rollout": Case(
        {"mass": (0.5, 2.0), "bound": (1.0, 2.0)},
        lambda **n: loop(adp.RolloutPolicy.of_lqr(*problem(**n), steps=3, horizon=0.15)),
    ),
    "safety_filter": Case({"wall": (-0.3, 0.1), "decay": (1.0, 3.0), "bound": (2.0, 3.0)}, walled),
    "identifying_tracker": Case({"error": (5.0, 10.0), "gain": (4.0, 5.0)}, referred),
    "changing_plant": Case({"mass": (0.8, 1.2), "before": ([0.8], [1.2]), "after": ([0.4], [0.6])}, changing),
    "robust_filter": Case(
        {"wall": (0.8, 0.9), "confidence": (3.0, 4.0), "margin": (0.0, 0.1), "theta_high": ([1.4], [1.5])},
        robust,
    ),
    "plan_around": Case({"spot": ([1.8], [1.9]), "weight": (1.0, 2.0), "bound": (0.8, 1.0)}, avoided, 1e-13),
    "path_integral": Case(
        {"mass": (0.8, 1.2), "noise": (0.3, 0.5), "temperature": (0.1, 0.2)}, lambda **n: sampled(**n)
    ),
    "energy_shaping": Case(
        {"mass": (0.8, 1.2), "gain": (1.0, 2.0), "capture": (0.5, 1.0)}, lambda **n: pumped(**n)
    ),
    "concurrent_tracker": Case(
        {"length": (0.04, 0.05), "feedback": (1.0, 2.0), "gain": (1.0, 2.0), "rate": (1.0, 1.5)},
        lambda **n: tracked(**n),
    ),
    "box_filter": Case({"low": (-3.0, -2.0), "high": (2.0, 3.0)}, lambda **n: boxed(**n)),
    "rate_plant": Case({"mass": (0.8, 1.2)}, lambda **n: stated(**n)),
    "near_optimal": Case(
        {"mass": (0.8, 1.2), "weight": (0.5, 2.0), "radius": (0.05, 0.1)}, lambda **n: improved(**n)
    ),
    "direct_shooting": Case(
        {"mass": (0.8, 1.2), "weight": (0.5, 2.0), "terminal": (0.5, 1.0)}, lambda **n: optimum(**n), 1e-13
    ),
}
