"""The table of an exported C text: named numbers, others in their place without another text."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from variants import by_turns

from staf_torch import (
    AnchoredKernel,
    GaussianKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    deploy,
    rings,
    rows,
    systems,
)
from staf_torch.deploy.c_header import runner_c, runner_learning_c

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
TABLE = re.compile(r"(?<=_numbers)\[\d+\] = \{.*?^\};", re.DOTALL | re.MULTILINE)
GUARD = re.compile(r"0x[0-9a-f]{8}")


def around(count: int, size: int = 2) -> Tensor:
    return 2 * torch.rand(count, size, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1


def learner(width: float, gain: float = 1.0) -> adp.ActorCritic:
    centers = StateFollowingCenters(rings(3), StateRadius(0.7, 1e-5))
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(GaussianKernel(width)), centers))
    weights = [0.2 * width, 0.8, -0.2]
    points = adp.RandomPoints(1, StateRadius(2.1, 1e-5))
    return adp.ActorCritic(basis, systems.TwoState(), COST, points, gain=gain, actor=weights)


POLICIES: dict[str, Callable[[bool], Any]] = {
    "gains of an LQR": lambda b: adp.LQR(systems.TwoState(), adp.QuadraticCost(9.0 if b else 1.0, 1.0, 2, 1)),
    "a kernel's width, weights": lambda b: learner(1.3 if b else 0.8),
}


def table(text: str) -> list[float]:
    """The numbers of the table of a header."""
    (found,) = TABLE.findall(text)
    entries = re.sub(r"/\*.*?\*/", "", found.partition("{")[2]).strip("};\n ").split(",")
    return [float(each.strip().rstrip("f")) for each in entries if each.strip()]


def written_at_run_time(path: Path, numbers: list[float], x: Tensor) -> Tensor:
    """Control of a header whose table a program has written to."""
    kind = "float" if x.dtype == torch.float32 else "double"
    source = f'#define GO_NUMBERS static\n#include "{path.name}"\n'
    source += f"void put(int k, double v) {{ go_numbers[k] = ({kind})v; }}\n"
    source += f"void call(const {kind} *x, {kind} *u) {{ go(x, u); }}\n"
    (path.parent / "w.c").write_text(source)
    strict = ("-Wall", "-Wextra", "-Werror", "-pedantic", "-std=c99", "-Wdouble-promotion")
    line = ["gcc", "-O2", *strict, "-shared", "-fPIC", "w.c", "-o", "w.so", "-lm"]
    subprocess.run(line, cwd=path.parent, check=True)
    device, u = ctypes.CDLL(str(path.parent / "w.so")), x.new_empty(len(x), 1)
    for place, number in enumerate(numbers):
        device.put(place, ctypes.c_double(number))
    for row, out in zip(x.contiguous(), u, strict=True):
        device.call(ctypes.c_void_p(row.data_ptr()), ctypes.c_void_p(out.data_ptr()))
    return u


@needs_gcc
@pytest.mark.parametrize(("name", "dtype"), by_turns(POLICIES, [torch.float64, torch.float32]))
def test_other_numbers_are_another_table_of_the_same_text(
    name: str, dtype: torch.dtype, tmp_path: Path
) -> None:
    x = around(50).to(dtype)
    paths = [tmp_path / "a.h", tmp_path / "b.h"]
    for path, other in zip(paths, (False, True), strict=True):
        policy = deploy.policy_of(POLICIES[name](other), dtype=dtype)
        deploy.export_c(policy, x, path, ["u"], name="go")
    a, b = (path.read_text() for path in paths)
    (numbers,) = TABLE.findall(b)
    spliced = TABLE.sub(lambda _: numbers, a)
    assert spliced != a
    assert GUARD.sub("", spliced) == GUARD.sub("", b)
    (first,), (wanted,) = (runner_c(path, [1], dtype)(x) for path in paths)
    assert not first.equal(wanted)
    assert written_at_run_time(paths[0], table(b), x).equal(wanted)
    paths[0].write_text(spliced)
    assert runner_c(paths[0], [1], dtype)(x)[0].equal(wanted)


@needs_gcc
def test_a_learner_has_its_first_weights_and_gains_in_the_table(tmp_path: Path) -> None:
    x0, paths = around(1), [tmp_path / "a.h", tmp_path / "b.h"]
    for path, numbers in zip(paths, ((0.8, 1.0), (1.3, 2.5)), strict=True):
        deploy.export_learning_c(learner(*numbers), x0, path, dt=0.01, name="go")
    a, b = (path.read_text() for path in paths)
    (numbers,) = TABLE.findall(b)
    assert "actor[2] at the start */" in a
    spliced = TABLE.sub(lambda _: numbers, a)
    assert GUARD.sub("", spliced) == GUARD.sub("", b) != GUARD.sub("", a)
    run = (around(40), around(40, 2).reshape(40, 1, 2))
    first, wanted = (runner_learning_c(path, 1, 1, torch.float64)(*run) for path in paths)
    paths[0].write_text(spliced)
    assert runner_learning_c(paths[0], 1, 1, torch.float64)(*run).equal(wanted)
    assert not first.equal(wanted)


@needs_gcc
def test_a_number_that_is_written_by_hand_is_that_of_an_export(tmp_path: Path) -> None:
    """What follows from it follows in C, too."""
    weights = learner(1.0).actor
    paths, x = [tmp_path / "a.h", tmp_path / "b.h"], around(50)
    for path, width in zip(paths, (1.0, 1.7), strict=True):
        deploy.export_c(deploy.policy_of(learner(width), weights), x, path, ["u"], name="go")
    text = paths[0].read_text()
    found = re.sub(r"^ +\S+, (/\* \d+: basis.*kernel\.width \*/)$", r"    1.7, \1", text, flags=re.M)
    assert found != text
    paths[0].write_text(found)
    (changed,), (wanted,) = (runner_c(path, [1], torch.float64)(x) for path in paths)
    assert changed.equal(wanted)


def test_an_object_with_numbers_of_rows_is_refused_or_one_row_is_named(tmp_path: Path) -> None:
    policy = deploy.policy_of(adp.LQR(systems.TwoState(), COST))
    policy.k = rows(torch.ones(3, 1, 2).double())
    with pytest.raises(ValueError, match=r"rows"):
        deploy.export_c(policy, around(1), tmp_path / "a.h", ["u"])
    assert not list(tmp_path.iterdir())
