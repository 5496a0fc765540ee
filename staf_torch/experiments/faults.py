"""Plants that are not what the design was made for: failed actuators, half an actuator, a wrong mass."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from torch import Tensor

from .. import adp
from ..adp import LQR, AdaptiveLQR, Cost, IntegralWindows, LeastSquares, LoopResult, Measured, ParametricPlant
from ..figures.closed_loop import FaultPicture, draw_faults
from ..numerics.checks import COMMAND_LINE, choice, integer, positive_real
from ..results.run_directory import RunDirectory
from ..settings.chase import generator_of, placement, plain
from ..signs import SHOWN, Progress
from .registry import Metrics
from .study import Method, Study, histories, recorded_times

_log = logging.getLogger(__name__)
_COLUMNS = {
    "case": "case",
    "method": "method",
    "cost_median": "cost, median",
    "cost_max": "largest",
    "ratio_median": "over the optimum, median",
    "ratio_max": "largest",
    "regulated": "regulated",
    "found_median": "found after (s), median",
    "parameter_error": "largest error of a parameter, over max(1, abs theta)",
}
_RECORDED = 0.01  # s between recorded times, about
_SETTLED = 1.0  # s at the end in which a regulated state stays near the origin


class FaultCase(NamedTuple):
    """A plant, its fault, and the policy that learns it."""

    model: ParametricPlant
    cost: Cost
    x0: Tensor  # (B, n)
    before: Tensor  # (B, p)
    after: Tensor  # (B, p)
    at: Tensor  # (B,) s
    dt: float  # s
    noise: float  # standard deviation of a measured state
    near: float  # norm below which the state is regulated
    adaptive: AdaptiveLQR
    optimum: Callable[[], Tensor | None]  # the least cost from x0 of who knows it all, (B,)


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run every case with three policies and fill the run directory; `metrics.json` comes last."""
    study = Study("faults", _COLUMNS, ("cost_median", "cost_max", "regulated"), _log, digits=5)
    pictures: dict[str, FaultPicture] = {}
    for name, case, results in loops(cfg):
        label = name.replace("_", " ")
        best = case.optimum()
        for method, result in results.items():
            measured = _measured(case, result, best)
            if method == "adaptive":
                measured |= _learned(case, result)
            study.add(f"{name}_{method.replace(' ', '_')}_", measured, case=label, method=method)
        pictures[label] = _picture(case, results)
    return study.write(cfg, RunDirectory(directory), lambda: draw_faults(pictures))


def loops(cfg: DictConfig) -> Iterator[tuple[str, FaultCase, dict[str, LoopResult]]]:
    """Yield the name of every case, the case, and its three policies' closed loops."""
    rows = integer(COMMAND_LINE, "trajectories", cfg.trajectories, least=1)
    duration = positive_real(COMMAND_LINE, "duration", cfg.duration)
    place, generator = placement(cfg.device, cfg.dtype), generator_of(cfg)
    for name in plain(cfg.faults.cases):
        choice(COMMAND_LINE, "faults.cases", name, tuple(CASES))
        case = CASES[name](rows, generator)
        yield (
            *(name, case),
            {method: _run(case, each, duration, place) for method, each in _controllers(case).items()},
        )


def held(cfg: DictConfig) -> dict[str, Tensor]:
    """Return what a run keeps of the rows of every case and policy."""
    return histories(
        {f"{case}, {method}": one for case, _, found in loops(cfg) for method, one in found.items()}
    )


run.held = held  # type: ignore[attr-defined]


def short_period(rows: int, generator: torch.Generator) -> FaultCase:
    """The F/A-18's short period with effectiveness (.7, 0): drift and effectiveness unknown, the drift's
    first estimate uniform in [-5, 5].

    Source: Deptula, Bell, Zegers, Licitra and Dixon, Automatica 116 (2020), 108922.
    """
    drift = torch.tensor([-1.175, 0.9871, -8.458, -0.8776], dtype=torch.float64, device="cpu")
    pushed = torch.tensor([[-0.194, -0.03593], [-19.29, -3.803]], dtype=torch.float64, device="cpu")

    def regressor(x: Tensor, u: Tensor) -> Tensor:
        none = torch.zeros_like(x)
        effect = pushed.to(x) * u.unsqueeze(-2)
        first, second = torch.cat((x, none), -1), torch.cat((none, x), -1)
        return torch.cat((torch.stack((first, second), dim=-2), effect), dim=-1)

    true = torch.cat((drift, torch.tensor([0.7, 0.0], dtype=torch.float64, device="cpu")))
    model = ParametricPlant(regressor, dim=2, inputs=2, theta=true)
    cost = adp.BoundedInputCost(0.25, 5.0, dim=2, inputs=2, bound=2.0)
    x0 = torch.tensor([[25.0, -10.0]], dtype=torch.float64, device="cpu").repeat(rows, 1)
    first = torch.ones(rows, 6, dtype=torch.float64, device="cpu")
    first[:, :4] = 10 * torch.rand(rows, 4, generator=generator, dtype=torch.float64, device="cpu") - 5
    law = LeastSquares([0.0] * 4 + [1.0] * 2, deviation=[10.0] * 4 + [1.0] * 2, floor=1e-5)
    # The plant is stable: where nothing is known, nothing is done but to probe.
    adaptive = AdaptiveLQR(
        *(model, cost, IntegralWindows(model, 0.002), law), robust=torch.zeros_like, probe=1.0
    ).starting_from(first)
    known = true.expand(rows, 6)
    return FaultCase(
        *(model, cost, x0, known, known, x0.new_zeros(rows), 0.001, 0.0, 1e-2, adaptive),
        lambda: adp.DirectShooting(model, cost).solve(x0[:1]).value.expand(rows),
    )


def unstable(rows: int, generator: torch.Generator) -> FaultCase:
    """x1'' = 25 x1 + u1 + u2/10, controlled every 20 ms, of whose first actuator half is lost on the way to
    the origin, between 0.1 and 0.5 s. An LQR that is made to be held for that long does not stand it."""

    def regressor(x: Tensor, u: Tensor) -> Tensor:
        effect = u * torch.tensor([1.0, 0.1], dtype=torch.float64, device="cpu").to(u)
        return torch.stack((torch.zeros_like(effect), effect), dim=-2)

    def known(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((x[..., 1], 25 * x[..., 0]), dim=-1)

    model = ParametricPlant(regressor, known, dim=2, inputs=2, theta=[1.0, 1.0], rows=[1])
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=2)
    x0 = 2 * torch.rand(rows, 2, generator=generator, dtype=torch.float64, device="cpu") - 1
    at = 0.1 + 0.4 * torch.rand(rows, generator=generator, dtype=torch.float64, device="cpu")
    law = LeastSquares([1.0, 1.0], deviation=[0.3, 0.05], floor=1e-3, forgetting=0.2, alarm=5.0)
    windows = IntegralWindows(model, 0.06, noise=0.002)
    before, after = (
        torch.tensor([each], dtype=torch.float64, device="cpu").repeat(rows, 1)
        for each in ([1.0, 1.0], [0.5, 1.0])
    )
    adaptive = AdaptiveLQR(model, cost, windows, law)
    return FaultCase(model, cost, x0, before, after, at, 0.02, 0.002, 0.05, adaptive, lambda: None)


def mass(rows: int, generator: torch.Generator) -> FaultCase:
    """An inverted pendulum with half or twice the mass of the design, states measured with noise of 0.01."""

    def regressor(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((torch.zeros_like(u), u - 0.1 * x[..., 1:]), dim=-1).unsqueeze(-1)

    def known(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((x[..., 1], 9.81 * x[..., 0].sin()), dim=-1)

    model = ParametricPlant(regressor, known, dim=2, inputs=1, theta=[1.0], rows=[1])
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    drawn = torch.rand(rows, 2, generator=generator, dtype=torch.float64, device="cpu")
    side = torch.where(
        torch.rand(rows, dtype=torch.float32, generator=generator, device="cpu") < 0.5, -1.0, 1.0
    )
    x0 = torch.stack((side * (0.5 + drawn[:, 0]), 2 * drawn[:, 1] - 1), dim=-1)
    true = torch.where(torch.arange(rows, device="cpu") % 2 == 0, 2.0, 0.5).double().unsqueeze(-1)  # 1 / mass
    law = LeastSquares([1.0], deviation=1.0, floor=1e-4)
    windows = IntegralWindows(model, 0.3, shape="smooth", first=0.013, noise=0.01)
    # Between the masses that are possible: too much push is dearer than too little, for so short a time.
    robust = LQR(model.believing(torch.tensor([1.15], dtype=torch.float64, device="cpu")), cost)
    # Noise times a gain of 40 costs 1.7 in 10 s, where the cheapest starts cost 9.
    filter = adp.ConsiderFilter(model, noise=0.01, process=0.01)
    adaptive = AdaptiveLQR(model, cost, windows, law, robust=robust, confidence=2.0, filter=filter)

    def optimum() -> Tensor:
        best = torch.full((rows,), torch.nan, dtype=torch.float64, device="cpu")
        for inverse in true.unique():
            same = true[:, 0] == inverse
            shooting = adp.DirectShooting(model.believing(inverse.unsqueeze(0)), cost)
            best[same] = shooting.solve(x0[same]).value
        return best

    return FaultCase(*(model, cost, x0, true, true, x0.new_zeros(rows), 0.001, 0.01, 0.05, adaptive), optimum)


CASES: dict[str, Callable[[int, torch.Generator], FaultCase]] = {
    "short_period": short_period,
    "unstable": unstable,
    "mass": mass,
}


class _Informed(torch.nn.Module):
    """u = -K e with the gain of every row's own plant, as it is in the end."""

    def __init__(self, case: FaultCase) -> None:
        super().__init__()
        self.own = case.after.unique(dim=0)
        self.laws = [LQR(case.model.believing(theta), case.cost, period=case.dt) for theta in self.own]
        self.count = case.model.parameters_count

    def forward(self, z: Tensor) -> Tensor:
        x, theta = z[..., : -self.count], z[..., -self.count :]
        u: Tensor = self.laws[0](x)
        for law, own in zip(self.laws[1:], self.own[1:], strict=True):
            u = torch.where((theta == own.to(theta)).all(-1, keepdim=True), law(x), u)
        return u


def _controllers(case: FaultCase) -> dict[str, adp.Controller]:
    """Return the controllers by name, measured: the informed one sees the last parameters."""
    n, p = case.x0.shape[-1], case.model.parameters_count
    design = LQR(case.model.believing(_design(case)), case.cost, period=case.dt)
    later = [*range(n), *range(n + p, n + 2 * p)]
    return {
        "ignorant LQR": Measured(adp.Feedback(design), noise=case.noise, dim=n),
        "informed LQR": Measured(
            adp.Feedback(_Informed(case)),
            noise=[case.noise] * n + [0.0] * p,
            dim=n + p,
            output=lambda z: z[..., later],
        ),
        "adaptive": Measured(case.adaptive, noise=case.noise, dim=n),
    }


def _design(case: FaultCase) -> Tensor:
    """The parameters that an ignorant design believes: healthy actuators, the nominal mass."""
    theta = case.adaptive.law.first.clone()
    if case.model.parameters_count == 6:  # the drift is known to it, the fault is not
        theta[:4] = case.before[0, :4]
    return theta


def _run(
    case: FaultCase, controller: adp.Controller, duration: float, place: tuple[torch.device, torch.dtype]
) -> LoopResult:
    plant = adp.ChangingPlant(case.model)
    z0 = plant.start(case.x0, case.before, case.after, case.at).to(*place)
    times = recorded_times(duration, case.dt, _RECORDED)
    return Method(controller, plant, plant.cost(case.cost)).run(z0, dt=case.dt, **times)


def _measured(case: FaultCase, result: LoopResult, best: Tensor | None) -> dict[str, float]:
    late = result.time >= result.time[-1] - _SETTLED
    norm = result.state[:, late, : case.x0.shape[-1]].norm(dim=-1)
    regulated = (norm < case.near).all(-1) & ~result.diverged
    measured = {"cost_median": float(result.cost.median()), "cost_max": float(result.cost.max())}
    if best is not None:
        ratio = torch.where(result.diverged, torch.inf, result.cost / best.to(result.cost))
        measured |= {"ratio_median": float(ratio.median()), "ratio_max": float(ratio.max())}
    return measured | {"regulated": float(regulated.double().mean())}


def _learned(case: FaultCase, result: LoopResult) -> dict[str, float]:
    """When the adaptive policy had found the plant, in the median, and its largest error at the end."""
    if case.adaptive.law.alarm is None:  # found: the model is certain enough for the first time
        found = (result["certain"].cumsum(1) == 0).sum(1) * (result.time[1] - result.time[0])
    else:
        alarmed = result["alarmed_at"][:, -1]
        found = torch.where(alarmed < 0, torch.inf, alarmed - case.at.to(alarmed))
    after = case.after.to(result.state)
    error = (result["theta"][:, -1] - after).abs() / after.abs().clamp(min=1.0)
    return {"found_median": float(found.median()), "parameter_error": float(error.max())}


def _picture(case: FaultCase, results: dict[str, LoopResult]) -> FaultPicture:
    n, adaptive = case.x0.shape[-1], results["adaptive"]
    time = adaptive.time.numpy()
    truth = torch.where((adaptive.time < case.at[0])[:, None], case.before[0], case.after[0])
    return FaultPicture(
        time=time,
        norms={name: result.state[0, :, :n].norm(dim=-1).cpu().numpy() for name, result in results.items()},
        parameters=adaptive["theta"][0].cpu().numpy(),
        truth=truth.numpy(),
        certain=adaptive["certain"][0].cpu().numpy() > 0,
    )
