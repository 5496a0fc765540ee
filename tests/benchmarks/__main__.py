"""All numbers that README and manuals claim, by one command: `python -m tests.benchmarks [PART ...]`.

    python -m tests.benchmarks --list            # parts, minutes, commands
    python -m tests.benchmarks laws memory       # some parts, by name
    python -m tests.benchmarks                   # all of them, an hour at most
    python -m tests.benchmarks device --output FILE   # from what its command printed on another machine

A part is a command and the numbers that its output, or its metrics.json, holds. They are kept in table.json
and printed as TABLE.md with date, commit, processor and versions of the peers; the row of a part that is not
run stays. Whole outputs are in runs/benchmarks/. Run it with nothing else running.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
KEPT, TABLE = HERE / "table.json", HERE / "TABLE.md"
NUMBER = r"([-+\d.e]+)"


class Part(NamedTuple):
    """A command, and the claims that it measures."""

    command: str
    claims: dict[str, str]  # what is claimed -> a name in metrics.json, or a pattern of the output
    minutes: float  # on two idle cores
    peers: tuple[str, ...] = ()  # distributions whose versions the table names


def bench(name: str) -> str:
    return f"python tests/benchmarks/{name}"


ABLATION = "staf experiment=ablation kernel=exponential centers.radius=0.1 seed=0"
CARD = r"^M = 3 SteepestDescent, 100 +{} +1000000(?: +\S+){{5}} +" + NUMBER
PEER = r"^JAX M = 3 SteepestDescent, 100 +components apart +{} +1000000 .* ours .*, +" + NUMBER
KERNELS = "exponential", "gaussian"
US = r"\| pendulum \| {} +(?:\|[^|]*){{4}}\| +" + NUMBER
PLANNERS = "near_optimal", "box-DDP", "plan followed", "PathIntegral", "GlobalValue"
FAULTS = r"\| mass +\| {} +(?:\|[^|]*){{3}}\| +" + NUMBER
TANGENT = "steepest_descent_x1_tangent_order_1"
PARTS = {
    "digits": Part(
        "staf experiment=flat_limit",
        {
            "worst relative error of a fit, r from 1e-8 to 0.5, float64": "graded_error_float64",
            "the same, float32": "graded_error_float32",
        },
        1,
    ),
    "accuracy": Part(
        ABLATION,
        {f"error on the ball, M = {m}, r = 0.1": rf"\| +{m} +\| +\**{NUMBER}" for m in (3, 6, 10, 15)},
        1,
    ),
    "choosing": Part(
        bench("choosing.py"),
        {
            "numbers in the tables of CHOOSING.md and CHOOSING_LAWS.md": rf"^all tables: \d+ of {NUMBER}",
            "those that come again, to three digits or in their range": rf"^all tables: {NUMBER}",
        },
        4,
    ),
    "far": Part(
        "staf experiment=ablation kernel=exponential,gaussian 'initial_state=[20.0,0.0]' centers.radius=0.1 "
        "centers.count=6 seed=0",
        {
            f"error on the ball, x of size 20, {kernel}": rf"\| +{kernel} +\| +\**{NUMBER}"
            for kernel in KERNELS
        },
        1,
    ),
    "chase": Part(
        "staf",
        {
            "largest error at the state, after the correction": "ultimate_error",
            "before it": "ultimate_error_before",
            "with ideal weights": "floor_error",
        },
        1,
    ),
    "regulation": Part("staf experiment=adp", {"cost, two states": "cost"}, 1),
    "three_state": Part("staf experiment=adp_three_state", {"cost, three states": "cost"}, 1),
    "laws": Part(
        "staf experiment=laws",
        {
            "excess, ten iterations of steepest descent": "steepest_descent_x10.ultimate_excess_before",
            "excess, one iteration and a tangent predictor": f"{TANGENT}.ultimate_excess_before",
        },
        1,
    ),
    "bound": Part(
        "staf experiment=exponential_bound",
        {
            "kernels that the paper's proof asks for, r = 0.1, 1e-3": "r0.1.eps0.001.count",
            "by one polynomial": "r0.1.eps0.001.one_polynomial_count",
            "needed": "r0.1.eps0.001.measured_count",
        },
        1,
    ),
    "memory": Part(
        "staf experiment=memory",
        {
            "rms error over the visited region, by the memory": "memory_rms_error",
            "by the last local model": "last_rms_error",
        },
        1,
    ),
    "learn": Part(
        "staf experiment=learn_kernel",
        {"error of a learned width and radius": "learned_error", "best of their grid": "grid_error"},
        1,
    ),
    "control": Part(
        "staf experiment=adp_comparison",
        {
            "rollout policy: mean cost over the optimum": "rollout_policy_ratio_mean",
            "rollout policy: share of 200 states regulated": "rollout_policy_regulated",
            "rollout policy: median cost over the optimum": "rollout_policy_ratio_median",
            "the law as published: share regulated": "staf_as_published_1_ms_regulated",
            "the law as published: median cost over the optimum": "staf_as_published_1_ms_ratio_median",
            "in information form: share regulated": "staf_information_form_regulated",
            "supervised: share regulated": "staf_information_supervised_regulated",
            "supervised: median cost over the optimum": "staf_information_supervised_ratio_median",
            "LQR: median cost over the optimum": "lqr_ratio_median",
            "three fixed quadratics: median": "global_quadratic_fixed_box_ratio_median",
            "LQR: mean cost over the optimum": "lqr_ratio_mean",
            "25 fixed Gaussians": "rbf_grid_fixed_box_ratio_mean",
            "three fixed quadratics": "global_quadratic_fixed_box_ratio_mean",
            "best StaF actor-critic": "staf_information_supervised_ratio_mean",
        },
        2,
    ),
    "engine": Part(
        bench("engine.py --only SteepestDescent --centers 3 --rows 1000"),
        {"steepest descent, M = 3, 1000 rows, over JAX": rf"float64.*SteepestDescent .*over JAX {NUMBER}"},
        1,
        ("jax", "numba"),
    ),
    "gradients": Part(
        bench("gradients.py --only lorenz,chase3"),
        {
            "gradient through Lorenz, over the forward pass": rf"lorenz .*with gradient .*ratio {NUMBER}",
            "jax.grad over it": rf"lorenz +JAX .*: {NUMBER} times",
            "gradient through a chase, M = 3": rf"chase3 .*with gradient .*ratio {NUMBER}",
        },
        1,
        ("jax",),
    ),
    "plants": Part(
        bench("plants.py"),
        {
            "100 000 pendulums, 1000 steps, CPU s": rf"\| staf_torch.lanes \| {NUMBER}",
            "JAX over it": rf"\| JAX[^|]*\|[^|]*\|[^|]*\| {NUMBER}",
            "CasADi over it": rf"\| CasADi[^|]*\|[^|]*\|[^|]*\| {NUMBER}",
        },
        1,
        ("jax", "casadi"),
    ),
    "loops": Part(
        bench("adp.py 1000"),
        {
            "information law, 1000 rows, 10 s at 1 ms, CPU s": (
                rf"\| staf_torch, information \| 2 \| 1000 \|[^|]*\| {NUMBER}"
            ),
            "the same in JAX": rf"\| JAX, information \| 2 \| 1000 \|[^|]*\| {NUMBER}",
            "a control of a rollout policy, two states, us": rf"\| TwoState \| 6 \| 1 \| {NUMBER}",
            "a control of near_optimal, pendulum, us": (
                rf"\| near_optimal of Pendulum \|[^|]*\|[^|]*\| {NUMBER}"
            ),
        },
        4,
        ("jax",),
    ),
    "planners": Part(
        "staf experiment=rivals rivals.plants=[pendulum] "
        "'rivals.methods=[near_optimal,box-DDP,plan followed,PathIntegral,GlobalValue]'",
        {f"a control of {name}, pendulum from drawn states, us": US.format(name) for name in PLANNERS},
        2,
    ),
    "discs": Part(
        "staf experiment=avoidance",
        {
            "1000 scenarios of three discs: collisions of the LQR": "lqr_constraint_violations",
            "behind the filter": "constraint_violations",
            "mean cost of the LQR": "lqr_cost_mean",
            "mean cost behind the filter": "cost_mean",
        },
        1,
    ),
    "faults": Part(
        "staf experiment=faults",
        {
            "AdaptiveLQR on a wrong mass, cost over the optimum, largest": FAULTS.format("adaptive"),
            "the LQR of the design": FAULTS.format("ignorant LQR"),
        },
        3,
    ),
    "swing_up": Part(
        bench("swing_up.py pendulum --seeds 1 --grid 0"),
        {
            "Pendulum-v1, resets 0 to 49, mean cost": rf"'mean_cost_50': {NUMBER}",
        },
        1,
        ("gymnasium",),
    ),
    "filter": Part(
        bench("safety.py"),
        {
            "safety filter, us a row and core": rf"{NUMBER} us a row and core",
            "largest difference to a dense solver": rf"dense solver: {NUMBER}",
        },
        1,
        ("scipy",),
    ),
    "evaluations": Part(
        bench("evaluate.py"),
        {"V^ and gradient at a point, eager, us": rf"^one value and gradient, eager \(us\) +{NUMBER}"},
        1,
    ),
    "fits": Part(
        bench("fit.py"),
        {"Cholesky of the same Gram matrices over a local fit, in time": rf"^cholesky / fit +{NUMBER}"},
        1,
    ),
    "exports": Part(
        bench("export.py runs/benchmarks/exported"),
        {
            "V^ and gradient by AOTInductor, float32, us": rf"float32 +AOTInductor, loader.*? {NUMBER}",
            "by onnxruntime, float32, us": rf"float32 +onnxruntime, io.*? {NUMBER}",
        },
        1,
        ("onnxruntime",),
    ),
    "streams": Part(
        bench("streams.py --held-out --no-kafbox"),
        {
            "17 held-out targets, error over the best peer, geometric mean": rf"geometric mean {NUMBER}",
            "the largest of these ratios": rf"geometric mean .* largest {NUMBER}",
        },
        20,
        ("river", "scikit-learn"),
    ),
    "speed": Part(
        bench("streams_speed.py"),
        {
            "StaFRegressor, n = 2, M = 6, float32, us to predict a sample": (
                rf"n = 2, M = 6, float32: predict {NUMBER} us"
            ),
            "us to learn it": rf"n = 2, M = 6, float32: predict \S+ us, learn {NUMBER} us",
            "n = 6, M = 28, us to learn a sample": rf"n = 6, M = 28, float32: .* learn {NUMBER} us",
            "MixtureRegressor of 32 neighbours, n = 4, us a sample": rf"bank of 32 neighbours.*: {NUMBER} us",
        },
        1,
    ),
    "drifting": Part(
        bench("drifting_streams.py --kinds drifting noisy"),
        {
            "drifting stream, M = 6, times the speed of ALD-KRLS": rf"M = 6.*?: {NUMBER} times the speed",
            **{
                f"noisy stream, M = {m}, rms error": rf"\| noisy \| [^|]*M = {m}[^|]*\|[^|]*\| {NUMBER}"
                for m in (3, 6, 15)
            },
            "noisy stream, ALD-KRLS": rf"\| noisy \| ALD-KRLS[^|]*\|[^|]*\| {NUMBER}",
        },
        1,
    ),
    "sweeps": Part(
        bench("sweep.py --only batched,basic"),
        {"100 jobs, batched over Hydra's basic launcher, CPU s": rf"batched launcher takes {NUMBER}"},
        1,
        ("hydra-core",),
    ),
    "device": Part(
        "python -m tests.gpu",
        {
            "chase_weights, M = 3, 1e6 rows x 100 times, float64, G steps/s": CARD.format("float64"),
            "the same, float32": CARD.format("float32"),
            "over JAX with components apart, float64": PEER.format("float64"),
        },
        2,
        ("jax",),
    ),
}


def processor() -> str:
    """Return the name of the processor."""
    try:
        found = re.search(r"model name\s*:\s*(.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    except OSError:
        found = None
    return found[1] if found else platform.processor() or platform.machine()


def version(distribution: str) -> str:
    try:
        return f"{distribution} {importlib.metadata.version(distribution)}"
    except importlib.metadata.PackageNotFoundError:
        return f"{distribution} not installed"


def found_in(part: Part, printed: str, metrics: dict[str, Any]) -> dict[str, str]:
    """Return the claims and their numbers, "not found" for one that neither output nor metrics hold."""
    numbers = {}
    for claim, where in part.claims.items():
        found = re.search(where, printed, re.MULTILINE)
        numbers[claim] = f"{metrics[where]:.4g}" if where in metrics else found[1] if found else "not found"
    return numbers


def measure(name: str) -> tuple[dict[str, str], str]:
    """Run a part; return its claims with their numbers, and what it printed."""
    part = PARTS[name]
    folder = ROOT / "runs" / "benchmarks" / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    words = shlex.split(part.command)
    if words[0] == "staf":
        words = [sys.executable, "-c", "from staf_torch.cli.staf import main; main()", *words[1:]]
        words += [f"hydra.run.dir={folder}", f"hydra.sweep.dir={folder}", "figures=false"]
    else:
        words[0] = sys.executable
    ended = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    (folder / "output.txt").write_text(ended.stdout + ended.stderr, encoding="utf-8")
    metrics: dict[str, Any] = {}
    if (folder / "metrics.json").exists():
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    tables = [page.read_text(encoding="utf-8") for page in sorted(folder.glob("*.md"))]
    printed = "\n".join((ended.stdout, *tables))
    return found_in(part, printed, metrics), printed


def record(name: str, kept: dict[str, Any], output: Path | None) -> bool:
    """Measure a part, or read what it printed; keep its numbers; return whether all were found."""
    part = PARTS[name]
    began = time.monotonic()
    if output is None:
        numbers, printed = measure(name)
    else:
        printed = output.read_text(encoding="utf-8")
        numbers = found_in(part, printed, {})
    versions = [version(each) for each in ("torch", *part.peers)]
    machine = f"{processor()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.0f}"
    if card := re.search(r"^(NVIDIA [^,]*), (torch [^;]*);", printed, re.MULTILINE):
        machine, versions = card[1], [card[2]]
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    kept[name] = {
        "command": part.command,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "commit": commit.stdout.strip() or "unknown",
        "machine": machine,
        "versions": ", ".join(versions),
        "numbers": {claim: number for claim, number in numbers.items() if number != "not found"},
    }
    lost = [claim for claim, number in numbers.items() if number == "not found"]
    print(f"{name}: {time.monotonic() - began:.0f} s, {numbers}", flush=True)
    return not lost


def markdown(kept: dict[str, Any]) -> str:
    """Return the table: a row a number, in the order of the parts."""
    lines = [
        "# Numbers",
        "",
        "Written by `python -m tests.benchmarks` ([how](README.md)); what is not here is not claimed.",
        "",
        "| claim | number | part | command | date | commit | machine | versions |",
        "|---|---:|---|---|---|---|---|---|",
    ]
    for name in PARTS:
        about = kept.get(name, {"numbers": {}})
        for claim, number in about["numbers"].items():
            facts = [
                f"`{about['command']}`",
                *(about[key] for key in ("date", "commit", "machine", "versions")),
            ]
            lines.append(" | ".join(("| " + claim, number, name, *facts)) + " |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("parts", nargs="*", help="all of them by default", metavar="PART")
    parser.add_argument("--list", action="store_true", help="the parts, with minutes and commands")
    parser.add_argument(
        "--output", type=Path, metavar="FILE", help="read what the one part printed elsewhere"
    )
    options = parser.parse_args()
    if options.output and len(options.parts) != 1:
        parser.error(f"--output is of one part; got {len(options.parts)}")
    if unknown := [name for name in options.parts if name not in PARTS]:
        parser.error(f"no part {unknown[0]!r}: there are {', '.join(PARTS)}")
    if options.list:
        for name, part in PARTS.items():
            print(f"{name:12} {part.minutes:4g} min  {part.command}")
        return 0
    kept = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}
    good = True
    for name in options.parts or PARTS:
        good &= record(name, kept, options.output)
        KEPT.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
        TABLE.write_text(markdown(kept), encoding="utf-8")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
