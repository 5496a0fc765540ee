"""The compiled chase under every law beside JAX and numba: `python tests/benchmarks/engine.py [--quick]`.

States given, ten iterations, the weights of every time returned; exponential kernel, the paper's V, rings.
The rounds of all programs of a row alternate; a speed is the best of the rounds, in CPU seconds of this
process, so that other programs on the machine matter little. The benchmark refuses a chase that was not
compiled. Peers that are not installed are skipped by name.
"""

from __future__ import annotations

import argparse
import logging
import resource
from collections.abc import Callable
from typing import Any

import numpy as np
import peer_laws
import torch
from timing import spent

import staf_torch as st
from staf_torch.engine import predictors

STEPS = 10
LEAST_SECONDS, MOST_ROUNDS = 0.04, 200  # the system notes what other threads used some milliseconds late
RADIUS = {3: 0.3, 6: 0.5, 15: 0.8}
WORK = {1: 4000, 1000: 100, 100_000: 16}  # rows: times
OTHERS: dict[str, st.optim.UpdateLaw] = {
    "BarzilaiBorwein": st.optim.BarzilaiBorwein(),
    "FixedStep": st.optim.FixedStep(),
    "FixedStep, absolute": st.optim.FixedStep(0.05, relative=False),
    "NormalisedLMS": st.optim.NormalisedLMS(),
    "PreconditionedDescent": st.optim.PreconditionedDescent(),
    "PreconditionedDescent, jacobi": st.optim.PreconditionedDescent("jacobi"),
    "RecursiveLeastSquares": st.optim.RecursiveLeastSquares(),
}
PREDICTED = {"tangent + 1": predictors.Tangent(), "secant + 1": predictors.Secant()}


class Refuse(logging.Handler):
    """A speed of a program that fell back to plain torch is none."""

    def emit(self, record: logging.LogRecord) -> None:
        raise RuntimeError(record.getMessage())


def states(batch: int, times: int, dtype: torch.dtype) -> torch.Tensor:
    """Circles of radii 0.5 to 1.5, (B, T, 2) contiguous."""
    angle, radius = torch.linspace(0, 6, batch), torch.linspace(0.5, 1.5, batch)
    x0 = torch.stack((radius * angle.cos(), radius * angle.sin()), dim=-1).double()
    return st.systems.simulate(st.systems.Oscillator(), x0, dt=0.01, steps=times - 1).to(dtype).contiguous()


def plain_value(x: torch.Tensor) -> torch.Tensor:
    """The paper's V as a user writes it."""
    return x[..., 0] ** 2 + 5 * x[..., 1] ** 2 + torch.tanh(x[..., 0] * x[..., 1])


def used(program: Callable[[], Any], calls: int) -> float:
    """CPU seconds of a call."""
    return max(spent(program, calls)[0], 1e-9)


def measured(programs: dict[str, Callable[[], Any]], steps: int, rounds: int) -> dict[str, float]:
    """Million trajectory-steps a CPU second of every program; says how long a compiler took."""
    best: dict[str, float] = {}
    for name, program in programs.items():
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        program()
        built = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
        if built > 0.05:
            print(f"      {name}: compiled in {built:.1f} CPU s", flush=True)
    total = dict.fromkeys(programs, 0.0)
    calls = {
        name: max(1, round(LEAST_SECONDS / max(spent(program, 3)[0], 1e-9)))
        for name, program in programs.items()
    }
    for _ in range(MOST_ROUNDS):
        for name, program in programs.items():
            seconds = used(program, calls[name])
            best[name] = min(best.get(name, np.inf), seconds)
            total[name] += seconds * calls[name]
        if min(total.values()) > rounds * LEAST_SECONDS:
            break
    return {name: steps / seconds / 1e6 for name, seconds in best.items()}


def peers(law: str, basis: st.StaFBasis, x: torch.Tensor) -> dict[str, Callable[[], Any]]:
    offsets = (basis.centers.directions * basis.centers.radius(x[0, 0])).double().numpy()
    found: dict[str, Callable[[], Any]] = {}
    array = x.numpy()
    try:
        import jax

        for name, (program, last) in peer_laws.jax_programs(law, offsets, STEPS).items():
            given = jax.device_put(np.ascontiguousarray(array.transpose(1, 2, 0)) if last else array)
            found[f"JAX {name}"] = lambda program=program, given=given: program(given).block_until_ready()
    except ImportError:
        print("      JAX is not installed")
    if len(x) == 1:
        try:
            program = peer_laws.numba_program(law, offsets, STEPS)
            found["numba"] = lambda: program(array)
        except ImportError:
            print("      numba is not installed")
    return found


def arithmetic_alone(basis: st.StaFBasis, x: torch.Tensor) -> Callable[[], Any]:
    """What JAX computes for `Exact`, as a row program: S^-1 K0^-1 S^-1 V, no row looked after.

    What a chase takes beyond it is the price of digits kept, of rows that diverge and of warnings.
    """
    offsets = basis.centers.directions * basis.centers.radius(x[0, 0])
    inverse = torch.linalg.inv((offsets @ offsets.mT).exp()).to(x)

    def step(last: torch.Tensor, at: torch.Tensor, row: object) -> tuple[torch.Tensor, torch.Tensor]:
        scale = (-(at.unsqueeze(-2) * offsets).sum(-1)).exp()
        values = plain_value(at.unsqueeze(-2) + offsets)
        weights = (inverse * (values * scale).unsqueeze(-2)).sum(-1) * scale
        return last, weights * (-at.square().sum(-1)).exp().unsqueeze(-1)

    program, start = st.lanes.Program(step), torch.zeros_like(x[:, 0, 0])
    return lambda: program(start, x)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="float64, fewer rounds, M = 3 and 6")
    parser.add_argument("--only", default="", help="laws whose names contain this")
    parser.add_argument("--rows", type=int, choices=WORK, help="this many rows alone")
    parser.add_argument("--centers", type=int, nargs="+", choices=RADIUS, help="these M alone")
    options = parser.parse_args()
    logging.getLogger("staf_torch").addHandler(Refuse())
    torch.set_num_threads(1)
    for count in options.centers or ((3, 6) if options.quick else (3, 6, 15)):
        basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(count), RADIUS[count]))
        for dtype in (torch.float64,) if options.quick else (torch.float64, torch.float32):
            for batch, times in WORK.items():
                if options.rows in (None, batch):
                    x, names = states(batch, times, dtype), (*peer_laws.LAWS, *OTHERS, *PREDICTED)
                    for name in names:
                        if options.only in name:
                            row(name, basis, x, 4 if options.quick else 8)


def row(name: str, basis: st.StaFBasis, x: torch.Tensor, rounds: int) -> None:
    """Measure one law at one size; print a line."""
    predictor: st.engine.Predictor | None = None
    steps, (batch, times, _) = STEPS, x.shape
    if name in PREDICTED:
        predictor, steps = PREDICTED[name], 1
        law: st.optim.UpdateLaw = st.optim.SteepestDescent()
    else:
        law = OTHERS[name] if name in OTHERS else getattr(st.optim, name)()

    def ours(call: Callable[..., Any], value: Any) -> Callable[[], Any]:
        return lambda: call(x, basis, value, law, inner_steps=steps, predictor=predictor)

    paper = st.targets.Paper()
    programs = {"ours": ours(st.chase_weights, paper)}
    if name == "SteepestDescent":
        programs |= {"everything": ours(st.chase, paper), "a callable": ours(st.chase_weights, plain_value)}
    if name == "Exact" and x.dtype == torch.float64:
        programs["arithmetic alone"] = arithmetic_alone(basis, x)
    if name in peer_laws.LAWS:
        programs |= peers(name, basis, x)
    found = measured(programs, batch * times, rounds)
    best = max((v for n, v in found.items() if n.startswith("JAX")), default=np.nan)
    text = ", ".join(f"{n} {v:.3g}" for n, v in found.items())
    size = f"M={basis.count} {str(x.dtype)[6:]} B={batch}"
    print(f"{size:24s} {name:30s} {text}; over JAX {found['ours'] / best:.2f}", flush=True)


if __name__ == "__main__":
    main()
