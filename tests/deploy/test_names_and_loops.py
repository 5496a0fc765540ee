"""Files in somebody's program: names that are free, headers beside each other, both dtypes, loops in ONNX."""

from __future__ import annotations

import importlib.util
import math
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers_swingup import double_integrator
from torch import Tensor, nn

from staf_torch import adp, deploy, lanes, systems
from staf_torch.deploy.formats import runner_onnx

needs_onnx = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("onnx", "onnxscript", "onnxruntime")),
    reason="needs the extra onnx",
)
needs_gcc = pytest.mark.skipif(not all(map(shutil.which, ("gcc", "g++"))), reason="needs gcc and g++")
LINE = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
LQR = adp.LQR(LINE, COST)
X = torch.tensor([[0.4, -0.3]], dtype=torch.float64)


def around(rows: int, size: int = 2) -> Tensor:
    return 2 * torch.rand(rows, size, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1


def remembered() -> adp.GlobalValue:
    problem = double_integrator(-1.0, 1.0)
    library = adp.BoxDDP(problem, steps=80, compile=False).solve(
        torch.tensor([[1.0, 0.0], [-1.0, 0.5]]).double()
    )
    return adp.GlobalValue(problem, library, region=[1.5, 1.0], candidates=3, lookahead=5)


def walled(policy: Any) -> adp.SafetyFilter:
    return adp.SafetyFilter(policy, LINE, lambda x, t: 0.5 - x[:, 0], dt=0.1, low=-3.0, high=3.0)


POLICIES: dict[str, Callable[[], Any]] = {
    "a filter": lambda: walled(LQR),
    "a memory": remembered,
}
TAKEN = "class", "restrict", "sinf", "state", "a__b", "9", "own_near"


@pytest.mark.parametrize("name", TAKEN)
def test_a_name_that_c_or_cpp_has_taken_is_refused_in_the_callers_words(name: str, tmp_path: Path) -> None:
    policy, path = deploy.policy_of(LQR), tmp_path / "a.h"
    calls: dict[str, Callable[[], object]] = {
        r"`export_c\(outputs=...\)`": lambda: deploy.export_c(policy, X, path, [name]),
        r"`export_c\(name=...\)`": lambda: deploy.export_c(policy, X, path, ["u"], name=name),
        r"`export_learning_c\(name=...\)`": lambda: deploy.export_learning_c(
            adp.Feedback(LQR), X, path, dt=0.1, name=name
        ),
    }
    for said, call in calls.items():
        with pytest.raises(ValueError, match=rf"{said} must .*; got '{name}'"):
            call()
    assert not path.exists()


@needs_onnx
def test_names_that_clash_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    policy, path = deploy.policy_of(LQR), tmp_path / "a.file"
    for names, said in ((["u", "v"], "must be 1 name"), ("u", "must be a list of names")):
        with pytest.raises(ValueError, match=rf"`export_c\(outputs=...\)` {said}"):
            deploy.export_c(policy, X, path, names)
    with pytest.raises(ValueError, match=r"`export_c\(example=...\)` must be in the dtype of the module"):
        deploy.export_c(policy, X.float(), path, ["u"])
    loop = deploy.policy_of(walled(LQR))
    for names, said in (
        (["state"], "must differ"),
        (["u", "v"], "must be 1 name"),
        ([""], "must not be empty"),
    ):
        with pytest.raises(ValueError, match=rf"`export_onnx\(outputs=...\)` {said}"):
            deploy.export_onnx(loop, path, ["state"], names, example=X)
    with pytest.raises(ValueError, match=r"`export_onnx\(example=...\)` must be given"):
        deploy.export_onnx(loop, path, ["state"], ["u"])
    assert not path.exists()


@needs_gcc
def test_two_controllers_in_one_program_give_each_its_own_controls(tmp_path: Path) -> None:
    other = adp.LQR(LINE, adp.QuadraticCost(9.0, 1.0, dim=2, inputs=1))
    deploy.export_c(deploy.policy_of(LQR), X, tmp_path / "a.h", ["u"])
    deploy.export_c(deploy.policy_of(walled(other)), X, tmp_path / "b.h", ["u"])
    deploy.export_c(deploy.policy_of(other), X, tmp_path / "c.h", ["u"], name="lqr")
    main = "int main(void) { double x[2] = { 0.4, -0.3 }, u[2]; lqr(x, u); filtered_lqr(x, u + 1);\n"
    main += 'printf("%.17g %.17g", u[0], u[1]); return 0; }\n'
    strict = ("-Wall", "-Wextra", "-Werror", "-pedantic", "-Wdouble-promotion")

    def built(compiler: tuple[str, ...], *headers: str) -> subprocess.CompletedProcess[str]:
        lines = [f'#include "{each}"\n' for each in headers]
        (tmp_path / "m.c").write_text("".join(["#include <stdio.h>\n", *lines, main]))
        command = [*compiler, *strict, "m.c", "-o", "m", "-lm"]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    wanted = [float(LQR(X)), float(walled(other)(X))]
    for compiler in (("gcc", "-std=c99"), ("g++", "-x", "c++", "-std=c++11")):
        assert built(compiler, "a.h", "b.h", "a.h").stderr == ""
        said = subprocess.run([tmp_path / "m"], capture_output=True, text=True, check=True).stdout
        assert [float(part) for part in said.split()] == pytest.approx(wanted, rel=1e-12)
        assert "another lqr is in this program already" in built(compiler, "a.h", "b.h", "c.h").stderr


@needs_onnx
@pytest.mark.parametrize(
    ("name", "dtype", "batch"),
    [("a filter", torch.float64, None), ("a memory", torch.float32, 1)],
)
def test_loops_of_a_policy_are_loops_in_onnx(
    name: str, dtype: torch.dtype, batch: int | None, tmp_path: Path
) -> None:
    path = tmp_path / "a.onnx"
    policy, x = deploy.policy_of(POLICIES[name](), dtype=dtype), around(batch or 20).to(dtype)
    source = deploy.export_onnx(policy, path, ["state"], ["u"], example=x, batch=batch, name="mine")
    assert source is not None
    assert source.flops > 100
    (u,) = runner_onnx(path)(x)
    torch.testing.assert_close(u, policy(x), rtol=1e-9 if batch is None else 1e-4, atol=1e-9)
    assert path.stat().st_size < 500_000


class Functions(nn.Module):
    """What onnxruntime lacks in double, and arrays, flags and outputs of every pass."""

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        def turn(z: Tensor) -> Tensor:
            return (
                (0.1 * z).tan()
                + (1e-9 * z).expm1()
                + z.abs().log1p()
                + torch.where(z > 0, z.trunc(), z.round())
            )

        def add(total: Tensor, now: Tensor) -> tuple[Tensor, Tensor]:
            return total + now, torch.where(total > now, total * now, total.clamp(max=0.3))

        matrix = torch.linspace(-1, 1, 1600, dtype=x.dtype).view(40, 40)
        wide = lanes.repeat(3, lambda b: (b @ matrix).tanh(), torch.cat((x,) * 20, -1))
        total, parts = lanes.scan(add, x[:, 0], x.sum(-1, keepdim=True).expand(-1, 6))
        return lanes.repeat(5, turn, x), torch.atan2(x[:, 0], x[:, 1]), wide, total, parts


@needs_onnx
def test_functions_that_onnxruntime_lacks_have_all_digits(tmp_path: Path) -> None:
    ends = [0.0, -0.0, 1e-12, -1.0, 3.0, 1e3]
    x = torch.tensor([[a, b] for a in ends for b in (*ends, math.inf)][:-1], dtype=torch.float64)
    x = torch.cat((x[torch.isfinite(x).all(-1)], around(20)))
    module, names = Functions(), ["turned", "angle", "wide", "total", "parts"]
    deploy.export_onnx(module, tmp_path / "a.onnx", ["state"], names, example=x)
    for found, wanted in zip(runner_onnx(tmp_path / "a.onnx")(x), module(x), strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-11, atol=1e-12)
