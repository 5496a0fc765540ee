"""Programs as plain C, as CUDA C and on a device that has no numbers: what they compute is the definition."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from recorded import Record
from registers import ptxas
from torch import Tensor

from staf_torch import StaFBasis, centers, chase_weights, kernels, lanes, optim, targets
from staf_torch.lanes.trace import philox

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-O0", "-shared", "-fPIC")
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")


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


@needs_gcc
def test_c_of_a_step_is_the_definition(tmp_path: Path) -> None:
    dtype, bound = torch.float32, 2e-5
    carry, u, row = given(1, dtype)
    program = lanes.Program(flow)
    text = program.c_source("flow", carry, u, row, outputs=["high", "size"], note="Of a test: */ too.")
    text += "void begin(flow_state *s) { flow_start(s); }\nvoid call(flow_state *s, const float *u, "
    text += "const float *g, float *h, float *z) { flow(s, u, g, h, z); }\n"
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


@needs_gcc
def test_random_numbers_of_a_seed_and_a_step_are_the_same_on_every_back_end(tmp_path: Path) -> None:
    dtype = torch.float32  # of which a step's number has more digits than fit

    def step(time: Tensor, now: Any, seed: Tensor) -> tuple[Tensor, Tensor]:
        return time + 1, philox.uniform(seed, time, 3)

    seeds = philox.seed_parts([0, 5, 2**41 + 3, 2**64 - 1], torch.empty(0, dtype=dtype))
    begin = torch.full((4,), 65534.0, dtype=dtype)  # the step's upper half changes
    program = lanes.Program(step)
    wanted = program.definition(begin, (), seeds, steps=4)[1]
    assert program(begin, (), seeds, steps=4)[1].equal(wanted)
    assert program.compiled
    assert program(begin[2:3], (), seeds[2:3], steps=4)[1].equal(wanted[2:3])
    with lanes.device.host():
        assert program(begin, (), seeds, steps=4)[1].equal(wanted)
    text = program.c_source("draw", begin, (), seeds)
    text += "void begin(draw_state *s) { draw_start(s); }\n"
    text += "void call(draw_state *s, const float *r, float *u) { draw(s, r, u); }\n"
    library = built(text, tmp_path, "draw.c", ("gcc", *STRICT))
    state, found = torch.empty(1, dtype=dtype), torch.empty(4, 3, dtype=dtype)
    library.begin(pointer(state))
    for k in range(4):
        library.call(*map(pointer, (state, seeds[0], found[k])))
    assert found.equal(wanted[0])
    many = philox.uniform(seeds, begin, 20_000)
    assert float(many.abs().max()) <= 1
    assert abs(float(many.mean())) < 0.01
    assert abs(float(many.square().mean()) - 1 / 3) < 0.01


def test_words_are_the_known_answers_of_random123() -> None:
    zero, ones = torch.zeros((), dtype=torch.int64), torch.tensor(0xFFFFFFFF)
    for word, known in (
        (zero, "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        (ones, "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ):
        assert " ".join(f"{int(one):08x}" for one in philox.words([word] * 4, [word] * 2)) == known


def moved(carry: Any, now: Any, row: Any) -> tuple[Any, Any]:
    return {"x": carry["x"] + now * row["gain"]}, (carry["x"], now)


def test_a_header_starts_with_the_first_row_and_has_the_names_of_its_trees() -> None:
    carry = {"x": torch.tensor([[0.5, 2.0], [7.0, 9.0]], dtype=torch.float64)}
    given = carry, torch.ones(2, 4, 2).double(), {"gain": torch.ones(2, 1).double()}
    text = lanes.Program(moved).c_source("go", *given, note="a word")
    assert " * a word\n" in text
    assert "0.5, /* 0: x[0] at the start */\n    2.0, /* 1: x[1] at the start */" in text
    for part in ("state->x[1] = go_numbers[1];", "const double now[2]", "const double gain[1]"):
        assert part in text
    assert "double out0[2], double out1[2])" in text
    named = lanes.Program(moved).c_source("go", *given, outputs=["a", "b"])
    assert named.startswith("#ifndef GO_H")
    assert "double a[2], double b[2])" in named


VERSION = ".".join(torch.__version__.split(".")[:2])
TEXTS: dict[str, Callable[[], str]] = {
    "C of a step": lambda: lanes.Program(moved).c_source(
        "go", {"x": torch.ones(1, 2)}, torch.ones(1, 1, 2), {"gain": torch.ones(1, 1)}
    ),
    "C of a loop": lambda: lanes.Program(
        lambda x, u, _: (lanes.repeat(9, lambda z: 0.5 * (z + u / z), x, where=lambda z: z * z > u), ())
    ).c_source("root", torch.ones(1), torch.ones(1, 1)),
    "C++ of a step": lambda: lanes.Program(moved, copies=1).text(
        {"x": torch.ones(1, 2)}, torch.ones(1, 1, 2), {"gain": torch.ones(1, 1)}
    ),
    "C++ of many entries": lambda: lanes.Program(
        lambda x, u, _: (torch.where(x > 1, 0.5 * x.roll(1, -1), x) + u.unsqueeze(-1), x.sum(-1)), copies=2
    ).text(torch.ones(1, 65), torch.ones(1, 1)),
    "CUDA of a step": lambda: lanes.Program(moved).cuda_source(
        {"x": torch.ones(1, 2)}, torch.ones(1, 1, 2), {"gain": lanes.Shared(torch.ones(1))}
    ),
}


@pytest.mark.parametrize("name", TEXTS)
def test_the_text_of_a_small_program_is_the_recorded(name: str, record: Record) -> None:
    """Under the torch with which it was recorded: what torch makes of a function is its own."""
    if record.known().get("torch", VERSION) == VERSION:
        record({"torch": VERSION, "text": TEXTS[name]()})


def test_a_kernel_on_the_host_is_the_definition() -> None:
    """No device is needed: g++ compiles the kernel, a loop is the grid."""
    carry, u, row = given(37, torch.float64)
    program = lanes.Program(flow)
    for every in (1, 4):
        with lanes.device.host():
            end, out = program(carry, u, row, every=every)
        wanted, outs = program.definition(carry, u, row, every=every)
        for one, other in zip((*end.values(), *out), (*wanted.values(), *outs), strict=True):
            assert one.dtype == other.dtype
            torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


def test_results_lie_rows_innermost_and_those_without_room_are_refused() -> None:
    program, x = lanes.Program(lambda x, now, row: (0.5 * x, x.square())), torch.ones(5, 9000)
    with lanes.device.recorded() as texts:
        assert program(x, steps=4)[1].stride() == (1, 45000, 5)
        with pytest.raises(RuntimeError, match=r"3.87e\+05 GB on cpu, for 5 rows and 2147483647"):
            program(x, steps=2**31 - 1)
    few, many = (text.partition("#ifndef OFFSET")[0] for text in texts)
    assert "#define OFFSET" not in few
    assert "#define OFFSET long long" in many


def test_a_chase_that_is_made_again_is_one_kernel() -> None:
    """Nothing is computed around it and nothing is read from the device; what has changed is noticed."""
    basis = StaFBasis(kernels.ExponentialKernel(), centers.StateFollowingCenters(DIRECTIONS, 0.3))
    states = 0.3 * torch.randn(5, 6, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    law, paper = optim.Nesterov(), targets.Paper()

    def again(states: Tensor, history: bool = True) -> Tensor:
        return chase_weights(states, basis, paper, law, history=history).weights

    def defined(states: Tensor) -> Tensor:
        with lanes.compiling("never"):
            return again(states)

    with lanes.device.recorded() as texts, lanes.compiling("always"):
        for _ in range(3):
            again(states)
            again(states, False)
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as seen:
            found = again(states)
        assert {each.key for each in seen.key_averages() if each.key.startswith("aten::")} == {
            "aten::empty_strided"
        }
        torch.testing.assert_close(found, defined(states), rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(again(states, False), found[:, -1:], rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(again(-states), defined(-states), rtol=1e-12, atol=1e-12)
        basis.centers.directions.mul_(0.5)
        torch.testing.assert_close(again(states), defined(states), rtol=1e-12, atol=1e-12)
    assert len(texts) == 1
    if shutil.which("nvcc") is not None:
        of = ptxas(texts[0], (90,))[90]  # of all kernels `python -m tests.gpu --ptxas` tells it
        assert 0 < of.registers < 255
        assert of.spilled == 0


DIRECTIONS = torch.tensor([[1.0, 0.0], [-0.5, 0.8], [-0.5, -0.8]], dtype=torch.float64)


def test_numbers_that_no_table_can_hold_stay_in_the_text_and_the_log_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    gain = torch.tensor([0.1, 0.2], dtype=torch.float64)
    program = lanes.Program(lambda x, now, row: (x, (x.double() * gain).sum(-1)))
    assert "0.2" in program.c_source("f", torch.ones(1, 2))
    assert "not in a table that can be changed: it has float64 inside of float32" in caplog.text
