"""The native code under AddressSanitizer and UBSan.

    python tests/sanitized.py [--calls 10000] [--seed 0] [--compiler clang++]

Row programs (a chase is one), filters of streams and banks of local models are built with both sanitizers,
shared by four threads that ask and learn, and called with shapes, layouts and dtypes drawn at random: 0 and 1
rows and times, strided, transposed, expanded and misaligned tensors, and inputs that must be refused. A bad
read, a bad write or undefined behaviour ends the process; what programs return is compared with plain torch.
In the end a read outside is made on purpose, which has to be found.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import random
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FLAGS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer")
SECONDS = 60  # of the processor, for a call; ten times as many by the clock
LIBRARIES = {"programs": "lanes", "filters": "filter", "banks": "bank", "threads": "bank"}
"""What each kind builds."""
ROWS, TIMES = (0, 1, 1, 2, 3, 7, 8, 9, 16, 17, 33), (0, 1, 1, 2, 3, 5)


def missing(compiler: str = "g++") -> str | None:
    """Why nothing can be sanitized here; None: it can."""
    try:
        found = _runtime(compiler)
    except (OSError, subprocess.CalledProcessError) as error:
        return f"there is no {compiler} ({error})"
    return None if found.is_absolute() and found.exists() else f"{compiler} has no runtime of the sanitizers"


def _runtime(compiler: str) -> Path:
    """The shared library of the sanitizers."""
    name = "libclang_rt.asan-x86_64.so" if "clang" in compiler else "libasan.so"
    said = subprocess.run([compiler, f"-print-file-name={name}"], capture_output=True, text=True, check=True)
    return Path(said.stdout.strip())


def run(
    calls: int,
    seed: int,
    cache: Path,
    compiler: str = "g++",
    kinds: Sequence[str] = tuple(LIBRARIES),
    level: str = "-O1",
) -> str:
    """Return what a process under the sanitizers said of so many calls, or what they found.

    Raises:
        AssertionError: if the read outside was not found that the process ends with.
    """
    environment = {
        **os.environ,
        "LD_PRELOAD": str(_runtime(compiler)),
        "ASAN_OPTIONS": "detect_leaks=0:exitcode=66",
        "UBSAN_OPTIONS": "print_stacktrace=1:halt_on_error=1",
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")]),
        "XDG_CACHE_HOME": str(cache),
        "CXX": compiler,
        "CXXFLAGS": " ".join((*FLAGS, level, *(("-shared-libasan",) if "clang" in compiler else ()))),
        "OMP_NUM_THREADS": "1",
    }
    line = [sys.executable, __file__, "--inside", "--calls", str(calls), "--seed", str(seed)]
    line += ["--kinds", *kinds]
    ended = subprocess.run(line, env=environment, capture_output=True, text=True, check=False)
    if "none bad" not in ended.stdout:
        return f"exit {ended.returncode}: {ended.stdout}{ended.stderr[-5000:]}"
    assert ended.returncode == 66, ended.stderr
    assert "heap-buffer-overflow" in ended.stderr
    return ended.stdout.strip()


def inside(calls: int, seed: int, chosen: Sequence[str]) -> None:
    """Call native code so often, in a process that has the sanitizers loaded."""
    import torch
    from helpers_threads import OBJECTS, crowd

    from staf_torch import lanes
    from staf_torch.online import MixtureRegressor, StaFRegressor

    chance = random.Random(seed)
    torch.manual_seed(seed)

    def laid_out(shape: tuple[int, ...], dtype: torch.dtype) -> torch.Tensor:
        """Numbers of that shape in some layout: in one piece, misaligned, strided, transposed or expanded."""
        kind = chance.choice(["whole", "misaligned", "strided", "transposed", "expanded"])
        found = torch.rand(shape, dtype=torch.float64).to(dtype)
        if kind == "misaligned":
            place = torch.empty(found.numel() + 1, dtype=dtype)[1:].view(shape)
        elif kind == "strided":
            place = torch.empty((*shape[:-1], 2 * shape[-1] + 1), dtype=dtype)[..., 1 : 1 + 2 * shape[-1] : 2]
        elif kind == "transposed" and len(shape) > 1:
            place = torch.empty((shape[1], shape[0], *shape[2:]), dtype=dtype).transpose(0, 1)
        elif kind == "expanded" and shape[0]:
            return found[:1].expand(shape)
        else:
            return found
        return place.copy_(found)

    def step(carry: tuple, now: tuple, row: tuple) -> tuple:
        (x,), (u,), (gain,) = carry, now, row
        x = torch.where(x > 0.5, x.sin(), x.exp()) * gain.unsqueeze(-1) + u.clamp(max=0.7)
        return (x,), (x, x.square().sum(-1), (x - u).abs().amax(-1))

    program = lanes.Program(step, name="sanitized")

    def a_program() -> None:
        rows, times = chance.choice(ROWS), chance.choice(TIMES)
        dtype = chance.choice([torch.float64, torch.float32])
        carry = (laid_out((rows, 3), dtype),)
        now = (laid_out((rows, times, 3), dtype),)
        given = carry, now, (laid_out((rows,), dtype),)
        every = chance.choice([1, 1, 2, 3])
        try:
            found, expected = (run(*given, every=every) for run in (program, program.definition))
        except (ValueError, RuntimeError):
            assert rows == 0 or times == 0
            return
        close = 1e-12 if dtype == torch.float64 else 1e-5
        for one, other in zip((*found[0], *found[1]), (*expected[0], *expected[1]), strict=True):
            torch.testing.assert_close(one, other, rtol=close, atol=close)

    def a_filter(kind: type = StaFRegressor) -> None:
        times, streams = chance.choice((1, 2, 3, 5, 17, 70)), chance.choice((0, 1, 1, 2, 3, 9))
        shape = (times, streams, 2) if streams else (times, 2)
        wrong = chance.random() < 0.2
        x = laid_out(shape, chance.choice([torch.float64, torch.float32]))
        y = laid_out((*shape[:-1][: 1 if wrong else None],), x.dtype)
        try:
            model = kind().fit(x, y)
            predicted = model.predict(x[-1])
        except (ValueError, RuntimeError, TypeError):
            return
        assert torch.as_tensor(predicted).shape[: len(shape) - 2] == shape[1:-1]

    def some_threads() -> None:
        with lanes.compiling("always"):
            crowd(OBJECTS[chance.choice([*OBJECTS])], chance.choice([1, 8, 60]))

    kinds = {
        "programs": a_program,
        "filters": a_filter,
        "banks": lambda: a_filter(MixtureRegressor),
        "threads": some_threads,
    }
    often = {"programs": 30, "filters": 10, "banks": 5, "threads": 1}
    counts = dict.fromkeys(chosen, 0)
    for at in range(calls):
        weights = [often[kind] for kind in chosen]
        # Each kind once at least.
        name = chosen[at] if at < len(chosen) else chance.choices(chosen, weights)[0]
        # Both signals end the process: a call that hangs listens to nothing else.
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        signal.alarm(10 * SECONDS)
        kinds[name]()
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        counts[name] += 1
    built = list(Path(os.environ["XDG_CACHE_HOME"], "staf_torch").rglob("*.so"))
    names = {library.name.partition("-")[0] for library in built}
    assert names >= {LIBRARIES[kind] for kind in chosen}, names
    bare = [str(library) for library in built if b"__asan_report_load" not in library.read_bytes()]
    assert not bare, bare
    print(f"{calls} calls of {len(built)} libraries under the sanitizers, none bad: {counts}", flush=True)
    outside = torch.empty(3, dtype=torch.float64)
    ctypes.string_at(outside.data_ptr(), 256)  # must be found, or all of this has shown nothing


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--calls", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--compiler", default="g++")
    parser.add_argument("--kinds", nargs="*", choices=[*LIBRARIES], default=[*LIBRARIES])
    parser.add_argument("--level", default="-O1", help="of the compiler; -O0 builds in half the time")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.inside:
        inside(chosen.calls, chosen.seed, chosen.kinds)
        return 0
    if why := missing(chosen.compiler):
        print(why)
        return 0
    with tempfile.TemporaryDirectory() as cache:
        said = run(chosen.calls, chosen.seed, Path(cache), chosen.compiler, chosen.kinds, chosen.level)
    print(said)
    return int("none bad" not in said)


if __name__ == "__main__":
    sys.exit(main())
