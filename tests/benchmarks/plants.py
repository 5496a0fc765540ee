"""A user's plant in plain torch, many rows through 1000 Runge-Kutta steps, beside JAX, CasADi, torch.compile.

    python tests/benchmarks/plants.py [--rows 100000]

A damped pendulum with a damping of its own in every row; only the last state is kept. CPU seconds of this
process on one thread, the least of some runs, the programs in turn. CasADi runs 1000 rows, torch.compile 50
steps, and the table has the time of all. A peer that is not installed is named and left out.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from timing import in_turn

from staf_torch import lanes

DT, STEPS, ROUNDS = 0.01, 1000, 3
MAPPED = 1000  # rows of a CasADi map
SOME = 50  # steps of torch.compile


def rate(x: torch.Tensor, damping: torch.Tensor) -> torch.Tensor:
    """x' of the user's plant: (B, 2), (B,) -> (B, 2)."""
    return torch.stack((x[:, 1], -x[:, 0].sin() - damping * x[:, 1] - 0.1 * x[:, 1] * x[:, 1].abs()), dim=-1)


def runge_kutta(field: Callable[[Any, Any], Any], x: Any, damping: Any) -> Any:
    """One step, of torch, JAX or CasADi."""
    k1 = field(x, damping)
    k2 = field(x + DT / 2 * k1, damping)
    k3 = field(x + DT / 2 * k2, damping)
    k4 = field(x + DT * k3, damping)
    return x + DT / 6 * (k1 + 2 * (k2 + k3) + k4)


def ours(x0: torch.Tensor, damping: torch.Tensor) -> Callable[[], np.ndarray]:
    """The step as a program of lanes."""
    program = lanes.Program(lambda x, _, row: (runge_kutta(rate, x, row), ()))
    assert program.compiles(x0, (), damping, steps=STEPS)
    return lambda: program(x0, (), damping, steps=STEPS)[0].numpy()


def compiled(x0: torch.Tensor, damping: torch.Tensor) -> Callable[[], np.ndarray]:
    """The step by torch.compile, called from Python; SOME steps."""
    step = torch.compile(lambda x, damping: runge_kutta(rate, x, damping))

    def run() -> np.ndarray:
        x = x0
        for _ in range(SOME):
            x = step(x, damping)
        return x.numpy()

    return run


def with_jax(x0: np.ndarray, damping: np.ndarray, last: bool) -> Callable[[], np.ndarray]:
    """jit(vmap(scan)), or one scan over arrays whose last dimension is the batch."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)

    def field(x: Any, c: Any) -> Any:
        return jnp.stack((x[1], -jnp.sin(x[0]) - c * x[1] - 0.1 * x[1] * jnp.abs(x[1])))

    def trajectory(x: Any, c: Any) -> Any:
        return jax.lax.scan(lambda x, _: (runge_kutta(field, x, c), None), x, None, length=STEPS)[0]

    fast = jax.jit(trajectory if last else jax.vmap(trajectory))
    given = jax.device_put(np.ascontiguousarray(x0.T) if last else x0)
    rows = jax.device_put(damping)
    return lambda: np.asarray(fast(given, rows).block_until_ready())


def with_casadi(x0: np.ndarray, damping: np.ndarray, folder: Path) -> Callable[[], np.ndarray]:
    """`fold` over the steps and `map` over MAPPED rows as C that gcc -O3 -march=native compiled."""
    import casadi as ca

    x, c = ca.SX.sym("x", 2), ca.SX.sym("c")

    def field(x: Any, c: Any) -> Any:
        return ca.vertcat(x[1], -ca.sin(x[0]) - c * x[1] - 0.1 * x[1] * ca.fabs(x[1]))

    step = ca.Function("step", [x, c], [runge_kutta(field, x, c)])
    start, fixed = ca.MX.sym("start", 2), ca.MX.sym("fixed")
    end = step.fold(STEPS)(start, ca.repmat(fixed, 1, STEPS))
    mapped = ca.Function("row", [start, fixed], [end]).map(MAPPED)
    generated = ca.CodeGenerator("mapped.c")
    generated.add(mapped)
    generated.generate(f"{folder}/")
    line = ["gcc", "-O3", "-march=native", "-ffast-math", "-shared", "-fPIC", "mapped.c", "-o", "mapped.so"]
    subprocess.run([*line, "-lm"], cwd=folder, check=True)
    call = ca.external(mapped.name(), f"{folder}/mapped.so")
    states, rows = x0[:MAPPED].T, damping[None, :MAPPED]
    return lambda: np.asarray(call(states, rows)).T


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=100_000)
    rows = parser.parse_args().rows
    torch.set_num_threads(1)
    torch.manual_seed(0)
    x0, damping = 2 * torch.rand(rows, 2).double() - 1, torch.rand(rows).double()
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        makers: dict[str, tuple[float, Callable[[], Callable[[], np.ndarray]]]] = {
            "staf_torch.lanes": (1, lambda: ours(x0, damping)),
            "JAX jit(vmap(scan))": (1, lambda: with_jax(x0.numpy(), damping.numpy(), False)),
            "JAX batch last": (1, lambda: with_jax(x0.numpy(), damping.numpy(), True)),
            "CasADi map, generated C": (
                rows / MAPPED,
                lambda: with_casadi(x0.numpy(), damping.numpy(), Path(folder)),
            ),
            "torch.compile of a step": (STEPS / SOME, lambda: compiled(x0, damping)),
        }
        programs: dict[str, Callable[[], np.ndarray]] = {}
        wanted: np.ndarray | None = None
        for name, (_, make) in makers.items():
            try:
                programs[name] = make()
            except ImportError as error:
                print(f"{name} is left out: {error}", file=sys.stderr)
                continue
            found = programs[name]()
            wanted = found if wanted is None else wanted
            if name != "torch.compile of a step":
                found = found.T if found.shape[0] == 2 else found
                np.testing.assert_allclose(found, wanted[: len(found)], rtol=1e-9, atol=1e-11)
        times = in_turn(programs, ROUNDS)
        best = {name: min(cpu for cpu, _ in each) * makers[name][0] for name, each in times.items()}
    print("| program | CPU s | us a row | ratio |\n|---|---|---|---|")
    for name, seconds in best.items():
        ratio = seconds / best["staf_torch.lanes"]
        print(f"| {name} | {seconds:.3g} | {1e6 * seconds / rows:.3g} | {ratio:.3g} |")


if __name__ == "__main__":
    main()
