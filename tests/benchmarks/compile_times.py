"""What the first call of a program costs: `python tests/benchmarks/compile_times.py [part of a name ...]`.

Every kernel, law and predictor of a chase with all results and certificate at 15 centers, closed loops whose
value has 15 centers, policies and filters; each in a process of its own with an empty cache, then in another
with the cache that the first one left. CPU seconds, compilers included, without what the same call costs once
all is there, and without what torch loads itself before the first derivative of a process (printed apart).
What reads a function of a user's own is traced in every process; its rows say so. Exits with 1 where a first
call takes more than 3, or one of the library's own programs more than .2 from the cache.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import variants  # noqa: E402

import staf_torch as st  # noqa: E402
from staf_torch import adp, lanes, systems, targets  # noqa: E402

COLD, CACHED = 3.0, 0.2  # CPU seconds, goals
OWN = ", a user's "  # in the names of programs that read a function of a user's own
CENTERS = 15
Case = Callable[[], Callable[[], object]]


def states(dim: int, rows: int = 16) -> torch.Tensor:
    """(rows, n), in float64."""
    return 0.3 * torch.randn(rows, dim, dtype=torch.float64, generator=torch.Generator().manual_seed(dim))


def own_value(y: torch.Tensor) -> torch.Tensor:
    """V as a user writes it."""
    return y.square().sum(-1) + (y[..., 0] * y[..., 1]).tanh()


def chases(kernel: str, law: str, predictor: str, dim: int, target: Any = None) -> Case:
    def case() -> Callable[[], object]:
        directions = st.rings(CENTERS) if dim == 2 else st.ball(CENTERS, dim)
        chosen = st.PolynomialKernel(6) if kernel == "polynomial" else variants.KERNELS[kernel].make()
        basis = st.StaFBasis(chosen, st.StateFollowingCenters(directions, 0.5))
        x = states(dim)[:, None] + 0.01 * torch.arange(20)[:, None]
        value = targets.Quadratic(2.5) if target is None else target
        law_of, way = variants.LAWS[law], variants.PREDICTORS[predictor]
        return lambda: st.chase(x, basis, value, law_of, inner_steps=10, predictor=way, certificate=True)

    return case


def value(plant: systems.ControlAffineSystem, kernel: str = "anchored_exponential") -> adp.ValueBasis:
    dim = plant.dim or 2
    directions = st.rings(CENTERS) if dim == 2 else st.ball(CENTERS, dim)
    centers = st.StateFollowingCenters(directions, st.StateRadius(0.7, 1e-5))
    return adp.StaFValueBasis(st.StaFBasis(variants.KERNELS[kernel].make(), centers))


def loops(plant_of: str, law: str, kernel: str = "anchored_exponential") -> Case:
    def case() -> Callable[[], object]:
        plant = variants.PLANTS[plant_of]()
        dim = plant.dim or 2
        cost = adp.QuadraticCost(1.0, 1.0, dim, plant.inputs)
        points = adp.RandomPoints(1, st.StateRadius(2.1, 1e-5))
        learner = adp.ActorCritic(
            value(plant, kernel), plant, cost, points, variants.ACTOR_CRITIC_LAWS[law]()
        )
        return lambda: adp.simulate(learner, plant, cost, states(dim), dt=1e-3, steps=10, compile=True)

    return case


def rollouts(plant_of: str, centers: int = CENTERS) -> Case:
    def case() -> Callable[[], object]:
        plant = variants.PLANTS[plant_of]()
        dim = plant.dim or 2
        cost = adp.QuadraticCost(1.0, 1.0, dim, plant.inputs)
        lqr = adp.LQR(plant, cost)
        centers_at = st.StateFollowingCenters(st.ball(centers, dim), 0.1)
        basis = st.StaFBasis(st.GaussianKernel(1.0), centers_at)
        policy = adp.RolloutPolicy(basis, plant, cost, lqr, lqr.value)
        x = states(dim)
        return lambda: lanes.ready(policy, x)

    return case


def near_optimal(plant_of: str) -> Case:
    def case() -> Callable[[], object]:
        plant = variants.PLANTS[plant_of]()
        cost = adp.QuadraticCost(1.0, 1.0, plant.dim or 2, plant.inputs)
        policy = adp.near_optimal(plant, cost, dt=0.02)
        return lambda: lanes.ready(policy, states(plant.dim or 2))

    return case


def filtered(plant_of: str, walls: int) -> Case:
    def case() -> Callable[[], object]:
        plant = variants.PLANTS[plant_of]()
        dim = plant.dim or 2
        cost = adp.QuadraticCost(1.0, 1.0, dim, plant.inputs)
        sets = [lambda x, k=k: 9.0 + k - x.square().sum(-1) for k in range(walls)]
        guard = adp.SafetyFilter(adp.LQR(plant, cost), plant, sets, dt=1e-3, low=-5.0, high=5.0)
        return lambda: adp.simulate(guard, plant, cost, states(dim), dt=1e-3, steps=10, compile=True)

    return case


def cases() -> dict[str, Case]:
    found: dict[str, Case] = {}
    for kernel in variants.KERNELS:
        for dim in (2, 4):
            name = f"chase{OWN}kernel" if kernel == "user_defined" else f"chase, {kernel}"
            found[f"{name}, {dim} states"] = chases(kernel, "steepest descent", "none", dim)
    found[f"chase{OWN}V, exponential"] = chases("exponential", "steepest descent", "none", 4, own_value)
    found[f"chase{OWN}V, tangent"] = chases(
        "exponential", "steepest descent", "tangent, order 2", 4, own_value
    )
    for law, predictor in variants.PAIRS:
        found[f"chase, {law}, predictor {predictor}"] = chases("exponential", law, predictor, 4)
    for law in variants.ACTOR_CRITIC_LAWS:
        found[f"loop, {law}, two states"] = loops("two_state", law)
    for plant in ("three_state", "cart_pole", "planar_quadrotor", "two_link_robot"):
        found[f"loop, information, {plant}"] = loops(plant, "information")
    found["loop, information, an anchored Gaussian"] = loops("two_state", "information", "anchored_gaussian")
    found["loop, information, cart_pole, Gaussian"] = loops("cart_pole", "information", "anchored_gaussian")
    for plant in ("two_state", "three_state", "cart_pole", "planar_quadrotor"):
        found[f"rollout policy, {plant}"] = rollouts(plant)
    found["rollout policy, planar_quadrotor, 28 centers"] = rollouts("planar_quadrotor", 28)
    for plant in ("pendulum", "cart_pole", "planar_quadrotor", "two_link_robot"):
        found[f"near_optimal, {plant}"] = near_optimal(plant)
    for walls in (1, 2, 3):
        found[f"safety filter{OWN}sets, {walls}, cart_pole"] = filtered("cart_pole", walls)
    return found


def spent() -> float:
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def once(case: Case, cache: str, told: multiprocessing.connection.Connection) -> None:
    """CPU seconds of the first call, less those of the third."""
    os.environ["XDG_CACHE_HOME"] = cache
    call, used = case(), []
    for _ in range(3):
        before = spent()
        call()
        used.append(spent() - before)
    told.send(used[0] - used[2])


def measured(case: Case, cache: str) -> float:
    ear, mouth = multiprocessing.Pipe(duplex=False)
    child = multiprocessing.get_context("fork").Process(target=once, args=(case, cache, mouth))
    child.start()
    mouth.close()
    try:
        seconds: float = ear.recv()
    except EOFError:
        seconds = float("nan")
    child.join()
    return seconds


def load_derivatives() -> float:
    """CPU seconds that torch takes before its first derivatives: it loads its own compiler."""
    before = spent()
    one = torch.ones(2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.func.vjp(lambda x: one * x, one)[1](one)
        torch.func.jvp(lambda x: one * x, (one,), (one,))
    return spent() - before


def main(parts: list[str]) -> int:
    torch.set_num_threads(1)
    print(f"torch loads {load_derivatives():.2f} CPU s for the first derivative of a process\n")
    late = []
    print("| program | first call, CPU s | from the cache |\n|---|---:|---:|")
    for name, case in cases().items():
        if parts and not any(part in name for part in parts):
            continue
        with tempfile.TemporaryDirectory() as cache:
            cold, kept = (measured(case, cache) for _ in range(2))
        print(f"| {name} | {cold:.2f} | {kept:.3f} |", flush=True)
        if not (cold <= COLD and (kept <= CACHED or OWN in name)):
            late.append(name)
    print(f"\nover {COLD} s, or over {CACHED} s from the cache: {'; '.join(late) or 'none'}")
    return int(bool(late))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
