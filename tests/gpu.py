"""Run programs of all kinds on a CUDA device: ``python -m tests.gpu``, in less than three minutes.

Each is compared with its definition on the processor, with a call of few of its rows, to the bit, and timed:
the whole call from Python to a synchronised device, and its kernel. Exits with 1 where one is wrong, 2
without a device. ``--ptxas`` compiles the kernels with nvcc in place of that, and needs no device;
``--only NAME`` takes some. Not collected by pytest.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import copy
import functools
import io
import itertools
import json
import math
import multiprocessing
import os
import statistics
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
import torch
from torch import Tensor

from staf_torch import (
    ExperienceMemory,
    GaussianKernel,
    StaFBasis,
    StaFRegressor,
    StateFollowingCenters,
    adp,
    lanes,
    rings,
    systems,
    targets,
)
from tests import gpu_cases as cases
from tests import gpu_peers as peers
from tests.registers import ptxas

FEW, BUILT = 16, 32
CLOSE, ROUNDED, POSED = 1e-12, 4.0, 1e-3
"""What a float64 number may be off by; and by how many times what plain torch's of float32 is,
which is at most that much."""
DTYPES = torch.float64, torch.float32
EXPERIMENTS = "avoidance", "exponential_bound", "feasibility"  # safe_box is right, too, in 70 s
EXPERIMENT_SECONDS, ALIKE = 75, 1e-6
Make = Callable[[int, torch.dtype], cases.Case]
KINDS: dict[str, tuple[Make, tuple[int, ...]]] = {
    "M = 3 SteepestDescent, 100": (cases.weights(3, "SteepestDescent", 100), (100_000, 1_000_000)),
    "M = 6 ConjugateGradient": (cases.weights(6, "ConjugateGradient", 16), (100_000, 1_000_000)),
    "M = 15 SteepestDescent": (cases.weights(15, "SteepestDescent", 16), (100_000, 1_000_000)),
    "few rows": (cases.weights(3, "SteepestDescent", 400), (1000,)),
    **{
        f"M = 15 {law}": (cases.weights(15, law, 16), (100_000,))
        for law in ("Nesterov", "HeavyBall", "Exact")
    },
    "flow": (cases.flows, (1, 1000, 100_000)),
    "pendulum": (cases.pendulums, (1, 1000, 1_000_000)),
    "float32 within": (cases.mixed, (1000, 1_000_000)),
    "inputs turned": (cases.turned, (1000, 1_000_000)),
    "memory of 80 states": (cases.memories, (1000, 100_000)),
    "stiff loop": (cases.stiff_loops, (1000, 1_000_000)),
    "Lorenz, Tsit5": (cases.lorenzes, (1000, 8_388_608)),
    "information actor-critic": (cases.information, (1000, 100_000)),
    "random points made there": (cases.random_points, (1000, 100_000)),
    "gradient of Lorenz": (cases.lorenz_gradients, (1000,)),
    "SafetyFilter": (cases.filtered, (1000, 100_000)),
    "RolloutPolicy": (cases.rollouts, (1000, 100_000)),
    "mass of a row's own": (cases.masses, (1000, 1_000_000)),
    "chase, everything": (cases.everything, (100_000,)),
    "streams, M = 6": (cases.streams(2, 6), (1000, 100_000)),
    "streams, a width of each": (cases.streams(2, 3, own=True), (100_000,)),
}
for _count, _law in itertools.product((3, 6, 15), cases.LAWS):
    # Of more iterations these make ten digits of a rounding.
    _few = (_count, _law) in ((15, "ConjugateGradient"), (15, "BarzilaiBorwein"), (6, "BarzilaiBorwein"))
    _name = f"M = {_count} {_law}" + ", 2 its" * _few
    KINDS.setdefault(_name, (cases.weights(_count, _law, 16, 2 if _few else 10), (100_000,)))
WITHIN = {"float32 within": 1e-7}
"""float64 cases that compute in float32 inside: a sine of float32 is right to two units."""


DEVICE = "cuda"


def wait() -> None:
    """Wait for the device."""
    if DEVICE == "cuda":
        torch.cuda.synchronize()


def on_cpu(call: Callable[[str], Any]) -> Any:
    with lanes.compiling("never"):
        return call("cpu")


moved = lanes.tree.moved


def first(tree: Any, rows: int) -> Any:
    """The first rows of a tree."""
    leaves, structure = lanes.tree.flatten(tree)
    some = (leaf if isinstance(leaf, lanes.Shared) else leaf[:rows] for leaf in leaves)
    return lanes.tree.unflatten(structure, some)


def tensors(tree: Any) -> list[Tensor]:
    leaves: list[Tensor] = lanes.tree.flatten(tree)[0]
    return leaves


def error(found: Any, wanted: Any) -> float:
    """The largest difference, over 1 + the size of the number; infinite where one is NaN alone."""
    worst = [0.0]
    for a, b in zip(tensors(found), tensors(wanted), strict=True):
        one, two = a.cpu().double(), b.cpu().double()
        away = torch.where(one == two, 0.0, (one - two).abs() / (1 + two.abs()))
        away = torch.where(one.isnan() & two.isnan(), 0.0, away).nan_to_num(float("inf"))
        worst.append(float(away.max()) if a.numel() else 0.0)
    return max(worst)


def most_of(counts: tuple[int, ...]) -> int:
    """The rows of which all calls take the first."""
    return max(FEW, *counts) if DEVICE == "cuda" else 1000


def converted(tree: Any, dtype: torch.dtype, wanted: torch.dtype) -> Any:
    """A tree with the numbers of one dtype as those of another."""
    leaves, structure = lanes.tree.flatten(tree)

    def cast(x: Tensor) -> Tensor:
        return x.to(wanted) if x.dtype == dtype else x

    to = (lanes.Shared(cast(x.tensor)) if isinstance(x, lanes.Shared) else cast(x) for x in leaves)
    return lanes.tree.unflatten(structure, to)


def made(name: str, dtype: torch.dtype, rows: int) -> cases.Case:
    """A case, whose first rows are those of any other number of rows."""
    make, counts = KINDS[name]
    torch.manual_seed(0)
    if name in OWN:
        return make(rows, dtype)
    case = make(most_of(counts), dtype)
    return replace(case, inputs=first(case.inputs, rows))


OWN = ("mass of a row's own",)  # that hold numbers for so many rows


def truth(name: str, dtype: torch.dtype, given: Any) -> tuple[Any, float]:
    """Few rows by the definition in float64 on the CPU, and how much its numbers of a dtype are off."""
    torch.manual_seed(0)
    rows = len(plain_of(given))
    with torch.no_grad():
        wanted = KINDS[name][0](rows, torch.float64).plain(*converted(given, dtype, torch.float64))
        if dtype == torch.float64:
            return wanted, 0.0
        torch.manual_seed(0)
        return wanted, error(KINDS[name][0](rows, dtype).plain(*given), wanted)


def plain_of(tree: Any) -> Tensor:
    """The first tensor of a tree that has rows."""
    return next(leaf for leaf in lanes.tree.flatten(tree)[0] if not isinstance(leaf, lanes.Shared))


def bound_of(name: str, dtype: torch.dtype, off: float) -> float:
    """What a number of the device may be off by; NaN where plain torch's is no judge."""
    if dtype == torch.float64:
        return WITHIN.get(name, CLOSE)
    return ROUNDED * off + 1e-6 if off < POSED else float("nan")


def build(name: str, dtype: torch.dtype) -> tuple[str, bytes, float]:
    """Leave a kernel in the cache and find the truth, in a process of its own; and the seconds it took."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    begin = time.perf_counter()
    try:
        case = KINDS[name][0](BUILT, dtype)
        case.to(DEVICE)
        with lanes.compiling("always"):
            case.call(*moved(case.inputs, DEVICE))
        wait()
        return "", known(name, dtype), time.perf_counter() - begin
    except Exception as told:
        return f"{name}: {type(told).__name__}: {told}", b"", time.perf_counter() - begin


def experiment(name: str) -> tuple[str, bool, str]:
    """Run an experiment on the device and on the CPU: its name, whether they agree, and what is told."""
    begin, found = time.perf_counter(), list[dict[str, Any]]()
    with tempfile.TemporaryDirectory() as folder:
        started = []
        for device in (DEVICE, "cpu"):
            place = f"{folder}/{device}{len(started)}"
            words = f"-m staf_torch experiment={name} figures=false device={device} hydra.run.dir={place}"
            command, given = (
                [sys.executable, *words.split()],
                dict[str, Any](stderr=subprocess.STDOUT, text=True),
            )
            given["env"] = os.environ | {"OMP_NUM_THREADS": "2"}
            started.append((place, subprocess.Popen(command, stdout=subprocess.PIPE, cwd=folder, **given)))
        for place, process in started:
            try:
                told = process.communicate(
                    timeout=max(1.0, EXPERIMENT_SECONDS + begin - time.perf_counter())
                )[0]
            except subprocess.TimeoutExpired:
                process.kill()
                return name, False, f"not ended after {EXPERIMENT_SECONDS} s"
            if process.returncode:
                return name, False, told[-600:]
            found.append(json.loads(Path(place, "metrics.json").read_text()))
    one, other = (dict(_numbers(each)) for each in found)
    away = max((abs(one[k] - other[k]) / (1 + abs(other[k])) for k in other if k in one), default=0.0)
    right = one.keys() == other.keys() and away < ALIKE
    return name, right, f"{len(other)} metrics, off by {away:.1e}, {time.perf_counter() - begin:.0f} s"


def _numbers(tree: Any, at: str = "") -> Iterator[tuple[str, float]]:
    """Numbers of a tree of JSON, without those that a clock gives."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            if "seconds" not in key and "time" not in key:
                yield from _numbers(value, f"{at}/{key}")
    elif isinstance(tree, list):
        for k, value in enumerate(tree):
            yield from _numbers(value, f"{at}/{k}")
    elif isinstance(tree, float | int) and math.isfinite(tree):
        yield at, float(tree)


def known(name: str, dtype: torch.dtype) -> bytes:
    """`truth` of the first rows; in bytes, as another process sends it."""
    drawn = not name.startswith(
        ("M =", "few rows", "chase", "Lorenz", "gradient")
    )  # by torch, otherwise where there are more
    inputs = made(name, dtype, most_of(KINDS[name][1])).inputs if drawn else KINDS[name][0](FEW, dtype).inputs
    held = io.BytesIO()
    torch.save(truth(name, dtype, first(inputs, FEW)), held)
    return held.getvalue()


def on_device(name: str, dtype: torch.dtype, rows: int) -> tuple[cases.Case, Callable[[], Any]]:
    """A case, and a call of it on the device."""
    case = made(name, dtype, rows)
    case.to(DEVICE)
    return case, functools.partial(case.call, *moved(case.inputs, DEVICE))


def timed(call: Callable[[], Any], times: int = 5) -> float:
    """The median of the seconds of a call, to its end on the device."""
    seconds = []
    for _ in range(times):
        wait()
        begin = time.perf_counter()
        call()
        wait()
        seconds.append(time.perf_counter() - begin)
    return statistics.median(seconds)


def of_kernels(call: Callable[[], Any]) -> tuple[float, int]:
    """The seconds that kernels of programs take in a call, NaN unless somebody knows; and how many others."""
    try:
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as seen:
            call()
            wait()
        found = [(each.key, each.self_device_time_total, each.count) for each in seen.key_averages()]
    except Exception:
        return float("nan"), -1
    own = [micro for key, micro, _ in found if key.startswith("lanes_kernel")]
    return (sum(own) / 1e6 if own else float("nan")), sum(count for key, _, count in found) - len(own)


def compare(name: str, dtype: torch.dtype, rows: int) -> bool:
    """Print a line of the table; whether it is right."""
    with lanes.compiling("always"):
        case, call = on_device(name, dtype, rows)
        if (name, dtype) not in TRUTHS:
            TRUTHS[name, dtype] = known(name, dtype)
        wanted, off = torch.load(io.BytesIO(TRUTHS[name, dtype]), weights_only=False)
        wanted = first(wanted, min(rows, FEW))
        bound = bound_of(name, dtype, off)
        begin = time.perf_counter()
        found = call()
        wait()
        began = time.perf_counter() - begin
        away = error(first(found, FEW), wanted)
        alike, bits = True, "" if rows <= 7 or name == "mass of a row's own" else "same bits"
        if bits:
            alone = case.call(*moved(first(case.inputs, 7), DEVICE))
            pairs = zip(tensors(first(found, 7)), tensors(alone), strict=True)
            alike = all(torch.equal(a.nan_to_num(7.0), b.nan_to_num(7.0)) for a, b in pairs)
            bits = bits if alike else "OTHER BITS"
        del found
        whole = timed(call)
        kernel, others = of_kernels(call)
    steps = rows * case.times
    right = away <= bound and alike
    what = f"{name:28} {str(dtype)[6:]:8} {rows:8} {away:8.1e} {bound:8.1e} {began:7.2f}"
    times = f"{1e3 * whole:9.3f} {1e3 * kernel:9.3f} {steps / whole / 1e9:8.3f} {steps / kernel / 1e9:8.3f}"
    print(f"{what} {times} {others:4} {bits}{'' if right else '  WRONG'}", flush=True)
    RATES[name, dtype, rows] = steps / whole
    return right


RATES: dict[tuple[str, torch.dtype, int], float] = {}
TRUTHS: dict[tuple[str, torch.dtype], bytes] = {}


def in_a_graph() -> bool:
    """Whether graphs compute what calls do, also with other numbers in their inputs."""
    away = 0.0
    for name in ("pendulum", "few rows"):
        case, _ = on_device(name, torch.float64, 1000)
        given = moved(case.inputs, DEVICE)
        for _ in range(4):
            case.call(*given)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            found = case.call(*given)
        plain_of(given).mul_(0.5)
        graph.replay()
        wait()
        away = max(away, error(found, case.call(*given)))
    return away == 0.0


def simulated_in_a_graph() -> bool:
    """Whether `systems.simulate` is recorded, too, and marks the rows that need shorter steps."""
    plant, away = systems.VanDerPol().to(DEVICE), 0.0
    x = torch.linspace(-1, 1, 2000, dtype=torch.float64, device=DEVICE).reshape(1000, 2)
    for _ in range(4):
        systems.simulate(plant, x, dt=0.01, steps=100)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        found = systems.simulate(plant, x, dt=0.01, steps=100)
    for scale in (0.5, 100.0):
        x.mul_(scale)
        graph.replay()
        wait()
        good = found.isfinite().flatten(1).all(1)
        wanted = systems.simulate(plant, x, dt=0.01, steps=100)
        away = max(away, error(found[good], wanted[good]))
    return away == 0.0 and not bool(good.all())


def on_streams() -> bool:
    """Whether calls on streams of their own, one after the other, have the numbers of one."""
    _, call = on_device("M = 3 SteepestDescent, 100", torch.float64, 1000)
    wanted, found = call(), []
    for stream in [torch.cuda.Stream() for _ in range(4)]:
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            found.append(call())
    wait()
    return all(torch.equal(each, wanted) for each in found)


def in_threads() -> bool:
    """Whether several threads, none of which has called CUDA before, get the numbers of one."""
    _, call = on_device("pendulum", torch.float64, 1000)
    wanted = call()
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        found = [each.result() for each in [pool.submit(call) for _ in range(8)]]
    wait()
    return all(error(each, wanted) == 0.0 for each in found)


def nothing_waits() -> bool:
    """Whether a call comes back while its kernel runs: nothing reads from the device."""
    _, call = on_device("Lorenz, Tsit5", torch.float64, 1_000_000)
    call()
    wait()
    begin = time.perf_counter()
    call()
    back = time.perf_counter() - begin
    wait()
    print(f"    back after {1e6 * back:.0f} us, ended after {1e6 * (time.perf_counter() - begin):.0f} us")
    torch.cuda.set_sync_debug_mode("error")
    try:
        call()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return back < 0.2 * (time.perf_counter() - begin)


def doors() -> dict[str, Callable[[], Any]]:
    """Functions of the library on tensors of the device, which give the same there as on the CPU."""
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)

    def x0(device: str, rows: int = 64) -> Tensor:
        return torch.linspace(-1, 1, 2 * rows, dtype=torch.float64).reshape(rows, 2).to(device)

    def simulated(device: str) -> Any:
        return systems.simulate(systems.VanDerPol().to(device), x0(device), dt=0.01, steps=400)

    def closed(device: str) -> Any:
        lqr = adp.Feedback(adp.LQR(plant, cost))
        return adp.simulate(lqr, plant, cost, x0(device), dt=0.01, steps=300, compile=True).state

    def policy(device: str) -> Any:
        asked = adp.RolloutPolicy.of_lqr(plant, cost).to(device)
        lanes.ready(asked, x0(device)[:1])
        return asked(x0(device)[:1]), asked(x0(device))

    def gradient(device: str) -> Any:
        program, gain = lanes.Program(cases.pendulum), torch.linspace(0.5, 2, 64).double().to(device)
        x, gain = x0(device).requires_grad_(), gain.requires_grad_()
        u, mass = torch.ones(64, 50).double().to(device), lanes.Shared(torch.tensor(2.0).double().to(device))
        end, angles = program(x, u, (gain, mass))
        (end.square().sum() + angles.sum()).backward()
        return x.grad, gain.grad

    def streams(device: str) -> Any:
        x, found = x0(device, 3 * 64).unflatten(0, (3, 64)), []
        for more in ({}, {"scaling": True}, {"noise": lanes.rows(0.01 + x0(device)[:, 0].abs())}):
            model = StaFRegressor(GaussianKernel(1.0), 0.4, 3, **more).fit(x[:2], x[:2].sum(-1))
            found += copy.deepcopy(model).partial_fit(x[2], x[2, :, 0]).predict(x[0], True)
        return found

    def remembered(device: str) -> Any:
        basis = StaFBasis(GaussianKernel(1.0), StateFollowingCenters(rings(3), 0.3))
        memory, x = ExperienceMemory(basis, 8, (64,)), x0(device)
        for k in range(12):
            memory.add(x + 0.1 * k, basis.local(x + 0.1 * k).fit(basis.values(x + 0.1 * k, targets.Paper())))
        return memory(x.unsqueeze(1) + 1.0), memory.start(x + 1.0)

    calls = {
        "systems.simulate": simulated,
        "adp.simulate": closed,
        "a policy": policy,
        "a gradient": gradient,
    }
    return calls | {"streams": streams, "a memory of local models": remembered}


def same_there(call: Callable[[str], Any]) -> bool:
    """Whether a function of the library has the same results on the device."""
    away = error(call(DEVICE), on_cpu(call))
    print(f"    {away:.1e}")
    return away < 1e-9


SPILLING = {
    "M = 15 Nesterov": "1 % of the 52 kB that a step moves; with shared memory 192 bytes remain",
    "M = 15 HeavyBall": "1 % of the 52 kB that a step moves; with shared memory 296 bytes remain",
    "M = 15 RecursiveLeastSquares": "72 bytes of 18 kB: its matrices of 225 numbers lie there",
    "loop with rbf_grid basis": "504 bytes beside 5.3 kB of matrices; with shared memory 268 to 432 remain",
    "M = 6 RecursiveLeastSquares": "20 kB a step; 252 kB with its matrices of 36 numbers in arrays",
}
"""Kernels of float64 that spill, and why no other form is taken: counted in their machine code for sm_90."""


def programs(only: str) -> Iterator[tuple[str, torch.dtype, Callable[[], Any]]]:
    """Yield a call of every program whose name has these letters."""
    for name, (make, _) in KINDS.items():
        for dtype in (torch.float64, torch.float32) if only in name else ():
            torch.manual_seed(0)
            case = make(3, dtype)
            yield name, dtype, functools.partial(case.call, *case.inputs)
    sys.path.insert(0, str(Path(__file__).parent))
    from tests.gpu_programs import PROGRAMS

    for name, call in PROGRAMS.items():
        if only in name:
            yield name, torch.float64, call


def registers(only: str) -> int:
    """Compile the kernels with nvcc for several architectures; print their registers and what is spilled."""
    bad, seen = 0, set[str]()
    for name, dtype, call in programs(only):
        with lanes.compiling("always"), lanes.device.recorded() as texts:
            call()
        for text in [text for text in texts if name in KINDS or text not in seen]:
            seen.add(text)
            found = ptxas(text, (80, 90, 100))
            spilling = any(each.spilled for each in found.values())
            why = SPILLING.get(name, "") if spilling else ""
            bad |= int(spilling and not why)
            told = ", ".join(
                f"sm_{a} {of.registers} registers {of.spilled} spilled {of.stack} stack"
                + f" {of.shared} shared" * (of.shared > 0)
                for a, of in found.items()
            )
            print(f"{name:28} {str(dtype)[6:]:8} {told}{why and f'; {why}'}", flush=True)
    return bad


def main() -> int:
    global DEVICE
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--ptxas", action="store_true")
    options.add_argument("--host", action="store_true", help="the host as a device, few rows")
    options.add_argument("--only", default="")
    given = options.parse_args()
    if given.ptxas:
        return registers(given.only)
    if given.host:
        DEVICE = "cpu"
        with lanes.device.host():
            names = [name for name in KINDS if given.only in name]
            return int(not all([*table(names, 1000), *checked(())]))
    if not torch.cuda.is_available():
        print("no CUDA device here")
        return 2
    return on_card(given.only)


def on_card(only: str) -> int:
    """Build everything ahead, in as many processes as there are cores, and print the tables."""
    begin = time.perf_counter()
    until = begin + SECONDS
    warnings.simplefilter("ignore")  # of the profiler
    names = [name for name in KINDS if only in name and (only or name not in LONG)]
    wanted = list(itertools.product(sorted(names, key=lambda name: "M = 15" not in name), DTYPES))
    workers = min(len(wanted), max(1, (os.cpu_count() or 1) - 2))
    spawn = multiprocessing.get_context("spawn")
    rival: dict[Any, Any] = {}
    with (
        concurrent.futures.ThreadPoolExecutor(8) as threads,
        concurrent.futures.ProcessPoolExecutor(workers, mp_context=spawn) as pool,
    ):
        tried = [] if only else [threads.submit(experiment, name) for name in EXPERIMENTS]
        waiting = {what: pool.submit(build, *what) for what in wanted}
        if not only:
            rival = peers.built(threads)
        for what, each in waiting.items():
            failed, held, seconds = each.result()
            TRUTHS.update({what: held} if held else {})
            if failed or seconds > SLOW:
                print(failed or f"{what[0]} {what[1]}: {seconds:.0f} s to build and to know", flush=True)
        for each in tried:
            yielded = each.result()
            RIGHT.append(yielded[1])
            print(f"experiment={yielded[0]}: {'right' if yielded[1] else 'WRONG'}, {yielded[2]}", flush=True)
        concurrent.futures.wait(rival.values())
    built = time.perf_counter() - begin
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}; built in {built:.0f} s", flush=True)
    RIGHT.extend(table(names, until=until))
    RIGHT.extend(checked())
    peers.compared(rival, RATES, until)
    print(f"{time.perf_counter() - begin:.0f} s in all; {'all right' if all(RIGHT) else 'WRONG'}")
    return int(not all(RIGHT))


LONG = ("M = 15 RecursiveLeastSquares",)
"""Kinds for `--only`: ten seconds a call, of matrices that do not fit into a thread's registers."""
SLOW = 20  # seconds of building that are told
SECONDS = 170.0  # after which nothing more is begun
RIGHT: list[bool] = []


def table(names: Sequence[str], largest: int = 10**9, until: float = float("inf")) -> Iterator[bool]:
    """Print the table, as far as it comes in time; whether each line is right."""
    rates = f"{'call ms':>9} kernel ms {'G/s':>8} {'kernel':>8} other kernels"
    print(f"{'program':28} {'dtype':8} {'rows':>8} {'error':>8} {'bound':>8} first s {rates}")
    for name, dtype in itertools.product(names, DTYPES):
        for rows in sorted({min(rows, largest) for rows in KINDS[name][1]}):
            if time.perf_counter() > until:
                print(f"{name:28} {str(dtype)[6:]:8} {rows:8} left out, as the time was over")
                continue
            yield attempted(f"{name} {dtype} {rows}", functools.partial(compare, name, dtype, rows))
            torch.cuda.empty_cache()


CHECKS = in_a_graph, simulated_in_a_graph, on_streams, in_threads, nothing_waits


def checked(checks: tuple[Callable[[], bool], ...] = CHECKS) -> Iterator[bool]:
    """Print what else holds; whether each does."""
    for check in checks:
        yield attempted(check.__name__.replace("_", " "), check, told=True)
    for door, call in doors().items():
        yield attempted(door, functools.partial(same_there, call), told=True)


def attempted(what: str, check: Callable[[], bool], *, told: bool = False) -> bool:
    """Whether something holds; an error is printed, and what is next goes on."""
    try:
        fine = check()
    except Exception:
        traceback.print_exc(limit=-5)
        fine, told = False, True
    if told:
        print(f"{what}: {'right' if fine else 'WRONG'}", flush=True)
    return fine


if __name__ == "__main__":
    sys.exit(main())
