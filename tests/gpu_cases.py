"""Programs of all kinds for a device: what `tests/gpu.py` runs on a card, and a test on the host."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

import staf_torch as st
from staf_torch import adp, lanes, optim, systems, targets
from staf_torch.adp.loop.step import ClosedLoop
from staf_torch.adp.loop.step import program as loop_program


@dataclass(frozen=True)
class Case:
    """A call of something with rows, as a user makes it."""

    call: Callable[..., Any]  # of the inputs, to a tree of tensors (B, ...)
    plain: Callable[..., Any]  # the same by the definition
    inputs: tuple[Any, ...]  # trees (B, ...) on the CPU
    times: int  # steps of a row
    to: Callable[[str], Any] = lambda device: None  # moves what else it holds


def of_program(program: lanes.Program, *inputs: Any, times: int, every: int = 1, **more: Any) -> Case:
    """A case that calls a program with (carry, now, row)."""
    more = {**more, "every": every}
    return Case(
        lambda *given: program(*given, **more),
        lambda *given: program.definition(*given, **more),
        inputs,
        times,
    )


def of_function(function: Callable[..., Any], *inputs: Any, times: int, parts: tuple[Any, ...] = ()) -> Case:
    """A case that calls a function of the library, whose parts are moved with it."""

    def plain(*given: Any) -> Any:
        with lanes.compiling("never"):
            return function(*given)

    def to(device: str) -> None:
        for part in parts:
            part.to(device)

    return Case(function, plain, inputs, times, to)


def flow(carry: Any, u: Tensor, row: Any) -> Any:
    """A little of everything: loops, a flag, a count, a matrix, a reduction, a product that stays a loop."""
    x, count, above = carry["x"], carry["count"], carry["above"]
    matrix = torch.linspace(-1, 1, 100, dtype=x.dtype, device=x.device).reshape(10, 10)
    rate = lanes.repeat(3, lambda z: (z + 0.1 * u).sin() + row["gain"].unsqueeze(-1) * z, x)
    wide = (torch.cat((rate,) * 5, dim=-1) @ matrix).tanh()
    x = x + 0.01 * torch.where(above.unsqueeze(-1), wide[..., :2], -rate)
    points = x.unsqueeze(-1) + torch.linspace(0, 1, 4, dtype=x.dtype, device=x.device)
    high = lanes.reduce(lambda p: p.exp(), points, "max", dim=2)
    swapped = {"x": x.flip(-1), "count": count + 1, "above": x[..., 0] > x[..., 1]}
    return swapped, (high, wide.abs().sum(-1).clamp(max=2.0))


def flows(rows: int, dtype: torch.dtype) -> Case:
    x, u = torch.randn(rows, 2, dtype=dtype), torch.randn(rows, 9, 2, dtype=dtype)
    carry = {"x": x, "count": torch.zeros(rows, dtype=torch.long), "above": x[:, 0] > 0}
    return of_program(lanes.Program(flow), carry, u, {"gain": torch.rand(rows, dtype=dtype)}, times=9)


def pendulum(x: Tensor, u: Tensor, row: Any) -> tuple[Tensor, Tensor]:
    gain, mass = row
    rate = torch.stack((x[..., 1], -gain * x[..., 0].sin() + u / mass), dim=-1)
    return x + 0.01 * rate, x[..., 0]


def pendulums(rows: int, dtype: torch.dtype) -> Case:
    carry, now = torch.randn(rows, 2, dtype=dtype), torch.randn(rows, 30, dtype=dtype)
    row = torch.rand(rows, dtype=dtype), lanes.Shared(torch.tensor(2.0, dtype=dtype))
    return of_program(lanes.Program(pendulum), carry, now, row, times=30, every=3)


class Motor(systems.ControlAffineSystem):
    """A mode of 127 1/s and more, held for 20 ms: exponential steps."""

    dim, inputs = 2, 1

    def drift(self, x: Tensor) -> Tensor:
        speed = x[..., 1]
        return torch.stack((speed, -127 * speed * (1 + 0.1 * speed.tanh().square())), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.tensor([[0.0], [27.8]]).to(x).expand(*x.shape[:-1], 2, 1)


def of_loop(controller: Any, plant: Any, cost: Any, x0: Tensor, times: int, **more: Any) -> Case:
    """A case that runs a closed loop of a controller, with random numbers as inputs."""
    loop = ClosedLoop(controller, plant, cost, **more).to(x0.dtype)
    drawn = 2 * torch.rand(len(x0), times, controller.draws, x0.shape[-1], dtype=x0.dtype) - 1
    case = of_program(loop_program(loop, True), loop.init(x0), drawn, {}, times=times)
    return replace(case, to=loop.to)


def stiff_loops(rows: int, dtype: torch.dtype) -> Case:
    plant, weights = Motor(), torch.diag(torch.tensor([1550.0, 15.5], dtype=torch.float64))
    cost = adp.QuadraticCost(weights, 1 / 144, dim=2, inputs=1)
    policy = adp.Feedback(adp.LQR(plant, cost, period=0.02))
    return of_loop(policy, plant, cost, torch.randn(rows, 2, dtype=dtype), 30, dt=0.02)


def mixed(rows: int, dtype: torch.dtype) -> Case:
    """float32 constants and float32 arithmetic inside a program of another dtype."""

    def step(x: Tensor, now: Any, row: Any) -> tuple[Tensor, Tensor]:
        late = torch.where(x > 0, 1.0, 0.1) * torch.tensor([0.3, 0.7], device=x.device)
        x = x + 0.01 * (late - x.float().sin())
        return x.to(dtype), x.to(dtype)

    x = torch.randn(rows, 2, dtype=dtype)
    return of_program(lanes.Program(step), x, torch.zeros(rows, 30, dtype=dtype), (), times=30)


RADIUS = {3: 1.0, 6: 1.5, 15: 2.4}
"""Radii of the centers at which the Gram matrices are well conditioned, and a rounding stays one."""
LAWS: dict[str, Callable[[], optim.UpdateLaw]] = {
    "SteepestDescent": optim.SteepestDescent,
    "Nesterov": optim.Nesterov,
    "ConjugateGradient": optim.ConjugateGradient,
    "HeavyBall": optim.HeavyBall,
    "Exact": optim.Exact,
    "BarzilaiBorwein": optim.BarzilaiBorwein,
    "FixedStep": optim.FixedStep,
    "NormalisedLMS": optim.NormalisedLMS,
    "PreconditionedDescent": optim.PreconditionedDescent,
    "jacobi": lambda: optim.PreconditionedDescent("jacobi"),
    "RecursiveLeastSquares": optim.RecursiveLeastSquares,
}


@functools.cache
def circles(rows: int, times: int, dtype: torch.dtype) -> Tensor:
    """Circles of radii 0.1 to 0.4, (B, T, 2) contiguous; the first are the same however many there are."""
    row = torch.arange(rows, dtype=torch.float64)
    radius, phase = 0.1 + 0.3 * (0.37 * row).frac(), 6 * (0.61 * row).frac()
    angle = phase.unsqueeze(1) + 0.01 * torch.arange(times)
    return (radius[:, None, None] * torch.stack((angle.cos(), -angle.sin()), dim=-1)).to(dtype).contiguous()


def weights(count: int, law: str, times: int, its: int = 10) -> Callable[[int, torch.dtype], Case]:
    def case(rows: int, dtype: torch.dtype) -> Case:
        basis = st.StaFBasis(
            st.ExponentialKernel(), st.StateFollowingCenters(st.rings(count), RADIUS[count])
        ).to(dtype)
        made = LAWS[law]()
        paper = targets.Paper()
        call = lambda x: st.chase_weights(x, basis, paper, made, inner_steps=its).weights  # noqa: E731
        return of_function(call, circles(rows, times, dtype), times=times, parts=(basis, paper))

    return case


def everything(rows: int, dtype: torch.dtype) -> Case:
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(3), 0.3)).to(dtype)
    law, paper = optim.SteepestDescent(), targets.Paper()

    def call(x: Tensor) -> Any:
        found = st.chase(x, basis, paper, law)
        return found.weights, found.estimate

    return of_function(call, circles(rows, 20, dtype), times=20, parts=(basis, paper))


_A = (0.161, -0.008480655492356989, 0.335480655492357, 2.8971530571054935, -6.359448489975075)
_TSIT5 = (
    (_A[0],),
    (_A[1], _A[2]),
    (_A[3], _A[4], 4.3622954328695815),
    (5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525),
    (5.86145544294642, -12.92096931784711, 8.159367898576159, -0.071584973281401, -0.028269050394068383),
)
_TSIT5_END = (
    0.09646076681806523,
    0.01,
    0.4798896504144996,
    1.379008574103742,
    -3.290069515436081,
    2.324710524099774,
)


def lorenz(x: Tensor, now: Any, row: Tensor) -> tuple[Tensor, tuple[()]]:
    """A step of Tsit5 (DiffEqGPU's benchmark): rho is a row's own."""

    def rate(x: Tensor) -> Tensor:
        a, b, c = x.unbind(-1)
        return torch.stack((10 * (b - a), row * a - b - a * c, a * b - 8 / 3 * c), dim=-1)

    slopes = [rate(x)]
    for share in _TSIT5:
        slopes.append(rate(x + 0.001 * sum(a * k for a, k in zip(share, slopes, strict=True))))
    return x + 0.001 * sum(b * k for b, k in zip(_TSIT5_END, slopes, strict=True)), ()


def lorenzes(rows: int, dtype: torch.dtype) -> Case:
    x0 = torch.tensor([1.0, 0.0, 0.0], dtype=dtype).expand(rows, 3)
    rho = (21 * (0.37 * torch.arange(rows, dtype=torch.float64)).frac()).to(dtype)
    return of_program(lanes.Program(lorenz), x0, (), rho, steps=1000, times=1000)


def learning(rows: int, dtype: torch.dtype) -> tuple[Any, Any, Any, Tensor]:
    """The learner of the paper's example, its plant, cost and first states."""
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    following = st.StateFollowingCenters(st.rings(3), st.StateRadius(0.7, 1e-5))
    basis = adp.StaFValueBasis(st.StaFBasis(st.AnchoredKernel(st.ExponentialKernel()), following))
    points = adp.RandomPoints(1, st.StateRadius(2.1, 1e-5))
    learner = adp.ActorCritic(basis, plant, cost, points, adp.Information())
    return (
        learner,
        plant,
        cost,
        torch.tensor([-1.0, 1.0], dtype=dtype) + 0.1 * torch.randn(rows, 2, dtype=dtype),
    )


def information(rows: int, dtype: torch.dtype) -> Case:
    return of_loop(*learning(rows, dtype), 100, dt=1e-3)


def random_points(rows: int, dtype: torch.dtype) -> Case:
    """The same learner as a user calls it: its points are made where it runs, by seed, row and step."""
    learner, plant, cost, x0 = learning(rows, dtype)

    def call(x0: Tensor) -> Any:
        found = adp.simulate(learner, plant, cost, x0, dt=1e-3, steps=1000, every=100)
        return found.state, found.cost

    return of_function(call, x0, times=1000)


def lorenz_gradients(rows: int, dtype: torch.dtype) -> Case:
    """Forwards and backwards, by the first state and rho."""
    program = lanes.Program(lorenz)

    def call(run: Any, x0: Tensor, rho: Tensor) -> Any:
        with torch.enable_grad():
            x, own = x0.clone().requires_grad_(), rho.clone().requires_grad_()
            end = run(x, (), own, steps=1000)[0]
            return torch.autograd.grad(end.square().sum(), (x, own))

    calls = functools.partial(call, program), functools.partial(call, program.definition)
    return Case(*calls, lorenzes(rows, dtype).inputs[::2], 1000)


def filtered(rows: int, dtype: torch.dtype) -> Case:
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    lqr = adp.LQR(plant, cost)
    safe = adp.SafetyFilter(lqr, plant, lambda x, t: x[:, 0] + 1.5, dt=0.05, low=-3.0, high=3.0)
    return of_loop(safe, plant, cost, torch.rand(rows, 2, dtype=dtype) - 0.5, 50, dt=0.05)


def rollouts(rows: int, dtype: torch.dtype) -> Case:
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    policy = adp.Feedback(adp.RolloutPolicy.of_lqr(plant, cost, steps=10))
    return of_loop(policy, plant, cost, torch.rand(rows, 2, dtype=dtype) - 0.5, 50, dt=0.02)


def masses(rows: int, dtype: torch.dtype) -> Case:
    """A mass of a row's own."""
    own = lanes.rows(0.5 + 1.5 * (0.37 * torch.arange(rows, dtype=dtype)).frac())
    plant = systems.Pendulum(mass=own)
    x0 = torch.tensor([1.0, 0.0], dtype=dtype).repeat(rows, 1)
    call = lambda x: systems.simulate(plant, x, dt=0.01, steps=200)  # noqa: E731
    return of_function(call, x0, times=200, parts=(plant,))


def memories(rows: int, dtype: torch.dtype) -> Case:
    """A carry of many entries: it stays in memory, and loops go over it."""

    def step(carry: Any, u: Tensor, row: Any) -> Any:
        held, at = carry
        place = torch.arange(80, device=u.device)
        held = torch.where((place == at.unsqueeze(-1)).unsqueeze(-1), u.unsqueeze(1), 0.999 * held)
        mean = held.mean(1)
        return (held, (at + 1) % 80), (mean, held[:, :, 0].tanh())

    carry = torch.zeros(rows, 80, 2, dtype=dtype), torch.zeros(rows, dtype=torch.long)
    return of_program(lanes.Program(step), carry, torch.randn(rows, 40, 2, dtype=dtype), (), times=40)


def turned(rows: int, dtype: torch.dtype) -> Case:
    """Inputs that lie otherwise: rows innermost, every second time, another dtype."""

    def step(x: Tensor, now: Any, row: Any) -> Any:
        u, pushed, count = now
        return 0.9 * x + torch.where(pushed.unsqueeze(-1), u, -0.5 * u) + 0.01 * count.unsqueeze(-1), x

    u = torch.randn(24, 3, rows, dtype=dtype).permute(2, 0, 1)[:, ::2]
    now = u, torch.rand(rows, 12) > 0.5, torch.arange(12).expand(rows, 12)
    return of_program(lanes.Program(step), torch.randn(3, rows, dtype=dtype).mT, now, (), times=12)


def streams(dim: int, count: int, own: bool = False) -> Callable[[int, torch.dtype], Case]:
    """The filter of as many streams: a stretch learned, and the next sample expected."""

    def case(rows: int, dtype: torch.dtype) -> Case:
        widths = 0.9 * dim**0.5 * (0.9 + 0.2 * (0.37 * torch.arange(rows, dtype=torch.float64)).frac())

        def call(x: Tensor, y: Tensor) -> Any:
            width = st.rows(widths[: len(x)].to(x.device)) if own else 0.9 * dim**0.5
            model = st.StaFRegressor(st.GaussianKernel(width), 0.4, count, noise=0.05)
            model.fit(x.transpose(0, 1), y.transpose(0, 1))
            return model.predict(x[:, 0], return_std=True)

        row, time = torch.arange(rows, dtype=torch.float64).view(-1, 1, 1), torch.arange(100).view(-1, 1)
        x = (0.05 * time * torch.linspace(1, 1.7, dim) + 0.61 * row * torch.linspace(1, 2, dim)).sin()
        y = (2 * x).sin().sum(-1) + 0.05 * (7.3 * time.squeeze(1) + row.squeeze(2)).sin()
        return of_function(call, x.to(dtype), y.to(dtype), times=100)

    return case
