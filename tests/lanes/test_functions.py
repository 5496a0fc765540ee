"""Elementary functions on lanes against 60 digits: units in the last place over the whole range."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import mpmath
import pytest
import torch
from torch import Tensor

from staf_torch import lanes

pytestmark = pytest.mark.needs_compiler

BOUNDS: dict[str, tuple[float, float]] = {  # units in the last place, float64 and float32
    "exp": (1.0, 1.0),
    "expm1": (2.0, 2.0),
    "log": (1.0, 1.0),
    "log1p": (1.0, 1.0),
    "sin": (1.0, 1.0),
    "cos": (1.0, 1.0),
    "tan": (2.0, 2.0),
    "tanh": (2.0, 2.0),
    "sqrt": (0.5, 0.5),
    "atan2": (1.0, 1.1),
    "sigmoid": (2.0, 2.0),
}
SPECIAL = (
    0.0,
    -0.0,
    math.inf,
    -math.inf,
    math.nan,
    1.0,
    -1.0,
    5e-324,
    -5e-324,
    1e-310,
    -1e-310,
    1.7e308,
    -1.7e308,
)
DTYPES = (torch.float64, torch.float32)


def everything(
    carry: tuple[()], now: tuple[()], row: tuple[Tensor, Tensor]
) -> tuple[tuple[()], dict[str, Tensor]]:
    x, y = row
    out = {name: getattr(torch, name)(x) for name in BOUNDS if name != "atan2"}
    rounded = {name: getattr(torch, name)(x) for name in ("floor", "ceil", "trunc", "round", "abs", "sign")}
    return (), {
        **out,
        "atan2": torch.atan2(x, y),
        **rounded,
        "max": torch.maximum(x, y),
        "min": torch.minimum(x, y),
    }


@pytest.fixture(scope="module")
def program() -> lanes.Program:
    return lanes.Program(everything)


def points(dtype: torch.dtype, count: int) -> Tensor:
    """Numbers of all sizes, a range where functions bend, neighbours of pi/2, 1 and -1."""
    generator = torch.Generator().manual_seed(0)
    low, high = (-1074, 1024) if dtype == torch.float64 else (-149, 128)
    power = torch.rand(count, generator=generator, dtype=torch.float64) * (high - low) + low
    sign = torch.where(torch.rand(count, generator=generator) < 0.5, -1.0, 1.0).double()
    sizes = sign * torch.exp2(power.clamp(max=1023.9))
    bend = torch.randn(count, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 30.0]).repeat(
        count // 2
    )
    turns = torch.arange(1, count // 4) * (math.pi / 2)
    near = torch.cat(
        [one + torch.linspace(-1e-3, 1e-3, count // 8, dtype=torch.float64) ** 3 for one in (1, -1)]
    )
    return torch.cat((sizes, bend, turns.double(), near)).to(dtype)


def units(found: float, exact: Any, digits: int, least: int, most: int) -> float:
    """The distance in units in the last place."""
    if not mpmath.isfinite(exact):
        return 0.0 if found == float(exact) else math.inf
    _, exponent = mpmath.frexp(exact) if exact else (0, least)
    unit = mpmath.mpf(2) ** max(exponent - digits, least)
    if abs(exact) >= mpmath.mpf(2) ** most - unit / 2:
        return 0.0 if math.isinf(found) and (found > 0) == (exact > 0) else math.inf
    return float(abs(mpmath.mpf(found) - exact) / unit) if math.isfinite(found) else math.inf


def exact(name: str, x: float, y: float) -> Any:
    at = mpmath.mpf(x)
    if name in ("log", "sqrt", "log1p") and at < (-1 if name == "log1p" else 0):
        return mpmath.nan
    if name == "log1p":
        return -mpmath.inf if at == -1 else mpmath.log(1 + at) if abs(at) > 1e-30 else at - at * at / 2
    if name == "expm1":
        return mpmath.expm1(max(at, -1000))
    if name == "sigmoid":
        return 1 / (1 + mpmath.exp(-at))
    if name == "tanh":
        return mpmath.tanh(at) if 1e-30 < abs(at) < 100 else at if abs(at) <= 1e-30 else mpmath.sign(at)
    if name == "atan2":
        return mpmath.atan2(at, mpmath.mpf(y))
    function: Callable[[Any], Any] = getattr(mpmath, name)
    return function(at)


@pytest.mark.parametrize("dtype", DTYPES)
def test_functions_are_within_their_bounds_over_the_whole_range(
    dtype: torch.dtype, program: lanes.Program
) -> None:
    x = points(dtype, 120)
    y = x.flip(0)
    assert program.compiles((), (), (x, y), steps=1)
    found = program((), (), (x, y), steps=1)[1]
    digits, least, most = (53, -1074, 1024) if dtype == torch.float64 else (24, -149, 128)
    with mpmath.workdps(60):
        for name, bounds in BOUNDS.items():
            wanted = [exact(name, *pair) for pair in zip(x.tolist(), y.tolist(), strict=True)]
            pairs = [
                (f, w, at) for f, w, at in zip(found[name][:, 0].tolist(), wanted, x.tolist(), strict=True)
            ]
            assert all(math.isnan(f) for f, w, _ in pairs if mpmath.isnan(w)), name
            worst = max((units(f, w, digits, least, most), at) for f, w, at in pairs if not mpmath.isnan(w))
            assert worst[0] <= bounds[DTYPES.index(dtype)], (name, worst)


@pytest.mark.parametrize("dtype", DTYPES)
def test_infinities_nan_zeros_and_subnormal_numbers_come_out_as_in_torch(
    dtype: torch.dtype, program: lanes.Program
) -> None:
    x, y = torch.cartesian_prod(*[torch.tensor(SPECIAL, dtype=torch.float64).to(dtype)] * 2).unbind(-1)
    found, wanted = program((), (), (x, y), steps=1)[1], program.definition((), (), (x, y), steps=1)[1]
    large = x.isfinite() & (x > 1)  # where the log1p of torch 2.6 is infinite at 1.7e308
    logarithms = torch.tensor([math.log1p(max(v, 0.0)) for v in x.tolist()], dtype=torch.float64)
    wanted["log1p"] = torch.where(large.unsqueeze(-1), logarithms.to(dtype).unsqueeze(-1), wanted["log1p"])
    for name in wanted:
        bound = 4 * torch.finfo(dtype).eps
        # torch itself flushes some subnormal results; the test above measures those of lanes.
        tiny = torch.finfo(dtype).tiny
        torch.testing.assert_close(found[name], wanted[name], rtol=bound, atol=tiny, equal_nan=True)
        numbers = ~wanted[name].isnan() & (wanted[name].abs() > tiny)
        if name not in ("max", "min"):  # which of 0 and -0 is the larger, torch itself answers either way
            numbers |= (x == 0).unsqueeze(-1) & (wanted[name] == 0)
        assert torch.equal(found[name].signbit()[numbers], wanted[name].signbit()[numbers]), name
