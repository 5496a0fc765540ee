"""Programs as plain C and as CUDA C: the numbers are those of the definition."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch import lanes, optim
from staf_torch.optim.objective import NativeError, Precomputed

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC")
pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")


def flow(carry: Any, u: Tensor, row: Any) -> Any:
    """A little of everything: loops, a flag, a count, a matrix, a reduction, a product that stays a loop."""
    x, count, above = carry["x"], carry["count"], carry["above"]
    matrix = torch.linspace(-1, 1, 100, dtype=x.dtype).reshape(10, 10)
    rate = lanes.repeat(3, lambda z: (z + 0.1 * u).sin() + row["gain"].unsqueeze(-1) * z, x)
    wide = (torch.cat((rate,) * 5, dim=-1) @ matrix).tanh()
    x = x + 0.01 * torch.where(above.unsqueeze(-1), wide[..., :2], -rate)
    points = x.unsqueeze(-1) + torch.linspace(0, 1, 4, dtype=x.dtype)
    high = lanes.reduce(lambda p: p.exp(), points, "max", dim=2)
    swapped = {"x": x.flip(-1), "count": count + 1, "above": x[..., 0] > x[..., 1]}
    return swapped, (high, wide.abs().sum(-1).clamp(max=2.0))


def given(batch: int, dtype: torch.dtype) -> tuple[Any, Tensor, Any]:
    torch.manual_seed(0)
    x, u = torch.randn(batch, 2, dtype=dtype), torch.randn(batch, 9, 2, dtype=dtype)
    carry = {"x": x, "count": torch.zeros(batch, dtype=torch.long), "above": x[:, 0] > 0}
    return carry, u, {"gain": torch.rand(batch, dtype=dtype)}


def built(text: str, folder: Path, name: str, command: tuple[str, ...]) -> ctypes.CDLL:
    (folder / name).write_text(text)
    out = folder / f"{name}.so"
    subprocess.run([*command, str(folder / name), "-o", str(out), "-lm"], check=True)
    return ctypes.CDLL(str(out))


def pointer(tensor: Tensor) -> ctypes.c_void_p:
    return ctypes.c_void_p(tensor.data_ptr())


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_c_of_a_step_is_the_definition(dtype: torch.dtype, bound: float, tmp_path: Path) -> None:
    carry, u, row = given(1, dtype)
    program = lanes.Program(flow)
    text = program.c_source("flow", carry, u, row, outputs=["high", "size"], note="Of a test: */ too.")
    kind = "float" if dtype == torch.float32 else "double"
    text += f"void begin(flow_state *s) {{ flow_start(s); }}\nvoid call(flow_state *s, const {kind} *u, "
    text += f"const {kind} *g, {kind} *h, {kind} *z) {{ flow(s, u, g, h, z); }}\n"
    library = built(text, tmp_path, "flow.c", ("gcc", *STRICT))
    state, high, size = (
        torch.empty(4, dtype=dtype),
        torch.empty(9, 2, dtype=dtype),
        torch.empty(9, dtype=dtype),
    )
    library.begin(pointer(state))
    for k in range(9):
        library.call(pointer(state), *map(pointer, (u[0, k], row["gain"], high[k], size[k])))
    end, (highs, sizes) = program.definition(carry, u, row)
    torch.testing.assert_close(high, highs[0], rtol=bound, atol=bound)
    torch.testing.assert_close(size, sizes[0], rtol=bound, atol=bound)
    torch.testing.assert_close(state[:2], end["x"][0], rtol=bound, atol=bound)
    assert state[2:].tolist() == [9.0, float(end["above"][0])]


@pytest.mark.parametrize("law", [optim.SteepestDescent(), optim.ConjugateGradient(), optim.BarzilaiBorwein()])
def test_c_of_a_learning_step_is_the_definition(law: optim.UpdateLaw, tmp_path: Path) -> None:
    factor = torch.randn(1, 4, 6, 6, dtype=torch.float64)
    gram = factor @ factor.mT + 5 * torch.eye(6, dtype=torch.float64)
    values, weights = torch.randn(1, 4, 6, dtype=torch.float64), torch.zeros(1, 6, dtype=torch.float64)

    def step(carry: Any, now: Any, _: Any) -> Any:
        gram, values = now
        objective = NativeError(
            gram, values, Precomputed(extremes=torch.tensor([1.0, 50.0], dtype=torch.float64))
        )
        carry = carry[0], law.begin(objective, *carry)
        carry = lanes.repeat(2, lambda c: law.step(objective, *c), carry)
        return carry, carry[0]

    program = lanes.Program(step)
    start = weights, law.init(weights)
    text = program.c_source("learn", start, (gram, values))
    text += "void begin(learn_state *s) { learn_start(s); }\n"
    text += "void call(learn_state *s, const double *g, const double *v, double *w) { learn(s, g, v, w); }\n"
    library = built(text, tmp_path, "learn.c", ("gcc", *STRICT))
    state, found = torch.empty(100, dtype=torch.float64), torch.empty(4, 6, dtype=torch.float64)
    library.begin(pointer(state))
    for k in range(4):
        library.call(*map(pointer, (state, gram[0, k], values[0, k], found[k])))
    torch.testing.assert_close(found, program.definition(start, (gram, values))[1][0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["9x", "state", "t3", "a-b"])
def test_a_name_that_c_does_not_take_is_refused(name: str) -> None:
    program = lanes.Program(lambda x, _, __: (x, x))
    with pytest.raises(ValueError, match="names of C"):
        program.c_source("f", torch.ones(1), outputs=[name])


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_cuda_text_on_a_host_is_the_definition(dtype: torch.dtype, bound: float, tmp_path: Path) -> None:
    """No device is needed: g++ compiles the kernel, a loop is the grid."""
    carry, u, row = given(37, dtype)
    program = lanes.Program(flow)
    call = lanes.cuda.Kernel(program, carry, u, row, compile=host_compiler(tmp_path))
    for every in (1, 4):
        end, out = call(carry, u, row, every=every)
        wanted, outs = program.definition(carry, u, row, every=every)
        for one, other in zip((*end.values(), *out), (*wanted.values(), *outs), strict=True):
            assert one.dtype == other.dtype
            torch.testing.assert_close(one, other, rtol=bound, atol=bound)


def host_compiler(folder: Path) -> Callable[[str, str], Callable[..., None]]:
    """Compile a kernel with g++: a grid of blocks as two loops."""

    def compile(source: str, name: str) -> Callable[..., None]:
        _, arguments = source[: source.index(")\n{")].split(f"{name}(")
        names = [part.split()[-1].lstrip("*") for part in arguments.split(",")]
        shim = "#include <cmath>\nusing namespace std;\n#define __global__\n"
        shim += "struct { int x; } blockIdx, blockDim, threadIdx;\n"
        launch = f'extern "C" void launch(int grid, int block, {arguments}) {{ blockDim.x = block;\n'
        launch += "for (blockIdx.x = 0; blockIdx.x < grid; ++blockIdx.x)\n"
        launch += "for (threadIdx.x = 0; threadIdx.x < block; ++threadIdx.x) "
        launch += f"{name}({', '.join(names)}); }}\n"
        library = built(
            shim + source + launch, folder, f"{name}.cpp", ("g++", "-O1", "-w", "-shared", "-fPIC")
        )

        def run(grid: Any, block: Any, args: Any) -> None:
            given = [pointer(a) if isinstance(a, Tensor) else ctypes.c_int(a) for a in args]
            library.launch(grid[0], block[0], *given)

        return run

    return compile
